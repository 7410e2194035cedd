import subprocess
import sys

import pytest

from deepracer_exp.config.running import MLflowTracking
from deepracer_exp.errors import BadInput
from deepracer_exp.tracking.store import resolve_store
from deepracer_exp.tracking.tracker import open_tracker


@pytest.mark.parametrize(
    ("uri", "said"),
    [
        ("sqllite:///x.db", "did you mean sqlite?"),
        ("ftp://host", "accepted: http(s)://host:port"),
        ("./mlruns", "accepted: http(s)://host:port"),
        ("file:///tmp/mlruns", "accepted: http(s)://host:port"),
        ("http://", "no host"),
        ("http://host:port", "accepted: http://host:port"),
        ("sqlite://", "names no file"),
        ("sqlite:///", "names no file"),
        ("sqlite:///:memory:", "names no file"),
        ("sqlite:////proc/none/mlflow.db", "folder /proc/none cannot be created"),
        ("sqlite:////proc/x.db", "/proc/x.db cannot be written"),
        ("sqlite:////proc", "is a folder"),
    ],
)
def test_a_uri_that_can_never_work_is_one_line_before_anything_starts(uri, said, tmp_path):
    with pytest.raises(BadInput) as error:
        open_tracker(MLflowTracking(kind="mlflow", uri=uri), tmp_path)
    assert "tracking.uri=" in str(error.value)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_a_path_that_sqlite_uris_cannot_name_is_bad_input(tmp_path):
    with pytest.raises(BadInput, match=r"path with '\?'"):
        resolve_store(None, tmp_path / "why?")


def test_checking_a_uri_does_not_import_mlflow(tmp_path):
    code = (
        "import sys; from pathlib import Path; from deepracer_exp.tracking.tracker import *\n"
        "from deepracer_exp.tracking.store import resolve_store\n"
        f"resolve_store(None, Path({str(tmp_path)!r}))\n"
        "assert not {name for name in sys.modules if name.startswith(('mlflow', 'torch'))}"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_relative_sqlite_file_means_the_same_after_a_change_of_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert resolve_store("sqlite:///a/b.db", tmp_path).sqlite_file == tmp_path / "a" / "b.db"
