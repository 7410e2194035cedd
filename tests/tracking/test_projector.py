"""The process that records: it may be lost, ends with its owner, and begins when a training has begun."""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import psutil
import pytest

from deepracer_exp.runs.run_files import read_run_id
from deepracer_exp.tracking import projector
from deepracer_exp.tracking.mlflow_metrics import now_ms
from deepracer_exp.tracking.projector import Projector
from deepracer_exp.tracking.tracker import ProjectedTracker
from deepracer_exp.tracking.tracking_file import (
    TrackedRun,
    read_recorded,
    read_tracked_run,
    write_tracked_run,
)
from tests.conftest import IN_PROCESS
from tests.waiting import PATIENCE_S, is_alive, wait_until

from .conftest import ProjectorHere, TrackerHere, begin, points, write_rows

MODULE = "deepracer_exp.tracking.project"


def processes(owner: psutil.Process | None = None) -> list[psutil.Process]:
    """Return the processes for trackers that this one, or `owner`, has started."""
    found = []
    for child in (owner or psutil.Process()).children():
        with suppress(psutil.Error):  # it has just ended
            if MODULE in child.cmdline():
                found.append(child)
    return found


@pytest.fixture
def kept():
    with Projector() as kept:
        yield kept
    assert not processes()


def test_a_lost_process_is_replaced_and_nothing_is_recorded_twice(store, mlflow, kept, tmp_path):
    tracker = ProjectedTracker(store, kept)
    begin(tracker, tmp_path)
    write_rows(tmp_path, [{"kl": 0.5}])
    wait_until(lambda: read_recorded(tmp_path).run_id and points(mlflow, read_run_id(tmp_path), "kl"))
    (lost,) = processes()
    lost.kill()
    lost.wait()
    write_rows(tmp_path, [{"kl": 0.25}])
    tracker.finish("FINISHED", PATIENCE_S)
    assert tracker.failure is None
    assert processes() != [lost]
    assert points(mlflow, read_run_id(tmp_path), "kl") == [(100, 0.5), (200, 0.25)]


@pytest.mark.faults
def test_the_next_run_has_the_same_process_and_one_that_hangs_does_not(store, mlflow, kept, tmp_path):
    pids = []
    for number in range(3):
        folder = tmp_path / str(number)
        folder.mkdir()
        tracker = ProjectedTracker(store, kept)
        begin(tracker, folder)
        write_rows(folder, [{"completion": 1.0}])
        pids += [process.pid for process in processes()]
        if number == 1:
            os.kill(pids[-1], signal.SIGSTOP)
        tracker.finish("FINISHED", 1.0 if number == 1 else 60.0)
        assert (tracker.failure is None) == (number != 1)
    assert pids[0] == pids[1] != pids[2]
    assert len(points(mlflow, read_run_id(tmp_path / "2"))) == 1


def test_the_process_ends_with_its_owner_even_if_that_is_killed(store, tmp_path):
    code = f"""
import time
from pathlib import Path
from deepracer_exp.tracking.store import resolve_store
from deepracer_exp.tracking.tracker import ProjectedTracker
from deepracer_exp.tracking.tracking_file import TrackedRun
folder = Path({str(tmp_path)!r})
tracker = ProjectedTracker(resolve_store(None, folder))
tracker.open(folder, TrackedRun("run", "race", 1))
print("open", flush=True)
time.sleep(600)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as owner:
        assert owner.stdout.readline() == b"open\n"
        children = wait_until(lambda: processes(psutil.Process(owner.pid)), "process for the tracker")
        os.kill(owner.pid, signal.SIGKILL)
        wait_until(lambda: not any(map(is_alive, children)), "end of the process")


@pytest.mark.slow
def test_a_training_that_mlflow_records_does_not_import_it(tmp_path):
    words = [word for word in IN_PROCESS if not word.startswith("tracking")]
    code = f"""
import sys
from deepracer_exp.cli import main
try:
    main(["train", *{words!r}, "tracking=mlflow"])
