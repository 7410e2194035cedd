"""Several runs or checkpoints in one figure: learning curves, generations, generalisation, speed and stability."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from deepracer_exp.aws.logs.recorded import TRAINING
from deepracer_exp.files import read_json
from deepracer_exp.reports.tables.evidence import iqm_band
from deepracer_exp.reports.tables.log_view import LogView
from deepracer_exp.reports.tables.statistics import Values, moving_average
from deepracer_exp.runs.lineage import clone_chain
from deepracer_exp.runs.run_files import EVALUATIONS

from .figure import Chart, Layer, Panel, band, heatmap, in_rows, line, mark, note, points
from .style import BLUE, CATEGORIES, FAINT, INK, ORANGE
from .training_charts import ITERATION

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


def group_name(name: str) -> str:
    """Return the common part of the names of runs that differ only in time and seed."""
    return _SEED.sub("", _TIME.sub("", name)) or name


def recordings_compared(named: Sequence[tuple[str | None, LogView]]) -> Chart | None:
    """Draw the training of runs and logs beside each other.

    Args:
        named: recordings, each with the name of the group that it was given to; None: recordings whose names differ
            only in time and seed form a group, drawn as interquartile mean with interval.
    """
    if len(named) < 2:
        return None
    views = [view for _, view in named]
    several = len({view.track_name for view in views}) > 1
    groups: dict[str, list[LogView]] = {}
    for name, view in named:
        course = f" on {view.track_name or 'an unknown track'}" if several else ""
        groups.setdefault((name or group_name(view.name)) + course, []).append(view)
    longest = max(float(view.iterations["steps"].sum()) for view in views)
    grid = np.linspace(0.0, longest, _PLACES)
    factor, unit = (1e-6, "million control steps") if longest >= 2e6 else (1e-3, "thousand control steps")
    panels: list[Panel] = []
    for column, (title, label) in _CURVES.items():
        layers: list[Layer] = []
        for number, (name, some) in enumerate(groups.items()):
            color = CATEGORIES[number % len(CATEGORIES)]
            curves = np.stack([_on_grid(view.iterations, column, grid) for view in some])
            if not np.isfinite(curves).any():
                continue
            middle, low, high = iqm_band(curves)
            if np.isfinite(low).any():
                layers.append(band(factor * grid, low, high, color))
            layers.append(line(factor * grid, middle, color, None if panels else name, width=2.5))
        if layers:
            x_range = (0.0, factor * longest)
            panels.append(Panel(title=title, x_label=unit, y_label=label, layers=layers, x_range=x_range))
    if not panels:
        return None
    panels += _best_laps(groups)
    counts = sorted({len(some) for some in groups.values()})
    words = (
        f"Lines are interquartile means over {' or '.join(map(str, counts))} recordings, bands their bootstrap "
        "intervals (95 per cent; from three recordings on)"
        if counts[-1] > 1
        else "Each line is one recording, so that nothing says how much of a difference is chance"
    )
    return Chart(
        name="recordings_compared",
        title="Recordings compared",
        caption=f"{words}. Episodes are those of the training, which explores.",
        rows=in_rows(panels),
    )


def _on_grid(iterations: pd.DataFrame, column: str, grid: Values) -> Values:
    """Return a column's moving average at numbers of control steps, NaN before its first and after its last value."""
    driven = iterations["steps"].to_numpy(np.float64).cumsum()
    values = moving_average(iterations[column].to_numpy(np.float64))
    finite = np.isfinite(values)
    if not finite.any():
        return np.full(len(grid), np.nan)
    return np.interp(grid, driven[finite], values[finite], left=np.nan, right=np.nan)


def _best_laps(groups: Mapping[str, Sequence[LogView]]) -> list[Panel]:
    best_s = [[float(view.comparable["lap_time_s"].min()) for view in some] for some in groups.values()]
    if not np.isfinite(np.concatenate(best_s)).any():
        return []
    places = [x + 0.5 * ((np.arange(len(laps)) + 0.5) / len(laps) - 0.5) for x, laps in enumerate(best_s)]
    n = len(groups)
    layers = [
        # Below the points, which it may coincide with.
        points(np.arange(n), list(map(np.median, best_s)), ORANGE, "median", symbol="diamond", size=16),
        points(np.concatenate(places), np.concatenate(best_s), BLUE, "a recording", size=8),
    ]
    axis: dict[str, Any] = {"x_names": list(groups), "x_range": (-0.5, n - 0.5), "y_label": "lap time, s"}
    return [Panel(title="Fastest exploring lap of each recording", layers=layers, **axis)]


