"""Runs that ended while the store was away."""

import json

import pytest

from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.runs.labels import Labels
from deepracer_exp.runs.run_files import read_run_id
from deepracer_exp.tracking.calls import StoreRefusedError
from deepracer_exp.tracking.delivery import (
    deliver,
    deliver_evaluation,
    deliver_labels,
    is_delivered,
    recorded_labels,
)
from deepracer_exp.tracking.mlflow_run import MLflowRun
from deepracer_exp.tracking.store import Store
from deepracer_exp.tracking.tracking_file import TrackedRun, read_tracked_run

from .conftest import TrackerHere, begin, points, runs_of, write_rows


@pytest.fixture
def away(free_port) -> str:
    return f"http://me:s3cr3t@127.0.0.1:{free_port}"


@pytest.fixture
def run_dir(tmp_path, away):
    """Return the folder of a run whose store never answered."""
    folder = tmp_path / "race" / "run"
    (folder / "checkpoints" / "000003").mkdir(parents=True)
    (folder / "checkpoints" / "000003" / "manifest.json").write_text("{}")
    (folder / "checkpoints" / "best").symlink_to("000003")
    tracker = TrackerHere(Store(away, None))
    begin(tracker, folder, params={"seed": "1"}, tags={"track": "oval"})
    write_rows(folder, [{"wall_clock_s": n / 2, "completion": n / 3, "kl": None} for n in range(1, 4)])
    (folder / "summary.json").write_text(json.dumps({"status": "stopped early", "reason": "collapsed"}))
    tracker.set_tag("stopping.rule", "collapsed")
    tracker.set_tag("end", "stopped early: collapsed")
    tracker.finish("FINISHED", deadline_s=0)
    assert tracker.failure is not None
    return folder


def test_a_run_that_the_store_never_saw_is_delivered_whole_and_once(run_dir, store, mlflow, tmp_path, caplog):
    moved = run_dir.rename(tmp_path / "moved")  # what was logged is found there, too
    assert not is_delivered(moved, store.uri, tmp_path)
    assert deliver(moved, store.uri, tmp_path) == 9
    assert is_delivered(moved, store.uri, tmp_path)
    (run,) = runs_of(mlflow)
    tracked = read_tracked_run(moved)
    assert (run.info.run_id, run.info.run_name, run.info.status) == (read_run_id(moved), "run", "FINISHED")
    assert (run.info.start_time, run.info.end_time) == (tracked.start_ms, tracked.end_ms)
    assert run.data.params == {"seed": "1"}
    wanted = {"track": "oval", "stopping.rule": "collapsed", "end": "stopped early: collapsed"}
    assert run.data.tags.items() >= wanted.items()
    assert run.data.metrics.keys() == {"train/completion", "train/iteration", "time/wall_clock_s"}
    assert {file.path for file in mlflow.list_artifacts(run.info.run_id)} == {
        *("config.yaml", "metrics.jsonl", "summary.json", "checkpoints")
    }
    assert deliver(moved, store.uri, tmp_path) == 0
    assert points(mlflow, run.info.run_id) == [(100, 1 / 3), (200, 2 / 3), (300, 1.0)]
    assert not [record for record in caplog.records if record.name.endswith("delivery")]


def test_a_run_killed_before_it_logged_its_end_is_ended_by_its_summary(run_dir, store, mlflow, tmp_path):
    tracked = json.loads((run_dir / "tracking.json").read_text())
    del tracked["tags"]["end"]
    (run_dir / "tracking.json").write_text(json.dumps({**tracked, "status": None, "end_ms": None}))
    deliver(run_dir, store.uri, tmp_path)
    (run,) = runs_of(mlflow)
    assert (run.info.status, run.data.tags["end"]) == ("FINISHED", "stopped early: collapsed")


def test_a_store_that_is_still_away_is_named_and_costs_nothing(run_dir, away, tmp_path):
    before = (run_dir / "tracking.json").read_text()
    with pytest.raises(RunFailed, match="does not answer") as failed:
        deliver(run_dir, away, tmp_path)
    assert "s3cr3t" not in f"{failed.value} {before}"
    assert (run_dir / "tracking.json").read_text() == before


