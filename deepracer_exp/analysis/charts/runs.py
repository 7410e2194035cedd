"""Several runs or checkpoints in one figure: learning curves, generations, generalisation, speed and stability."""

import re
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from deepracer_exp.analysis.comparison import last_value
from deepracer_exp.analysis.log_view import LogView
from deepracer_exp.analysis.statistics import Values, median_band, moving_average
from deepracer_exp.runs.files import RunRecord

from .figure import Chart, Layer, Panel, band, bars, heatmap, in_rows, line, mark, note, points
from .style import BLUE, CATEGORIES, FAINT, INK, ORANGE
from .training import ITERATION

_CURVES = {
    "completion_mean": ("Progress", "per cent of the lap"),
    "reward_mean": ("Reward", "reward of an episode"),
    "lap_time_p25_s": ("Lap time, 25th percentile", "lap time, s"),
    "entropy": ("Entropy of the policy", "nats"),
}
_SMOOTHED = 5
"""Iterations in the moving average of a learning curve."""
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
    groups = _split_by_course(groups)
    longest = max(float(view.iterations["steps"].sum()) for view in views)
    grid = np.linspace(0.0, longest, _PLACES)
    factor, unit = (1e-6, "million control steps") if longest >= 2e6 else (1e-3, "thousand control steps")
    tables = []
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
                layers.append(band(factor * grid, low, high, color))
            layers.append(line(factor * grid, median, color, None if panels else name, width=2.0))
            found = {"group": name, "runs": len(some), "column": column, "steps": grid, "median": median}
            tables.append(pd.DataFrame(found | {"low": low, "high": high}))
        if layers:
            x_range = (0.0, factor * longest)
            panels.append(Panel(title=title, x_label=unit, y_label=label, layers=layers, x_range=x_range))
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
        rows=in_rows(panels),
        table=pd.concat(tables, ignore_index=True),
    )


def group_name(name: str) -> str:
    """Return what the names of runs that differ only in time and seed have in common."""
    return _SEED.sub("", _TIME.sub("", name)) or name


def _split_by_course(groups: Mapping[str, list[LogView]]) -> dict[str, list[LogView]]:
    """Split and name groups by their course as well, if there are several courses."""
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
    best = [[float(view.episodes["lap_time_s"].min()) for view in some] for some in groups.values()]
    y = np.concatenate(best)
    if not np.isfinite(y).any():
        return None
    x = [
        number + 0.5 * ((at + 0.5) / len(some) - 0.5)
        for number, some in enumerate(best)
        for at in range(len(some))
    ]
    medians = [float(np.median(some)) for some in best]
    return Panel(
        title="Best lap of each run",
        y_label="lap time, s",
        x_names=names,
        x_range=(-0.5, len(names) - 0.5),
        layers=[
            # Below the points, which it may coincide with.
            points(np.arange(len(names)), medians, ORANGE, "median", symbol="diamond", size=12),
            points(x, y, BLUE, "a run", size=6),
        ],
    )


def generations(views: Sequence[LogView]) -> Chart | None:
    """Draw a run and the clones of it on one axis of iterations.

    Args:
        views: the oldest first; a recording of several rounds contains all of these.
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
    panels: list[Panel] = []
    for column, (title, label) in _CURVES.items():
        if not whole[column].notna().any():
            continue
        layers: list[Layer] = []
        for number, (_, name) in enumerate(begins):
            here = whole[whole["generation"] == number]
            x, y = here["iteration"], here[column].to_numpy(np.float64)
            color = CATEGORIES[number % len(CATEGORIES)]
            text = None if panels else f"{number + 1}: {name}"
            layers.append(points(x, y, color, size=3.5))
            layers.append(line(x, moving_average(y), color, text, width=2.0))
        layers += [mark(begin - 0.5, "", FAINT) for begin, _ in begins[1:]]
        panels.append(Panel(title=title, x_label=ITERATION, y_label=label, layers=layers))
    gained = whole.groupby("generation")["completion_mean"].max()
    return Chart(
        name="generations",
        title="Generations of clones",
        caption="Each colour is a training that continues the one before it; points are iterations, lines their "
        "moving average of three. Best mean progress by generation: "
        + ", ".join(f"{value:.0f}" for value in gained)
        + " per cent.",
        rows=in_rows(panels),
        share_x=True,
        table=whole,
    )


def generalisation_matrix(views: Sequence[LogView], results: Sequence[pd.DataFrame]) -> Chart | None:
    """Draw how far each policy drives on each track.

    Args:
        views: of the policies' trainings.
        results: of their evaluations, `run_folders.evaluation_results`.
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
    cells = heatmap(
        np.arange(len(tracks)),
        np.arange(len(names)),
        matrix,
        "completion, per cent",
        written=True,
        value_range=(0.0, 100.0),
    )
    away = [
        value
        for row, (view, _) in zip(matrix, driven, strict=True)
        for track, value in zip(tracks, row, strict=True)
        if track != view.track_name and np.isfinite(value)
    ]
    words = (
        f"On tracks that a policy was not trained on, the mean is {np.mean(away):.0f} per cent."
        if away
        else "No policy was tried on a track that it was not trained on."
    )
    return Chart(
        name="generalisation_matrix",
        title="How far each policy drives on each track",
        caption=f"A row is a policy, a column a track it was tried on; empty cells were not tried. {words}",
        rows=[[Panel(x_label="driven on", layers=[cells], x_names=tracks, y_names=names)]],
        table=pd.DataFrame(matrix, index=names, columns=tracks).reset_index(names="policy"),
    )


