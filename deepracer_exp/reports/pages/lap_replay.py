"""The replay of two laps: one page on which they drive beside each other, with speed and steering below."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepracer_exp.errors import BadInput
from deepracer_exp.files import atomic_write
from deepracer_exp.reports.charts.figure import Chart, Layer, Panel, line, points
from deepracer_exp.reports.charts.lap_charts import ordinary_lap
from deepracer_exp.reports.charts.maps import map_panel
from deepracer_exp.reports.charts.style import BLUE, ORANGE, PAPER
from deepracer_exp.reports.tables.line_file import driven_speed_mps
from deepracer_exp.reports.tables.log_tables import Table
from deepracer_exp.reports.tables.log_view import LogView
from deepracer_exp.reports.tables.statistics import Values
from deepracer_exp.reports.tables.step_columns import first_rows
from deepracer_exp.tracks.track import Track

from .page import plot_of, render

COLORS = (BLUE, ORANGE)
_DIGITS = 4
_SAME_START = 0.02
"""Largest distance between the starts of two laps, as a share of the track, so that they drive side by side."""
_BESIDE = 0.05
"""Share of the rows of a lap that may be far beside its track."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReplayedLap:
    """A lap as it is replayed; all arrays are (n,)."""

    name: str
    """The run or log of the lap."""
    words: str
    """Description of the lap."""
    track: Track
    lap_time_s: float
    """NaN of a lap that is not complete."""
    time_s: Values
    """Seconds since the lap began, by the clock of its lap time."""
    x_m: Values
    y_m: Values
    yaw_deg: Values
    speed_mps: Values
    steering_deg: Values
    others: NDArray[np.float64] | None = None
    """x and y of the boxes and bots on the road, (n, K, 2); None: the car is alone, or they are not known."""

    @property
    def others_by_key(self) -> dict[str, Values]:
        """X and y of each of the others, (n,), by the keys that move its point."""
        if self.others is None:
            return {}
        keys = [f"other_{axis}{number}" for number in range(self.others.shape[1]) for axis in "xy"]
        return dict(zip(keys, self.others.reshape(len(self.others), -1).T, strict=True))

    @property
    def driven(self) -> Values:
        """Laps driven along the centre line since waypoint 0; it does not fall back to 0 at the start line."""
        place = self.track.project(np.column_stack([self.x_m, self.y_m])).ndist
        return np.unwrap(place, period=1.0) if self.track.closed else place

    @property
    def fits(self) -> bool:
        """Whether it was driven along the track, in its direction."""
        offset_m = self.track.project(np.column_stack([self.x_m, self.y_m])).offset_m
        beside = np.abs(offset_m) > self.track.width_max_m
        return bool(beside.mean() < _BESIDE and self.driven[-1] > self.driven[0])


def laps_of_log(view: LogView, rival: LogView | None) -> list[ReplayedLap]:
    """Return the fastest complete lap of a log and that of a rival; without a rival, an ordinary lap of the same log.

    Raises:
        BadInput: a log has no complete lap with its steps, only one where two are needed, or an unknown track.
    """
    first = fastest_lap_of_log(view)
    if rival is not None:
        return [first, fastest_lap_of_log(rival, first)]
    if view.episodes["lap_time_s"].notna().sum() < 2:
        raise BadInput(
            view.name, "has one complete lap only", "another run or log beside it to replay against"
        )
    fastest, laps = int(view.comparable["lap_time_s"].idxmin()), view.comparable
    if laps["lap_time_s"].notna().sum() < 2:
        laps = view.episodes
    return [first, _lap(view, ordinary_lap(laps, fastest), "an ordinary lap")]


def fastest_lap_of_log(view: LogView, beside: ReplayedLap | None = None) -> ReplayedLap:
    """Return the fastest `LogView.comparable` lap; of those that began where the lap beside it did, if there are any.

    Raises:
        BadInput: it has none with its steps, or its track is unknown.
    """
    laps = view.comparable["lap_time_s"].dropna()
    if not len(laps):
        raise BadInput(view.name, "has no complete lap with its steps", "a run or log with laps")
    if beside is not None:
        places = view.steps["lap_position"].to_numpy(np.float64)[first_rows(view.steps)]
        same = laps[is_same_start(places, beside)[laps.index]]
        laps = same if len(same) else laps
    return _lap(view, int(laps.idxmin()), "the fastest")


def is_same_start(places: Values, beside: ReplayedLap) -> NDArray[np.bool_]:
    """Return whether places, shares of the track (n,), are the start of a lap."""
    return np.abs((places - beside.driven[0] + 0.5) % 1.0 - 0.5) < _SAME_START


def _lap(view: LogView, episode: int, which: str) -> ReplayedLap:
    if view.course is None:
        raise BadInput(view.name, "its track is not known", "with --track NAME or a file")
    row, rows = view.episodes.loc[episode], view.steps[view.episode_index == episode]
    lap_time_s, tstamp = float(row["lap_time_s"]), rows["tstamp"].to_numpy(np.float64)
    where = f"iteration {row['iteration']}, " if view.trained else f"{row['stream']}, "
    return ReplayedLap(
        name=view.name,
        words=f"{which} ({where}episode {row['episode']})",
        track=view.course,
        lap_time_s=lap_time_s,
        # The lap ends with its last row, and may have begun before its first.
        time_s=lap_time_s - (tstamp[-1] - tstamp),
        x_m=rows["X"].to_numpy(np.float64),
        y_m=rows["Y"].to_numpy(np.float64),
        yaw_deg=rows["yaw"].to_numpy(np.float64),
        speed_mps=driven_speed_mps(rows["track_speed_mps"]).to_numpy(np.float64),
        steering_deg=rows["steer"].to_numpy(np.float64),
        others=view.others_at(rows),
    )


