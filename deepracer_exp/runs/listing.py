"""The runs of a folder as rows for `deepracer-exp runs`."""

import datetime
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from deepracer_exp.errors import BadInput, count

from .checkpoint_files import BEST
from .labels import read_labels
from .run_files import (
    CHECKPOINTS,
    CONFIG,
    METRICS,
    PROVENANCE,
    SUMMARY,
    full_name,
    read_metrics,
    read_object,
    read_run_id,
    run_folders,
)

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
    "study",
    "trial",
    "note",
    "id",
)
"""Columns of a row; `tag.KEY` for each tag follows. `run` is EXPERIMENT/FOLDER, `began` an ISO time, `lap_s` the mean
usual lap of the best checkpoint, `score_s` its race score (usual and held-out), `exploring_lap_s` the fastest exploring
lap, all in seconds; of a run in progress, those so far. `study` and `trial`: of a run that a sweep has made, once it
has ended."""

Row = dict[str, Any]
RUNNING, KILLED = "running", "killed"


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

        summary = {"status": RUNNING if is_held(folder) else KILLED}
    row["state"] = str(summary["status"])
    row |= {key: summary.get(key) for key in ("study", "trial")}
    if summary["status"] == RUNNING:
        summary = _so_far(folder)
    best = summary.get("best") or {}
    row |= {"lap_s": best.get("eval_lap_time_s"), "score_s": best.get("eval_race_score_s")}
    row |= {"exploring_laps": summary.get("laps"), "exploring_lap_s": summary.get("best_lap_time_s")}
    row |= {"name": labels.name, "note": labels.note}
    row |= {key: machine.get(key) for key in ("user", "host")}
    return row | labels.named_tags


def _so_far(folder: Path) -> dict[str, Any]:
    """Return the figures of a run in progress, by the keys of a summary: from its metrics and its best checkpoint."""
    try:
        rows = read_metrics(folder / METRICS)
    except BadInput:  # it has only begun
        return {}
    name = (folder / CHECKPOINTS / BEST).resolve().name
    best = next((row for row in rows if f"{row['iteration']:06d}" == name), None)
    return {**(rows[-1] if rows else {}), "best": best}


def fold_studies(rows: Sequence[Row], best_runs: Mapping[str, str]) -> list[Row]:
    """Collapse the runs of each study into a single row, in the place of the first.

    The row has the figures of the study's best run: the one in `best_runs` under the study's name, or else the one with
    the best race score.
    """
    studies = {row["study"] for row in rows if row["study"] is not None}
    members: dict[str, list[Row]] = {study: [] for study in studies}
    folded: list[Row] = []
    for row in rows:
        study = row["run"].partition("/")[0]
        # Only the end of a run says that a sweep has made it.
        if row["study"] in studies or (study in studies and row["state"] in (RUNNING, KILLED)):
            of_study = members[row["study"] or study]
            if not of_study:
                folded.append(row)
            of_study.append(row)
        else:
            folded.append(row)
    first = {id(some[0]): _of_study(study, some, best_runs.get(study)) for study, some in members.items()}
    return [first.get(id(row), row) for row in folded]


def _of_study(study: str, rows: Sequence[Row], best_run: str | None) -> Row:
    def rank(row: Row) -> tuple[bool, float]:
        score_s = row["score_s"]
        return row["run"] != f"{study}/{best_run}", math.inf if score_s is None else score_s

    trials = {row["trial"] for row in rows if row["trial"] is not None}
    # A run says whose trial it is when it ends; one that has ended and is none is the clone of the best.
    number = len(trials) + sum(row["study"] is None for row in rows)
    laps = [row["exploring_laps"] for row in rows if row["exploring_laps"] is not None]
    running = any(row["state"] == RUNNING for row in rows)
    return min(rows, key=rank) | {
        "run": f"best:{study}, of {count(number, 'trial')}",
        "state": RUNNING if running else "ended",
        "exploring_laps": sum(laps) if laps else None,
        "began": rows[0]["began"],
    }


def _began_s(folder: Path) -> float:
    """Return when a run began, Unix time: its folder's name says so, unless it was renamed."""
    try:
        return datetime.datetime.strptime(folder.name[: len("20260101-120000")], "%Y%m%d-%H%M%S").timestamp()
    except ValueError:
        return (folder / CONFIG).stat().st_mtime


def iso_time(seconds: float) -> str:
    """Return a Unix time as an ISO time of UTC, which sorts as a text."""
    return datetime.datetime.fromtimestamp(seconds, datetime.UTC).isoformat(timespec="seconds")
