import json
import math
import socket
import sqlite3
import time
from dataclasses import replace
from pathlib import Path

import pytest
from mlflow import MlflowClient

from deepracer_exp.runs.run_files import read_run_id
from deepracer_exp.tracking import projector
from deepracer_exp.tracking.metadata import param_text
from deepracer_exp.tracking.mlflow_metrics import metric_name, now_ms
from deepracer_exp.tracking.mlflow_run import MLflowRun
from deepracer_exp.tracking.projection import MLflowProjection
from deepracer_exp.tracking.store import resolve_store
from deepracer_exp.tracking.tracker import ProjectedTracker
from deepracer_exp.tracking.tracking_file import TrackedRun, write_tracked_run

from .conftest import TrackerHere, begin, points, write_rows


def test_every_point_is_recorded_once_and_at_its_env_step(tracker, mlflow, tmp_path):
    steps = [8192 * iteration for iteration in range(1, 301)]
    write_rows(tmp_path, [{"env_steps": step, "completion": step / 100, "lr": 1 / step} for step in steps])
    more = [None, math.nan, 9.5, math.inf]  # what is no number leaves a gap
    write_rows(tmp_path, [{"env_steps": 10**7 + n, "best_lap_time_s": lap_s} for n, lap_s in enumerate(more)])
    tracker.finish("FINISHED")
    assert tracker.failure is None
    assert points(mlflow, tracker.run_id, "best_lap_time_s") == [(10**7 + 2, 9.5)]
    assert points(mlflow, tracker.run_id) == [(step, step / 100) for step in steps]
    assert points(mlflow, tracker.run_id, "lr") == [(step, 1 / step) for step in steps]


def test_params_tags_and_files_are_found_by_name(store, mlflow, tmp_path):
    (tmp_path / "config.yaml").write_text("seed: 1")
    (tmp_path / "checkpoints" / "000007").mkdir(parents=True)
    (tmp_path / "checkpoints" / "000007" / "manifest.json").write_text("{}")
    (tmp_path / "checkpoints" / "best").symlink_to("000007")
    many = {f"group.key_{number}": number for number in range(250)}  # more than one call takes
    values = {"reward.file": None, "knots": "7" * 9000, **many}
    params = {key: param_text(value) for key, value in values.items()}
    tracker = TrackerHere(store)
    begin(tracker, tmp_path, "a run", params=params, tags={"track": "oval"})
    tracker.set_tag("stopped_by", "reliable")
    tracker.finish("FINISHED")
    assert tracker.failure is None
    run = mlflow.get_run(tracker.run_id)
    assert run.info.run_name == "a run"
    assert mlflow.get_experiment(run.info.experiment_id).name == "race"
    assert run.data.params.keys() == params.keys()
    assert (run.data.params["group.key_249"], run.data.params["reward.file"]) == ("249", "null")
    assert run.data.tags.items() >= {"track": "oval", "stopped_by": "reliable"}.items()
    assert {file.path for file in mlflow.list_artifacts(tracker.run_id)} == {"config.yaml", "checkpoints"}
    saved = mlflow.download_artifacts(tracker.run_id, "checkpoints/best/manifest.json", str(tmp_path))
    assert Path(saved).read_text() == "{}"


def test_a_busy_store_blocks_nothing_and_gets_every_point_later(store, tracker, mlflow, wait_until, tmp_path):
    write_rows(tmp_path, [{"completion": 0.0}])
    wait_until(lambda: tracker.run_id and points(mlflow, tracker.run_id))
    busy = sqlite3.connect(store.sqlite_file, isolation_level=None)
    busy.execute("BEGIN EXCLUSIVE")
    write_rows(tmp_path, [{"completion": float(number)} for number in range(1, 101)])
    tracker.set_tag("half", "done")  # returns at once
    busy.execute("ROLLBACK")
    busy.close()
    tracker.finish("FINISHED")
    assert tracker.failure is None
    assert points(mlflow, tracker.run_id) == [(100 * number + 100, float(number)) for number in range(101)]
    assert mlflow.get_run(tracker.run_id).data.tags["half"] == "done"


def test_repeating_a_call_changes_nothing(store, mlflow):
    tracked = TrackedRun("run", "race", 1234)
    run, repeated = MLflowRun(store), MLflowRun(store)
    for one in (run, repeated):
        one.open(tracked)
    assert repeated.run_id == run.run_id
    for _ in range(2):
        run.log([("update/kl", 0.5, 1000, 7), ("update/kl", 0.25, 2000, 8)], {"seed": "1"})
        run.end("FINISHED", 2345)
    assert points(mlflow, run.run_id, "kl") == [(7, 0.5), (8, 0.25)]


@pytest.fixture
def batches(monkeypatch) -> list[tuple[int, int, int]]:
    """How many metrics, parameters and tags each request to write values had."""
    sent = []
    log_batch = MlflowClient.log_batch

    def log(self, run_id, metrics=(), params=(), tags=(), **options):
        sent.append((len(metrics), len(params), len(tags)))
        return log_batch(self, run_id, metrics, params, tags, **options)

    monkeypatch.setattr(MlflowClient, "log_batch", log)
    return sent


def test_all_that_has_come_up_is_one_request(store, batches, tmp_path):
    write_rows(tmp_path, [{"kl": 1.0, "lr": 0.1}] * 90)
    run = TrackedRun("run", "race", now_ms(), params={"seed": "1", "track": "oval"}, tags={"half": "done"})
    run = replace(run, store=store.shown)
    write_tracked_run(tmp_path, run)
    projection = MLflowProjection(store, tmp_path)
    assert projection.update() is None
    assert batches == [(90 * 4, 2, 0)]  # with iteration and clock; a new run has its tags
    assert projection.update() is None
    write_tracked_run(tmp_path, replace(run, tags={"half": "won"}))
    write_rows(tmp_path, [{"kl": 1.0, "lr": 0.1}])
    assert projection.update() is None
    assert batches[1:] == [(4, 0, 1)]


