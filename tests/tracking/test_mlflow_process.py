"""A training leaves MLflow to another process, which records the same, may be lost, and ends with it."""

import os
import signal
import subprocess
import sys

import psutil
import pytest

from deepracer_exp.tracking import mlflow_process
from deepracer_exp.tracking.calls import StoreRefusedError, StoreUnavailableError
from deepracer_exp.tracking.mlflow_process import RemoteRun, released
from deepracer_exp.tracking.mlflow_tracker import MLflowTracker
from deepracer_exp.tracking.tracking_file import TrackedRun
from tests.conftest import IN_PROCESS
from tests.waiting import wait_until

from .conftest import begin, points, write_rows

TRACKED = TrackedRun("run", "race", 1234, params={"seed": "1"}, tags={"track": "oval"})


def process_of(run: RemoteRun) -> psutil.Process:
    """Return the one process that this one has started for MLflow and that makes the calls of a run."""
    ours = [child for child in psutil.Process().children() if "mlflow_process" in " ".join(child.cmdline())]
    assert len(ours) == 1
    return ours[0]


@pytest.fixture(autouse=True)
def _no_process_of_another_test():
    mlflow_process._close_idle()


@pytest.fixture
def remote(store):
    run = RemoteRun(store)
    run.open(TRACKED, is_first=True)
    yield run
    released(run)


def test_another_process_records_what_this_one_would(remote, mlflow, tmp_path):
    file = tmp_path / "log.txt"
    file.write_text("done")
    remote.log([("update/kl", 0.5, 1000, 7)], TRACKED.params, {"half": "done"})
    remote.log_artifact(file, "logs")
    remote.end("FINISHED", 2345)
    run = mlflow.get_run(remote.run_id)
    assert (run.info.run_name, run.info.status, run.info.end_time) == ("run", "FINISHED", 2345)
    assert run.data.params == {"seed": "1"}
    assert run.data.tags.items() >= {"track": "oval", "half": "done"}.items()
    assert points(mlflow, remote.run_id, "kl") == [(7, 0.5)]
    assert [file.path for file in mlflow.list_artifacts(remote.run_id, "logs")] == ["logs/log.txt"]
    assert remote.metrics == {"update/kl": 0.5}


def test_what_the_store_refuses_is_refused_here(remote, mlflow, tmp_path):
    with pytest.raises(StoreRefusedError, match="is gone"):
        remote.log_artifact(tmp_path / "none", None)
    mlflow.delete_run(remote.run_id)
    with pytest.raises(StoreRefusedError, match="was deleted in MLflow"):
        remote.read(remote.run_id)


def test_a_lost_process_is_replaced_and_nothing_is_recorded_twice(remote, mlflow):
    remote.log([("update/kl", 0.5, 1000, 7)])
    lost = process_of(remote)
    lost.kill()
    with pytest.raises(StoreUnavailableError, match="lost"):
        remote.log([("update/kl", 0.25, 2000, 8)])
    remote.log([("update/kl", 0.25, 2000, 8)])
    assert process_of(remote).pid != lost.pid
    assert points(mlflow, remote.run_id, "kl") == [(7, 0.5), (8, 0.25)]


def test_the_next_run_has_the_same_process(store, mlflow, tmp_path):
    pids = set()
    for number in range(2):
        folder = tmp_path / str(number)
        folder.mkdir()
        tracker = MLflowTracker(store, RemoteRun)
        begin(tracker, folder)
        write_rows(folder, [{"completion": 1.0}])
        tracker.finish("FINISHED")
        assert tracker.failure is None
        assert len(points(mlflow, tracker.run_id)) == 1
        pids |= {
            child.pid for child in psutil.Process().children() if "mlflow_process" in child.cmdline()[-1]
        }
    assert len(pids) == 1


def test_the_process_ends_with_its_owner_even_if_that_is_killed(store):
    code = f"""
import time
from pathlib import Path
from deepracer_exp.tracking.mlflow_process import RemoteRun
from deepracer_exp.tracking.store import resolve_store
run = RemoteRun(resolve_store(None, Path({str(store.sqlite_file.parent)!r})))
print("open", flush=True)
time.sleep(600)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as owner:
        assert owner.stdout.readline() == b"open\n"
        children = psutil.Process(owner.pid).children(recursive=True)
        assert children
        os.kill(owner.pid, signal.SIGKILL)
        wait_until(lambda: not any(child.is_running() for child in children), "end of the process")


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
    (tracked,) = tmp_path.glob("runs/*/*/tracking.json")
    assert '"complete": true' in tracked.read_text()
