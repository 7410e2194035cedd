"""Standings told: a table for people, a JSON file for everything else."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.table import Table

from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.formats.whole_file import write_whole

from .report import NOTHING
from .result import CONFIDENCE
from .standings import Figures, Recommendation, Standing

_MINOR = ("median", "score s")
_HELD_OUT = "held-out\ndone %"
_LABELS = "kept as"
_NAMES = ("steps", _LABELS, "laps %", "done %", _HELD_OUT, "p25 s", "median", "best", "score s")


def table(standings: Sequence[Standing], chosen: Recommendation | None, console: Console) -> Table:
    """Return the standings as a table, a line for each checkpoint, as full as the console is wide.

    Args:
        standings: the oldest first.
        chosen: its line stands out.
        console: where it will be shown.
    """
    hidden = set() if any(_of_held_out(one) is not None for one in standings) else {_HELD_OUT}
    endless = console.options.update(max_width=10_000)
    for intervals, left_out in ((True, hidden), (True, hidden.union(_MINOR)), (False, hidden.union(_MINOR))):
        shown = Table(box=None, pad_edge=False)
        names = [name for name in _NAMES if name not in left_out]
        shown.add_column("checkpoint", no_wrap=True)
        for name in names:
            shown.add_column(name, no_wrap=True, justify="left" if name == _LABELS else "right")
        for one in standings:
            cells = _cells(one, intervals)
            best = chosen is not None and one.name == chosen.name
            style = "bold green" if best else "dim" if one.figures is None else ""
            shown.add_row(one.name, *(cells[name] for name in names), style=style)
        if console.measure(shown, options=endless).maximum <= console.width:
            break
    return shown


def legend(standings: Sequence[Standing]) -> str:
    """Return what the columns of the table are."""
    held_out = any(_of_held_out(one) is not None for one in standings)
    return "; ".join(
        [
            f"laps: share of complete laps, in brackets its {CONFIDENCE:.0%} interval",
            "done: completion, the part of the lap driven, mean",
            *["held-out done: the same on held-out conditions"] * held_out,
            "p25: a quarter of the laps are faster",
            "score: race score, seconds per complete lap on all conditions, failed laps included",
        ]
    )


def notes(standings: Sequence[Standing], chosen: Recommendation | None) -> list[str]:
    """Return what is to be said of single checkpoints, a line each."""
    lines = [f"{one.name} is left out: {one.fault}" for one in standings if one.fault is not None]
    lines += [f"{one.name} is pinned: {', '.join(one.pinned)}" for one in standings if one.pinned]
    if chosen is not None:
        lines.append(f"recommended: {chosen.name}: {chosen.why}")
    return lines


def write_json(
    file: Path,
    run: Path,
    config: EvaluationConfig,
    standings: Sequence[Standing],
    chosen: Recommendation | None,
) -> None:
    """Write the standings with the protocol they were driven under.

    Raises:
        OSError: the file cannot be written.
    """
    content = {
        "run": str(run),
        "evaluation": asdict(config),
        "checkpoints": [asdict(one) for one in standings],
        "recommended": None if chosen is None else asdict(chosen),
    }
    write_whole(file, json.dumps(content, indent=2) + "\n")


def _of_held_out(one: Standing) -> float | None:
    return None if one.figures is None else one.figures.held_out_completion


def _cells(one: Standing, intervals: bool) -> dict[str, str]:
    """Return what is shown of a checkpoint, by column."""
    labels = [*one.labels, *["pinned"] * bool(one.pinned), *["torn"] * (one.figures is None)]
    found = one.figures
    if found is None:
        return {name: NOTHING for name in _NAMES} | {_LABELS: ", ".join(labels)}
    return {
        "steps": f"{one.counters['env_steps']:,}",
        _LABELS: ", ".join(labels),
        "laps %": _share(found, intervals),
        "done %": f"{found.completion:.1f}",
        _HELD_OUT: NOTHING if found.held_out_completion is None else f"{found.held_out_completion:.1f}",
        "p25 s": _seconds(found.lap_time_p25_s),
        "median": _seconds(found.lap_time_median_s),
        "best": _seconds(found.lap_time_best_s),
        "score s": _seconds(found.race_score_s),
    }


def _share(found: Figures, intervals: bool) -> str:
    share = f"{100 * found.lap_share:.0f}"
    if found.lap_share_interval is None or not intervals:
        return share
    low, high = (f"{100 * bound:.0f}" for bound in found.lap_share_interval)
    return share if low == high else f"{share} ({low}\N{EN DASH}{high})"


def _seconds(time: float | None) -> str:
    return NOTHING if time is None else f"{time:.2f}"
