"""kill -9 and SIGSTOP of a sweep's processes: every trial is accounted for once, whatever happens.

`FAULT_TIMES=20` lets each of them happen twenty times (`make test-faults`).
"""

import contextlib
import multiprocessing
import os
import random
import signal
import sqlite3
import time
from pathlib import Path

import optuna
import psutil
import pytest

from deepracer_exp.runs.checkpoints import checkpoint_name
from deepracer_exp.runs.run_files import read_metrics, read_object
from deepracer_exp.sweeps.queue.claims import TrialClaims
from deepracer_exp.sweeps.queue.storage import open_storage
from deepracer_exp.sweeps.trial import Trial
from tests.waiting import PATIENCE_S

from .conftest import meanwhile

TIMES = range(int(os.environ.get("FAULT_TIMES", "1")))
TRIALS, ITERATIONS = 3, 6
SWEEP = (
    *("sweep", "study=s", "experiment=tiny", "tracking=off", "collector.threads=1", "checkpoints.every=2"),
    *("episode.max_steps=60", "budget.env_steps=null", f"budget.iterations={ITERATIONS}"),
    *("algorithm.lr=tag(log,interval(1e-5,1e-3))", "sweep.protocol=three_trials", "sweep.rerank=0"),
    *(f"sweep.trials={TRIALS}", "sweep.lease_s=6"),
)

# Its workers end or die, and their driver knows: no lease has to run out.
SMALL = (
    *("budget.iterations=2", "algorithm.frames_per_iteration=256", "checkpoints.every=1"),
    "sweep.lease_s=3600",
)


class Sweep:
    """A sweep started as a racer does, with its workers in sight."""

    def __init__(self, start, cwd, *overrides):
        self.cwd = cwd
        self.command = start(*SWEEP, *overrides)
        self.driver = psutil.Process(self.command.popen.pid)

    def workers(self):
        """Return the worker processes that live."""
        return self.command.workers()

    def is_over(self):
        """Return whether the sweep has ended; on a busy machine it may, before the test looks again."""
        return self.command.popen.poll() is not None

    def rows(self):
        """Return how many iterations are recorded, of all trials."""
        return sum(file.read_bytes().count(b"\n") for file in self.cwd.glob("runs/s/*/metrics.jsonl"))

    def wait_for(self, condition, what):
        return self.command.wait_for(condition, what)

    def end(self):
        ended = self.command.end()
        assert ended.code == 0, f"{ended.stderr}\n{self.log()}"
        return ended

    def log(self):
        file = self.cwd / "runs" / "s" / "workers.log"
        return file.read_text() if file.exists() else ""


@pytest.fixture
def sweep(start, tmp_path):
    begun = []

    def go(*overrides, at_random=None):
        begun.append(Sweep(start, tmp_path, *overrides))
        if at_random is not None:
            wait_at_random(at_random, begun[-1])
        return begun[-1]

    return go


def wait_at_random(moment, sweep):
    """Wait for a moment of the sweep, whatever the speed of the machine: so many rows, and a little."""
    rows, more_s = moment.randrange(TRIALS * ITERATIONS - 3), moment.uniform(0.0, 1.5)
    sweep.wait_for(lambda: sweep.rows() >= rows and (sweep.workers() or sweep.is_over()), f"{rows} rows")
    time.sleep(more_s)


def claims(cwd, storage=None):
    return TrialClaims(open_storage(storage, cwd / "runs").engine, "s").all()


def assert_every_trial_is_accounted_for_once(cwd, storage=None, trials=TRIALS, iterations=ITERATIONS):
    """The study has each trial once, with the value of a run that has each of its iterations once."""
    opened = open_storage(storage, cwd / "runs")
    found = TrialClaims(opened.engine, "s").all()
    assert all(claim.is_reported for claim in found)
    assert [claim.trial.number for claim in found] == list(range(trials))
    known = optuna.load_study(study_name="s", storage=opened).trials
    # The queue and Optuna have the same trials by the same numbers, whoever was killed when.
    assert [Trial.of(one) for one in known] == [claim.trial for claim in found]
    assert {one.state for one in known} == {optuna.trial.TrialState.COMPLETE}
    for trial in (claim.trial for claim in found):
        (run,) = trial.runs
        assert trial.values == run.values
        folder = cwd / "runs" / "s" / Path(run.run_dir).name
        assert read_object(folder / "summary.json")["status"] == "finished"
        rows = [row["iteration"] for row in read_metrics(folder / "metrics.jsonl")]
        assert rows == list(range(1, iterations + 1))
    assert len({trial.params["algorithm.lr"] for trial in known}) == trials


