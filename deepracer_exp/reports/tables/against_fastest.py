"""A lap of a run of ours against the fastest lap of its car: the seconds lost by sector and cause."""

import shlex
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from deepracer_exp.errors import BadInput
from deepracer_exp.evaluation.fastest.fastest_lap import FastestLap, Question, kept_lap
from deepracer_exp.runs.next_steps import COMMAND, own_word
from deepracer_exp.runs.stored_run import StoredRun
from deepracer_exp.tracks.sectors import Sector, sectors_of
from deepracer_exp.tracks.track import Track

from .log_view import LogView, once_per_view
from .statistics import Values

CAUSES = ("line", "speed", "steering")
"""A longer line; less speed on it; and the detour by steering to and fro around a smooth line."""
_SMOOTH_M, _APART_M = 0.6, 0.05
"""Length over which a driven line is averaged to be smooth, and that between its points."""
_SAME_START_M = 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class TimeLoss:
    """The seconds that a lap loses to the fastest lap, by cause and sector."""

    fastest: FastestLap
    lap_time_s: float
    by_sector: pd.DataFrame
    """Seconds, a column for each of `CAUSES`, index: names of sectors."""


@once_per_view
def question_of(view: LogView, folder: Path) -> Question | None:
    """Return the question whose answer is the fastest lap of a run's car on the view's course; None if not known.

    Raises:
        BadInput: the action space leaves the car nothing to choose.
    """
    try:
        experiment = StoredRun(folder).experiment
        tracks = experiment.tracks
        config = tracks.get(view.track_name) or (next(iter(tracks.values())) if len(tracks) == 1 else None)
        if config is None or view.course is None:
            return None
        track = Track.from_config(config, view.course.reversed)
    except BadInput:  # the page lists which files of the run could not be read
        return None
    return Question.of(experiment, track)


@once_per_view
def loss(view: LogView, folder: Path) -> TimeLoss | None:
    """Compare the run's fastest exploring lap from the start line, by a car on usual conditions, with the fastest lap.

    None: there is no such lap, or the fastest lap is not known.
    """
    try:
        question = question_of(view, folder)
    except BadInput:
        return None
    fastest = None if question is None else kept_lap(question)
    lap = None if fastest is None else _lap_from_the_line(view, fastest)
    if question is None or fastest is None or lap is None:
        return None
    driven = pd.DataFrame({name: fastest.column(name) for name in ("time_s", "x_m", "y_m")})
    sectors = sectors_of(question.track)
    return TimeLoss(
        fastest=fastest,
        lap_time_s=float(lap["time_s"].iloc[-1]),
        by_sector=by_cause(
            _in_sectors(lap, sectors, question.track), _in_sectors(driven, sectors, question.track)
        ),
    )


def by_cause(lap: pd.DataFrame, fastest: pd.DataFrame) -> pd.DataFrame:
    """Attribute the time that a lap loses.

    Both have `time_s`, `way_m` and `smooth_m`, the way without the detour of steering, for each sector.

    Returns:
        Seconds by `CAUSES`, whose sum is the difference of `time_s`. A longer line costs its length at the speed of the
        fastest lap; what is left is speed.
    """
    per_m = fastest["time_s"] / fastest["way_m"]
    steering = ((lap["way_m"] - lap["smooth_m"]) - (fastest["way_m"] - fastest["smooth_m"])) * per_m
    line = (lap["smooth_m"] - fastest["smooth_m"]) * per_m
    speed = lap["time_s"] - fastest["time_s"] - line - steering
    return pd.DataFrame({"line": line, "speed": speed, "steering": steering})[list(CAUSES)]


