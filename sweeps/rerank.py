"""Re-ranking: the best trials of a sweep raced again, on laps that did not choose them."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.trial import FrozenTrial

from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.evaluation.evaluator import Evaluator, OnStep
from deepracer_exp.evaluation.result import HELD_OUT, USUAL, Evaluation, Group
from deepracer_exp.runs.checkpoints import read_checkpoint
from deepracer_exp.runs.resolve import resolve

from .best import complete_trials
from .objectives import cost, values_of, without_lap
from .worker_config import WorkerConfig

_SEED = 30_011
"""Seed of the conditions; no protocol of the project has it."""
_SHIFT = 0.25
"""Shift of the starting positions, as a share of their distance."""
_RESAMPLES = 2000
_CONFIDENCE = 0.95


def fresh(protocol: EvaluationConfig, trials: int) -> EvaluationConfig:
    """Return a protocol with starting positions and random draws that no evaluation of the sweep had."""
    starts = tuple((place + _SHIFT) / trials for place in range(trials))
    return replace(protocol, trials=trials, seed=_SEED, starts=starts)


def rerank(
    worker_config: WorkerConfig, study: optuna.Study, on_next: Callable[[FrozenTrial], None], on_step: OnStep
) -> list[dict[str, Any]]:
    """Race the best checkpoints of the best trials on fresh laps; return their results, the best first.

    `values` are means over a trial's runs. `interval` is the 95 per cent interval of the first of them, by bootstrap
    over laps: of these policies, not of further trainings. `on_next` is called with each trial before its laps,
    `on_step` after each control step; what they raise ends it.
    """
    config = worker_config.config
    protocol = fresh(worker_config.protocol, config.rerank_laps)
    found = []
    for trial in complete_trials(study)[: config.rerank]:
        on_next(trial)
        driven = [_driven(Path(run["run_dir"]), protocol, on_step) for run in trial.user_attrs["runs"]]
        found.append(_reranked(trial.number, driven, config.objectives, protocol.time_s))
    return sorted(found, key=lambda one: cost(config.objectives, one["values"]))


def interval_of(evaluations: Sequence[Evaluation], objective: str, trial_time_s: float) -> list[float]:
    """Return the bootstrap interval of an objective; trials are resampled within each track and each evaluation.

    `trial_time_s` is the longest that a trial of an evaluation may take.
    """
    groups = [group for one in evaluations for group in one.groups if group.condition == USUAL]
    rng = np.random.default_rng(0)
    draws = np.mean([_draws(group, objective, trial_time_s, rng) for group in groups], axis=0)
    tail = 100 * (1 - _CONFIDENCE) / 2
    return np.percentile(draws, [tail, 100 - tail]).tolist()


def _draws(
    group: Group, objective: str, trial_time_s: float, rng: np.random.Generator
) -> "np.ndarray[Any, np.dtype[np.float64]]":
    """Return the objective's value in each resample, (n,)."""
    column = {trial: at for at, trial in enumerate(group.trials)}
    sums = np.zeros((4, len(column)))  # laps tried, complete laps, counted time, progress
    for attempt in group.decided:
        time_s = attempt.time_s if objective == "race_score" or attempt.complete else 0.0
        sums[:, column[attempt.trial]] += (1, attempt.complete, time_s, attempt.progress)
    drawn = sums[:, rng.integers(len(column), size=(_RESAMPLES, len(column)))].sum(axis=2)
    tried, laps, time_s, progress = drawn
    completion = progress / tried
    if objective == "completion":
        return completion
    fallback = np.array([without_lap(one, trial_time_s) for one in completion])
    return np.where(laps > 0, time_s / np.maximum(laps, 1), fallback)


def _driven(run_dir: Path, protocol: EvaluationConfig, on_step: OnStep) -> Evaluation:
    run = resolve(str(run_dir), run_dir.parent, None)
    stored = read_checkpoint(run.experiment, run.checkpoints, run.choose_checkpoint(None))
    return Evaluator(run.experiment, protocol)(stored.networks.policy, on_step)


def _reranked(
    number: int, driven: Sequence[Evaluation], objectives: Sequence[str], trial_time_s: float
) -> dict[str, Any]:
    times = [time for one in driven if (time := one.on(USUAL).mean_lap_time_s) is not None]
    held_out = [one.on(HELD_OUT).completion for one in driven if HELD_OUT in one.conditions]
    return {
        "trial": number,
        "values": np.mean([values_of(one, objectives, trial_time_s) for one in driven], axis=0).tolist(),
        "interval": interval_of(driven, objectives[0], trial_time_s),
        "lap_time_s": float(np.mean(times)) if times else None,
        "completion": float(np.mean([one.on(USUAL).completion for one in driven])),
        "held_out_completion": float(np.mean(held_out)) if held_out else None,
    }