def write_replay(path: Path, laps: Sequence[ReplayedLap]) -> Path:
    """Write the page on which two laps drive beside each other atomically.

    Raises:
        BadInput: they are not on the same track in the same direction.
        OSError: it cannot be written.
    """
    titles = [f"{lap.track.title}{', reversed' * lap.track.reversed}" for lap in laps]
    # The two may count its waypoints from different places.
    laps = [replace(lap, track=laps[0].track) for lap in laps]
    if not laps[1].fits:
        raise BadInput(
            laps[1].name, f"drove on {titles[1]}, {laps[0].name} on {titles[0]}", "two laps on the same track"
        )
    names = [f"{letter}  {lap.name}" for letter, lap in zip("AB", laps, strict=True)]
    chart = _chart(titles[0], laps)
    drawn = plot_of(chart)
    page = render(
        __package__,
        "lap_replay.html.j2",
        [drawn],
        scripts=["lap_replay.js"],
        plot=drawn,
        caption=chart.caption,
        track=titles[0],
        table=Table(
            ("", "which lap", "lap time, s", "from, % of the track"),
            tuple(
                (name, lap.words, _time(lap.lap_time_s), f"{100 * (lap.driven[0] % 1.0):.0f}")
                for name, lap in zip(names, laps, strict=True)
            ),
            2,
        ),
        letters=list(zip("AB", COLORS, strict=True)),
        end_s=round(max(float(lap.time_s[-1]) for lap in laps), 2),
        laps=json.dumps([_values(lap, laps[0]) for lap in laps]),
    )
    return atomic_write(path, page)


def _time(seconds: float) -> str:
    return f"{seconds:.3f}" if np.isfinite(seconds) else "not complete"


def _values(lap: ReplayedLap, first: ReplayedLap) -> dict[str, list[float]]:
    """Return the data by which the page moves a car; from the same start, `driven` begins as in the first lap."""
    driven = lap.driven
    values = {
        "time_s": lap.time_s,
        "x": lap.x_m,
        "y": lap.y_m,
        "yaw_deg": np.unwrap(lap.yaw_deg, period=360.0),
        "driven": driven + np.round(first.driven[0] - driven[0]),
        "speed": lap.speed_mps,
        "steering": lap.steering_deg,
        **lap.others_by_key,
    }
    return {name: np.nan_to_num(some).round(_DIGITS).tolist() for name, some in values.items()}


def _chart(track: str, laps: Sequence[ReplayedLap]) -> Chart:
    """Draw the lines of two laps, their speed and their steering; the page moves a point on each."""
    paths: list[Layer] = []
    cars: list[Layer] = []
    curves: dict[str, list[Layer]] = {"speed": [], "steering": []}
    ends: dict[str, list[Layer]] = {"speed": [], "steering": []}
    for number, (letter, color, lap) in enumerate(zip("AB", COLORS, laps, strict=True)):
        moved = list(lap.others_by_key.items())
        for (key_x, xs), (key_y, ys) in zip(moved[::2], moved[1::2], strict=True):
            paths.append(_moved(number, key_x, key_y, xs, ys, color))
            paths[-1]["marker"] |= {"symbol": "square", "size": 9}
        paths.append(line(lap.x_m, lap.y_m, color, letter, width=1.5))
        cars.append(_moved(number, "x", "y", lap.x_m, lap.y_m, color))
        cars[-1].update(mode="lines+markers", line={"width": 7, "color": color})
        cars[-1]["marker"] |= {"size": [1, 12]}
        place = 100 * (lap.driven % 1.0 if lap.track.closed else lap.driven)
        crossed = np.flatnonzero(np.diff(place) < -50) + 1
        for name, values in (("speed", lap.speed_mps), ("steering", lap.steering_deg)):
            x, y = (np.insert(some, crossed, np.nan) for some in (place, values))
            curves[name].append(line(x, y, color))
            ends[name].append(_moved(number, "place", name, place, values, color))
    return Chart(
        name="lap_replay",
        title=track,
        caption="Position on the track is counted along the centre line from waypoint 0; curves are broken where it "
        "begins again. Behind: how much later a car came to where it is than the other one."
        + " Squares are the boxes, bots and rivals around the car of their colour."
        * any(lap.others is not None for lap in laps),
        rows=[
            [map_panel(laps[0].track, [*paths, *cars])],
            [Panel(layers=[*curves["speed"], *ends["speed"]], y_label="speed, m/s", x_range=(0.0, 100.0))],
            [
                Panel(
                    layers=[*curves["steering"], *ends["steering"]],
                    x_label="position on the track, per cent",
                    y_label="steering, ° (left is positive)",
                    x_range=(0.0, 100.0),
                )
            ],
        ],
    )


def _moved(lap: int, x: str, y: str, xs: ArrayLike, ys: ArrayLike, color: str) -> Layer:
    """Return a point at the beginning of a lap; `x` and `y` name the values that move it."""
    layer = points(np.asarray(xs)[:1], np.asarray(ys)[:1], color, size=12)
    layer.update(meta={"lap": lap, "x": x, "y": y}, hoverinfo="skip")
    layer["marker"].update(opacity=1.0, line={"width": 1.5, "color": PAPER})
    return layer
