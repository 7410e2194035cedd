"""Simulated laps of a policy beside the laps of a log: numbers, figures, and where on the track they differ."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from deepracer_exp.analysis.charts.actions import COLUMNS, ActionClasses, classify
from deepracer_exp.analysis.charts.figure import Chart, Layer, Panel, band, bars, in_rows, line
from deepracer_exp.analysis.charts.laps import time_lost_panel
from deepracer_exp.analysis.charts.maps import beside, map_panel
from deepracer_exp.analysis.charts.style import BLUE, ORANGE, VERMILION
from deepracer_exp.analysis.log_course import waypoint_positions
from deepracer_exp.analysis.log_tables import NONE, Table, facts, problem_rows
from deepracer_exp.analysis.log_view import DISCOUNT, PREPARE, LogView
from deepracer_exp.analysis.sectors import interval_times, sector_at, sectors_of
from deepracer_exp.analysis.statistics import Values, totals
from deepracer_exp.analysis.step_columns import add_derived, begins_of, first_rows
from deepracer_exp.analysis.tables import episode_table
from deepracer_exp.aws.logs.recording import STEP_COLUMNS
from deepracer_exp.errors import BadInput, count
from deepracer_exp.files import atomic_write
from deepracer_exp.tracks.track import Track

from .page import plot_of, render

PLACES = np.arange(100) / 100
"""Lap positions at which laps are compared."""
STRETCH = 10
"""Places of the stretch where they differ most."""
MOST_TRAINING_LAPS = 10
"""Laps of a training that stand for a log without an evaluation: its policy still explores."""
_MISTAKES = ("off_track", "crashed", "reversed", "immobilized")
_SMOOTHED = 5
"""Control steps in the mean of steering and place along a lap; the speed is one of as many already."""
_NEAR = 0.03
"""Share of the lap beyond which the nearest step says nothing about a place."""
_SAME_ACTION = 0.02
"""Degrees and m/s by which the same action may differ between log and simulation: text logs are rounded."""
_SAME = 0.005
"""m and m/s below which line and speed count as the same."""
SIDES = {"log": ORANGE, "simulated": BLUE}
_PER_CENT = 100.0 * PLACES
_RANGES = (
    " Actions are counted in ranges of steering (split at 0.2 and 0.6 of the largest angle) and speed (three of equal "
    "width): they are continuous, or log and run have different lists of them."
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Laps:
    """Attempted laps on one course."""

    steps: pd.DataFrame
    """`recording.STEP_COLUMNS` and `tables.DERIVED_COLUMNS`, lap by lap."""
    episodes: pd.DataFrame
    """One row a lap, `tables.EPISODE_COLUMNS`."""
    words: str
    """Description of the laps."""
    chosen: bool = False
    """Whether they were chosen because they are complete."""

    @cached_property
    def number(self) -> NDArray[np.intp]:
        """Lap of each row of `steps`."""
        return np.cumsum(first_rows(self.steps)) - 1

    @cached_property
    def driven(self) -> pd.DataFrame:
        """Return the rows that follow an action."""
        return self.steps[(self.steps["episode_status"] != PREPARE).to_numpy()]

    def along(self, column: str, closed: bool) -> Values:
        """Return a column at `PLACES`, (laps, places), as a mean over steps; NaN where no lap passed."""
        steps = 1 if column == "track_speed_mps" else _SMOOTHED
        table = np.full((len(self.episodes), len(PLACES)), np.nan)
        for lap, rows in self.steps.groupby(self.number):
            values = rows[column].rolling(steps, center=True, min_periods=1).mean().to_numpy(np.float64)
            finite = np.isfinite(values)
            if not finite.any():
                continue
            positions = rows["lap_position"].to_numpy(np.float64)[finite]
            apart = np.abs(PLACES[:, None] - positions).min(axis=1)
            if closed:
                apart = np.minimum(apart, np.abs(np.abs(PLACES[:, None] - positions) - 1.0).min(axis=1))
            order = np.argsort(positions, kind="stable")
            passed = np.interp(
                PLACES, positions[order], values[finite][order], period=1.0 if closed else None
            )
            table[lap] = np.where(apart <= _NEAR, passed, np.nan)
        return table

    def measures(self) -> dict[str, float]:
        """Return the numbers that are compared, by their names with units; NaN where there is none."""
        laps, rows = self.episodes, self.driven
        tried = max(int(laps["ended"].sum()), 1)
        time_s = float(laps["time_s"].sum())
        complete = int((laps["complete"] & (laps["resets"] == 0)).sum())
        status = self.steps["episode_status"].astype(str)
        mistake = status.isin(_MISTAKES).to_numpy()
        began = begins_of(mistake, first_rows(self.steps))
        turned_deg = rows["steer"].diff().abs()[np.diff(self.number[rows.index], prepend=-1) == 0]
        return {
            "complete laps, %": np.nan if self.chosen else 100.0 * complete / tried,
            "fastest lap, s": float(laps["lap_time_s"].min()),
            "median lap, s": float(laps["lap_time_s"].median()),
            "mean speed, m/s": float(laps["dist_m"].sum()) / time_s if time_s else np.nan,
            "off the track or stuck, per lap": np.nan if self.chosen else float(began.sum()) / tried,
            "mean distance from the centre line, m": float(rows["offset_m"].abs().mean()),
            "mean steering change per step, °": float(turned_deg.mean()),
        }


def laps_on(course: Track, steps: pd.DataFrame, words: str, chosen: bool = False) -> Laps:
    """Return laps on a course; the rows of each (`recording.STEP_COLUMNS`) are contiguous and in the order of time."""
    rows = steps[list(STEP_COLUMNS)].reset_index(drop=True)
    rows = add_derived(rows, course, DISCOUNT)
    if "lap_clock_s" in steps:  # a metrics file may have set it
        rows["lap_clock_s"] = steps["lap_clock_s"].to_numpy()
    return Laps(steps=rows, episodes=episode_table(rows), words=words, chosen=chosen)


def logged_laps(view: LogView, course: Track) -> Laps:
    """Return the laps of a log that a simulation is compared with: of its races, else the best of its training.

    Raises:
        BadInput: a training without a complete lap.
    """
    laps = view.episodes
    if not view.trained:
        streams = [str(name) for name in laps["stream"].unique()]
        named = f"{', '.join(streams[:2])}{' ...' * (len(streams) > 2)}"
        words = f"{count(len(laps), 'lap')} of {count(len(streams), 'evaluation')}"
        return laps_on(course, view.steps, f"{words} ({named}){_company(view)}")
    best = laps["lap_time_s"].dropna().nsmallest(MOST_TRAINING_LAPS).index
    if not len(best):
        raise BadInput(
            f"{view.name}: has no evaluation, and its training no complete lap with its steps; accepted: logs with "
            "laps to compare"
        )
    words = count(int(laps["lap_time_s"].notna().sum()), "complete lap")
    words = f"the fastest {len(best)} of {words}" if words != count(len(best), "complete lap") else words
    chosen = np.isin(view.episode_index, best)
    words += f" of the training, which explores: the log has no steps of an evaluation{_company(view)}"
    return laps_on(course, view.steps[chosen], words, chosen=True)


def _company(view: LogView) -> str:
    """Say that the log was not driven alone if it has crashes; nothing else in it shows bots or obstacles."""
    steps = view.recording.steps
    crashed = (steps["episode_status"] == "crashed") | (steps["obstacle_crash_counter"] > 0)
    return "; driven among bots or obstacles, while the simulated car drives alone" if crashed.any() else ""


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """A part of the track."""

    begin: int
    """Begin of the stretch in per cent of the track from waypoint 0."""
    end: int
    """End of the stretch in per cent of the track; at most 100 also behind the start line."""
    first_waypoint: int
    last_waypoint: int
    sector: str
    offset_m: float
    """Mean distance of the simulated line to the left of the logged one."""
    speed_mps: float
    """Mean speed of the simulated car above the logged one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AgainstLog:
    """Simulated laps and logged ones on the same course."""

    course: Track
    logged: Laps
    simulated: Laps

    @cached_property
    def curves(self) -> dict[str, tuple[Values, Values]]:
        """Logged and simulated values at `PLACES`, (laps, places), by column."""
        return {
            name: (
                self.logged.along(name, self.course.closed),
                self.simulated.along(name, self.course.closed),
            )
            for name in ("offset_m", "track_speed_mps", "steer")
        }

    def difference(self, column: str) -> Values:
        """Return how much more the simulated median is, (places,); NaN where one side did not pass."""
        logged, simulated = (quantile(curves, 0.5) for curves in self.curves[column])
        return simulated - logged

    @cached_property
    def actions(self) -> ActionClasses | None:
        """Actions of both, logged ones first; in ranges if the two lists of actions are not the same."""
        rows = pd.concat([laps.driven[list(COLUMNS)] for laps in (self.logged, self.simulated)])
        spans = rows.groupby("action")[["steer", "throttle"]].agg(np.ptp)
        same = bool((spans <= _SAME_ACTION).all(axis=None))
        return classify(rows if same else rows.assign(action=np.nan))

    @property
    def action_shares(self) -> tuple[Values, Values]:
        """Shares of each class of `actions` in per cent, logged and simulated; of none without actions."""
        if self.actions is None:
            return np.zeros(0), np.zeros(0)
        n, m = len(self.logged.driven), len(self.actions.names)
        counts = (totals(part, None, m) for part in np.split(self.actions.number, [n]))
        logged, simulated = (100.0 * counted / max(counted.sum(), 1.0) for counted in counts)
        return logged, simulated

    @property
    def table(self) -> pd.DataFrame:
        """The numbers: `name`, `logged`, `simulated`, `difference`; differences of shares are in percentage points."""
        logged, simulated = self.logged.measures(), self.simulated.measures()
        rows = [(name, logged[name], simulated[name]) for name in logged]
        if self.actions is not None:
            names = [f"action {name}, %" for name in self.actions.names]
            rows += list(zip(names, *self.action_shares, strict=True))
        table = pd.DataFrame(rows, columns=["name", "logged", "simulated"])
        return table.assign(difference=table["simulated"] - table["logged"])

    @property
    def texts(self) -> Table:
        """The table as texts."""
        rows = []
        for name, *values in self.table.itertuples(index=False):
            form = ".1f" if name.endswith("%") else ".2f"
            texts = (
                f"{value:{sign}{form}}" if np.isfinite(value) else NONE
                for value, sign in zip(values, ("", "", "+"), strict=True)
            )
            rows.append((name, *texts))
        return Table(("", "log", "simulated", "difference"), tuple(rows), 1)

    @cached_property
    def stretch(self) -> Stretch | None:
        """Where line or speed differ most, None where nothing can be compared.

        The line counts in halves of the road's width, the speed in means of the logged one; the larger of the two
        counts.
        """
        offset_m, speed_mps = self.difference("offset_m"), self.difference("track_speed_mps")
        mean_mps = np.nanmean(self.curves["track_speed_mps"][0]) if np.isfinite(speed_mps).any() else 1.0
        apart = np.fmax(np.abs(offset_m) / (self.course.width_m / 2), np.abs(speed_mps) / mean_mps)
        begins = len(PLACES) if self.course.closed else len(PLACES) - STRETCH + 1
        windows = (np.arange(begins)[:, None] + np.arange(STRETCH)) % len(PLACES)
        whole = np.isfinite(apart[windows]).all(axis=1)
        if not whole.any():
            return None
        first = int(np.where(whole, np.nan_to_num(apart)[windows].mean(axis=1), -1.0).argmax())
        begin, end = first / len(PLACES), (first + STRETCH) / len(PLACES)
        waypoint_at = waypoint_positions(self.course)[: len(self.course.waypoints) - self.course.closed]
        inside = np.flatnonzero(((waypoint_at - begin) % 1.0) <= end - begin)
        inside = inside[np.argsort((waypoint_at[inside] - begin) % 1.0)]
        sectors = sectors_of(self.course)
        middle = np.array([(begin + end) / 2 % 1.0])
        return Stretch(
            begin=round(100 * begin),
            end=round(100 * end) if end <= 1 else round(100 * end) - 100,
            first_waypoint=int(inside[0]) if len(inside) else 0,
            last_waypoint=int(inside[-1]) if len(inside) else 0,
            sector=sectors[int(sector_at(sectors, middle)[0])].name,
            offset_m=float(offset_m[windows[first]].mean()),
            speed_mps=float(speed_mps[windows[first]].mean()),
        )

    @property
    def sentences(self) -> list[str]:
        """The result in words: lap times, line, and where they differ most."""
        logged, simulated = (laps.episodes["lap_time_s"] for laps in (self.logged, self.simulated))
        if not len(simulated.dropna()):
            lines = ["The simulated car completes no lap."]
        elif not len(logged.dropna()):
            lines = ["The logged car completes no lap."]
        else:
            lines = [
                f"The simulated lap takes {simulated.median():.2f} s, the logged one {logged.median():.2f} s: "
                f"{simulated.median() - logged.median():+.2f} s (medians)."
            ]
        offset_m, speed_mps = (np.abs(self.difference(name)) for name in ("offset_m", "track_speed_mps"))
        apart = self.stretch
        if apart is None:
            return [*lines, "They have no stretch of the track in common that is long enough to compare."]
        if max(np.nanmax(offset_m), np.nanmax(speed_mps)) < _SAME:
            return [*lines, "Line and speed are the same all along the track, to 1 cm and 0.01 m/s."]
        return [
            *lines,
            f"The lines are {np.nanmean(offset_m):.2f} m apart on average, the speeds {np.nanmean(speed_mps):.2f} m/s.",
            f"They differ most from {apart.begin} to {apart.end}% of the track (waypoints {apart.first_waypoint} to "
            f"{apart.last_waypoint}, sector {apart.sector}): there the simulated car is {abs(apart.offset_m):.2f} m "
            f"further {'left' if apart.offset_m > 0 else 'right'} and {abs(apart.speed_mps):.2f} m/s "
            f"{'faster' if apart.speed_mps > 0 else 'slower'}.",
        ]


