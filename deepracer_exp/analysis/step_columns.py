"""Columns worked out from recorded steps: how the car moved, and where on the course it was."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from numba import njit
from numpy.typing import NDArray

from deepracer_exp.tracks.track import Track

from .episode_table import flying_rows

Values = NDArray[np.float64]
DERIVED_COLUMNS: Mapping[str, str] = {
    "delta_time_s": "s since the row before; 0 in an episode's first row unless it is a flying lap; so of the others",
    "delta_dist_m": "m from the row before; 0 in an episode's first row",
    "track_speed_mps": "m/s, distance over time since the row before; NaN in an episode's first row",
    "progress_speed_pps": "per cent of the lap a second since the row before; NaN in an episode's first row",
    "acceleration_mps2": "m/s2 of growing track speed, between the rows before and after; 0 where it falls",
    "braking_mps2": "m/s2 of falling track speed, likewise, positive; 0 where it grows",
    "yaw_rate_dps": "degrees a second since the row before, positive to the left",
    "true_bearing_deg": "degrees, -180 to 180, direction in which the logged point moved since the row before",
    "slide_deg": "degrees, direction in which the rear axle moved since the row before minus the mean of both yaws; "
    "0 for tyres that do not slip, positive where the tail goes to the left",
    "skew_deg": "degrees, direction of travel minus that of the centre line, positive to the left",
    "lap_position": "0 to 1, normalised projection on the centre line in driving direction; without a course "
    "worked out of progress and the start's waypoint",
    "offset_m": "m from the centre line, positive to the left of the driving direction",
    "discounted_future_reward": "reward units, this row's and all later ones of the episode, discounted",
}
"""Names of the columns that `add_derived` adds, with meaning and unit."""
FRONT_TO_REAR_AXLE_M = 0.14 + 0.081663
"""From the logged point back to the rear axle (deepracer-simapp: front point, rear wheels of the car's model)."""
STILL_M = 0.01
"""Below this a movement has no direction."""


def add_derived(
    steps: pd.DataFrame, first: NDArray[np.bool_], course: Track | None, discount: float
) -> pd.DataFrame:
    """Return the steps with `DERIVED_COLUMNS`.

    Args:
        steps: rows of each episode together and in the order of time.
        first: whether a row is its episode's first one.
        course: what was driven on.
        discount: factor on the reward of the next step.
    """
    x, y, yaw = (steps[name].to_numpy(np.float64) for name in ("X", "Y", "yaw"))
    lap_position, offset_m, center_deg = _places(steps, first, course)
    reward = steps["reward"].to_numpy(np.float64)
    time_s, progress = (steps[name].to_numpy(np.float64) for name in ("tstamp", "progress"))
    columns = _motion(first & ~flying_rows(steps, first), x, y, yaw, time_s)
    passed_s = np.where(first | (columns["delta_time_s"] <= 0), np.nan, columns["delta_time_s"])
    columns["progress_speed_pps"] = _since(progress, first) / passed_s
    # Both are directions between two rows: a centre line turns by up to 10 degrees at a waypoint.
    center_turned = _wrapped(_since(center_deg, first))
    columns["skew_deg"] = _wrapped(columns["true_bearing_deg"] - (center_deg - center_turned / 2))
    columns["lap_position"], columns["offset_m"] = lap_position, offset_m
    columns["discounted_future_reward"] = _discounted(np.nan_to_num(reward), first, discount)
    return steps.assign(**{name: columns[name] for name in DERIVED_COLUMNS})


def _motion(first: NDArray[np.bool_], x: Values, y: Values, yaw: Values, time_s: Values) -> dict[str, Values]:
    delta_time_s = _since(time_s, first)
    dx, dy = _since(x, first), _since(y, first)
    delta_dist_m = np.hypot(dx, dy)
    moving = ~first & (delta_dist_m >= STILL_M)
    passed_s = np.where(delta_time_s > 0, delta_time_s, np.nan)
    track_speed_mps = delta_dist_m / passed_s
    change = _change(track_speed_mps, time_s, first)
    turned = _wrapped(_since(yaw, first))
    bearing = np.where(moving, np.degrees(np.arctan2(dy, dx)), np.nan)
    heading = np.radians(yaw)
    rear_x, rear_y = (
        place - FRONT_TO_REAR_AXLE_M * part(heading) for place, part in ((x, np.cos), (y, np.sin))
    )
    rear_dx, rear_dy = _since(rear_x, first), _since(rear_y, first)
    rear_deg = np.degrees(np.arctan2(rear_dy, rear_dx))
    slide = np.where(moving & (np.hypot(rear_dx, rear_dy) >= STILL_M), rear_deg - (yaw - turned / 2), np.nan)
    return {
        "delta_time_s": delta_time_s,
        "delta_dist_m": delta_dist_m,
        "track_speed_mps": track_speed_mps,
        "acceleration_mps2": np.maximum(change, 0.0),
        "braking_mps2": np.maximum(-change, 0.0),
        "yaw_rate_dps": turned / passed_s,
        "true_bearing_deg": bearing,
        "slide_deg": _wrapped(slide),
    }


def _places(
    steps: pd.DataFrame, first: NDArray[np.bool_], course: Track | None
) -> tuple[Values, Values, Values]:
    """Return lap position, offset and the centre line's direction in degrees."""
    if course is not None:
        found = course.project(steps[["X", "Y"]].to_numpy(np.float64))
        return found.ndist, found.offset_m, np.degrees(found.heading_rad)
    unknown = np.full(len(steps), np.nan)
    waypoint = steps["closest_waypoint"].to_numpy(np.float64)
    if not len(waypoint):
        return unknown, unknown, unknown
    start = waypoint[first][np.cumsum(first) - 1] / (waypoint.max() + 1.0)
    progress = steps["progress"].to_numpy(np.float64)
    started = progress[first][np.cumsum(first) - 1]
    return (start + (progress - started) / 100.0) % 1.0, unknown, unknown


def _since(values: Values, first: NDArray[np.bool_]) -> Values:
    """Return the differences to the rows before, 0 in first rows."""
    since = np.diff(values, prepend=values[:1])
    since[first] = 0.0
    return since


def _change(speed_mps: Values, time_s: Values, first: NDArray[np.bool_]) -> Values:
    """Return the speed's change a second between the rows before and after; 0 where one of them is missing.

    A speed is that of the time since the row before: its moment is the middle of it. Control steps last 50 to 80 ms
    in the service's traces, so that differences of neighbours would be mostly noise.
    """
    change = np.zeros(len(speed_mps))
    if len(change) > 3:
        passed_s = (time_s[3:] + time_s[2:-1] - time_s[1:-2] - time_s[:-3]) / 2.0
        with np.errstate(divide="ignore", invalid="ignore"):
            change[2:-1] = (speed_mps[3:] - speed_mps[1:-2]) / passed_s
        change[2:-1][first[3:] | first[2:-1] | first[1:-2]] = 0.0
    return np.nan_to_num(change, nan=0.0, posinf=0.0, neginf=0.0)


def _wrapped(angle_deg: Values) -> Values:
    return (angle_deg + 180.0) % 360.0 - 180.0


@njit(cache=True, nogil=True)
def _discounted(reward, first, discount):  # type: ignore[no-untyped-def]
    future = np.empty(len(reward))
    total = 0.0
    for i in range(len(reward) - 1, -1, -1):
        total = reward[i] + discount * total
        future[i] = total
        if first[i]:
            total = 0.0
    return future