def learning_curves_compared(records: Mapping[str, RunRecord]) -> Chart:
    """Draw the learning curves of our own runs over each other, and their lap times.

    Args:
        records: the runs by a short label, each with at least one iteration.
    """
    named = [f"{label}  {record.name}" for label, record in records.items()]
    panels: list[Panel] = []
    for column, title, unit in (
        ("completion", "Completion, mean", "per cent of the lap"),
        ("mean_return", "Return of an episode, mean", "return"),
        ("mean_lap_time_s", "Lap time, mean", "s"),
    ):
        layers: list[Layer] = []
        for number, (name, record) in enumerate(zip(named, records.values(), strict=True)):
            rows = pd.DataFrame(record.rows)
            columns = [one for one in rows if one.startswith(f"{column}/")] or [column]
            # Not every iteration ends an episode on every track.
            values = rows[columns].astype(float).ffill().mean(axis=1, skipna=False)
            curve = values.rolling(_SMOOTHED, min_periods=1).mean()
            steps, color = rows["env_steps"] / 1000, CATEGORIES[number % len(CATEGORIES)]
            dashed = number >= len(CATEGORIES)
            layers.append(line(steps, curve, color, None if panels else name, dashed=dashed))
        panels.append(Panel(title=title, x_label="thousand control steps", y_label=unit, layers=layers))
    best_s, mean_s = (
        np.array([last_value(record, name) for record in records.values()], np.float64)
        for name in ("best_lap_time_s", "mean_lap_time_s")
    )
    at = np.arange(len(records))
    laps: list[Layer] = [
        bars(at, best_s, BLUE, "best"),
        points(at, mean_s, ORANGE, "mean of the last iteration", size=8, symbol="diamond"),
        *(note((float(k), 0.0), "no lap") for k in at[np.isnan(best_s)]),
    ]
    panels.append(Panel(title="Laps in training", y_label="lap time, s", layers=laps, x_names=list(records)))
    return Chart(
        name="learning_curves_compared",
        title="Learning curves and lap times",
        caption=f"Lines are moving averages of {_SMOOTHED} iterations.",
        rows=in_rows(panels),
        table=pd.DataFrame({"run": named, "best_lap_time_s": best_s, "mean_lap_time_s": mean_s}),
    )


def speed_and_stability(run: str, checkpoints: pd.DataFrame, recommended: str) -> Chart:
    """Draw the lap time of checkpoints against their share of complete laps.

    Args:
        run: its name.
        checkpoints: one row each, the oldest first: `name`, `labels` (`best, last` or the like), `lap_time_s` (25th
            percentile; NaN without a lap), `complete` (per cent of the episodes) with its interval `low` to `high`,
            and `held_out_lap_time_s` and `held_out_complete` on held-out conditions (NaN if there are none).
        recommended: name of the one with a ring.
    """
    layers: list[Layer] = []
    for number, one in enumerate(checkpoints.itertuples()):
        color, x = CATEGORIES[number % len(CATEGORIES)], one.lap_time_s
        if np.isfinite(one.held_out_lap_time_s):
            away, share = one.held_out_lap_time_s, one.held_out_complete
            layers.append(
                line(np.linspace(x, away, 3), np.linspace(one.complete, share, 3), color, width=0.8)
            )
            layers.append(points([away], [share], color, size=7, symbol="circle-open"))
        layers.append(line([x, x, x], [one.low, one.complete, one.high], color))
        if one.name == recommended:
            ring = f"recommended: {recommended}"
            layers.append(points([x], [one.complete], INK, ring, size=15, symbol="circle-open"))
        # Lap times are multiples of the control period, so that points coincide: the older ones are larger.
        later = checkpoints.iloc[number + 1 :]
        above = ((later["lap_time_s"] == x) & (later["complete"] == one.complete)).sum()
        words = "  ".join(filter(None, [one.name, one.labels, "" if np.isfinite(x) else "no lap"]))
        layers.append(points([x], [one.complete], color, words, size=6 + 4 * above))
    times_s = checkpoints[["lap_time_s", "held_out_lap_time_s"]].to_numpy(np.float64)
    times_s = times_s[np.isfinite(times_s)]
    x_range = (0.0, 1.0)
    if len(times_s):
        rim = max(0.12 * float(np.ptp(times_s)), 0.05)
        x_range = (float(times_s.max()) + rim, float(times_s.min()) - rim)
    else:
        layers.append(note((0.5, 50.0), "no complete lap"))
    panel = Panel(
        x_label="lap time, 25th percentile, s (faster to the right)",
        y_label="complete laps, per cent",
        layers=layers,
        x_range=x_range,
        y_range=(-4.0, 104.0),
    )
    return Chart(
        name="speed_and_stability",
        title=f"{run}: speed and stability of its checkpoints",
        caption="Filled points are the usual conditions, with the 95 per cent interval of the share of complete laps; "
        "open points are held-out conditions.",
        rows=[[panel]],
        table=checkpoints,
    )