def quantile(curves: Values, share: float) -> Values:
    """Return a quantile over laps, (places,); NaN where no lap passed."""
    return pd.DataFrame(curves).quantile(share).to_numpy()


def lines_compared(both: AgainstLog) -> Chart:
    """Draw the lines of all laps and their medians on the course, and the stretch where they differ most."""
    layers: list[Layer] = []
    if (stretch := both.stretch) is not None:
        end = stretch.end if stretch.end > stretch.begin else stretch.end + 100
        there = both.course.points_at(np.linspace(stretch.begin, end, 60) / 100.0 % 1.0)
        layers.append(line(there[:, 0], there[:, 1], VERMILION, "where they differ most", width=9.0))
    for laps, color in zip((both.logged, both.simulated), SIDES.values(), strict=True):
        # NaN between the laps.
        apart = laps.steps[["X", "Y"]].to_numpy(np.float64)
        apart = np.insert(apart, np.flatnonzero(np.diff(laps.number)) + 1, np.nan, axis=0)
        layers.append(line(apart[:, 0], apart[:, 1], color, width=0.6))
    for (name, color), curves in zip(SIDES.items(), both.curves["offset_m"], strict=True):
        path = beside(both.course, PLACES, quantile(curves, 0.5))
        path = np.vstack([path, path[:1]]) if both.course.closed else path
        layers.append(line(path[:, 0], path[:, 1], color, f"{name}, median", width=2.5))
    return Chart(
        name="lines_compared",
        title="Both lines",
        caption="Thin lines are the laps, thick ones their medians at each place. The marked stretch is the tenth of "
        "the track where line or speed differ most: the line in halves of the road's width, the speed in means of "
        "the logged one.",
        rows=[[map_panel(both.course, layers)]],
    )