@pytest.mark.faults
@pytest.mark.parametrize("seed", TIMES)
def test_after_kill_9_of_the_only_worker_another_one_continues(sweep, tmp_path, seed):
    running = sweep("sweep.workers=1", "algorithm.frames_per_iteration=256", at_random=random.Random(seed))
    for worker in running.workers():  # none after the last trial
        with contextlib.suppress(psutil.NoSuchProcess):
            worker.kill()
    running.end()
    assert_every_trial_is_accounted_for_once(tmp_path)


@pytest.mark.usefixtures("workers_start_early")
def test_a_worker_killed_in_the_middle_of_a_trial_is_replaced_and_each_trial_counts_once(call, tmp_path):
    """The reward function of the second trial kills its worker, the only one, once."""
    (tmp_path / "deadly.py").write_text(
        "import os, pathlib\n\n\n"
        "def reward_function(params):\n"
        "    deadly = pathlib.Path('deadly')\n"
        "    if len(list(pathlib.Path().glob('runs/s/*/metrics.jsonl'))) == 2 and deadly.exists():\n"
        "        deadly.unlink()\n"
        "        os.kill(os.getpid(), 9)\n"
        "    return params['speed']\n"
    )
    (tmp_path / "deadly").touch()
    ended = call(*SWEEP, *SMALL, "sweep.trials=2", "sweep.workers=1", "reward.file=deadly.py")
    assert ended.code == 0, ended.stderr
    assert not (tmp_path / "deadly").exists()
    assert_every_trial_is_accounted_for_once(tmp_path, trials=2, iterations=2)
    assert [claim.attempt for claim in claims(tmp_path)] == [1, 2]


@pytest.mark.usefixtures("workers_start_early")
def test_ctrl_c_of_a_sweep_in_this_process_leaves_its_trials_ready_to_resume(call, tmp_path):
    def rows() -> int:
        return sum(file.read_bytes().count(b"\n") for file in tmp_path.glob("runs/s/*/metrics.jsonl"))

    with meanwhile(lambda: rows() >= 3, lambda: os.kill(os.getpid(), signal.SIGINT)):
        ended = call(*SWEEP, *SMALL, "sweep.workers=2", "sweep.trials=1000")
    assert ended.code == 130
    assert "Traceback" not in ended.stderr + (tmp_path / "runs" / "s" / "workers.log").read_text()
    assert ended.stderr.splitlines()[-1] == "interrupted; resume it with: deepracer-exp sweep study=s"
    assert not multiprocessing.active_children()
    trials = assert_those_under_way_can_be_resumed(tmp_path)
    assert call("sweep", "study=s", f"sweep.trials={trials}").code == 0
    assert_every_trial_is_accounted_for_once(tmp_path, trials=trials, iterations=2)


def assert_those_under_way_can_be_resumed(cwd):
    """Return how many trials the study has if no other one begins."""
    begun = claims(cwd)
    assert {claim.attempt for claim in begun} == {1}
    open_ones = [claim for claim in begun if not claim.has_ended]
    assert len(open_ones) <= 2
    assert all(claim.expired for claim in open_ones)
    # Workers that claimed at the same moment may have left a gap.
    return 1 + max(claim.trial.number for claim in begun)


def interrupted(running, times=1):
    """Press Ctrl-C in the terminal of a sweep, and wait for its end."""
    for number in range(times):
        time.sleep(0.5 * number)
        running.command.signal_group(signal.SIGINT)
    ended = running.command.end()
    assert ended.code == 130
    assert "Traceback" not in ended.stderr + running.log()
    assert ended.stderr.splitlines()[-1] == "interrupted; resume it with: deepracer-exp sweep study=s"
    running.command.assert_nothing_left()


