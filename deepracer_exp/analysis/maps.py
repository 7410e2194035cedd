"""What charts along the track have in common: maps, laps and stretches of a training."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from shapely import get_coordinates, get_parts, get_rings

from deepracer_exp.tracks.track import Track

from .chart import FAINT, Layer, Line, Note, Panel, Road, Values
from .log_view import LogView

NUMBERED = 10
"""Every so many waypoints have their number on a map."""
LABEL_M = 0.035
"""Distance of a waypoint's number from the border, as a share of the longer side of the map."""
LEAST_STEPS = 4
"""Steps in a cell below which their mean is mostly chance."""
STARTING_STEPS = 10
"""First control steps of an episode, in which the car pulls away from standing."""
PREPARE = "prepare"
THIRDS = ("first third of the iterations", "second third", "last third")


def map_panel(course: Track, layers: Sequence[Layer], title: str = "", numbers: bool = True) -> Panel:
    """Return a map: the road, `layers` on it, its borders above them, and numbers of waypoints beside it."""
    polygons = [part for part in get_parts(course.road) if part.geom_type == "Polygon"]
    rings = [get_coordinates(ring) for polygon in polygons for ring in get_rings(polygon)]
    borders = [Line(x=ring[:, 0], y=ring[:, 1], color=FAINT, width=0.8) for ring in rings]
    start = np.stack([course.inner[0], course.outer[0]])
    start_line = Line(x=start[:, 0], y=start[:, 1], color=FAINT, width=2.4)
    notes = waypoint_notes(course) if numbers else ()
    road = Road(rings=rings, center=course.waypoints)
    return Panel(layers=[road, *layers, *borders, start_line, *notes], title=title, map=True)


def waypoint_notes(course: Track, every: int = NUMBERED) -> list[Note]:
    """Return the numbers of waypoints, outside the road."""
    last = len(course.waypoints) - course.closed
    # Long courses have more waypoints than room for their numbers.
    every *= max(1, round(last / 160))
    index = np.arange(0, last, every)
    if len(index) > 1 and course.closed and last - index[-1] < every // 2:
        index = index[:-1]
    far_m = LABEL_M * float(np.ptp(course.outer, axis=0).max())
    notes: list[Note] = []
    for k in index.tolist():
        # On the side with more room to other parts of the road.
        sides = [_beside(course, border, k, far_m) for border in (course.outer, course.inner)]
        rooms = [float(np.linalg.norm(course.waypoints - side, axis=1).min()) for side in sides]
        x, y = sides[int(rooms[1] > 1.05 * rooms[0])].tolist()
        if all(np.hypot(note.x - x, note.y - y) > far_m for note in notes):
            notes.append(Note(x=x, y=y, text=str(k)))
    return notes


def _beside(course: Track, border: Values, k: int, far_m: float) -> Values:
    """Return the place beyond a border at waypoint k."""
    aside = border[k] - course.waypoints[k]
    return border[k] + far_m * aside / max(float(np.linalg.norm(aside)), 1e-9)


def waypoint_count(view: LogView) -> int:
    """Return the number of waypoints: of the course, or where it is not known of those that were logged."""
    logged = int(view.steps["closest_waypoint"].max()) + 1 if len(view.steps) else 0
    return logged if view.course is None else max(len(view.course.waypoints), logged)


def waypoints_of(steps: pd.DataFrame) -> NDArray[np.intp]:
    """Return the closest waypoint of each row; -1 where none is told."""
    return np.maximum(steps["closest_waypoint"].to_numpy(np.intp), -1)


def driven(view: LogView, *columns: str) -> pd.DataFrame:
    """Return columns of the training's rows but prepare rows, which stand for no action and pay nothing."""
    return _picked(view, is_driven(view), columns)


def recent(view: LogView, *columns: str) -> pd.DataFrame:
    """Return these rows of the last third of the iterations; the earlier ones tell of drivers long gone."""
    return _picked(view, is_driven(view) & (thirds(view.steps["iteration"].to_numpy()) == 2), columns)


def is_driven(view: LogView) -> NDArray[np.bool_]:
    """Return whether each row of `view.steps` is none of the prepare rows."""
    return (view.steps["episode_status"] != PREPARE).to_numpy()


def _picked(view: LogView, wanted: NDArray[np.bool_], columns: Sequence[str]) -> pd.DataFrame:
    # Column by column: a frame of all columns would take seconds on millions of rows.
    rows = np.flatnonzero(wanted)
    return pd.DataFrame({name: view.steps[name].to_numpy()[rows] for name in columns})


def thirds(iteration: NDArray[np.integer]) -> NDArray[np.intp]:
    """Return the third of the training, 0 to 2, that each iteration belongs to."""
    first, last = (int(iteration.min()), int(iteration.max())) if len(iteration) else (0, 0)
    # From the end, so that the last of one or two iterations is of the last third.
    return 2 - 3 * (last - iteration.astype(np.intp)) // (last - first + 1)


def of_episodes(view: LogView, wanted: NDArray[np.bool_], *columns: str) -> pd.DataFrame:
    """Return columns of the driven rows of the wanted episodes, (n,) in the order of `view.episodes`."""
    return _picked(view, wanted[episode_places(view)] & is_driven(view), columns)


def episode_places(view: LogView) -> NDArray[np.intp]:
    """Return for each row of `view.steps` the place of its episode in `view.episodes`."""
    episode = view.steps["episode"].to_numpy()
    return np.cumsum(np.diff(episode, prepend=episode[:1]) != 0)


def fastest_lap(view: LogView, *columns: str) -> pd.DataFrame | None:
    """Return columns of the driven rows of the training's fastest complete lap; None: there is none."""
    times_s = view.episodes["lap_time_s"].to_numpy(np.float64)
    if not np.isfinite(times_s).any():
        return None
    return of_episodes(view, np.arange(len(times_s)) == np.nanargmin(times_s), *columns)


def waypoint_positions(course: Track) -> Values:
    """Return the place of each waypoint on the lap, 0 to 1."""
    steps_m = np.linalg.norm(np.diff(course.waypoints, axis=0), axis=1)
    return np.r_[0.0, np.cumsum(steps_m)] / course.length_m
