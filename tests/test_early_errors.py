"""Errors in a command line are reported at once, and in one line."""

import contextlib
import json
import os
import sqlite3
import subprocess
import sys
from dataclasses import asdict

import pytest
import yaml

from deepracer_exp.config.options import groups, options
from deepracer_exp.tracking.tracking_file import TrackedRun

HEAVY = ("torch", "mujoco", "mlflow", "optuna", "pandas")
CASES = {
    ("tarin",): "did you mean train?",
    ("train", "--fats"): "unrecognized arguments: --fats; see `deepracer-exp train --help`",
    ("runs", "clean", "--aply"): "see `deepracer-exp runs clean --help`",
    ("train", "seed=now"): "seed",
    ("train", "track=../../x"): "track=../../x",
    ("train", "reward.file=pipe"): "pipe: is a pipe",
    ("train", "track.file=nothing.npy"): "nothing.npy",
    ("train", "action_space.file=pipe"): "action_space.file=pipe: is a pipe",
    ("train", "custom_files=nowhere"): "nowhere",
    ("train", "evaluation.tracks=[../x]"): "evaluation.tracks=../x",
    ("train", "evaluation.held_out=../x"): "evaluation.held_out=../x",
    ("train", "-m", "seed=range(1,1000000)"): "more than 1,000 runs",
    ("train", "-m", "seed=range(0,5,0)"): "range(0,5,0)",
    ("train", "--options", "trak"): "did you mean track?",
    ("import", "nowhere", "--name", "mine"): "nowhere",
    ("validate", "reward.file=nothing.py"): "nothing.py",
    ("validate", "reward=racing"): "reward=racing",
    ("evaluate", "unknown"): "unknown: no such run in runs (3 there)",
    ("evaluate", "runs/a/run", "checkpoint=120"): "checkpoint=120",
    ("evaluate", "runs/a/run", "checkpoint="): "checkpoint",
    (
        "evaluate",
        "runs/a/run",
        "checkpoint=newest",
    ): "checkpoint=newest: a checkpoint is best, last, fastest or the number of",
    (
        "evaluate",
        "runs/a/run",
        f"checkpoint={'9' * 5000}",
    ): "a checkpoint is best, last, fastest or the number of",
    ("evaluate", "runs/a/run", "evaluation=sumit"): "did you mean summit?",
    ("evaluate", "runs/a/own"): "network.target=my_network:Net: named by a stored run",
    ("evaluate", "evaluation=summit"): "RUN: missing; write deepracer-exp evaluate RUN",
    ("evaluate", "one", "two"): "one two: 2 runs given",
    ("evaluate", "unknown", "runs_dir=recorded"): "unknown: no such run in recorded (1 there); no registered",
    ("evaluate", "runs/a/run", "--video", "lap.avi"): "--video lap.avi: accepted: an .mp4",
    ("watch", "unknown"): "unknown: no such run in runs (3 there)",
    ("watch", "runs/a/run", "checkpoint=120"): "checkpoint=120",
    (
        "watch",
        "runs/a/run",
        "-o",
        "nowhere/lap.mp4",
    ): "--output nowhere/lap.mp4: accepted: an .mp4 in an existing",
    ("watch", "runs/a/run", "--port", "8000"): "--port 8000: accepted: only with --live",
    ("watch", "runs/a/run", "--live", "checkpoint=best"): "checkpoint=best: --live",
    ("watch", "runs/a/run", "--live", "--port", "70000"): "--port: 70000: accepted: 1 to 65535",
    ("watch", "runs/a/own", "--live"): "network.target=my_network:Net: named by a stored run",
    ("resume", "unknown"): "unknown: no such run",
    ("resume", "~no_such_user"): "~no_such_user",
    ("resume", "a" * 300): "File name too long",
    ("resume", "runs/a/run", "budget.stepz=1"): "budget.stepz",
    ("resume", "runs/a/own"): "network.target=my_network:Net: named by a stored run",
    ("resume", "runs/a/ended"): "has ended (budget reached: env_steps); to resume it, give it more",
    ("resume", "recorded/a/stopped"): "has ended (stopped early: converged); stopping=none resumes it anyway",
    ("clone", "unknown"): "unknown: no such run",
    ("clone", "runs/a/run", "checkpoint=120"): "checkpoint=120",
    (
        "clone",
        "alone",
        "network=mlp",
    ): "network: cannot be changed in a clone: hidden: [64, 64] -> [128, 128]",
    ("clone", "alone", "action_space=discrete"): "action_space: cannot be changed in a clone",
    ("clone", "runs/a/own"): "network.target=my_network:Net: named by a stored run",
    ("checkpoints", "runs/a/own"): "network.target=my_network:Net: named by a stored run",
    ("checkpoints", "unknown"): "unknown: no such run",
    ("checkpoints", "runs/a/run"): "checkpoints",
    ("runs", "lst"): "did you mean list?",
    ("runs", "runs_dir=nowhere"): "runs_dir=nowhere: is not a folder",
    ("runs", "run_dir=nowhere"): "did you mean runs_dir?",
    ("runs", "compare", "a", "best:b"): "compare: no such action; accepted: list, lineage",
    ("runs", "lineage", "unknown"): "unknown: no such run",
    ("runs", "promote", "unknown"): "unknown: no such run",
    ("runs", "promote", "runs/a/run", "checkpoint=../x"): "checkpoint=../x",
    ("runs", "clean", "runs_dir=nowhere"): "runs_dir=nowhere: is not a folder",
    ("export", "unknown", "format=onnx"): "unknown: no such run",
    ("export", "runs/a/run", "format=onnx"): "checkpoint",
    ("export", "runs/a/run", "format=onx"): "format",
    ("export", "alone", "format=car"): "observation: the car has no features",
    ("export", "runs/a/own", "format=onnx"): "network.target=my_network:Net: named by a stored run",
    ("analyze", "unknown"): "unknown: no such file or folder, and no run",
    ("analyze", "pipe"): "pipe: is a pipe",
    ("analyze", "log.txt", "--reward", "nothing.py"): "nothing.py",
    ("analyze", "log.txt", "--target", "soon"): "--target soon: accepted: seconds above 0",
    (
        "analyze",
        "log.txt",
        "--output",
        "nowhere/page.html",
    ): "--output nowhere/page.html: its folder does not exist",
    ("analyze",): "RUN: 0 runs or logs given; accepted: one",
    ("analyze", "log.txt", "--compare", "runs/a/run"): "unrecognized arguments: --compare",
    ("compare",): "RUN RUN: 0 runs and 0 logs; accepted: two or more that differ, or an experiment",
    ("compare", "one", "two"): "one: no such file or folder, and no run",
    ("compare", "unknown", "log.txt"): "unknown: no such file or folder, and no run",
    ("compare", "runs/a/run"): "runs/a/run: 1 run and 0 logs; accepted: two or more that differ",
    ("compare", "runs/a/run", "runs/a/run"): "1 run and 0 logs; accepted: two or more that differ",
    (
        "compare",
        "old=runs/a/run,",
        "new=log.txt",
    ): "'': names nothing; accepted: logs of the service, or a run",
    ("compare", "a", "--replay", "laps.html"): "--replay laps.html: 3 runs and logs given; accepted: two",
    ("compare", "runs/a/run", "runs/a/ended", "checkpoint=last"): "last: no such file or folder, and no run",
    (
        "compare",
        "runs/a/run",
        "log.txt",
        "--format",
        "csv",
    ): "--format csv: accepted with runs only; log.txt is a log",
    ("compare", "runs/a/run", "runs/a/ended", "trackin.uri=x"): "no such key (did you mean tracking.uri?)",
    ("compare", "runs/a/run", "pipe"): "pipe: is a pipe",
    ("compare", "runs/a/run", "log.txt", "checkpoint=../x"): "../x: no such file or folder, and no run",
    ("compare", "runs/a/run", "log.txt", "-o", "nowhere/page.html"): "--output nowhere",
    ("tracks", "nowhere"): "nowhere",
    ("sweep", "algorithm.lr=1e-4,1e-3", "sweep.workers=100000"): "sweep.workers=100000",
    ("sweep", "track=../x,Oval_track"): "track=../x",
    ("sweep", "algorithm.lr=1e-4,1e-3", "reward.file=nothing.py"): "nothing.py",
    ("sweep", "algorithm.lr=1e-4,1e-3", "sweep.protocol=../x", "--cfg"): "sweep.protocol=../x",
    ("sweep", "study=../x", "algorithm.lr=1e-4,1e-3", "--cfg"): "study",
    ("sweep", "best", "unknown"): "sweeps.db",
    ("sweep", "best", "unknown", "seed=1"): "seed=1: no such key",
    ("sweep", "best", "../x"): "../x",
    ("ui", "--port", "http"): "--port: http: accepted: 1 to 65535",
    ("ui", "--port", "65536"): "--port: 65536: accepted: 1 to 65535",
    ("evaluate", "run=x"): "run=x: write deepracer-exp evaluate x",
    ("evaluate", "run=x", "--video", "lap.mp4"): "run=x: write deepracer-exp evaluate x",
    ("clone", "run=x", "checkpoint=last"): "run=x: write deepracer-exp clone x",
    ("export", "format=onnx", "run=my runs/x"): "write deepracer-exp export 'my runs/x'",
    ("checkpoints", "run=x"): "run=x: write deepracer-exp checkpoints x",
    ("lineage", "a"): "lineage: no such command",
    ("stopping", "replay", "a"): "stopping: no such command",
    ("resume", "x", "--runs-dir", "there"): "unrecognized arguments: --runs-dir",
    ("analyze", "x", "--out", "page.html"): "unrecognized arguments: --out",
    ("evaluate", "x", "tracking_uri=http://h"): "did you mean tracking.uri?",
}