def generations(views: Sequence[LogView]) -> Chart | None:
    """Draw a run and the clones of it, or the rounds of the first recording, on one axis of iterations."""
    parts: list[tuple[str, pd.DataFrame]] = []
    offset = 0
    for view in _clone_chain(views) or views[:1]:
        table = view.iterations
        if not len(table):
            continue
        first = int(table["iteration"].min())
        starts = [(part.first_iteration, part.name) for part in view.recording.rounds]
        starts = starts or [(first, group_name(view.name))]
        number = np.searchsorted([start for start, _ in starts[1:]], table["iteration"], "right")
        moved = table.assign(iteration=table["iteration"] + offset - first)
        # A training on another track has no iteration here.
        parts += [(name, moved[number == k]) for k, (_, name) in enumerate(starts) if (number == k).any()]
        offset = int(moved["iteration"].max()) + 1
    if len(parts) < 2:
        return None
    panels: list[Panel] = []
    for column, (title, label) in _CURVES.items():
        if not any(table[column].notna().any() for _, table in parts):
            continue
        layers: list[Layer] = []
        for number, (name, table) in enumerate(parts):
            x, y = table["iteration"], table[column].to_numpy(np.float64)
            color = CATEGORIES[number % len(CATEGORIES)]
            text = None if panels else f"{number + 1}: {name}"
            layers += [points(x, y, color, size=5), line(x, moving_average(y), color, text, width=2.5)]
        layers += [mark(table["iteration"].min() - 0.5, "", FAINT) for _, table in parts[1:]]
        panels.append(Panel(title=title, x_label=ITERATION, y_label=label, layers=layers))
    best = ", ".join(f"{table['completion_mean'].max():.0f}" for _, table in parts)
    return Chart(
        name="generations",
        title="Generations of clones",
        caption="Each colour is a training that continues the one before it; points are iterations, lines their "
        f"moving average of three. Best mean progress by generation: {best} per cent.",
        rows=in_rows(panels),
        share_x=True,
    )


def _clone_chain(views: Sequence[LogView]) -> list[LogView]:
    """Return the views that are a run and its clones, the oldest first; none where that is not known."""
    by_folder = {folder.resolve(): view for view in views if (folder := view.run_folder) is not None}
    return [by_folder[folder] for folder in clone_chain([*by_folder])]


def generalisation_matrix(driven: Sequence[tuple[str, str | None, Mapping[str, float]]]) -> Chart | None:
    """Draw each policy's completion on each track, as evaluated or raced.

    Args:
        driven: of each policy its name, the track it was trained on, and its mean completion, per cent, by track.
    """
    driven = [row for row in driven if row[2]]
    tracks = list(dict.fromkeys(track for _, _, results in driven for track in results))
    if len(tracks) < 2:
        return None
    labels = [
        f"{group_name(name)}, trained on {trained or 'an unknown track'}" for name, trained, _ in driven
    ]
    names = [label if labels.count(label) == 1 else f"{label} ({k + 1})" for k, label in enumerate(labels)]
    matrix = np.array([[results.get(track, np.nan) for track in tracks] for _, _, results in driven])
    scale, places = "completion, per cent", (np.arange(len(tracks)), np.arange(len(names)))
    cells = heatmap(*places, matrix, scale, written=True, value_range=(0.0, 100.0))
    foreign = np.array([[track != trained for track in tracks] for _, trained, _ in driven])
    away = matrix[foreign & np.isfinite(matrix)]
    words = (
        f"On tracks that a policy was not trained on, the mean is {away.mean():.0f} per cent."
        if len(away)
        else "No policy was tried on a track that it was not trained on."
    )
    return Chart(
        name="generalisation_matrix",
        title="How far each policy drives on each track",
        caption=f"A row is a policy, a column a track it was tried on; empty cells were not tried. {words}",
        rows=[[Panel(x_label="driven on", layers=[cells], x_names=tracks, y_names=names)]],
    )


def policy_of(view: LogView) -> tuple[str, str | None, dict[str, float]]:
    """Return a recording's name, track, and mean completion in per cent by track: of its evaluations and races.

    Of a run of ours those are the stored evaluations.
    """
    steps = view.recording.steps
    raced = steps[(steps["stream"] != TRAINING).to_numpy()].astype({"track": str, "stream": str})
    episodes = raced.groupby(["track", "stream", "episode"])["progress"].max()
    by_track: dict[str, float] = episodes.groupby("track").mean().to_dict()
    folder = view.run_folder
    return view.name, view.track_name, by_track | (stored_completion(folder) if folder is not None else {})


