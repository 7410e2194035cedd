"""Several runs in one picture: with their seeds, as generations, and on each other's tracks."""

import re
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from .chart import (
    BLUE,
    CATEGORIES,
    FAINT,
    ORANGE,
    Band,
    Cells,
    Chart,
    Layer,
    Line,
    Mark,
    Panel,
    Points,
    Values,
)
from .charts_of_training import ITERATION
from .log_view import LogView
from .statistics import median_band, moving_average

_CURVES = {
    "completion_mean": ("Progress", "per cent of the lap"),
    "reward_mean": ("Reward", "reward of an episode"),
    "lap_time_p25_s": ("Lap time, 25th percentile", "lap time, s"),
    "entropy": ("Entropy of the policy", "nats"),
}
_PLACES = 150
"""Points of a curve of several runs."""
_TIME = re.compile(r"^\d{8}-\d{6}-")
_SEED = re.compile(r"[-_]?seed[-_=]?\d+$")


def runs_compared(views: Sequence[LogView]) -> Chart | None:
    """Draw runs beside each other; those that differ only in their seed as a median with its bootstrap interval."""
    if len(views) < 2:
        return None
    groups: dict[str, list[LogView]] = {}
    for view in views:
        groups.setdefault(group_name(view.name), []).append(view)
    groups = _told_apart(groups)
    longest = max(float(view.iterations["steps"].sum()) for view in views)
    grid = np.linspace(0.0, longest, _PLACES)
    factor, unit = (1e-6, "million control steps") if longest >= 2e6 else (1e-3, "thousand control steps")
    rows = []
    panels: list[Panel] = []
    for column, (title, label) in _CURVES.items():
        layers: list[Layer] = []
        for number, (name, some) in enumerate(groups.items()):
            color = CATEGORIES[number % len(CATEGORIES)]
            curves = np.stack([_on_grid(view.iterations, column, grid) for view in some])
            if not np.isfinite(curves).any():
                continue
            median, low, high = median_band(curves)
            if len(some) > 1:
                layers.append(Band(x=factor * grid, low=low, high=high, color=color))
            named = name if not panels else None
            layers.append(Line(x=factor * grid, y=median, name=named, color=color, width=2.0))
            rows.append(
                pd.DataFrame(
                    {"group": name, "runs": len(some), "column": column, "steps": grid, "median": median}
                    | {"low": low, "high": high}
                )
            )
        if layers:
            panels.append(
                Panel(
                    title=title, x_label=unit, y_label=label, layers=layers, x_range=(0.0, factor * longest)
                )
            )
    if not panels:
        return None
    laps = _best_laps(groups)
    if laps is not None:
        panels.append(laps)
    counts = sorted({len(some) for some in groups.values()})
    words = (
        f"Lines are medians over {' or '.join(map(str, counts))} runs whose names differ only in their seed, bands "
        "the medians' bootstrap intervals (95 per cent)"
        if counts[-1] > 1
        else "Each line is one run, so that nothing says how much of a difference is chance"
    )
    return Chart(
        name="runs_compared",
        title="Runs compared",
        caption=f"{words}. Where bands of two colours overlap, more seeds are needed to tell them apart.",
        rows=[panels[at : at + 2] for at in range(0, len(panels), 2)],
        table=pd.concat(rows, ignore_index=True),
    )


def group_name(name: str) -> str:
    """Return what the names of runs that differ only in time and seed have in common."""
    return _SEED.sub("", _TIME.sub("", name)) or name


def _told_apart(groups: Mapping[str, list[LogView]]) -> dict[str, list[LogView]]:
    """Name groups by their runs' courses as well, where these differ."""
    courses = {view.track_name for some in groups.values() for view in some}
    if len(courses) < 2:
        return dict(groups)
    named: dict[str, list[LogView]] = {}
    for name, some in groups.items():
        for view in some:
            named.setdefault(f"{name} on {view.track_name or 'an unknown track'}", []).append(view)
    return named


def _on_grid(iterations: pd.DataFrame, column: str, grid: Values) -> Values:
    """Return a column's moving average at numbers of control steps, NaN before its first and after its last value."""
    driven = iterations["steps"].to_numpy(np.float64).cumsum()
    values = moving_average(iterations[column].to_numpy(np.float64))
    known = np.isfinite(values)
    if not known.any():
        return np.full(len(grid), np.nan)
    return np.interp(grid, driven[known], values[known], left=np.nan, right=np.nan)