def write_run(run, config, *checkpoints, **summary):
    """Write a run's folder, with empty checkpoints; the run has ended if there is a summary."""
    (run / "checkpoints").mkdir(parents=True)
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    for checkpoint in checkpoints:
        (run / "checkpoints" / checkpoint).mkdir()
        (run / "checkpoints" / "last").symlink_to(checkpoint)
    if summary:
        (run / "summary.json").write_text(json.dumps({"iteration": 1, "wall_clock_s": 1.0} | summary))


@pytest.fixture(scope="module")
def refused(tmp_path_factory, call_at):
    """Call all of them in one fresh process: exit code, output and heavy imports of each."""
    folder = tmp_path_factory.mktemp("early")
    os.mkfifo(folder / "pipe")
    (folder / "log.txt").write_text("nothing\n")
    (folder / "recorded").mkdir()
    with contextlib.closing(sqlite3.connect(folder / "recorded" / "mlflow.db")) as store:
        store.execute("CREATE TABLE registered_model_aliases (name, alias, version)")
    config = yaml.safe_load(call_at(folder, "train", "name=a", "--cfg").stdout)
    runs, recorded = folder / "runs" / "a", folder / "recorded" / "a"
    write_run(runs / "run", config)
    write_run(runs / "own", config | {"network": {"target": "my_network:Net", "kwargs": {}}}, "000001")
    write_run(folder / "alone", config, "000001")
    spent = config["budget"]["env_steps"]
    write_run(
        runs / "ended",
        config,
        status="finished",
        reason="budget reached: env_steps",
        limit="env_steps",
        env_steps=spent,
    )
    write_run(recorded / "stopped", config, status="stopped early", reason="converged", env_steps=9)
    store = f"sqlite:///{folder / 'recorded' / 'mlflow.db'}"
    tracked = TrackedRun("a", "a", 0, store=store, end_ms=1, run_id="id", complete=True)
    (recorded / "stopped" / "tracking.json").write_text(json.dumps(asdict(tracked)))
    code = f"""
import contextlib, io, json, sys
from deepracer_exp.cli import main
known = set()
for words in {list(CASES)!r}:
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
            main(words)
    except SystemExit as ended:
        heavy = {{name for name in {HEAVY!r} if name in sys.modules}}
        print(json.dumps([words, ended.code, said.getvalue(), sorted(heavy - known)]), flush=True)
        known |= heavy
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    return {tuple(words): (code, said, heavy) for words, code, said, heavy in lines}


@pytest.mark.parametrize("words", CASES, ids=" ".join)
def test_an_error_is_one_line_before_anything_heavy_is_imported(refused, words):
    code, said, heavy = refused[words]
    assert code == 2, said
    assert CASES[words] in said
    assert said.startswith("deepracer-exp: ")
    assert said.count("\n") == 1
    assert not heavy


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("reward=my_reward.py", "reward.file=my_reward.py"),
        ("track=routes/my.npy", "track.file=routes/my.npy"),
        ("action_space=model_metadata.json", "action_space.file=model_metadata.json"),
    ],
)
def test_a_file_given_as_an_option_is_answered_with_the_right_key(call, given, meant):
    call("train", given).assert_bad_input(f"did you mean {meant}?")


def test_each_option_is_listed_with_what_it_is_for(call):
    for group in groups():
        lines = call("train", "--options", group).stdout.splitlines()
        assert [line.split()[0] for line in lines] == options(group)
    assert "only the budget ends the run" in call("train", "--options", "stopping").stdout.lower()
