"""Stored policies raced on fresh laps, by which none of them was chosen."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import nn

from deepracer_exp.config.compose import compose_evaluation
from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.evaluation.results import HELD_OUT, USUAL, Evaluation
from deepracer_exp.runs.stored_run import StoredRun

TRIALS = 64
_SEED = 20_181_128
"""Seed of the held-out conditions; a training's evaluations have 0."""
_SHIFT = 0.25
"""Shift of the starts, as a share of the distance between them: evaluations of a training start at multiples of an
eighth or a sixteenth of the lap."""


@dataclass(frozen=True, kw_only=True)
class Driven:
    """How a policy drove single laps from standing starts all around the track."""

    completion: float
    """Per cent of the lap, mean; usual conditions."""
    lap_share: float
    """Share of complete laps."""
    lap_time_s: float | None
    """Mean of the complete laps, None without one."""
    held_out_completion: float
    """Completion on held-out conditions (other friction, noise, delays), per cent of the lap, mean."""
    held_out_lap_time_s: float | None

    def figures(self) -> dict[str, float | None]:
        """Return the figures for JSON."""
        return {key: None if value is None else round(value, 4) for key, value in asdict(self).items()}

    def named(self, which: str) -> dict[str, float | None]:
        """Return the figures for JSON, `which` in their names: completion_kept."""
        return {f"{key}_{which}": value for key, value in self.figures().items()}


def protocol(*overrides: str) -> EvaluationConfig:
    """Return the evaluation that overrides of `deepracer-exp evaluate` describe."""
    return compose_evaluation(overrides)[0].evaluation


def fresh_trials(trials: int, option: str = "three_trials") -> EvaluationConfig:
    """Return an option of conf/evaluation with single laps whose starts and conditions no training's evaluation has."""
    starts = ",".join(repr((place + _SHIFT) / trials) for place in range(trials))
    conditions = (f"evaluation.seed={_SEED}", f"evaluation.starts=[{starts}]")
    return protocol(f"evaluation={option}", f"evaluation.trials={trials}", *conditions)


def stored_policy(run: Path, checkpoint: str | None = None) -> tuple[Experiment, nn.Module]:
    """Return a run's experiment and a policy of it; None: the best, or the last of a run too short to be ranked."""
    stored = StoredRun(run).with_checkpoint(checkpoint)
    return stored.experiment, stored.read_policy().networks.policy


def drive(run: Path, checkpoints: Sequence[str | None], trials: int = TRIALS) -> list[Driven]:
    """Let policies of a run drive the fresh trials.

    Args:
        run: its folder.
        checkpoints: as for `stored_policy`.
        trials: on each of usual and held-out conditions.
    """
    torch.set_num_threads(1)
    stored = [stored_policy(run, name) for name in checkpoints]
    evaluator = Evaluator(stored[0][0], fresh_trials(trials))
    return [driven(evaluator(policy)) for _, policy in stored]


def driven(evaluation: Evaluation) -> Driven:
    """Return the figures of an evaluation."""
    usual, held_out = evaluation.on(USUAL), evaluation.on(HELD_OUT)
    return Driven(
        completion=usual.completion,
        lap_share=sum(attempt.complete for attempt in usual.attempts) / len(usual.attempts),
        lap_time_s=usual.mean_lap_time_s,
        held_out_completion=held_out.completion,
        held_out_lap_time_s=held_out.mean_lap_time_s,
    )