def test_a_run_deleted_in_mlflow_is_refused(run_dir, store, mlflow, tmp_path):
    deliver(run_dir, store.uri, tmp_path)
    run_id = read_run_id(run_dir)
    mlflow.delete_run(run_id)
    with pytest.raises(BadInput, match=f"{run_id} was deleted in MLflow"):
        deliver(run_dir, store.uri, tmp_path)
    (run_dir / "summary.json").unlink()
    with pytest.raises(BadInput, match="has not ended"):
        deliver(run_dir, store.uri, tmp_path)


def test_a_note_and_tags_that_were_removed_are_removed_in_mlflow(store, mlflow, tmp_path):
    run_id = mlflow.create_run("0", tags={"own": "1"}).info.run_id
    for labels in (
        Labels("blue", "fast", {"car": "red", "tyres": "new"}),
        Labels("blue", None, {"car": "red"}),
    ):
        deliver_labels(run_id, labels, store.uri, tmp_path)
        assert recorded_labels(run_id, store.uri, tmp_path) == labels
    assert mlflow.get_run(run_id).data.tags["own"] == "1"


def test_what_was_removed_while_the_store_was_away_is_removed_by_the_next_delivery(
    run_dir, store, mlflow, tmp_path
):
    deliver(run_dir, store.uri, tmp_path)
    run_id = read_run_id(run_dir)
    deliver_labels(run_id, Labels("blue", "fast", {"car": "red"}), store.uri, tmp_path)
    deliver(run_dir, store.uri, tmp_path)
    assert recorded_labels(run_id, store.uri, tmp_path).tags == {}


def test_a_run_that_the_store_does_not_know_is_delivered_anew(run_dir, store, mlflow, tmp_path):
    deliver(run_dir, store.uri, tmp_path)
    state = json.loads((run_dir / "mlflow.json").read_text())
    mlflow.update_run(state["run_id"], name="another")  # so that it is not this run's
    (run_dir / "mlflow.json").write_text(json.dumps(state | {"run_id": "0" * 32}))
    assert deliver(run_dir, store.uri, tmp_path) > 0
    assert read_run_id(run_dir) not in ("0" * 32, state["run_id"])


def test_an_evaluation_and_its_film_reach_the_run_in_mlflow(run_dir, store, mlflow, tmp_path, away, caplog):
    deliver(run_dir, store.uri, tmp_path)
    film = tmp_path / "lap.mp4"
    film.write_bytes(b"film")
    metrics = {"race/evaluate/lap_time_s": 8.765, "race/evaluate/score_s": None}
    deliver_evaluation(run_dir, store.uri, tmp_path, 300, metrics, {film: "films"})
    (run,) = runs_of(mlflow)
    assert run.info.status == "FINISHED"
    (point,) = mlflow.get_metric_history(run.info.run_id, "race/evaluate/lap_time_s")
    assert (point.step, point.value) == (300, 8.765)
    assert [file.path for file in mlflow.list_artifacts(run.info.run_id, "films")] == ["films/lap.mp4"]
    caplog.clear()
    deliver_evaluation(run_dir, away, tmp_path, 300, metrics, {film: "films"})
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "this evaluation was not recorded" in caplog.text


@pytest.mark.parametrize(
    "place", ["http://127.0.0.1:1/files", "s3://bucket/files", "ftp://127.0.0.1:1/files"]
)
def test_no_file_goes_to_a_machine_that_only_a_database_file_names(store, mlflow, tmp_path, place):
    mlflow.create_experiment("race", place)
    run = MLflowRun(store)
    run.open(TrackedRun("run", "race", 1))
    file = tmp_path / "summary.json"
    file.write_text("{}")
    with pytest.raises(StoreRefusedError, match="accepted: a folder"):
        run.log_artifact(file, None)
