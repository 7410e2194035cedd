"""`deepracer-exp checkpoints` on a run trained for a moment."""

import json
import os
import re
import shutil
from pathlib import Path

import pytest

from deepracer_exp.runs.checkpoint_files import HASHES, pin, write_hashes
from tests.page_html import Html

QUICK = ("evaluation.trials=2", "evaluation.held_out=aws", "evaluation.time_s=8")


@pytest.fixture
def run_dir(copied) -> Path:
    """A run with three checkpoints of one's own: 7, its best, 8 and 9, its last; 7 and 9 have the same weights."""
    run = copied("checkpoints.every=1", "checkpoints.keep=9")
    checkpoints = run / "checkpoints"
    original = checkpoints.rename(run / "original")
    own = sorted(path for path in original.iterdir() if path.name.isdigit())
    for name, source in (("000007", own[-1]), ("000008", own[0]), ("000009", own[-1])):
        shutil.copytree(source, checkpoints / name)
        (checkpoints / name / HASHES).unlink(missing_ok=True)
        manifest = json.loads((checkpoints / name / "manifest.json").read_text())
        manifest["metadata"]["iteration"] = int(name)
        (checkpoints / name / "manifest.json").write_text(json.dumps(manifest))
        write_hashes(checkpoints / name)
    (checkpoints / "best").symlink_to("000007")
    (checkpoints / "last").symlink_to("000009")
    shutil.rmtree(original)
    return run


def corrupt(run_dir: Path, name: str) -> None:
    os.truncate(next((run_dir / "checkpoints" / name).rglob("state.tdz")), 100)


def test_every_kept_checkpoint_drives_the_same_trials(run_dir, call, tmp_path):
    pin(run_dir / "checkpoints", "000008", "promoted as racer@champion")
    ended = call("checkpoints", run_dir.name, *QUICK, "-o", "picture.html")
    assert ended.code == 0, ended.stderr
    assert re.search(r"(?m)^7 .*best", ended.stdout)
    assert re.search(r"(?m)^8 .*pinned", ended.stdout)
    assert re.search(r"(?m)^9 .*last", ended.stdout)
    assert "checkpoint 8 is pinned: promoted as racer@champion" in ended.stdout
    page = Html((tmp_path / "picture.html").read_text())
    assert (
        "Checkpoints of tiny Recommended: checkpoint 7, best by race score (usual and held-out)" in page.text
    )
    assert "checkpoint kept as steps laps %" in page.text
    assert "figure-speed_and_stability" in page.ids
    # Whatever one driver leaves to the next would show.
    rows = {
        line.split()[0]: line.split()[-6:]
        for line in ended.stdout.splitlines()
        if line[:1] in "789" and line[1:2] == " "
    }
    assert rows["7"] == rows["9"] != rows["8"]
    assert "recommended: checkpoint 7: best by race score (usual and held-out)" in ended.stdout


def test_a_corrupt_checkpoint_is_shown_and_left_out(run_dir, call):
    corrupt(run_dir, "000009")
    ended = call("checkpoints", str(run_dir), *QUICK, "evaluation.held_out=null")
    assert ended.code == 0, ended.stderr
    assert re.search(r"(?m)^9 .*last, bad", ended.stdout)
    assert re.search(r"checkpoint 9 is left out: .*state.tdz is not as it was written", ended.stdout)
    assert "recommended: checkpoint 9" not in ended.stdout


def test_a_run_with_only_corrupt_checkpoints_is_refused(run_dir, call):
    for name in ("000007", "000008", "000009"):
        corrupt(run_dir, name)
    call("checkpoints", run_dir.name, *QUICK).assert_refused("state.tdz")


def test_by_default_the_trials_of_the_training_are_driven(run_dir, call):
    for name in ("000007", "000008"):
        shutil.rmtree(run_dir / "checkpoints" / name)
    ended = call("checkpoints", run_dir.name)
    assert ended.code == 0, ended.stderr
    assert "1 checkpoint, 16 trials each" in ended.stderr
    assert "best is a broken link" in ended.stderr


def test_evaluate_warns_when_it_uses_another_checkpoint(run_dir, call):
    corrupt(run_dir, "000007")
    ended = call("evaluate", run_dir.name, "checkpoint=best", "evaluation.held_out=null")
    assert ended.code == 0, ended.stderr
    (warning,) = [line for line in ended.stderr.splitlines() if line.startswith("warning: ")]
    assert "000007: " in warning
    assert "using checkpoint 9, the newest intact one" in warning
    assert "checkpoint 9:" in ended.stderr
    (file,) = (run_dir / "evaluations").iterdir()
    assert json.loads(file.read_text())["checkpoint"]["name"] == "000009"


def test_a_run_without_checkpoints_is_refused(run_dir, call):
    shutil.rmtree(run_dir / "checkpoints")
    call("checkpoints", run_dir.name).assert_refused("checkpoints: none")