def along_the_track(both: AgainstLog) -> Chart:
    """Draw time, speed, steering and distance from the centre line along the course."""
    bounds = np.append(PLACES, 1.0)
    spent = [interval_times(laps.steps, bounds) for laps in (both.logged, both.simulated)]
    panels = []
    if all(len(times) for times in spent):
        logged, simulated = (times.median().to_numpy() for times in spent)
        lost_s = np.r_[0.0, np.cumsum(simulated - logged)]
        delta = pd.DataFrame({"lap_position": bounds, "delta_s": lost_s})
        title = "Time the simulated laps lose to the logged ones"
        panels.append(time_lost_panel(title, delta, sectors_of(both.course), 100.0))
    for column, title, label in (
        ("track_speed_mps", "Speed along the track", "m/s"),
        ("steer", "Steering commanded, positive to the left", "degrees"),
        ("offset_m", "Distance from the centre line, positive to the left", "m"),
    ):
        layers: list[Layer] = []
        for (name, color), curves in zip(SIDES.items(), both.curves[column], strict=True):
            layers.append(band(_PER_CENT, quantile(curves, 0.1), quantile(curves, 0.9), color))
            layers.append(line(_PER_CENT, quantile(curves, 0.5), color, name, width=2.5))
        panels.append(Panel(title=title, y_label=label, layers=layers))
    panels[-1] = replace(panels[-1], x_label="per cent of the track from waypoint 0")
    return Chart(
        name="along_the_track",
        title="Along the track",
        caption="Lines are medians over the laps, bands reach from the 10th to the 90th percentile. Where the line of "
        "the time rises, the simulated car is slower.",
        rows=in_rows(panels, 1),
        share_x=True,
    )