def test_a_run_is_written_to_no_more_often_than_every_few_seconds(
    store, batches, monkeypatch, wait_until, tmp_path
):
    monkeypatch.setattr(projector, "UPDATE_S", 0.3)
    began = time.monotonic()
    tracker = TrackerHere(store)
    begin(tracker, tmp_path)
    for number in range(20):
        write_rows(tmp_path, [{"kl": float(number)}])
        time.sleep(0.03)
    wait_until(lambda: sum(metrics for metrics, *_ in batches) == 20 * 3)
    assert len(batches) <= 1 + (time.monotonic() - began) / 0.3
    tracker.finish("FINISHED")


def test_a_parameter_that_is_refused_costs_no_metric(store, mlflow, tmp_path):
    write_rows(tmp_path, [{"kl": 0.5}])
    run = TrackedRun("run", "race", now_ms(), params={"seed": "1", "?!": "1"}, tags={"half": "done"})
    write_tracked_run(tmp_path, replace(run, store=store.shown))
    assert MLflowProjection(store, tmp_path).update().startswith("refused the parameters: ")
    assert points(mlflow, read_run_id(tmp_path), "kl") == [(100, 0.5)]


def test_a_run_deleted_in_the_ui_costs_one_line_and_nothing_else(
    tracker, mlflow, caplog, wait_until, tmp_path
):
    write_rows(tmp_path, [{"kl": 1.0}])
    wait_until(lambda: tracker.run_id and points(mlflow, tracker.run_id, "kl"))
    mlflow.delete_run(tracker.run_id)
    write_rows(tmp_path, [{"kl": 1.0}] * 3)
    wait_until(lambda: "refused metrics" in str(tracker.outage))
    tracker.set_tag("last", "1")
    tracker.finish("FINISHED")
    assert tracker.failure is not None
    assert len(caplog.records) == 1


def test_a_deleted_experiment_is_named_and_the_training_continues(store, mlflow, caplog, tmp_path):
    mlflow.delete_experiment(mlflow.create_experiment("race"))
    tracker = TrackerHere(store)
    begin(tracker, tmp_path)
    write_rows(tmp_path, [{"kl": 1.0, "lr": 2.0}])
    tracker.finish("FINISHED")
    assert tracker.failure is not None
    assert "experiment 'race' was deleted in MLflow" in caplog.text
    assert len(caplog.records) == 1


def test_a_server_that_is_down_costs_no_training_and_shows_no_password(
    tmp_path, free_port, caplog, wait_until
):
    tracker = TrackerHere(resolve_store(f"http://me:s3cr3t@127.0.0.1:{free_port}", tmp_path))
    begin(tracker, tmp_path)
    write_rows(tmp_path, [{"kl": 1.0}] * 6, covered=5)
    wait_until(lambda: tracker.outage is not None)
    assert not caplog.records
    # A limit of CPU time, of which attempts in this process use little.
    tracker.finish("FAILED", deadline_s=0.05)
    for words in ("some of this run was not recorded", f"http://127.0.0.1:{free_port}"):
        assert words in caplog.text
    assert tracker.failure is not None
    assert tracker.failure in caplog.text
    assert len(caplog.records) == 1
    assert "s3cr3t" not in caplog.text
    assert not [file for file in tmp_path.glob("*.json") if "s3cr3t" in file.read_text()]


@pytest.mark.processes
@pytest.mark.parametrize("kind", [TrackerHere, pytest.param(ProjectedTracker, marks=pytest.mark.faults)])
def test_two_runs_that_begin_at_once_in_a_new_folder_lose_nothing(kind, tmp_path):
    """Recorded by threads, and by processes, which import MLflow for seconds each."""
    runs = tmp_path / "meine Läufe mit ß" / "50%#"
    trackers = [kind(resolve_store(None, runs)) for _ in range(2)]
    folders = [tmp_path / str(seed) for seed in range(2)]
    for seed, (tracker, folder) in enumerate(zip(trackers, folders, strict=True)):
        folder.mkdir()
        tracker.open(folder, TrackedRun(f"run {seed}", "race", 1))
        rows = [{"env_steps": step, "kl": step + seed / 8} for step in range(50)]
        (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    for tracker in trackers:
        tracker.finish("FINISHED", 120)
        assert tracker.failure is None
    client = MlflowClient(tracking_uri=resolve_store(None, runs).uri)
    for seed, folder in enumerate(folders):
        run_id = read_run_id(folder)
        assert points(client, run_id, "kl") == [(step, step + seed / 8) for step in range(50)]
        assert [file.path for file in client.list_artifacts(run_id)] == ["metrics.jsonl"]
    assert {path.name for path in runs.iterdir()} == {"mlflow.db", "mlflow.db.lock", "mlflow-artifacts"}


@pytest.mark.slow
def test_a_training_records_the_use_of_the_machine_beside_its_rows(train_here, tmp_path):
    ended = train_here("tracking=mlflow")
    assert ended.code == 0, ended.stderr
    client = MlflowClient(tracking_uri=resolve_store(None, tmp_path / "runs").uri)
    run_id = json.loads((ended.folder / "mlflow.json").read_text())["run_id"]
    steps = [row["env_steps"] for row in ended.metrics]
    for column in ("cpu_percent", "memory_mb", "memory_percent"):
        assert metric_name(column).startswith("system/")
        assert [step for step, _ in points(client, run_id, column)] == steps
        assert column not in ended.metrics[0]
    tags = client.get_run(run_id).data.tags
    assert tags["host"] == socket.gethostname()
    assert tags["mlflow.user"]
