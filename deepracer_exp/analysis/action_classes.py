"""The actions of a recording as numbered classes with names, also where the action space is continuous."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from .chart import Values
from .log_view import LogView
from .maps import driven

STEERING_EDGES = (-0.6, -0.2, 0.2, 0.6)
"""Where classes of steering meet, as shares of the largest angle."""
STEERING_NAMES = ("hard right", "right", "straight", "left", "hard left")
SPEED_EDGES = (1 / 3, 2 / 3)
"""Where classes of speed meet, as shares of the way from the lowest to the highest."""
SPEED_NAMES = ("slow", "middle", "fast")
COLUMNS = ("X", "Y", "lap_position", "closest_waypoint", "iteration", "steer", "throttle", "action")
MOST_CLASSES = 40
"""More different actions than these are no choice from a list."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ActionClasses:
    """What a car can do, sorted from right to left and from slow to fast."""

    rows: pd.DataFrame
    """`COLUMNS` of the training's rows without prepare rows."""
    number: NDArray[np.intp]
    """Class of each row (n,); -1 where the action is not told."""
    names: tuple[str, ...]
    steering_deg: Values
    """Of each class, positive to the left; the mean of its rows where it stands for a range."""
    speed_mps: Values
    continuous: bool
    """Whether classes stand for ranges of a continuous action space."""


def action_classes(view: LogView) -> ActionClasses | None:
    """Sort the training's actions into classes; None: no row tells one."""
    rows = driven(view, *COLUMNS)
    steer, speed = rows["steer"].to_numpy(np.float64), rows["throttle"].to_numpy(np.float64)
    known = np.isfinite(steer) & np.isfinite(speed)
    if not known.any():
        return None
    action = rows["action"].to_numpy(np.float64)
    listed = np.sort(pd.unique(action[known]))
    continuous = not np.isfinite(listed).all() or len(listed) > MOST_CLASSES
    if continuous:
        key, names = _ranges(steer, speed, known)
    else:
        key, names = np.searchsorted(listed, action), []
    key = np.where(known, key, -1)
    count = int(key.max()) + 1
    size = np.bincount(key[known], minlength=count)
    with np.errstate(invalid="ignore"):
        steering_deg = np.bincount(key[known], steer[known], minlength=count) / size
        speed_mps = np.bincount(key[known], speed[known], minlength=count) / size
    if not continuous:
        names = [f"{_angle(a)} {b:.2g} m/s" for a, b in zip(steering_deg, speed_mps, strict=True)]
    # Two actions may differ by less than floats keep.
    order = np.lexsort([speed_mps.round(3), steering_deg.round(1)]) if not continuous else np.arange(count)
    order = order[size[order] > 0]
    place = np.full(count + 1, -1)
    place[order] = np.arange(len(order))
    return ActionClasses(
        rows=rows,
        number=place[key],
        names=tuple(names[k] for k in order),
        steering_deg=steering_deg[order],
        speed_mps=speed_mps[order],
        continuous=continuous,
    )


def _ranges(steer: Values, speed: Values, known: NDArray[np.bool_]) -> tuple[NDArray[np.intp], list[str]]:
    largest = max(float(np.abs(steer[known]).max()), 1e-9)
    low, high = float(speed[known].min()), float(speed[known].max())
    turn = np.digitize(steer / largest, STEERING_EDGES)
    pace = np.digitize((speed - low) / max(high - low, 1e-9), SPEED_EDGES)
    names = [f"{side}, {pace_name}" for side in STEERING_NAMES for pace_name in SPEED_NAMES]
    return turn * len(SPEED_NAMES) + pace, names


def _angle(steering_deg: float) -> str:
    """Return an angle in words that need no sign."""
    if abs(steering_deg) < 0.05:
        return "straight"
    return f"{'left' if steering_deg > 0 else 'right'} {abs(steering_deg):.3g}°"
