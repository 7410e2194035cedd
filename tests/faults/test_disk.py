"""Folders that take nothing, or no more; and folders with unusual names."""

import json
import threading

import numpy as np
import pytest

from tests.waiting import wait_until


@pytest.mark.parametrize("size_kib", [150, 300, 500])
def test_a_disk_that_fills_up_ends_the_run_with_one_line(train_here, mounted, size_kib):
    """With these sizes: in the first, in later iterations, while pictures are drawn."""
    folder = mounted(f"size={size_kib}k")
    ended = train_here("budget.env_steps=65536")
    assert ended.code == 3, ended.stderr
    assert ended.complaint.startswith("deepracer-exp: run failed: ")
    assert "No space left on device" in ended.complaint
    assert "finished" not in ended.stdout
    for summary in folder.glob("*/*/summary.json"):
        assert json.loads(summary.read_text())["status"] == "failed"
    for name in ("best", "last"):
        for link in folder.glob(f"*/*/checkpoints/{name}"):
            assert json.loads((link / "manifest.json").read_text())


def test_a_disk_that_is_full_already_is_bad_input(train_here, mounted):
    mounted("size=4k")
    ended = train_here()
    ended.assert_bad_input("runs_dir=runs", "No space left on device")


def test_a_folder_that_is_read_only_is_bad_input(train_here, mounted):
    mounted("ro")
    ended = train_here()
    ended.assert_bad_input("runs_dir=runs", "Read-only file system")


def test_paths_of_any_name_work(train_here, tmp_path):
    name = "= Zürich Straße a'b\"c 50% {braces} [0] $HOME"
    folder = tmp_path / name
    folder.mkdir()
    (folder / f"{name}.py").write_text("def reward_function(params):\n    return 1.0\n")
    angle = np.linspace(0, 2 * np.pi, 100)
    ring = 3 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    np.save(folder / f"{name}.npy", np.concatenate([ring, 0.9 * ring, 1.1 * ring], axis=1))
    actions = [{"steering_angle": angle, "speed": 1.0} for angle in (-20, 20)]
    (folder / f"{name}.json").write_text(json.dumps({"action_space": actions}))

    def quoted(path) -> str:
        escaped = str(path).replace("'", "\\'")
        return f"'{escaped}'"

    ended = train_here(
        "budget.iterations=1",
        f"runs_dir={quoted(folder / 'runs')}",
        f"reward.file={quoted(folder / f'{name}.py')}",
        f"track.file={quoted(folder / f'{name}.npy')}",
        f"action_space.file={quoted(folder / f'{name}.json')}",
    )
    assert ended.code == 0, ended.stderr
    (summary,) = (folder / "runs").glob("*/*/summary.json")
    assert json.loads(summary.read_text())["status"] == "finished"
    assert (summary.parent / "best_lap.png").is_file()


@pytest.mark.parametrize("tracking", ["off", pytest.param("mlflow", marks=pytest.mark.faults)])
def test_a_folder_that_vanishes_during_the_training_ends_the_run_with_one_line(
    train_here, tmp_path, tracking
):
    def vanish() -> None:
        files = wait_until(lambda: list(tmp_path.glob("runs/*/*/metrics.jsonl")), "iteration")
        files[0].parent.rename(tmp_path / "gone")

    threading.Thread(target=vanish).start()
    ended = train_here("budget.env_steps=100000000", f"tracking={tracking}")
    assert ended.code == 3, ended.stderr
    assert ended.complaint.startswith("deepracer-exp: run failed: runs/tiny/")
    assert "is gone" in ended.complaint or "No such file or directory" in ended.complaint
