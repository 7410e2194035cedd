"""Derived columns of a recording's steps, and the first rows of episodes, laps and resets."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from deepracer_exp.aws.logs.recorded import TRAINING
from deepracer_exp.env.rules import lap_clock_s
from deepracer_exp.env.state import STILL_M
from deepracer_exp.jit import njit
from deepracer_exp.tracks.track import Track

from .statistics import MOST_ROWS, Values, subsample

DERIVED_COLUMNS: Mapping[str, str] = {
    "lap_clock_s": "s since the lap began, as the service counts a lap time (`rules.lap_clock_s`)",
    "delta_time_s": "s since the row before; 0 in an episode's first row except on a flying lap; likewise the others",
    "delta_dist_m": "m from the row before; 0 in an episode's first row",
    "track_speed_mps": "m/s, distance over time of five steps around (`SPEED_STEPS`); NaN in an episode's first row",
    "progress_speed_pps": "per cent of the lap a second, likewise",
    "acceleration_mps2": "m/s2 of growing track speed, between the rows before and after; 0 where it falls",
    "braking_mps2": "m/s2 of falling track speed, likewise, positive; 0 where it grows",
    "yaw_rate_dps": "degrees a second, likewise, positive to the left",
    "true_bearing_deg": "degrees, -180 to 180, direction in which the logged point moved since the row before",
    "slide_deg": "degrees, direction in which the rear axle moved since the row before minus the mean of both yaws; "
    "0 for tyres that do not slip, positive where the tail goes to the left",
    "skew_deg": "degrees, direction of travel minus that of the centre line, positive to the left",
    "lap_position": "0 to 1, normalised projection on the centre line in driving direction; without a course "
    "computed from progress and the waypoint of the start",
    "offset_m": "m from the centre line, positive to the left of the driving direction",
    "discounted_future_reward": "reward units, of this row and all later ones of the episode, discounted",
}
"""Names of the columns that `add_derived` adds, with meaning and unit."""
SPEED_STEPS = 5
"""Window of the speed in control steps: their distance over their time, two steps on either side of the step itself.

Steps last 20 to 110 ms by the time stamps, but positions are not of those moments: of single steps up to 38% are above
the fastest command, up to 20 m/s. By a constant period the fast recordings of version 6 would reach 16 m/s, since it
skips frames.
"""
_JUMP_M, _JUMP_MPS = 1.0, 10.0
"""A step that is longer and faster was not driven: version 6 logs prepare rows at the place of the episode before."""
CONTROL_PERIOD_S = 1 / 15
"""The service's, for recordings without two rows in succession."""
FRONT_TO_REAR_AXLE_M = 0.14 + 0.081663
"""Distance from the logged point to the rear axle (deepracer-simapp: front point, rear wheels of the model)."""
STOPPED = ("off_track", "crashed", "immobilized", "reversed")
"""Status of the rows after which a car is put back, or the episode ends."""
FIRST_STEPS = 2
"""Highest step number of an episode's first row: formats without prepare rows may begin with 2."""


def add_derived(steps: pd.DataFrame, course: Track | None, discount: float) -> pd.DataFrame:
    """Return the steps with `DERIVED_COLUMNS`.

    The rows of each episode are contiguous and in the order of time; `discount` is the factor on the reward of the next
    step.
    """
    x, y, yaw, time_s, progress, reward = (
        steps[name].to_numpy(np.float64) for name in ("X", "Y", "yaw", "tstamp", "progress", "reward")
    )
    first = first_rows(steps)
    lap_position, offset_m, center_deg = _places(steps, first, course)
    stopped = first & ~flying_rows(steps)
    derived = dict(
        zip(_MOVED, _moved((x, y, yaw), time_s, progress, first, stopped, center_deg), strict=True)
    )
    faster, slower = _change(derived["track_speed_mps"], time_s, stopped)
    derived |= {
        "lap_clock_s": _lap_clock(steps, stopped, first, derived["delta_time_s"]),
        "acceleration_mps2": faster,
        "braking_mps2": slower,
        "lap_position": lap_position,
        "offset_m": offset_m,
        "discounted_future_reward": _discounted(reward, first, discount),
    }
    return with_columns(steps, {name: derived[name] for name in DERIVED_COLUMNS})


def with_columns(rows: pd.DataFrame, more: Mapping[str, Values]) -> pd.DataFrame:
    """Return rows with more columns, none of which is copied, as `assign` would."""
    columns: dict[str, Any] = {name: rows[name].array for name in rows} | dict(more)
    return pd.DataFrame(columns, index=rows.index, copy=False)


_MOVED = (
    *("delta_time_s", "delta_dist_m", "track_speed_mps", "progress_speed_pps", "yaw_rate_dps"),
    *("true_bearing_deg", "slide_deg", "skew_deg"),
)