@pytest.mark.faults
def test_ctrl_c_begins_no_other_trial_and_leaves_those_under_way_ready_to_resume(sweep, tmp_path):
    running = sweep("sweep.workers=2", "sweep.trials=1000")
    running.wait_for(lambda: running.rows() >= ITERATIONS + 1, "rows")
    interrupted(running)
    trials = assert_those_under_way_can_be_resumed(tmp_path)
    sweep(f"sweep.trials={trials}").end()
    assert_every_trial_is_accounted_for_once(tmp_path, trials=trials)


@pytest.mark.faults
@pytest.mark.parametrize("times", [1, 2])
def test_ctrl_c_ends_a_sweep_whose_trials_would_take_minutes_to_end(sweep, tmp_path, times):
    (tmp_path / "slow.py").write_text(
        "import time\n\n\ndef reward_function(params):\n    time.sleep(0.2)\n    return 1.0\n"
    )
    running = sweep("sweep.workers=2", "reward.file=slow.py", "reward.time_limit_s=19", "collector.cars=4")
    running.wait_for(lambda: len([claim for claim in claims(tmp_path) if claim.trial.runs]) == 2, "runs")
    interrupted(running, times)
    assert not any(claim.has_ended for claim in claims(tmp_path))


@pytest.mark.faults
def test_the_cars_of_a_killed_worker_are_gone_with_it(sweep):
    """A trial with processes of its own: they have another fork server, which has no other client."""
    long = ("sweep.trials=1", "budget.iterations=10000")
    running = sweep("sweep.workers=1", "collector=sync", "collector.processes=1", *long)
    running.wait_for(running.rows, "rows")
    (worker,) = [one for one in running.workers() if os.getsid(one.pid) == one.pid]
    below = worker.children(recursive=True)
    assert len(below) >= 2
    worker.kill()
    _, left = psutil.wait_procs(below, PATIENCE_S)
    assert not left


@pytest.mark.faults
@pytest.mark.parametrize("seed", TIMES)
def test_after_kill_9_of_everything_the_study_resumes(sweep, tmp_path, seed):
    running = sweep("sweep.workers=2", at_random=random.Random(seed))
    for process in (running.driver, *running.workers()):
        with contextlib.suppress(psutil.NoSuchProcess):
            process.kill()
    running.command.popen.wait()
    sweep("sweep.workers=2").end()
    assert_every_trial_is_accounted_for_once(tmp_path)


@pytest.mark.faults
@pytest.mark.parametrize("seed", TIMES)
def test_a_worker_that_wakes_up_after_its_lease_writes_neither_into_the_study_nor_into_the_run(
    sweep, tmp_path, seed
):
    running = sweep("sweep.workers=2", "budget.iterations=40")
    running.wait_for(lambda: running.rows() >= 1 + random.Random(seed).randrange(4), "rows")
    held, late = running.wait_for(lambda: suspended(running), "trial under way")
    try:
        taken = running.wait_for(
            lambda: next(
                (s for s in claims(tmp_path) if s.trial.number == held.trial.number and s.attempt > 1), None
            ),
            "other worker that takes over",
        )
        assert taken.owner != held.owner
        running.wait_for(
            lambda: next(s for s in claims(tmp_path) if s.trial.number == held.trial.number).is_reported,
            "result",
        )
    finally:
        late.resume()
    running.end()
    assert_every_trial_is_accounted_for_once(tmp_path, iterations=40)
    claim = next(claim for claim in claims(tmp_path) if claim.trial.number == held.trial.number)
    assert claim.attempt == taken.attempt
    # The sleeper held its folder, so that the other one continued in a copy.
    assert claim.trial.runs[0].run_dir != held.trial.runs[0].run_dir
    assert not (Path(held.trial.runs[0].run_dir) / "summary.json").exists()