except SystemExit as ended:
    print(ended.code, "mlflow" in sys.modules)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.stdout.splitlines()[-1] == "0 False", done.stderr
    assert "not recorded" not in done.stderr
    (file,) = tmp_path.glob("runs/*/*/mlflow.json")
    assert read_recorded(file.parent).has_all_of(read_tracked_run(file.parent))


@pytest.fixture
def pauses_of_a_minute(monkeypatch) -> None:
    monkeypatch.setattr(projector, "UPDATE_S", 60.0)


def test_the_first_row_of_a_run_lets_its_record_begin(pauses_of_a_minute, store, tmp_path):
    tracker = TrackerHere(store)
    begin(tracker, tmp_path)
    tracker.projector.thread.join(0.5)
    assert tracker.run_id is None
    write_rows(tmp_path, [{"return": 1.0}])
    wait_until(lambda: tracker.run_id is not None, "a run in MLflow")
    tracker.finish("FINISHED")


def test_a_training_that_ends_before_it_has_begun_is_recorded(pauses_of_a_minute, store, mlflow, tmp_path):
    tracker = TrackerHere(store)
    begin(tracker, tmp_path)
    tracker.finish("KILLED")
    assert tracker.failure is None
    assert mlflow.get_run(tracker.run_id).info.status == "KILLED"


def test_a_training_that_takes_long_to_begin_is_recorded_meanwhile(store, tmp_path):
    tracker = TrackerHere(store)
    begin(tracker, tmp_path)
    wait_until(lambda: tracker.run_id is not None, "a run in MLflow")
    tracker.finish("KILLED")


def test_a_run_whose_folder_cannot_be_read_says_so_at_its_end(store, tmp_path):
    tracker = TrackerHere(store)
    begin(tracker, tmp_path)
    write_rows(tmp_path, [{"kl": 1.0}])
    (tmp_path / "metrics.jsonl").write_text("no JSON\n")
    tracker.finish("FINISHED", 60)
    assert "metrics.jsonl" in str(tracker.failure)


def test_an_end_that_changes_afterwards_is_recorded_without_its_files_again(store, mlflow, tmp_path):
    run = TrackedRun("run", "race", 1234, store=store.shown)
    (tmp_path / "config.yaml").write_text("checkpoints: {every: 5}\n")
    recorded = projector.ProjectedRun(tmp_path, run, store, ProjectorHere())
    recorded.begin(is_training=True)
    recorded.change(status="FINISHED", end_ms=now_ms())
    assert recorded.wait_for_end(60) is None
    (tmp_path / "config.yaml").write_text("checkpoints: {every: 7}\n")
    recorded.change(status="FAILED", end_ms=now_ms() + 1, values={"trial/lap_time_s": 9.5})
    assert recorded.wait_for_end(60) is None
    found = mlflow.get_run(recorded.recorded.run_id)
    assert (found.info.status, found.data.metrics["trial/lap_time_s"]) == ("FAILED", 9.5)
    (tmp_path / "there").mkdir()
    file = mlflow.download_artifacts(found.info.run_id, "config.yaml", str(tmp_path / "there"))
    assert "every: 5" in Path(file).read_text()


def test_a_folder_of_version_0_1_0_keeps_its_run(store, mlflow, tmp_path):
    tracker = TrackerHere(store)
    begin(tracker, tmp_path)
    write_rows(tmp_path, [{"kl": 1.0}])
    tracker.finish("FINISHED")
    run_id = tracker.run_id
    run = read_tracked_run(tmp_path)
    write_tracked_run(tmp_path, replace(run, run_id=run_id, complete=True))
    (tmp_path / "mlflow.json").unlink()
    assert read_run_id(tmp_path) == run_id
    assert read_recorded(tmp_path).has_all_of(run)
    again = TrackerHere(store)
    again.open(tmp_path, read_tracked_run(tmp_path))
    write_rows(tmp_path, [{"kl": 2.0}])
    again.finish("FINISHED")
    assert again.failure is None
    assert again.run_id == run_id
    assert points(mlflow, run_id, "kl") == [(100, 1.0), (200, 2.0)]
