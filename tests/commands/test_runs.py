"""`deepracer-exp runs`, and shell completion."""

import fcntl
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.conftest import command

NONE = "\N{EN DASH}"


def write_run(folder: Path, summary: dict | None) -> Path:
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text("{}")
    if summary is not None:
        (folder / "summary.json").write_text(json.dumps(summary))
    return folder


def stamp(seconds_ago: float) -> str:
    return time.strftime("%Y%m%d-%H%M%S", time.localtime(time.time() - seconds_ago))


def test_runs_are_listed_newest_first_with_state_and_results(call, tmp_path):
    names = [f"{stamp(seconds)}-{name}" for seconds, name in ((200_000, "old"), (7_300, "mid"), (90, "new"))]
    finished = {
        "status": "finished",
        "laps": 1234,
        "best_lap_time_s": 7.654,
        "best": {"eval_race_score_s": 8.02, "eval_lap_time_s": 7.98, "eval_completion": 100.0},
    }
    write_run(tmp_path / "runs" / "a" / names[0], finished)
    write_run(
        tmp_path / "runs" / "b" / names[1],
        {"status": "failed", "laps": 0, "best_lap_time_s": None, "best": None},
    )
    running = write_run(tmp_path / "runs" / "a" / names[2], None)
    write_run(tmp_path / "runs" / "a" / f"{stamp(300_000)}-killed", None)
    damaged = write_run(tmp_path / "runs" / "a" / f"{stamp(400_000)}-damaged", None)
    (damaged / "summary.json").write_text("{")
    with (running / ".running").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        ended = call("runs")
    assert ended.code == 0, ended.stderr
    rows = [line.split() for line in ended.stdout.splitlines()[1:]]
    assert rows == [
        [f"a/{names[2]}", "running", NONE, NONE, NONE, NONE, "1", "min"],
        [f"b/{names[1]}", "failed", NONE, NONE, "0", NONE, "2", "h"],
        [f"a/{names[0]}", "finished", "7.98", "8.02", "1,234", "7.65", "2", "d"],
        [rows[3][0], "killed", NONE, NONE, NONE, NONE, "3", "d"],
        [rows[4][0], "unreadable", NONE, NONE, NONE, NONE, "4", "d"],
    ]


def test_runs_elsewhere_are_listed_with_runs_dir(call, tmp_path):
    write_run(tmp_path / "there" / "a" / "renamed", {"status": "finished"})
    assert "a/renamed" in call("runs", "runs_dir=there").stdout
    assert call("runs", "list", "runs_dir=there").stdout == call("runs", "runs_dir='there'").stdout


def test_an_empty_folder_has_no_runs(call, tmp_path):
    (tmp_path / "runs").mkdir()
    assert call("runs").stdout == "no runs in runs\n"


def test_listing_runs_imports_neither_mlflow_nor_torch(tmp_path):
    write_run(tmp_path / "runs" / "a" / "run", {"status": "finished"})
    code = (
        "import sys\nfrom deepracer_exp.cli import main\ntry:\n    main(['runs'])\n"
        "finally:\n    print([n for n in ('mlflow', 'torch', 'pandas', 'hydra') if n in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stderr == "[]\n"
    assert "a/run" in done.stdout


@pytest.mark.parametrize(
    ("typed", "completion"),
    [
        ("ru", "runs"),
        ("runs l", "lineage"),
        ("train netw", "network="),
        ("train network=mlp_sm", "mlp_small_shared"),
        ("train --options tra", "tracking"),
        ("evaluate 2026", "20260101-120000-mine"),
        ("evaluate evaluation=su", "summit"),
        ("runs lineage runs_dir=there 2025", "20250101-120000-theirs"),
        ("clone best:", "a"),  # the shell takes what follows the colon for a word of its own
        ("tracks Oval", "Oval_track"),
    ],
)
def test_the_shell_completes_commands_groups_options_and_runs(tmp_path, typed, completion):
    write_run(tmp_path / "runs" / "a" / "20260101-120000-mine", None)
    write_run(tmp_path / "there" / "a" / "20250101-120000-theirs", None)
    line = f"deepracer-exp {typed}"
    asked = {
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_SUPPRESS_SPACE": "1",
        "_ARGCOMPLETE_IFS": "\n",
        "_ARGCOMPLETE_COMP_WORDBREAKS": " \t\n\"'><=;|&(:",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(tmp_path / "completions"),
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
        "COMP_TYPE": "9",
    }
    subprocess.run(command(), cwd=tmp_path, env=os.environ | asked, check=False)
    assert completion in (tmp_path / "completions").read_text().split("\n")
