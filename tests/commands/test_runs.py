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
    names = [f"{stamp(seconds)}-{name}" for seconds, name in ((200_000, "old"), (7_300, "mid"), (61, "new"))]
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
    _, *listed, note = ended.stdout.splitlines()
    assert note.startswith("lap, race score: of the best checkpoint")
    rows = [line.split() for line in listed]
    assert rows == [
        [f"a/{names[2]}", "running", NONE, NONE, NONE, NONE, "1", "min"],
        [f"b/{names[1]}", "failed", NONE, NONE, "0", NONE, "2", "h"],
        [f"a/{names[0]}", "finished", "7.98", "8.02", "1,234", "7.65", "2", "d"],
        [rows[3][0], "killed", NONE, NONE, NONE, NONE, "3", "d"],
        [rows[4][0], "unreadable", NONE, NONE, NONE, NONE, "4", "d"],
    ]


def write_study(runs_dir: Path) -> None:
    """Write a study of three trials, one of them running, beside a run of another experiment."""
    for number, (score_s, ending) in enumerate([(9.0, "finished"), (8.5, "finished"), (None, None)]):
        best = {"eval_race_score_s": score_s, "eval_lap_time_s": 7.0 + number, "eval_completion": 100.0}
        summary = {"status": ending, "study": "season", "trial": number, "laps": 10, "best": best}
        write_run(runs_dir / "season" / f"{stamp(900 - 100 * number)}-{number}", summary if ending else None)
    write_run(runs_dir / "other" / f"{stamp(1000)}-alone", {"status": "finished"})


def test_the_trials_of_a_study_are_one_line_with_its_best_run(call, tmp_path):
    write_study(tmp_path / "runs")
    rows = [line.split() for line in call("runs").stdout.splitlines()[1:3]]
    assert [row[:-2] for row in rows] == [
        ["best:season,", "of", "3", "trials", "ended", "8.00", "8.50", "20", NONE],
        [rows[1][0], "finished", NONE, NONE, NONE, NONE],
    ]
    # What the sweep calls its best goes before the race score of the training's laps.
    names = sorted(path.name for path in (tmp_path / "runs" / "season").iterdir())
    best = {"study": "season", "trial": 0, "run_dir": names[0], "values": {"race_score": 9.1}}
    (tmp_path / "runs" / "season" / "best_of_sweep.json").write_text(json.dumps(best))
    assert call("runs").stdout.splitlines()[1].split()[4:7] == ["ended", "7.00", "9.00"]
    # The clone of the best trial is a run of the study and no trial.
    clone = tmp_path / "runs" / "season" / f"{stamp(600)}-clone1"
    write_run(clone, {"status": "finished", "study": "season", "laps": 1, "best": {"eval_lap_time_s": 6.5}})
    best_of_sweep = tmp_path / "runs" / "season" / "best_of_sweep.json"
    best_of_sweep.write_text(json.dumps(best | {"run_dir": clone.name}))
    assert call("runs").stdout.splitlines()[1].split()[:6] == [
        "best:season,",
        "of",
        "3",
        "trials",
        "ended",
        "6.50",
    ]


@pytest.mark.parametrize(
    "arguments", [["--trials"], ["--where", "study=season"], ["--sort", "score_s"], ["--format", "csv"]]
)
def test_the_trials_of_a_study_can_be_listed(call, tmp_path, arguments):
    write_study(tmp_path / "runs")
    listed = call("runs", "list", *arguments).stdout
    assert "best:season" not in listed
    assert sum("season/" in line for line in listed.splitlines()) == 3 - (arguments[0] == "--where")


def test_a_running_training_shows_what_its_best_checkpoint_has_reached(call, tmp_path):
    run = write_run(tmp_path / "runs" / "a" / f"{stamp(90)}-now", None)
    rows = [
        {
            "iteration": 10,
            "laps": 3,
            "best_lap_time_s": 9.5,
            "eval_lap_time_s": 8.25,
            "eval_race_score_s": 8.75,
        },
        {
            "iteration": 20,
            "laps": 7,
            "best_lap_time_s": 9.0,
            "eval_lap_time_s": 8.0,
            "eval_race_score_s": 9.5,
        },
        {"iteration": 21, "laps": 8, "best_lap_time_s": 8.9},
    ]
    (run / "metrics.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in rows) + '{"iteration": 2')
    with (run / ".running").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        before = call("runs").stdout.splitlines()[1].split()
        (run / "checkpoints" / "000010").mkdir(parents=True)
        (run / "checkpoints" / "best").symlink_to("000010")
        after = call("runs").stdout.splitlines()[1].split()
    assert before[1:6] == ["running", NONE, NONE, "8", "8.90"]
    assert after[1:6] == ["running", "8.25", "8.75", "8", "8.90"]


def test_runs_elsewhere_are_listed_with_runs_dir(call, tmp_path):
    run = write_run(tmp_path / "there" / "a" / "renamed", {"status": "finished"})
    os.utime(run / "config.yaml", (0, 0))
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
