"""Fresh laps of a study: its best policies race from starts and with random draws unseen in the sweep."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import optuna
from numpy.typing import NDArray
from optuna.trial import FrozenTrial

from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.evaluation.results import HELD_OUT, USUAL, Evaluation, TrialGroup
from deepracer_exp.runs.stored_run import StoredRun
from deepracer_exp.sweeps.report.best_trial import FreshLaps, complete_trials, has_runs

from .queue.worker_config import WorkerConfig
from .search.objectives import cost, objective_values, without_lap
from .trial import Trial

if TYPE_CHECKING:
    from deepracer_exp.evaluation.evaluator import OnStep

_SEED = 30_011
"""Seed of the conditions of fresh laps; no protocol of the project has it, nor the one after it."""
_SHIFTS = 0.25, 0.625
"""Shifts of the starting positions of both draws, as a share of the distance between two."""
_RESAMPLES = 2000
_CONFIDENCE = 0.95


def fresh(protocol: EvaluationConfig, trials: int, *, again: bool = False) -> EvaluationConfig:
    """Return a protocol with starting positions and random draws that no evaluation of the sweep had.

    `again` gives a second set, for a choice among policies that the first set has selected.
    """
    starts = tuple((place + _SHIFTS[again]) / trials for place in range(trials))
    return replace(protocol, trials=trials, seed=_SEED + again, starts=starts)


def rerank(
    worker_config: WorkerConfig,
    study: optuna.Study,
    on_next: Callable[[FrozenTrial], None],
    on_step: "OnStep",
) -> list[FreshLaps]:
    """Race the best checkpoints of the best trials on fresh laps; return their results, the best first.

    The interval is a bootstrap over laps: of these policies, not of further trainings. A trial whose runs were deleted
    is left out. `on_next` is called with each trial before its laps, `on_step` after each control step; what they raise
    ends it.
    """
    config = worker_config.config
    protocol = fresh(worker_config.protocol, config.rerank_laps)
    fresh_laps = []
    there = [trial for trial in complete_trials(study) if has_runs(trial, worker_config.folder)]
    for trial in there[: config.rerank]:
        on_next(trial)
        runs = Trial.of(trial).runs
        driven = [drive_fresh(run.folder(worker_config.folder), protocol, on_step)[0] for run in runs]
        fresh_laps.append(_reranked(trial.number, driven, config.objectives, protocol.time_s))
    return sorted(fresh_laps, key=lambda laps: cost(config.objectives, laps.values))


def interval_of(evaluations: Sequence[Evaluation], objective: str, trial_time_s: float) -> list[float]:
    """Return the bootstrap interval of an objective; trials are resampled within evaluation, track and condition.

    The race score counts the laps of all conditions, the other objectives those of the usual ones (`objective_values`).
    `trial_time_s` is the longest that a trial of an evaluation may take.
    """
    rng = np.random.default_rng(0)
    counted = [
        [
            [
                group
                for group in evaluation.groups
                if group.track == track and (objective == "race_score" or group.condition == USUAL)
            ]
            for track in evaluation.tracks
        ]
        for evaluation in evaluations
    ]
    draws = np.mean([_draws(by_track, objective, trial_time_s, rng) for by_track in counted], axis=0)
    tail = 100 * (1 - _CONFIDENCE) / 2
    return np.percentile(draws, [tail, 100 - tail]).tolist()


def _draws(
    by_track: Sequence[Sequence[TrialGroup]], objective: str, trial_time_s: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return the objective's value in each resample, (n,), the mean over tracks; times need a lap on each."""
    if objective == "zigzag":
        return np.mean([_zigzag_draws(groups, rng) for groups in by_track], axis=0)
    drawn = [np.sum([_resampled(group, objective, rng) for group in groups], axis=0) for groups in by_track]
    tried, laps, time_s, progress = np.stack(drawn, axis=1)
    completion = np.mean(progress / tried, axis=0)
    if objective == "completion":
        return completion
    fallback = np.array([without_lap(share, trial_time_s) for share in completion])
    return np.where((laps > 0).all(axis=0), np.mean(time_s / np.maximum(laps, 1), axis=0), fallback)


def _zigzag_draws(groups: Sequence[TrialGroup], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return changes of steering a metre in each resample of the trials, (n,)."""
    zigzags = [zigzag for group in groups for zigzag in group.zigzags]
    sums = np.array([(zigzag.changes, zigzag.straight_m) for zigzag in zigzags]).T
    changes, straight_m = sums[:, rng.integers(len(zigzags), size=(_RESAMPLES, len(zigzags)))].sum(axis=2)
    return changes / np.maximum(straight_m, 1.0)


def _resampled(group: TrialGroup, objective: str, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return laps tried, complete laps, counted time and progress in each resample of the trials, (4, n)."""
    column = {trial: place for place, trial in enumerate(group.trials)}
    sums = np.zeros((4, len(column)))
    for attempt in group.decided:
        time_s = attempt.time_s if objective == "race_score" or attempt.complete else 0.0
        sums[:, column[attempt.trial]] += (1, attempt.complete, time_s, attempt.progress)
    return sums[:, rng.integers(len(column), size=(_RESAMPLES, len(column)))].sum(axis=2)


def drive_fresh(run_dir: Path, protocol: EvaluationConfig, on_step: "OnStep") -> tuple[Evaluation, str]:
    """Let the best checkpoint of a run drive; return the result and the checkpoint's name.

    Raises:
        BadInput: the run has no checkpoint that can be used.
        RunFailed: an action or a car's state became NaN or infinite.
    """
    # PyTorch takes seconds to import, and the workers start first.
    from deepracer_exp.evaluation.evaluator import Evaluator

    run = StoredRun(run_dir).with_checkpoint()
    stored = run.read_policy()
    return Evaluator(run.experiment, protocol)(stored.networks.policy, on_step), stored.path.name


def _reranked(
    number: int, driven: Sequence[Evaluation], objectives: Sequence[str], trial_time_s: float
) -> FreshLaps:
    usual = [evaluation.on(USUAL) for evaluation in driven]
    times_s = [laps.mean_lap_time_s for laps in usual if laps.mean_lap_time_s is not None]
    held_out = [race.on(HELD_OUT).completion for race in driven if HELD_OUT in race.conditions]
    values = [objective_values(evaluation, objectives, trial_time_s) for evaluation in driven]
    return FreshLaps(
        trial=number,
        values=np.mean(values, axis=0).tolist(),
        interval=interval_of(driven, objectives[0], trial_time_s),
        lap_time_s=float(np.mean(times_s)) if times_s else None,
        completion=float(np.mean([laps.completion for laps in usual])),
        held_out_completion=float(np.mean(held_out)) if held_out else None,
    )
