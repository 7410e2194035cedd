"""The runs of an MLflow store as rows for `deepracer-exp runs tracking.uri=URI`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from deepracer_exp.runs.labels import USER_TAG
from deepracer_exp.runs.listing import Row, iso_time

from .calls import pages
from .metadata import END_TAG, HOST, NAME, STUDY, USER_NOTE
from .mlflow_metrics import BEST, METRICS
from .store import open_client
from .study_run import KIND, TRIAL


def rows_of_store(uri: str, runs_dir: Path) -> list[Row]:
    """Return a row for each run of an MLflow store, the newest first, without the runs of studies that group others.

    Raises:
        BadInput: the store does not answer.
    """
    with open_client("runs", uri, runs_dir) as client:
        names = {experiment.experiment_id: experiment.name for experiment in pages(client.search_experiments)}
        runs = list(pages(client.search_runs, experiment_ids=list(names)))
    rows = [_of_store(run, names[run.info.experiment_id]) for run in runs if KIND not in run.data.tags]
    return sorted(rows, key=lambda row: (row["began"], row["run"]), reverse=True)


def _of_store(run: Any, experiment: str) -> Row:
    tags: Mapping[str, str] = run.data.tags
    metrics: Mapping[str, float] = run.data.metrics
    state = tags.get(END_TAG, "").partition(":")[0] or run.info.status.lower()
    folder = Path(tags.get("run_dir", run.info.run_id)).name
    row = {
        "run": f"{experiment}/{folder}",
        "name": tags.get(NAME),
        "state": state,
        "lap_s": metrics.get(f"{BEST}lap_time_s"),
        "score_s": metrics.get(f"{BEST}score_s"),
        "exploring_laps": metrics.get(METRICS["laps"][0]),
        "exploring_lap_s": metrics.get(METRICS["best_lap_time_s"][0]),
        "began": iso_time(run.info.start_time / 1000),
        "user": tags.get("mlflow.user"),
        "host": tags.get(HOST),
        "study": tags.get(STUDY),
        "trial": tags.get(TRIAL),
        "note": tags.get(USER_NOTE),
        "id": run.info.run_id,
        **{key: value for key, value in tags.items() if key.startswith(USER_TAG)},
    }
    # Anyone can write tags on a server; control characters would reach the terminal.
    return {_printable(key): _printable(value) for key, value in row.items()}


def _printable(value: Any) -> Any:
    return (
        "".join(character if character.isprintable() else " " for character in value)
        if isinstance(value, str)
        else value
    )