@pytest.mark.faults
@pytest.mark.parametrize("seed", TIMES)
@pytest.mark.parametrize("is_killed", [True, False])
def test_a_sweep_that_ends_in_its_last_stage_resumes_the_clone_and_no_trial(
    sweep, start, tmp_path, is_killed, seed
):
    """The clone has each of its iterations once, in one folder, whether the sweep was killed or got a Ctrl-C."""
    iterations, runs = 30, tmp_path / "runs" / "s"
    clone = f"sweep.clone={{randomization: sim2real, budget.iterations: {iterations}}}"
    running = sweep("sweep.workers=2", "sweep.rerank_laps=2", clone)
    rows, begun = 1 + random.Random(seed).randrange(iterations // 2), Path(checkpoint_name(0))
    running.wait_for(
        lambda: (
            any(last.readlink() != begun for last in runs.glob("*-clone1/checkpoints/last"))
            and sum(file.read_bytes().count(b"\n") for file in runs.glob("*-clone1/metrics.jsonl")) >= rows
        ),
        f"a checkpoint and {rows} rows of the clone",
    )
    ended_s = {path: path.stat().st_mtime_ns for path in runs.glob("*/summary.json")}
    assert len(ended_s) == TRIALS
    if is_killed:
        running.driver.kill()
        running.command.popen.wait()
    else:
        interrupted(running)
        (summary,) = runs.glob("*-clone1/summary.json")
        assert read_object(summary)["status"] == "interrupted"
    # The command that the interrupted sweep has printed: the study remembers the clone.
    again = start("sweep", "study=s").end()
    assert again.code == 0, again.stderr
    assert "resumes after iteration" in (next(runs.glob("*-clone1")) / "log.txt").read_text()
    assert "Submit " in again.stdout
    assert_every_trial_is_accounted_for_once(tmp_path)
    assert {path: path.stat().st_mtime_ns for path in ended_s} == ended_s
    (folder,) = runs.glob("*-clone1")
    assert read_object(folder / "summary.json")["status"] == "finished"
    assert [row["iteration"] for row in read_metrics(folder / "metrics.jsonl")] == [*range(1, iterations + 1)]


def is_locked(cwd):
    with contextlib.closing(sqlite3.connect(cwd / "runs" / "sweeps.db", timeout=2.0)) as study:
        try:
            study.execute("BEGIN IMMEDIATE")
        except sqlite3.OperationalError:
            return True
    return False


def suspended(running):
    """Suspend the worker of a trial whose run is under way; return claim and worker, or None if there is none now.

    Not while it writes to the study: others wait for the lock on the file, however long its owner sleeps.
    """
    for claim in claims(running.cwd):
        if not claim.has_ended and claim.trial.runs:
            worker = psutil.Process(int(claim.owner.rsplit(":", 2)[1]))
            worker.suspend()
            (now,) = [one for one in claims(running.cwd) if one.trial.number == claim.trial.number]
            is_ours = not now.has_ended and now.owner == claim.owner and not is_locked(running.cwd)
            if is_ours and not (Path(now.trial.runs[-1].run_dir) / "summary.json").exists():
                return now, worker
            worker.resume()
    return None


@pytest.mark.faults
@pytest.mark.parametrize("seed", TIMES)
def test_two_drivers_share_one_study(sweep, tmp_path, seed):
    both = [sweep("sweep.workers=1"), sweep("sweep.workers=1")]
    for one in both:
        one.end()
    assert_every_trial_is_accounted_for_once(tmp_path)


@pytest.mark.faults
@pytest.mark.parametrize("seed", TIMES)
def test_while_the_database_is_away_all_wait_and_then_continue(sweep, tmp_path, postgres, seed):
    moment, url = random.Random(seed), postgres.new_database()
    running = sweep("sweep.workers=2", f"sweep.storage={url}", at_random=moment)
    postgres.stop(moment.choice([signal.SIGINT, signal.SIGQUIT]))
    time.sleep(moment.uniform(1.0, 9.0))  # shorter and longer than a lease
    assert running.command.popen.poll() is None
    postgres.start()
    running.end()
    assert_every_trial_is_accounted_for_once(tmp_path, url)
    said = running.log() + "".join(path.read_text() for path in tmp_path.glob("std*.txt"))
    assert postgres.password not in said
    study = optuna.load_study(study_name="s", storage=open_storage(url, tmp_path))
    assert postgres.password not in str(study.user_attrs)