def _lap_from_the_line(view: LogView, fastest: FastestLap) -> pd.DataFrame | None:
    """Return time and place at each step of the fastest lap `on_usual` that begins where the car's fastest begins."""
    laps = view.episodes[view.on_usual & view.episodes["lap_time_s"].notna()]
    laps = laps.sort_values("lap_time_s", kind="stable")
    start = np.array([fastest.column("x_m")[0], fastest.column("y_m")[0]])
    columns = ("X", "Y", "lap_clock_s")
    for episode in laps["episode"]:
        rows = view.of_episodes((view.episodes["episode"] == episode).to_numpy(), *columns)
        if np.hypot(*(rows[["X", "Y"]].to_numpy()[0] - start)) < _SAME_START_M:
            return rows.rename(columns={"X": "x_m", "Y": "y_m", "lap_clock_s": "time_s"})
    return None


def _in_sectors(lap: pd.DataFrame, sectors: list[Sector], track: Track) -> pd.DataFrame:
    """Return time and ways of a lap in each sector, from the start line on."""
    points = lap[["x_m", "y_m"]].to_numpy(np.float64)
    way_m = _way_m(points)
    even_m = np.arange(0.0, way_m[-1] + _APART_M, _APART_M)
    even = pd.DataFrame({axis: np.interp(even_m, way_m, points[:, axis]) for axis in (0, 1)})
    smooth = even.rolling(2 * round(0.5 * _SMOOTH_M / _APART_M) + 1, center=True, min_periods=1).mean()
    along = np.unwrap(track.project(points).ndist, period=1.0)
    # The last step is at the line or just beyond it.
    along = np.maximum.accumulate(along)
    bounds = np.array([0.0, *(sector.end for sector in sectors)])
    bounds[-1] = max(along[-1], bounds[-2])

    def spent(values: Values) -> Values:
        reached = np.interp(bounds, along, values)
        reached[0] = values[0]  # the car stands in one place for some steps
        return np.diff(reached)

    return pd.DataFrame(
        {
            "time_s": spent(np.r_[0.0, lap["time_s"].to_numpy()[1:]]),
            "way_m": spent(way_m),
            "smooth_m": spent(np.interp(way_m, even_m, _way_m(smooth.to_numpy()))),
        },
        index=[sector.name for sector in sectors],
    )


def _way_m(points: Values) -> Values:
    return np.r_[0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T))]


def fastest_in_words(view: LogView, folder: Path) -> str:
    """Return the fastest known lap of a run's car on the track with its bound, or the command that finds it."""
    try:
        question = question_of(view, folder)
    except BadInput as error:
        return f"none: {error}"
    fastest = None if question is None else kept_lap(question)
    if fastest is None:
        return _not_searched(folder)
    return f"{fastest.lap_time_s:.2f} s; none is faster than {fastest.bound_s:.2f} s"


def _not_searched(folder: Path) -> str:
    return f"not searched yet: {COMMAND} analyze {shlex.quote(own_word(folder))} --fastest"


def loss_in_words(view: LogView, folder: Path) -> str:
    """Return the loss of a run's lap to the fastest lap of its car, or the command that computes it."""
    try:
        question = question_of(view, folder)
    except BadInput as error:
        return f"none: {error}"
    if question is None or kept_lap(question) is None:
        return _not_searched(folder)
    lost = loss(view, folder)
    return f"no complete {view.lap_word} from the start line" if lost is None else lost_in_words(lost)


def lost_in_words(lost: TimeLoss) -> str:
    """Return a sentence with the losses and the worst sector."""
    total, causes = lost.lap_time_s - lost.fastest.lap_time_s, lost.by_sector.sum()
    by_sector = lost.by_sector.sum(axis=1)
    parts = ", ".join(f"{causes[name]:+.2f} s {name}" for name in CAUSES)
    of_car = f"{lost.fastest.lap_time_s:.2f} s; bound {lost.fastest.bound_s:.2f} s"
    return (
        f"{lost.lap_time_s:.2f} s, {total:.2f} s more than the fastest lap of this car ({of_car}): {parts}; most in "
        f"{by_sector.idxmax()} ({by_sector.max():+.2f} s)"
    )