@njit(cache=True, nogil=True, error_model="numpy")
def _moved(poses, time_s, progress, first, stopped, center_deg):  # type: ignore[no-untyped-def]
    """Return the columns `_MOVED`, of the changes since the last row, (8, n)."""
    x, y, yaw = poses
    out = np.full((8, len(x)), np.nan)
    since, apart = np.zeros((4, len(x))), stopped.copy()
    before_x = before_y = 0.0
    for i in range(len(x)):
        heading = math.radians(yaw[i])
        rear_x = x[i] - FRONT_TO_REAR_AXLE_M * math.cos(heading)
        rear_y = y[i] - FRONT_TO_REAR_AXLE_M * math.sin(heading)
        seconds = dx = dy = turned = rear_dx = rear_dy = gained = center_turned = 0.0
        if not stopped[i] and i > 0:
            seconds, dx, dy = time_s[i] - time_s[i - 1], x[i] - x[i - 1], y[i] - y[i - 1]
            turned = _wrapped(yaw[i] - yaw[i - 1])
            rear_dx, rear_dy = rear_x - before_x, rear_y - before_y
        if not first[i] and i > 0:
            gained, center_turned = progress[i] - progress[i - 1], _wrapped(center_deg[i] - center_deg[i - 1])
        before_x, before_y = rear_x, rear_y
        dist = math.sqrt(dx * dx + dy * dy)
        out[0, i], out[1, i] = seconds, dist
        since[0, i], since[1, i], since[2, i], since[3, i] = seconds, dist, gained, turned
        apart[i] |= dist > _JUMP_M and dist > _JUMP_MPS * seconds
        if not stopped[i] and dist >= STILL_M:
            bearing = math.degrees(math.atan2(dy, dx))
            out[5, i] = bearing
            # Both are directions between two rows, because a centre line turns by up to 10 degrees at a waypoint.
            out[7, i] = _wrapped(bearing - (center_deg[i] - center_turned / 2))
            if rear_dx * rear_dx + rear_dy * rear_dy >= STILL_M**2:
                rear_deg = math.degrees(math.atan2(rear_dy, rear_dx))
                out[6, i] = _wrapped(rear_deg - (yaw[i] - turned / 2))
    for i in range(1, len(x)):
        if apart[i]:
            continue
        begin, end = i, i + 1
        while begin > max(i - SPEED_STEPS // 2, 1) and not apart[begin - 1]:
            begin -= 1
        while end < min(i + 1 + SPEED_STEPS // 2, len(x)) and not apart[end]:
            end += 1
        seconds = since[0, begin:end].sum()
        if seconds > 0.0:
            out[2, i] = since[1, begin:end].sum() / seconds
            out[4, i] = since[3, begin:end].sum() / seconds
            if not first[i]:
                out[3, i] = since[2, begin:end].sum() / seconds
    return out


@njit(cache=True, nogil=True)
def _wrapped(angle_deg):  # type: ignore[no-untyped-def]
    # Most turns between two rows are small, and a remainder takes longer than all else here.
    if -180.0 <= angle_deg < 180.0:
        return angle_deg
    return (angle_deg + 180.0) % 360.0 - 180.0


def _lap_clock(
    steps: pd.DataFrame, stopped: NDArray[np.bool_], first: NDArray[np.bool_], delta_time_s: Values
) -> Values:
    """Return the clock of a lap: the time before its first row was driven without a pause, the rest is recorded."""
    begin, tstamp = np.flatnonzero(first), steps["tstamp"].to_numpy(np.float64)
    part = subsample(len(stopped), MOST_ROWS)
    known_s = delta_time_s[part][~stopped[part]]
    period_s = float(np.median(known_s)) if len(known_s) else CONTROL_PERIOD_S
    # The generation that counts from 0 has no prepare rows either.
    before_s = lap_clock_s(np.maximum(steps["steps"].to_numpy()[begin], 1), period_s)
    began_s = tstamp[begin] - np.where(stopped[begin], before_s, delta_time_s[begin])
    return tstamp - began_s[np.cumsum(first) - 1]


def timed_by_service(steps: pd.DataFrame, metrics: pd.DataFrame) -> tuple[pd.DataFrame, int]:
    """Set the clocks of complete laps to the times that the service's metrics files give.

    `steps` have the derived columns, each episode's contiguous; `metrics` has `recording.METRICS_COLUMNS`.

    Returns:
        The steps, and of how many laps without resets the files give the time.
    """
    in_training = metrics["stream"].astype(str) == TRAINING
    laps = metrics[(metrics["completion"] >= 100.0) & (in_training == (metrics["phase"] == "training"))]
    if laps.empty or steps.empty:
        return steps, 0
    begin = np.flatnonzero(first_rows(steps))
    counts = np.diff(np.append(begin, len(steps)))
    end = begin + counts - 1
    official = laps.drop_duplicates(["stream", "episode"]).astype({"stream": str})
    keys = steps.iloc[end][["stream", "episode"]].astype({"stream": str})
    known_s = keys.merge(official, how="left", on=["stream", "episode"])["time_s"].to_numpy(np.float64)
    whole = (np.maximum.reduceat(steps["progress"].to_numpy(np.float64), begin) >= 100.0) & whole_from_start(
        steps
    )
    late_s = np.where(whole, known_s - steps["lap_clock_s"].to_numpy()[end], np.nan)
    moved = steps["lap_clock_s"].to_numpy() + np.repeat(np.nan_to_num(late_s), counts)
    return with_columns(steps, {"lap_clock_s": moved}), int(
        (np.isfinite(late_s) & (resets(steps) == 0)).sum()
    )


def _places(
    steps: pd.DataFrame, first: NDArray[np.bool_], course: Track | None
) -> tuple[Values, Values, Values]:
    """Return lap position, offset and the centre line's direction in degrees."""
    if course is not None:
        lap_position, offset_m, center_rad = course.follow(steps["X"].to_numpy(), steps["Y"].to_numpy())
        return lap_position, offset_m, np.degrees(center_rad, out=center_rad)
    unknown = np.full(len(steps), np.nan)
    if not len(steps):
        return unknown, unknown, unknown
    waypoint, progress = (steps[name].to_numpy(np.float64) for name in ("closest_waypoint", "progress"))
    start = waypoint / (waypoint.max() + 1.0) - progress / 100.0
    return (start[first][np.cumsum(first) - 1] + progress / 100.0) % 1.0, unknown, unknown


@njit(cache=True, nogil=True, error_model="numpy")
def _change(speed_mps, time_s, first):  # type: ignore[no-untyped-def]
    """Return the rise and fall of speed per second between the rows before and after, (2, n); 0 at an end.

    The moment of a speed is the middle of its step. Steps are uneven, so that differences of neighbours would be mostly
    noise.
    """
    out = np.zeros((2, len(speed_mps)))
    for i in range(2, len(speed_mps) - 1):
        if not (first[i + 1] or first[i] or first[i - 1]):
            passed_s = (time_s[i + 1] + time_s[i] - time_s[i - 1] - time_s[i - 2]) / 2.0
            change = (speed_mps[i + 1] - speed_mps[i - 1]) / passed_s
            if math.isfinite(change):
                out[0, i], out[1, i] = max(change, 0.0), max(-change, 0.0)
    return out


@njit(cache=True, nogil=True)
def _discounted(reward, first, discount):  # type: ignore[no-untyped-def]
    future = np.empty(len(reward))
    total = 0.0
    for i in range(len(reward) - 1, -1, -1):
        total = discount * total + (reward[i] if math.isfinite(reward[i]) else 0.0)
        future[i] = total
        if first[i]:
            total = 0.0
    return future


def first_rows(steps: pd.DataFrame) -> NDArray[np.bool_]:
    """Return which rows are the first of their episode; the rows of an episode must be contiguous."""
    stream = steps["stream"].astype("category").cat.codes.to_numpy()
    episode = steps["episode"].to_numpy()
    first = np.ones(len(steps), bool)
    first[1:] = (episode[1:] != episode[:-1]) | (stream[1:] != stream[:-1])
    return first


def flying_rows(steps: pd.DataFrame) -> NDArray[np.bool_]:
    """Return whether first rows continue the last row: laps of a race are driven without a stop."""
    number = steps["steps"].to_numpy()
    stream = steps["stream"].astype("category").cat.codes.to_numpy()
    flying = first_rows(steps) & (number > FIRST_STEPS)
    flying[:1] = False
    flying[1:] &= (number[1:] == number[:-1] + 1) & (stream[1:] == stream[:-1])
    return flying


def whole_from_start(steps: pd.DataFrame) -> NDArray[np.bool_]:
    """Return for each episode whether its beginning is recorded."""
    begin = np.flatnonzero(first_rows(steps))
    return (steps["steps"].to_numpy()[begin] <= FIRST_STEPS) | flying_rows(steps)[begin]


def begins_of(is_so: NDArray[np.bool_], first: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the first row of each consecutive block of True; an episode's `first` row begins a new block."""
    begins = is_so.copy()
    begins[1:] &= first[1:] | ~is_so[:-1]
    return begins


def resets(steps: pd.DataFrame) -> NDArray[np.int64]:
    """Return the number of resets in each episode."""
    first = first_rows(steps)
    stopped = steps["episode_status"].isin(STOPPED).to_numpy()
    begins = begins_of(stopped, first)
    begin = np.flatnonzero(first)
    end = np.append(begin[1:], len(steps))[: len(begin)] - 1
    return (
        np.add.reduceat(begins, begin, dtype=np.int64) - stopped[end] if len(begin) else np.zeros(0, np.int64)
    )


def laps_driven(steps: pd.DataFrame) -> NDArray[np.bool_]:
    """Return for each episode whether it is a complete lap without a reset whose beginning is recorded.

    Only these show the driving line and lap time: a car that is put back stands, and drives a part of the lap again.
    """
    begin = np.flatnonzero(first_rows(steps))
    progress = steps["progress"].to_numpy(np.float64)
    complete = np.maximum.reduceat(progress, begin) >= 100.0 if len(begin) else np.zeros(0, bool)
    return complete & whole_from_start(steps) & (resets(steps) == 0)
