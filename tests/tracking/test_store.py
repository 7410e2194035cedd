import shutil
import subprocess
import sys

import pytest
from mlflow import MlflowClient

from deepracer_exp.config.running import MLflowTracking
from deepracer_exp.errors import BadInput
from deepracer_exp.tracking.mlflow_run import MLflowRun
from deepracer_exp.tracking.store import resolve_store
from deepracer_exp.tracking.tracker import open_tracker
from deepracer_exp.tracking.tracking_file import TrackedRun
from tests.conftest import refused

SERVERS = "accepted: http(s)://host:port"


@pytest.mark.parametrize(
    ("uri", "said"),
    [
        ("sqllite:///x.db", "did you mean sqlite?"),
        *((uri, SERVERS) for uri in ("ftp://host", "./mlruns", "file:///tmp/mlruns")),
        ("http://", "no host"),
        ("http://host:port", "accepted: http://host:port"),
        *((uri, "names no file") for uri in ("sqlite://", "sqlite:///", "sqlite:///:memory:")),
        ("sqlite:////proc/none/mlflow.db", "folder /proc/none cannot be created"),
        ("sqlite:////proc/x.db", "/proc/x.db cannot be written"),
        ("sqlite:////proc", "is a folder"),
    ],
)
def test_a_uri_that_can_never_work_is_one_line_before_anything_starts(uri, said, tmp_path):
    message = refused(open_tracker, MLflowTracking(kind="mlflow", uri=uri), tmp_path)
    assert "tracking.uri=" in message
    assert said in message


def test_a_path_that_sqlite_uris_cannot_name_is_bad_input(tmp_path):
    with pytest.raises(BadInput, match=r"path with '\?'"):
        resolve_store(None, tmp_path / "why?")


def test_neither_a_uri_that_is_checked_nor_a_training_s_tracker_imports_mlflow(tmp_path):
    code = (
        "import sys; from pathlib import Path; from deepracer_exp.config.running import MLflowTracking, TrackingOff\n"
        "from deepracer_exp.tracking.projector import Projector\n"
        "from deepracer_exp.tracking.tracker import open_tracker\n"
        "from deepracer_exp.tracking.tracking_file import TrackedRun\n"
        "from deepracer_exp.tracking.store import resolve_store\n"
        f"resolve_store(None, Path({str(tmp_path)!r}))\n"
        f"tracker = open_tracker(TrackingOff(kind='off'), Path({str(tmp_path / 'runs')!r}))\n"
        "tracker.open(Path('no'), TrackedRun('run', 'race', 1))\n"
        "tracker.log({'kl': 1.0}, 1); tracker.set_tag('a', 'b'); tracker.finish('FINISHED')\n"
        "assert tracker.failure is tracker.outage is None\n"
        "Projector.send = lambda self, line: None\n"
        f"folder = Path({str(tmp_path)!r})\n"
        "tracker = open_tracker(MLflowTracking(kind='mlflow', uri=None), folder)\n"
        "tracker.open(folder, TrackedRun('run', 'race', 1))\n"
        "tracker.log({'kl': 1.0}, 1); tracker.set_tag('a', 'b'); tracker.finish('FINISHED', 0.01)\n"
        "assert tracker.failure is not None\n"
        "assert not {name for name in sys.modules if name.startswith(('mlflow', 'torch'))}"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert not (tmp_path / "runs").exists()


def test_a_relative_sqlite_file_means_the_same_after_a_change_of_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert resolve_store("sqlite:///a/b.db", tmp_path).sqlite_file == tmp_path / "a" / "b.db"


def test_a_store_is_the_one_that_a_run_names_by_whichever_path_and_after_a_move(tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "runs").symlink_to(tmp_path / "data")
    store = resolve_store(None, tmp_path / "data")
    assert store.is_named(resolve_store(None, tmp_path / "runs").shown)
    assert store.is_named(f"sqlite:///{tmp_path}/before/mlflow.db")
    assert not store.is_named("sqlite:///:memory:")
    assert not store.is_named("http://127.0.0.1:5000")
    assert not store.is_named(None)
    (tmp_path / "before").mkdir()
    (tmp_path / "before" / "mlflow.db").touch()
    assert not store.is_named(f"sqlite:///{tmp_path}/before/mlflow.db")


@pytest.fixture
def recorded(empty_database, tmp_path):
    """Return the folder of a project with a run that has a file, and the run."""
    project = tmp_path / "before"
    project.mkdir()
    shutil.copy(empty_database, project / "mlflow.db")
    run = MLflowRun(resolve_store(None, project))
    run.open(TrackedRun("run", "race", 1_000))
    (tmp_path / "file.txt").write_text("first", encoding="utf-8")
    run.log_artifact(tmp_path / "file.txt", None)
    return project, run.run_id


@pytest.mark.parametrize("is_copied", [False, True])
def test_a_moved_store_gets_its_files_where_it_is_now_and_none_where_it_was(recorded, tmp_path, is_copied):
    before, run_id = recorded
    (tmp_path / "file.txt").write_text("second", encoding="utf-8")
    after = tmp_path / "after ü"
    shutil.copytree(before, after)
    if not is_copied:
        shutil.rmtree(before)
    there = sorted(before.rglob("*"))
    store = resolve_store(None, after)
    run = MLflowRun(store)
    run.read(run_id)
    run.log_artifact(tmp_path / "file.txt", "evaluations")
    new = MLflowRun(store)
    new.open(TrackedRun("second", "race", 2_000))
    new.log_artifact(tmp_path / "file.txt", None)
    files = after / "mlflow-artifacts"
    assert (files / run_id / "artifacts" / "file.txt").read_text() == "first"
    assert (files / run_id / "artifacts" / "evaluations" / "file.txt").read_text() == "second"
    assert (files / new.run_id / "artifacts" / "file.txt").read_text() == "second"
    assert sorted(before.rglob("*")) == there


def test_a_store_that_has_not_moved_leaves_its_files_to_mlflow(recorded, tmp_path):
    before, run_id = recorded
    store = resolve_store(None, before)
    place = MlflowClient(store.uri).get_run(run_id).info.artifact_uri
    assert store.moved_folder(place) is None
    # That of runs in another folder which are recorded here is no earlier place of this store.
    elsewhere = tmp_path / "elsewhere" / "mlflow-artifacts"
    elsewhere.mkdir(parents=True)
    assert store.moved_folder((elsewhere / "0" / "artifacts").as_uri()) is None
    assert resolve_store("http://127.0.0.1:1", before).moved_folder("mlflow-artifacts:/0/artifacts") is None
