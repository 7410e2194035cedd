"""Recordings of drives that never were: their lap times, mistakes and curves are known by construction."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pandas as pd

from deepracer_exp.aws.logs.recorded import METRICS_COLUMNS, STEP_COLUMNS, UPDATE_COLUMNS, Recording
from deepracer_exp.aws.models.model_metadata import Action, ModelMetadata
from deepracer_exp.reports.tables.log_course import catalogue_track
from deepracer_exp.reports.tables.step_columns import FRONT_TO_REAR_AXLE_M
from deepracer_exp.tracks.sectors import waypoint_positions
from deepracer_exp.tracks.track import Track

COURSE = "reinvent_base"
STEERING_DEG = (-20.0, 0.0, 20.0)
HZ = 15.0
FINE = np.linspace(0.0, 1.0, 20001)
"""Places of a lap between which the speed is constant."""
OFF_ROWS = 6
"""Rows in which a car that runs off leaves the centre line."""


@dataclass(frozen=True, kw_only=True)
class Drive:
    """One episode: along the centre line at a known speed, to the end of the lap or off the road."""

    speed_mps: float = 1.5
    iteration: int = 0
    start: float = 0.0
    """Share of the course at which it starts."""
    sections: tuple[tuple[float, float, float], ...] = ()
    """Where on the course (from, to) another speed is driven, m/s."""
    until: float = 1.0
    """Share of the lap after which the recording of the episode stops; 1: the lap is complete."""
    off_at: int | None = None
    """Waypoint at which it runs off to the outside, towards less steering than commanded unless `spins`."""
    spins: bool = False
    """Whether it runs off because its tail comes round."""
    offset_m: float = 0.0
    """Beside the centre line, positive to the left."""
    wanders: tuple[tuple[float, float], ...] = ()
    """Where on the course (from, to) its steering is drawn by chance."""

    def lap_time_s(self) -> float:
        """Return the time of the complete lap on `COURSE`, which begins one step before its first row."""
        return float(self._passed_s(made_up_course().length_m)[-1]) + 1 / HZ

    def _passed_s(self, length_m: float) -> np.ndarray:
        """Return the time at each of the places `FINE` of the lap."""
        speed = self._speed((self.start + (FINE[1:] + FINE[:-1]) / 2) % 1.0)
        return np.r_[0.0, np.cumsum(np.diff(FINE) * length_m / speed)]

    def _speed(self, place: np.ndarray) -> np.ndarray:
        speed = np.full(len(place), self.speed_mps)
        for begin, end, other in self.sections:
            speed[(place >= begin) & (place < end)] = other
        return speed


@cache
def made_up_course(name: str = COURSE) -> Track:
    return catalogue_track(name)


def made_up_recording(
    drives: Sequence[Drive],
    *,
    course: str = COURSE,
    entropy: Sequence[float] = (),
    evaluated: Sequence[float] = (),
    evaluations: Mapping[str, Sequence[Drive]] | None = None,
    name: str = "made_up",
) -> Recording:
    """Make the recording of a training.

    Args:
        drives: its episodes, in their order.
        course: of the catalogue.
        entropy: nats, of the policy update of each iteration.
        evaluated: completion in per cent of the five evaluation episodes after each iteration.
        evaluations: drives of other streams.
        name: of the recording.
    """
    dice = np.random.default_rng(0)
    everything = [("training", drives), *(evaluations or {}).items()]
    speeds = tuple(sorted({speed for _, some in everything for one in some for speed in _speeds(one)}))
    tables = []
    for stream, some in everything:
        clock_s = 20.0
        for episode, drive in enumerate(some):
            same = replace(drive, iteration=0)
            rows = _rows(course, same, speeds, dice) if drive.wanders else _drawn_once(course, same, speeds)
            time_s = rows["tstamp"] + clock_s
            clock_s = time_s[-1] + 0.05
            of = {"stream": stream, "episode": episode, "iteration": drive.iteration}
            tables.append(rows | {"tstamp": time_s} | {key: np.full(len(time_s), of[key]) for key in of})
    steps = pd.DataFrame({key: np.concatenate([rows[key] for rows in tables]) for key in tables[0]})
    steps = steps.assign(
        worker=0, pause_duration=0.0, track=course, track_len=made_up_course(course).length_m
    )
    for column in ("obstacle_crash_counter", "wall_clock", "speed_mps"):
        steps[column] = np.nan
    updates = pd.DataFrame(
        {"iteration": range(len(entropy)), "epoch": 0, "policy_loss": -0.02, "value_loss": np.nan}
        | {"kl": 0.01, "entropy": list(entropy), "lr": 3e-4}
    )
    return Recording(
        name=name,
        steps=typed(steps, STEP_COLUMNS),
        updates=typed(updates, UPDATE_COLUMNS),
        metrics=_evaluated(drives, evaluated),
        metadata=ModelMetadata(actions=tuple(Action(angle, v) for v in speeds for angle in STEERING_DEG)),
        hyperparameters={"discount_factor": 0.99},
        reward_source=None,
        track=course,
        problems=(),
        files=(),
    )


def _speeds(drive: Drive) -> list[float]:
    return [drive.speed_mps, *(speed for _, _, speed in drive.sections)]


@cache
def _drawn_once(course: str, drive: Drive, speeds: tuple[float, ...]) -> dict[str, np.ndarray]:
    """Return the rows of a drive that nothing is drawn by chance for: trainings repeat the same ones."""
    return _rows(course, drive, speeds, np.random.default_rng())


def _rows(
    course: str, drive: Drive, speeds: tuple[float, ...], dice: np.random.Generator
) -> dict[str, np.ndarray]:
    track = made_up_course(course)
    passed_s = drive._passed_s(track.length_m)
    until = drive.until
    if drive.off_at is not None:
        until = (waypoint_positions(track)[drive.off_at] - drive.start) % 1.0
    end_s = float(np.interp(until, FINE, passed_s))
    time_s = np.r_[np.arange(0.0, end_s - 0.5 / HZ, 1.0 / HZ), end_s]
    gone = np.interp(time_s, passed_s, FINE)
    gone[-1] = until
    place = (drive.start + gone) % 1.0
    turns = _turns(track, place)
    steering = np.where(np.abs(turns) < 0.15, 0.0, 20.0 * np.sign(turns))
    for begin, end in drive.wanders:
        here = (place >= begin) & (place < end)
        steering[here] = dice.choice(STEERING_DEG, here.sum())
    offset_m, yaw_rad = np.full(len(gone), drive.offset_m), _heading(track, place)
    complete, off = until >= 1.0 and drive.off_at is None, drive.off_at is not None
    if off:
        leaving = np.clip((np.arange(len(gone)) - len(gone) + 1) / OFF_ROWS + 1.0, 0.0, 1.0)
        side = 1.0 if turns[-1] >= 0 else -1.0
        offset_m -= side * (track.width_max_m / 2 + 0.15) * leaving**2
        steering = np.where(leaving > 0, 0.0 if drive.spins else 20.0 * side, steering)
    xy = track.points_at(place) + offset_m[:, None] * np.column_stack([-np.sin(yaw_rad), np.cos(yaw_rad)])
    yaw_rad = _towed(xy, yaw_rad[0])
    if off and drive.spins:
        yaw_rad = yaw_rad + side * 1.5 * leaving**2
    found = track.project(xy)
    near = [np.linalg.norm(xy - track.waypoints[k], axis=1) for k in (found.previous, found.next)]
    throttle = drive._speed(place)
    status = np.array(["in_progress"] * len(gone), dtype=object)
    status[0] = "prepare"
    if complete or off:
        status[-1] = "lap_complete" if complete else "off_track"
    return {
        "steps": np.arange(1, len(gone) + 1),
        "X": xy[:, 0],
        "Y": xy[:, 1],
        "yaw": np.degrees((yaw_rad + np.pi) % (2 * np.pi) - np.pi),
        "steer": steering,
        "throttle": throttle,
        "action": len(STEERING_DEG) * np.searchsorted(speeds, throttle)
        + np.searchsorted(STEERING_DEG, steering),
        "reward": np.diff(100.0 * gone, prepend=0.0),
        "done": (np.arange(len(gone)) == len(gone) - 1) & (complete or off),
        "all_wheels_on_track": np.abs(offset_m) < track.width_min_m / 2 - 0.1,
        "progress": 100.0 * gone,
        "closest_waypoint": np.where(near[0] <= near[1], found.previous, found.next),
        "tstamp": time_s,
        "episode_status": status,
    }


def _towed(xy: np.ndarray, yaw_rad: float) -> np.ndarray:
    """Return the yaw of a car whose front moves through places while its rear wheels roll without slip."""
    yaws, rear = [yaw_rad], xy[0] - FRONT_TO_REAR_AXLE_M * np.array([np.cos(yaw_rad), np.sin(yaw_rad)])
    for front in xy[1:]:
        ahead = (front - rear) / np.linalg.norm(front - rear)
        rear = front - FRONT_TO_REAR_AXLE_M * ahead
        yaws.append(float(np.arctan2(ahead[1], ahead[0])))
    return np.unwrap(yaws)


def _heading(track: Track, place: np.ndarray) -> np.ndarray:
    """Return the direction of the road at places, without the jumps of its centre line's corners."""
    around = [_beside(track, place, d) for d in np.linspace(-0.012, 0.012, 9)]
    heading = np.unwrap(np.stack([track.start_pose(at).yaw_rad for at in around]), axis=0).mean(axis=0)
    return np.unwrap(heading)


