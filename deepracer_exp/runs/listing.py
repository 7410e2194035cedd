"""The runs of a folder as rows: what `deepracer-exp runs` lists."""

import datetime
from pathlib import Path
from typing import Any

from deepracer_exp.errors import BadInput

from .files import CONFIG, PROVENANCE, SUMMARY, full_name, read_object, read_run_id, run_folders
from .labels import read_labels

COLUMNS = (
    "run",
    "name",
    "state",
    "lap_s",
    "score_s",
    "exploring_laps",
    "exploring_lap_s",
    "began",
    "user",
    "host",
    "note",
    "id",
)
"""Columns of a row; `tag.KEY` for each tag follows. `run` is EXPERIMENT/FOLDER, `began` an ISO time, `lap_s`
the mean usual lap of the best checkpoint, `score_s` its race score (usual and held-out), `exploring_lap_s` the fastest
exploring lap, all in seconds."""

Row = dict[str, Any]


def rows_of_folder(runs_dir: Path) -> list[Row]:
    """Return a row for each run of a folder, the newest first."""
    rows = map(_of_folder, run_folders(runs_dir))
    return sorted(rows, key=lambda row: (row["began"], row["run"]), reverse=True)


def _of_folder(folder: Path) -> Row:
    row: Row = dict.fromkeys(COLUMNS)
    row |= {"run": full_name(folder), "began": iso_time(_began_s(folder))}
    try:
        summary, labels = read_object(folder / SUMMARY), read_labels(folder)
        row["id"] = read_run_id(folder)
        machine = read_object(folder / PROVENANCE).get("machine") or {}
    except BadInput:  # one damaged run does not hide the others
        return row | {"state": "unreadable"}
    if not summary.get("status"):
        from .folder import is_held  # imports Hydra, which a run that has ended does without

        summary = {"status": "running" if is_held(folder) else "killed"}
    row["state"] = str(summary["status"])
    best = summary.get("best") or {}
    row |= {"lap_s": best.get("eval_lap_time_s"), "score_s": best.get("eval_race_score_s")}
    row |= {"exploring_laps": summary.get("laps"), "exploring_lap_s": summary.get("best_lap_time_s")}
    row |= {"name": labels.name, "note": labels.note}
    row |= {key: machine.get(key) for key in ("user", "host")}
    return row | labels.named_tags


def _began_s(folder: Path) -> float:
    """Return when a run began, Unix time: its folder's name says so, unless it was renamed."""
    try:
        return datetime.datetime.strptime(folder.name[: len("20260101-120000")], "%Y%m%d-%H%M%S").timestamp()
    except ValueError:
        return (folder / CONFIG).stat().st_mtime


def iso_time(seconds: float) -> str:
    """Return a Unix time as an ISO time of UTC, which sorts as a text."""
    return datetime.datetime.fromtimestamp(seconds, datetime.UTC).isoformat(timespec="seconds")