def actions_compared(both: AgainstLog) -> Chart | None:
    """Draw how often each action is taken."""
    if both.actions is None:
        return None
    # From left to right, as on the road seen from above.
    places, names = np.arange(len(both.actions.names)), both.actions.names[::-1]
    layers = [
        bars(places + side * 0.2, share[::-1], color, name, width=0.38)
        for side, share, (name, color) in zip((-1, 1), both.action_shares, SIDES.items(), strict=True)
    ]
    return Chart(
        name="actions_compared",
        title="Actions taken",
        caption="Share of all control steps. Equal policies in an equal simulation would take equal shares."
        + _RANGES * both.actions.continuous,
        rows=[[Panel(layers=layers, x_names=names, x_label="action", y_label="% of the steps")]],
    )


def write_against_log(
    path: Path, run: str, both: AgainstLog, view: LogView, learned: Chart | None = None
) -> Path:
    """Write the page of simulated laps, driven by the policy of `run`, beside those of a log atomically.

    `learned` is a figure of how both were trained.

    Raises:
        OSError: it cannot be written.
    """
    drawn = (lines_compared(both), along_the_track(both), actions_compared(both), learned)
    charts = [chart for chart in drawn if chart is not None]
    page = render(
        __package__,
        "against_log.html.j2",
        [plot_of(chart) for chart in charts],
        run=run,
        log=view.name,
        sentences=both.sentences,
        table=both.texts,
        captions={chart.name: chart.caption for chart in charts},
        facts=[("Log", both.logged.words), ("Simulated", both.simulated.words), *facts(view)[:1]],
        problems=problem_rows(view),
    )
    return atomic_write(path, page)