def _beside(track: Track, place: np.ndarray, distance: float) -> np.ndarray:
    return place + distance if track.closed else np.clip(place + distance, 0, 1)


def _turns(track: Track, place: np.ndarray) -> np.ndarray:
    """Return the centre line's curvature around places, 1/m, positive to the left."""
    yaw = [track.start_pose(_beside(track, place, d)).yaw_rad for d in (-0.01, 0.01)]
    return ((yaw[1] - yaw[0] + np.pi) % (2 * np.pi) - np.pi) / (0.02 * track.length_m)


def _evaluated(drives: Sequence[Drive], evaluated: Sequence[float]) -> pd.DataFrame:
    last = {drive.iteration: episode for episode, drive in enumerate(drives)}
    rows = [
        {"iteration": k, "episode": last[k], "trial": trial, "reward": completion, "completion": completion}
        for k, completion in enumerate(evaluated)
        for trial in range(1, 6)
    ]
    more = {"stream": "training", "worker": 0, "phase": "evaluation", "time_s": 10.0}
    more |= {"episode_status": "Off track", "resets": np.nan}
    return typed(pd.DataFrame(rows, columns=list(METRICS_COLUMNS)).assign(**more), METRICS_COLUMNS)


def typed(table: pd.DataFrame, columns: Mapping[str, tuple[str, str]]) -> pd.DataFrame:
    return table[list(columns)].astype({name: kind for name, (kind, _) in columns.items()})
