"""Laps driven by the policies of runs: for a replay, and for the commands of the fast ones."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.env.trace_columns import PACKED, STATUS_CODE
from deepracer_exp.errors import BadInput, count
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.evaluation.film import LapRecorder, best_attempt
from deepracer_exp.evaluation.race_protocol import Attempt
from deepracer_exp.evaluation.results import USUAL, Evaluation
from deepracer_exp.reports.tables.proposed_actions import Commands, fast_laps, fast_laps_in_words
from deepracer_exp.runs.checkpoint_files import checkpoint_words
from deepracer_exp.runs.checkpoints import StoredPolicy
from deepracer_exp.runs.stored_run import StoredRun

from .lap_replay import ReplayedLap, is_same_start


def laps_to_replay(
    run: StoredRun,
    protocol: EvaluationConfig,
    beside: ReplayedLap | None = None,
    ordinary: bool = False,
) -> list[ReplayedLap]:
    """Race a run's checkpoint under the usual conditions and return its fastest lap, or the one with most progress.

    The lap is one of those on the track of `beside` that began where it did, if there are any. `ordinary` adds the
    median of the other complete laps on the track, of those from the same start if there are any.

    Raises:
        BadInput: the checkpoint, a track or a condition cannot be used, or there is no other complete lap.
        RunFailed: a car's state became NaN.
    """
    stored, evaluator, recorder, evaluation = _raced(run, protocol)
    starts = np.array([trial.start_ndist for trial in evaluator.trials])
    course = np.array([trial.course for trial in evaluator.trials])
    here = np.ones(len(starts), bool)
    if beside is not None:
        tracks = [course.tracks[0] for course in evaluator.race.setup.courses]
        here = np.array([replace(beside, track=track).fits for track in tracks])[course]
        here = here if here.any() else ~here
        same = here & is_same_start(starts, beside)
        here = same if same.any() else here
    best = best_attempt(evaluation, {*np.flatnonzero(here).tolist()})
    chosen = [(best, "the fastest" if best.complete else "the farthest")]
    if ordinary:
        others = [
            attempt
            for attempt in evaluation.on(USUAL).attempts
            if attempt.complete and attempt is not best and course[attempt.trial] == course[best.trial]
        ]
        if not others:
            laps = count(int(best.complete), "complete lap")
            raise BadInput(
                f"{run.path.name}, {checkpoint_words(stored.path.name)}: {laps} in "
                f"{count(len(evaluator.trials), 'trial')}; accepted: more evaluation.trials, or another run or log "
                "beside it to replay against"
            )
        near = [attempt for attempt in others if starts[attempt.trial] == starts[best.trial]]
        chosen.append((_median(near or others), "an ordinary lap"))
    return [
        _replayed(recorder, attempt, run, f"{words} of {checkpoint_words(stored.path.name)}")
        for attempt, words in chosen
    ]


def commands_of_run(run: StoredRun) -> Commands:
    """Race a run's checkpoint as its training evaluates it, on the usual conditions; return its fast laps' commands.

    On several tracks the fast laps are those of each track.

    Raises:
        BadInput: the checkpoint cannot be used, or completes no lap without a reset.
        RunFailed: a car's state became NaN.
    """
    stored, _, recorder, evaluation = _raced(run, run.experiment.evaluation)
    words: list[str] = []
    steps: list[NDArray[np.float64]] = []
    for group in evaluation.groups:
        laps = [attempt for attempt in group.attempts if attempt.complete and not attempt.resets]
        if not laps:
            continue
        times_s = np.array([attempt.time_s for attempt in laps])
        fast = fast_laps(times_s)
        words.append(
            fast_laps_in_words(int(fast.sum()), len(laps), float(times_s.min()), f"on {group.track}")
        )
        steps += [recorder.rows(laps[number])[1] for number in np.flatnonzero(fast)]
    name = f"{run.path.name}, {checkpoint_words(stored.path.name)}"
    if not steps:
        tried = count(len(evaluation.on(USUAL).attempts), "lap")
        raise BadInput(name, f"completes none of {tried} without a reset", "a run that does")
    rows = np.concatenate(steps)
    # The prepare step has no command yet.
    rows = rows[rows[:, PACKED["episode_status"]] != STATUS_CODE["prepare"]]
    return Commands(
        laps="; ".join(words),
        steering_deg=rows[:, PACKED["steer"]],
        speed_mps=rows[:, PACKED["throttle"]],
    )


def _raced(
    run: StoredRun, protocol: EvaluationConfig
) -> tuple[StoredPolicy, Evaluator, LapRecorder, Evaluation]:
    """Race a checkpoint on the usual conditions and record every step."""
    stored = run.read_policy()
    torch.set_num_threads(1)
    evaluator = Evaluator(run.experiment, replace(protocol, held_out=None))
    recorder = LapRecorder(evaluator)
    return stored, evaluator, recorder, evaluator(stored.networks.policy, recorder)


def _median(attempts: Sequence[Attempt]) -> Attempt:
    return sorted(attempts, key=lambda attempt: attempt.time_s)[len(attempts) // 2]


def _replayed(recorder: LapRecorder, attempt: Attempt, run: StoredRun, words: str) -> ReplayedLap:
    lap = recorder.lap(attempt)
    return ReplayedLap(
        name=run.path.name,
        words=words,
        track=lap.track,
        lap_time_s=attempt.time_s if attempt.complete else np.nan,
        time_s=lap.time_s,
        x_m=lap.x_m,
        y_m=lap.y_m,
        yaw_deg=np.degrees(lap.yaw_rad),
        speed_mps=lap.speed_mps,
        steering_deg=np.degrees(lap.steering_rad),
        others=None if lap.others is None else lap.others[..., :2],
    )
