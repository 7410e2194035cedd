"""kill -9 of each process that the program starts, at random moments, again and again.

What the killed one had started is gone, and study and run resume. `FAULT_TIMES=20` kills each of
them twenty times (`make test-faults`), `KILL_LOOPS=FILE` adds a line of what was measured.
"""

import contextlib
import json
import os
import random
import signal
import sqlite3
import time
from pathlib import Path

import psutil
import pytest

from deepracer_exp.runs.run_files import read_metrics, read_object
from tests.waiting import PATIENCE_S, is_alive

from .test_killed_sweeps import Sweep, assert_every_trial_is_accounted_for_once, claims

KILLS = int(os.environ.get("FAULT_TIMES", "1"))
MANY = "sweep.trials=10000"

pytestmark = [pytest.mark.faults, pytest.mark.timeout(1800 * KILLS)]


@pytest.fixture
def kill(request):
    """Kill a process, wait until all that it had started is gone, and note how long that took."""
    kills = []

    def go(victim, doomed, moment):
        victim.kill()
        began = time.monotonic()
        while (left := doomed()) and time.monotonic() < began + PATIENCE_S:
            time.sleep(0.05)
        lines = [" ".join(process.cmdline())[:120] for process in left]
        kills.append({"moment": moment, "gone_after_s": round(time.monotonic() - began, 2), "left": lines})
        assert not left

    yield go
    if file := os.environ.get("KILL_LOOPS"):
        with Path(file).open("a") as lines:
            lines.write(json.dumps({request.node.name: kills}) + "\n")


def ended(cwd):
    with contextlib.closing(sqlite3.connect(cwd / "runs" / "sweeps.db")) as study:
        return study.execute("SELECT count(*) FROM deepracer_trials WHERE state IS NOT NULL").fetchone()[0]


def on_last_try(cwd):
    """Return whether a trial would count as failed if its worker were lost once more before the next checkpoint."""
    under_way = [claim for claim in claims(cwd) if not claim.has_ended]
    return any(run.tries >= 3 for claim in under_way for run in claim.trial.runs)


def rest(start, cwd):
    """Finish the trials that have begun, in a sweep without kills."""
    # Workers that claim at the same moment spread out, so that a trial before the last may not have begun.
    begun = max((claim.trial.number for claim in claims(cwd)), default=0) + 1
    Sweep(start, cwd, f"sweep.trials={begun}").end()
    assert_every_trial_is_accounted_for_once(cwd, trials=begun)


def alive(processes):
    return list(filter(is_alive, processes))


def test_nothing_outlives_a_killed_driver_and_its_study_resumes(start, tmp_path, kill):
    for number in range(KILLS):
        dice = random.Random(number)
        sweep = Sweep(start, tmp_path, MANY, "sweep.workers=2")
        if number % 3 == 1:
            time.sleep(dice.uniform(0.2, 8.0))
            moment = "while it starts"
        else:
            rows = sweep.rows() + dice.randrange(1, 8)
            sweep.wait_for(lambda: sweep.workers() and sweep.rows() >= rows, f"{rows} rows")  # noqa: B023
            moment = f"{rows} rows"
        kill(sweep.driver, sweep.command.processes, moment)
        sweep.command.popen.wait()
    rest(start, tmp_path)


@pytest.mark.parametrize("what", ["worker", "fork server"])
def test_a_sweep_survives_a_killed(what, start, tmp_path, kill):
    sweep = Sweep(start, tmp_path, MANY, "sweep.workers=2")
    for number in range(KILLS):
        before = ended(tmp_path) if number else 0
        sweep.wait_for(lambda: sweep.workers() and sweep.rows() and ended(tmp_path) > before, "trials")  # noqa: B023
        time.sleep(random.Random(number).uniform(0.0, 1.0))
        sweep.wait_for(lambda: sweep.workers() and not on_last_try(tmp_path), "trial with more tries")
        workers = sweep.workers()
        victim = random.Random(number).choice(workers)
        server = victim.parent()
        if what == "worker":
            kill(victim, lambda: alive([victim]), f"{before} trials")  # noqa: B023
        else:
            kill(server, lambda: alive([server, *workers]), f"{before} trials")  # noqa: B023
    sweep.command.popen.send_signal(signal.SIGINT)
    assert sweep.command.popen.wait(PATIENCE_S) == 130
    sweep.command.assert_nothing_left()
    rest(start, tmp_path)


def test_nothing_outlives_a_killed_run_and_it_resumes(start, tmp_path, kill):
    iterations = 15 * KILLS  # more than the rows that are waited for
    run = (
        *("train", "experiment=tiny", "tracking=off", "collector.processes=2", "checkpoints.every=4"),
        *("episode.max_steps=60", "budget.env_steps=null", f"budget.iterations={iterations}"),
    )
    metrics = "runs/tiny/*/metrics.jsonl"
    folders, rows = [], 0
    for number in range(KILLS):
        dice = random.Random(number)
        started = start("resume", str(folders[0])) if folders else start(*run)
        rows += dice.randrange(1, 12)
        started.wait_for(
            lambda: sum(file.read_bytes().count(b"\n") for file in tmp_path.glob(metrics)) >= rows,  # noqa: B023
            f"{rows} rows",
        )
        time.sleep(dice.uniform(0.0, 0.5))
        kill(psutil.Process(started.popen.pid), started.processes, f"{rows} rows")
        started.popen.wait()
        folders = [path.parent for path in tmp_path.glob("runs/tiny/*/config.yaml")]
    (folder,) = folders
    last = start("resume", str(folder)).end()
    assert last.code == 0, last.stderr
    assert read_object(folder / "summary.json")["status"] == "finished"
    assert [row["iteration"] for row in read_metrics(folder / "metrics.jsonl")] == list(
        range(1, iterations + 1)
    )