def stored_completion(run: Path) -> dict[str, float]:
    """Return the mean completion in per cent by track: of its newest stored evaluation there, usual conditions.

    Files that are no evaluation are left out.
    """
    by_track: dict[str, float] = {}
    for file in sorted((run / EVALUATIONS).glob("*.json")):
        try:
            groups: list[dict[str, Any]] = read_json(file, "what `evaluate` writes there")["groups"]
            usual = [group for group in groups if group["condition"] == "usual"]
            by_track |= {str(group["track"]): float(group["completion"]["mean"]) for group in usual}
        except (ValueError, TypeError, KeyError):
            continue
    return by_track


def evaluated_laps(checkpoints: pd.DataFrame) -> Chart | None:
    """Draw the time of every evaluated lap of each checkpoint; None without a complete lap.

    `checkpoints` has a row each, the oldest first: `name`, and `laps_s`, the times of its complete laps on the usual
    conditions, s.
    """
    laps_s = [np.asarray(times_s, np.float64) for times_s in checkpoints["laps_s"]]
    if not sum(map(len, laps_s)):
        return None
    x = [x + 0.5 * ((np.arange(len(some)) + 0.5) / max(len(some), 1) - 0.5) for x, some in enumerate(laps_s)]
    medians = [float(np.median(some)) if len(some) else np.nan for some in laps_s]
    panel = Panel(
        layers=[
            points(np.concatenate(x), np.concatenate(laps_s), BLUE, "a lap", size=7),
            points(np.arange(len(laps_s)), medians, ORANGE, "median", size=13, symbol="diamond"),
        ],
        x_names=list(checkpoints["name"]),
        x_label="checkpoint",
        y_label="lap time, s",
    )
    return Chart(
        name="evaluated_laps",
        title="Evaluated laps of each checkpoint",
        caption="Complete laps on the usual conditions, from left to right in the order of the trials; a checkpoint "
        "without one has no point.",
        rows=[[panel]],
    )


def speed_and_stability(checkpoints: pd.DataFrame, recommended: str) -> Chart:
    """Draw the lap time of checkpoints against their share of complete laps.

    Args:
        checkpoints: one row each, the oldest first: `name`, `labels` (`best, last` or the like), `lap_time_s` (25th
            percentile; NaN without a lap), `complete` (per cent of the episodes) with its interval `low` to `high`,
            and `held_out_lap_time_s` and `held_out_complete` on held-out conditions (NaN if there are none).
        recommended: name of the one with a ring.
    """
    layers: list[Layer] = []
    for number, checkpoint in enumerate(checkpoints.itertuples()):
        color, x = CATEGORIES[number % len(CATEGORIES)], checkpoint.lap_time_s
        if np.isfinite(checkpoint.held_out_lap_time_s):
            away, share = checkpoint.held_out_lap_time_s, checkpoint.held_out_complete
            between = np.linspace(x, away, 3), np.linspace(checkpoint.complete, share, 3)
            layers.append(line(*between, color, width=1.0))
            layers.append(points([away], [share], color, size=9, symbol="circle-open"))
        layers.append(line([x, x, x], [checkpoint.low, checkpoint.complete, checkpoint.high], color))
        if checkpoint.name == recommended:
            ring = f"recommended: checkpoint {recommended}"
            layers.append(points([x], [checkpoint.complete], INK, ring, size=20, symbol="circle-open"))
        # Lap times are multiples of the control period, so that points coincide: the older ones are larger.
        later = checkpoints.iloc[number + 1 :]
        above = ((later["lap_time_s"] == x) & (later["complete"] == checkpoint.complete)).sum()
        words = "  ".join(
            filter(
                None,
                [f"checkpoint {checkpoint.name}", checkpoint.labels, "" if np.isfinite(x) else "no lap"],
            )
        )
        layers.append(points([x], [checkpoint.complete], color, words, size=8 + 5 * above))
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
        title="Speed and stability of the checkpoints",
        caption="Filled points are the usual conditions, with the 95 per cent interval of the share of complete laps; "
        "open points are held-out conditions.",
        rows=[[panel]],
    )
