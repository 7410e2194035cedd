"""Evaluations of the policy while it is being trained."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from deepracer_exp.config.experiment import Experiment
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.evaluation.result import HELD_OUT, USUAL, Rank


@dataclass(frozen=True, kw_only=True)
class Mark:
    """What an evaluation said of a policy."""

    rank: Rank
    eval_completion: float
    """Per cent of the lap, mean over the laps tried on the usual conditions."""
    held_out_completion: float | None
    """The same on the held-out conditions; None where there are none."""
    eval_lap_time_s: float | None
    """Mean time of the complete laps on the usual conditions, over all tracks."""
    eval_lap_share: float
    """Complete laps per lap tried on the usual conditions, 0 to 1."""
    eval_race_score_s: float | None
    """Seconds per complete lap on all conditions, failed laps included; None without a lap on each track."""

    def columns(self) -> dict[str, float | None]:
        """Return what stands in a row of metrics.jsonl."""
        return {name: getattr(self, name) for name in COLUMNS}


COLUMNS = ("eval_completion", "held_out_completion", "eval_lap_share", "eval_lap_time_s", "eval_race_score_s")
NOT_EVALUATED: dict[str, float | None] = dict.fromkeys(COLUMNS)


class Examination:
    """The trials of group `evaluation`, driven by the policy every few iterations; the same trials each time."""

    def __init__(self, experiment: Experiment):
        """Read what is to be driven.

        Raises:
            BadInput: a track or a condition is unknown or malformed.
        """
        self._every = experiment.checkpoints.every
        self._metric = experiment.checkpoints.metric
        # The cars of the training rest meanwhile, so that all cores are free.
        self._evaluator = None if self._every is None else Evaluator(experiment, experiment.evaluation)

    @property
    def is_held(self) -> bool:
        """Whether there are evaluations at all."""
        return self._evaluator is not None

    def is_due(self, iteration: int) -> bool:
        """Return whether the policy is to be evaluated after so many updates."""
        return self._every is not None and iteration % self._every == 0

    def without_the_last(self, row: Mapping[str, Any]) -> dict[str, Any]:
        """Return a row of metrics.jsonl as it was before its policy was evaluated only because the run ended there."""
        return {**row} if self.is_due(row["iteration"]) else {**row, **NOT_EVALUATED}

    def __call__(self, policy: torch.nn.Module) -> Mark:
        """Evaluate the policy.

        Raises:
            RunFailed: an action or a car's state became NaN or infinite.
        """
        assert self._evaluator is not None
        evaluation = self._evaluator(policy)
        usual = evaluation.on(USUAL)
        has_held_out = HELD_OUT in evaluation.conditions
        return Mark(
            rank=evaluation.rank(self._metric),
            eval_completion=usual.completion,
            held_out_completion=evaluation.on(HELD_OUT).completion if has_held_out else None,
            eval_lap_share=usual.lap_share,
            eval_lap_time_s=usual.mean_lap_time_s,
            eval_race_score_s=evaluation.race_score_s,
        )