def _best_laps(groups: Mapping[str, Sequence[LogView]]) -> Panel | None:
    names = list(groups)
    x, y = [], []
    for number, some in enumerate(groups.values()):
        for place, view in enumerate(some):
            x.append(number + 0.5 * ((place + 0.5) / len(some) - 0.5))
            y.append(float(view.episodes["lap_time_s"].min()))
    if not np.isfinite(y).any():
        return None
    medians = [
        float(np.median([view.episodes["lap_time_s"].min() for view in some])) for some in groups.values()
    ]
    return Panel(
        title="Best lap of each run",
        y_label="lap time, s",
        x_names=names,
        x_range=(-0.5, len(names) - 0.5),
        layers=[
            # Below the points, which it may coincide with.
            Points(
                x=np.arange(len(names), dtype=np.float64),
                y=np.array(medians),
                name="median",
                color=ORANGE,
                symbol="diamond",
                size=12,
            ),
            Points(x=np.array(x), y=np.array(y), name="a run", color=BLUE, size=6),
        ],
    )


def generations(views: Sequence[LogView]) -> Chart | None:
    """Draw a run and the clones of it on one axis of iterations.

    Args:
        views: the oldest first; a recording of several rounds stands for all of them.
    """
    begins: list[tuple[float, str]] = []
    tables = []
    offset = 0
    for view in views:
        table = view.iterations
        if not len(table):
            continue
        rounds = view.recording.rounds
        first = int(table["iteration"].min())
        starts = [(one.first_iteration, one.name) for one in rounds] or [(first, group_name(view.name))]
        begins += [(float(offset + start - first), name) for start, name in starts]
        generation = (
            len(begins)
            - len(starts)
            + np.searchsorted([s for s, _ in starts[1:]], table["iteration"], "right")
        )
        moved = table["iteration"] + (offset - first)
        tables.append(table.assign(iteration=moved, generation=generation))
        offset = int(moved.max()) + 1
    if len(begins) < 2:
        return None
    whole = pd.concat(tables, ignore_index=True)
    x = whole["iteration"].to_numpy(np.float64)
    panels: list[Panel] = []
    for column, (title, label) in _CURVES.items():
        values = whole[column].to_numpy(np.float64)
        if not np.isfinite(values).any():
            continue
        layers: list[Layer] = []
        for number, (_, name) in enumerate(begins):
            here = (whole["generation"] == number).to_numpy()
            color = CATEGORIES[number % len(CATEGORIES)]
            named = f"{number + 1}: {name}" if not panels else None
            layers.append(Points(x=x[here], y=values[here], color=color, size=3.5))
            layers.append(Line(x=x[here], y=moving_average(values[here]), name=named, color=color, width=2.0))
        layers += [Mark(at=begin - 0.5, label="", color=FAINT) for begin, _ in begins[1:]]
        panels.append(Panel(title=title, x_label=ITERATION, y_label=label, layers=layers))
    gained = whole.groupby("generation")["completion_mean"].max()
    return Chart(
        name="generations",
        title="Generations of clones",
        caption="Each colour is a training that goes on from the one before it; points are iterations, lines their "
        "moving average of three. Best mean progress by generation: "
        + ", ".join(f"{value:.0f}" for value in gained)
        + " per cent.",
        rows=[panels[at : at + 2] for at in range(0, len(panels), 2)],
        share_x=True,
        table=whole,
    )


def generalisation_matrix(views: Sequence[LogView], results: Sequence[pd.DataFrame]) -> Chart | None:
    """Draw how far each policy comes on each track.

    Args:
        views: of the policies' trainings.
        results: what each of them did, `run_folders.evaluation_results`.
    """
    tracks = list(dict.fromkeys(str(track) for table in results for track in table["track"]))
    driven = [(view, table) for view, table in zip(views, results, strict=True) if len(table)]
    if len(tracks) < 2 or not driven:
        return None
    labels = [
        f"{group_name(view.name)}, trained on {view.track_name or 'an unknown track'}" for view, _ in driven
    ]
    names = [label if labels.count(label) == 1 else f"{label} ({at + 1})" for at, label in enumerate(labels)]
    matrix = np.full((len(driven), len(tracks)), np.nan)
    for row, (_, table) in enumerate(driven):
        for track, completion in zip(table["track"], table["completion"], strict=True):
            matrix[row, tracks.index(str(track))] = float(completion)
    layers: list[Layer] = [
        Cells(
            x=tracks,
            y=names,
            values=matrix,
            scale="completion, per cent",
            written=True,
            value_range=(0.0, 100.0),
        )
    ]
    away = [
        matrix[row, column]
        for row, (view, _) in enumerate(driven)
        for column, track in enumerate(tracks)
        if track != view.track_name and np.isfinite(matrix[row, column])
    ]
    told = (
        f"Away from home the mean is {np.mean(away):.0f} per cent."
        if away
        else "No policy was tried away from home."
    )
    return Chart(
        name="generalisation_matrix",
        title="How far each policy comes on each track",
        caption=f"A row is a policy, a column a track it was tried on; empty cells were not tried. {told}",
        rows=[[Panel(x_label="driven on", layers=layers)]],
        table=pd.DataFrame(matrix, index=names, columns=tracks).reset_index(names="policy"),
    )
