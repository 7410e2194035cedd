"""What stands in the folders of our own runs beside the recording: where a clone comes from, and evaluations."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from deepracer_exp.errors import BadInput
from deepracer_exp.runs.files import EVALUATIONS, METRICS
from deepracer_exp.runs.lineage import LINEAGE, read_lineage

from .log_view import LogView

RESULT_COLUMNS = ("track", "completion", "lap_share", "lap_time_s")
USUAL = "usual"
"""Condition of an evaluation that is as the training's."""


def run_folder(view: LogView) -> Path | None:
    """Return the folder of a run of ours, None of other recordings."""
    return next((file.parent for file in view.recording.files if file.name == METRICS), None)


def clone_chain(views: Sequence[LogView]) -> list[LogView]:
    """Return the views that are a run and its clones, the oldest first; none where that is not known.

    A file that says where a clone comes from and cannot be read counts as none.
    """
    generation = {}
    for place, view in enumerate(views):
        folder = run_folder(view)
        try:
            lineage = read_lineage(folder) if folder is not None and (folder / LINEAGE).is_file() else None
        except BadInput:
            lineage = None
        generation[place] = (
            view.name,
            lineage.parent if lineage else None,
            lineage.generation if lineage else 0,
        )
    names = {name for name, _, _ in generation.values()}
    parents = {parent for _, parent, _ in generation.values()}
    related = [
        (number, place)
        for place, (name, parent, number) in generation.items()
        if parent in names or name in parents
    ]
    return [views[place] for _, place in sorted(related)]


def evaluation_results(view: LogView) -> pd.DataFrame:
    """Return what the policy of a recording did on each track, one row each with `RESULT_COLUMNS`.

    These are the recorded evaluations and races; of a run of ours the newest stored evaluation of each track on usual
    conditions. Files that are no evaluation are left out.
    """
    rows = {str(row["track"]): row for row in _driven(view)}
    folder = run_folder(view)
    for file in sorted((folder / EVALUATIONS).glob("*.json")) if folder is not None else ():
        try:
            groups = json.loads(file.read_text(encoding="utf-8"))["groups"]
            for group in groups:
                if group["condition"] == USUAL:
                    rows[str(group["track"])] = _stored(group)
        except (OSError, ValueError, TypeError, KeyError, AttributeError):
            continue
    return pd.DataFrame(list(rows.values()), columns=list(RESULT_COLUMNS))


def _stored(group: dict[str, Any]) -> dict[str, Any]:
    found = {name: group[name]["mean"] for name in RESULT_COLUMNS[1:]}
    return {
        "track": group["track"],
        **{name: float("nan") if v is None else float(v) for name, v in found.items()},
    }


def _driven(view: LogView) -> list[dict[str, Any]]:
    steps = view.recording.steps
    raced = steps[steps["stream"].astype(str) != "training"]
    if not len(raced):
        return []
    keys = [raced[name].astype(str) for name in ("track", "stream")]
    groups = raced.groupby([*keys, raced["episode"]])
    episodes = pd.DataFrame(
        {
            "progress": groups["progress"].max(),
            "time_s": groups["tstamp"].max() - groups["tstamp"].min(),
        }
    ).reset_index(level="track")
    return [
        {
            "track": str(track),
            "completion": float(some["progress"].mean()),
            "lap_share": float((some["progress"] >= 100).mean()),
            "lap_time_s": float(some["time_s"][some["progress"] >= 100].mean()),
        }
        for track, some in episodes.groupby("track")
    ]
