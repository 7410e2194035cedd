"""What a killed command leaves outside of its run folder is cleared away by the next one."""

import contextlib
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import psutil
import pytest

from tests.conftest import IN_WORKERS, command
from tests.waiting import wait_until

from .forked import begin, hold


@pytest.fixture
def scratch():
    """Yield an empty folder for temporary files, with a path short enough for sockets."""
    folder = Path(tempfile.mkdtemp(prefix="s-", dir="/tmp"))
    yield folder
    shutil.rmtree(folder)


def left(scratch: Path) -> set[str]:
    """Return what lies there, without the one cache that PyTorch keeps for all processes."""
    return {one.name for one in scratch.iterdir() if not one.name.startswith("torchinductor_")}


def lines(file: Path) -> list[str]:
    return file.read_text(encoding="utf-8").splitlines()


def is_over(process: psutil.Process) -> bool:
    """Return whether a process and all its threads have closed their files."""
    try:
        return process.status() == psutil.STATUS_ZOMBIE and process.num_threads() == 1
    except psutil.NoSuchProcess:
        return True


def kill_all(training) -> set[Path]:
    """Kill all processes of a training at one moment, also the one that removes their semaphores.

    Returns what they had in shared memory by a name.
    """
    killed = training.processes()
    for process in killed:
        with contextlib.suppress(psutil.NoSuchProcess):
            process.suspend()
    held = training.note_shared_memory()
    for process in killed:
        with contextlib.suppress(psutil.NoSuchProcess):
            process.kill()
    training.popen.wait()
    wait_until(lambda: all(map(is_over, killed)))  # a killed process first gives its memory back
    return held


@pytest.fixture
def start_one(start, scratch):
    """Start a training of two workers that takes hours, with its temporary files in `scratch`."""
    options = (*IN_WORKERS, "budget.env_steps=100000000")
    return lambda: start("train", *options, env={"TMPDIR": str(scratch)})


@pytest.fixture
def another(tmp_path, scratch):
    """Run another command to its end."""
    options = {"cwd": tmp_path, "env": os.environ | {"TMPDIR": str(scratch)}, "check": True}
    return lambda: subprocess.run(command("--version"), **options, capture_output=True)


@pytest.mark.usefixtures("workers_start_early")
def test_what_a_killed_process_has_left_is_cleared_by_the_next_one(scratch):
    def another() -> None:
        process = multiprocessing.Process(target=begin, args=(scratch,))
        process.start()
        process.join()
        assert process.exitcode == 0

    killed = multiprocessing.Process(target=hold, args=(scratch,))
    killed.start()
    held = [
        Path(line) for line in wait_until(lambda: (scratch / "held").exists() and lines(scratch / "held"))
    ]
    assert [file.exists() for file in held] == [True, True]
    another()
    assert [file.exists() for file in held] == [True, True]
    killed.kill()
    killed.join()
    another()
    assert [file.exists() for file in held] == [False, False]


@pytest.mark.faults
def test_the_next_command_clears_what_kill_9_has_left(start_one, another, scratch):
    training = start_one()
    training.wait_for_iterations(2)
    names, held = left(scratch), training.note_shared_memory()
    assert names, "nothing to be left"
    assert all(name.startswith("deepracer_exp-") for name in names), names
    assert any(file.name.startswith("sem.mp-") for file in held), "no semaphore to be left"
    another()
    assert left(scratch) == names, "the folder of a living command is gone"
    assert all(file.exists() for file in held), "a semaphore of a living command is gone"
    held = kill_all(training)
    assert left(scratch) == names
    another()
    assert not left(scratch)
    assert not any(file.exists() for file in held)
    training.assert_nothing_left()


@pytest.mark.faults
def test_it_clears_what_was_left_at_any_moment_of_a_start(start_one, another, scratch):
    moments = random.Random(5)
    for number in range(10):
        training = start_one()
        if number % 2:  # the moments around the first semaphore, however long the imports take
            training.wait_for_worker()
        time.sleep(moments.uniform(0.0, 1.0 if number % 2 else 8.0))
        held = kill_all(training)
        another()
        assert not left(scratch)
        assert not any(file.exists() for file in held)
        training.assert_nothing_left()


@pytest.mark.faults
def test_a_command_that_ends_leaves_nothing(start_one, scratch):
    training = start_one()
    training.wait_for_iterations(1)
    training.note_shared_memory()
    training.popen.send_signal(signal.SIGTERM)
    assert training.end().code == 143
    assert not left(scratch)
    training.assert_nothing_left()
