"""Race a policy as the races of a log were driven: on its course, from its starts, as many laps in a row."""

from dataclasses import replace

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from rich.console import Console
from torch import nn

from deepracer_exp.analysis.log_course import catalogue_track, directed, numbered_as_logged, was_driven_on
from deepracer_exp.analysis.log_view import LogView
from deepracer_exp.analysis.statistics import subsample
from deepracer_exp.analysis.step_columns import first_rows, flying_rows
from deepracer_exp.aws.logs.recording import STEP_COLUMNS
from deepracer_exp.aws.worlds.catalogue import find_world
from deepracer_exp.config.compose import compose_evaluation, compose_experiment
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.overrides import override_line
from deepracer_exp.config.track import TrackConfig
from deepracer_exp.env.trace import to_table
from deepracer_exp.errors import BadInput, count
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.evaluation.film import LapRecorder
from deepracer_exp.lookup.resolve import StoredRun
from deepracer_exp.reports.against_log import AgainstLog, laps_on, logged_laps
from deepracer_exp.tracks.track import Track

STREAM = "simulated"
MOST_STARTS = 20
"""Starts of a log that are driven, evenly chosen: without randomisation equal starts give equal laps."""
_TIME_LIMIT = 3.0
"""How much longer than the longest logged race a simulated one may take, ..."""
_LEAST_S = 60.0
"""... and this long in any case."""


def race_against_log(run: StoredRun, view: LogView, course_name: str | None, err: Console) -> AgainstLog:
    """Race the policy of a run's chosen checkpoint as the laps of a log, which `prepare_races` returned, were driven.

    `course_name` is the name or the file of the course; None: that of the log.

    Raises:
        BadInput: the log has no lap to compare, its course is unknown, or the checkpoint cannot be used.
        RunFailed: a car's state became NaN or infinite.
    """
    config, track = course_driven(view, run.experiment, course_name)
    course = numbered_as_logged(track, view.steps)
    logged = logged_laps(view, course)
    stored = run.read_policy()
    torch.set_num_threads(1)
    err.print(
        f"{run.path.name}, checkpoint {stored.path.name}: races as {view.name} was driven", soft_wrap=True
    )
    steps = race_as_logged(run.experiment, stored.networks.policy, config, track, logged.steps)
    simulated = laps_on(course, steps, "")
    words = f"{count(len(simulated.episodes), 'lap')} of checkpoint {stored.path.name} from the same starts"
    return AgainstLog(course=course, logged=logged, simulated=replace(simulated, words=words))


def course_driven(
    view: LogView, experiment: Experiment, course_name: str | None = None
) -> tuple[TrackConfig, Track]:
    """Return the course of a log, in the direction it was driven.

    It is that of `course_name`, else the world that the log names or that its positions show, else one of the
    experiment's.

    Raises:
        BadInput: it is none of them.
    """
    candidates: list[TrackConfig] = []
    named = course_name or (view.course.name if view.course is not None else view.track_name)
    if find_world(named) is not None:
        candidates += compose_experiment([override_line("track", find_world(named))])[0].tracks.values()
    elif course_name is not None:
        catalogue_track(course_name)  # names what is wrong with it
        candidates += compose_experiment([override_line("track.file", course_name)])[0].tracks.values()
    for config in candidates if course_name is not None else (*candidates, *experiment.tracks.values()):
        forward, backward = (Track.from_config(config, reversed=back) for back in (False, True))
        if was_driven_on(forward, view.steps):
            track = directed(forward, backward, view.steps)
            return replace(config, direction="reversed" if track is backward else "forward"), track
    length_m = float(view.steps["track_len"].median())
    if course_name is not None:
        raise BadInput(
            f"--track {course_name}", f"is not where the car of {view.name} drove ({length_m:.2f} m)"
        )
    raise BadInput(
        f"{view.name}: its track {view.track_name!r} ({length_m:.2f} m) is none of the service's worlds and none that "
        "the run was trained on; accepted: --track with the file of its route (.npy)"
    )


def race_as_logged(
    experiment: Experiment, policy: nn.Module, config: TrackConfig, track: Track, logged: pd.DataFrame
) -> pd.DataFrame:
    """Race a policy from the starts of a log, its most probable actions, without randomisation.

    From each start it drives as many laps in a row as the log. A car that leaves the track is put back with the
    service's penalty.

    Args:
        experiment: car, action space and observation.
        policy: reads what the experiment observes, writes `action`.
        config: the course, in the direction to drive.
        track: the same, built.
        logged: steps of the log's laps, `recording.STEP_COLUMNS`.

    Returns:
        The steps of all laps, `recording.STEP_COLUMNS`, as the service's trace has them: laps without a stop between
        them count their steps on.

    Raises:
        RunFailed: an action or a car's state became NaN or infinite.
    """
    starts, laps, longest_s = _races(logged, track)
    protocol = compose_evaluation(["evaluation=aws_virtual"])[0].evaluation
    protocol = replace(
        protocol,
        laps=int(laps.max()),
        time_s=min(max(_LEAST_S, _TIME_LIMIT * longest_s), 3600.0),
        trials=len(starts),
        starts=tuple(starts.tolist()),
        tracks=None,
        usual="none",
        held_out=None,
    )
    evaluator = Evaluator(replace(experiment, track=config), protocol, threads=1)
    recorder = LapRecorder(evaluator)
    attempts = evaluator(policy, recorder).groups[0].attempts
    kept = [
        attempt
        for trial in range(len(starts))
        for attempt in [each for each in attempts if each.trial == trial][: laps[trial]]
    ]
    tables = []
    for number, attempt in enumerate(kept):
        first = int(attempt.begin_s > 0)  # the first step of a flying lap is the last of the one before
        numbers, packed = recorder.rows(attempt)
        numbers, packed = numbers[first:], packed[first:]
        steps = to_table(packed[:, :-1], 0, [config.name]).to_pandas()
        tables.append(
            steps.assign(
                stream=STREAM,
                worker=0,
                episode=number,
                steps=numbers + 1,
                tstamp=packed[:, -1],
                done=np.arange(len(steps)) == len(steps) - 1,
                wall_clock=np.nan,
            )
        )
    kinds = {name: kind for name, (kind, _) in STEP_COLUMNS.items()}
    return pd.concat(tables, ignore_index=True)[list(STEP_COLUMNS)].astype(kinds)


def _races(logged: pd.DataFrame, track: Track) -> tuple[NDArray[np.float64], NDArray[np.intp], float]:
    """Return where the log's races start (n,), how many laps each of them has, and the longest one's seconds."""
    first = first_rows(logged)
    standing = np.flatnonzero(first & ~flying_rows(logged))
    laps = np.add.reduceat(first.astype(np.intp), standing)
    front = track.project(logged[["X", "Y"]].to_numpy(np.float64)[standing])
    starts = (front.ndist - logged["progress"].to_numpy(np.float64)[standing] / 100.0) % 1.0
    ends = np.append(standing[1:], len(logged)) - 1
    time_s = logged["tstamp"].to_numpy(np.float64)
    chosen = subsample(len(starts), MOST_STARTS)
    return (
        np.minimum(starts, np.nextafter(1.0, 0.0))[chosen],
        laps[chosen],
        float((time_s[ends] - time_s[standing]).max()),
    )
