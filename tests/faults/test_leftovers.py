"""What a killed command leaves outside of its run folder is cleared away by the next one."""

import os
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import psutil
import pytest

from tests.conftest import command

pytestmark = pytest.mark.slow


@pytest.fixture
def scratch():
    """Yield an empty folder for temporary files, with a path short enough for sockets."""
    folder = Path(tempfile.mkdtemp(prefix="s-", dir="/tmp"))
    yield folder
    shutil.rmtree(folder)


def left(scratch: Path) -> set[str]:
    """Return what lies there, without the one cache that PyTorch keeps for all processes."""
    return {one.name for one in scratch.iterdir() if not one.name.startswith("torchinductor_")}


def is_over(process: psutil.Process) -> bool:
    """Return whether a process has closed its files."""
    try:
        return process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def is_tracker(process: psutil.Process) -> bool:
    """Return whether it is the process by which Python removes the semaphores of others that were killed."""
    return "multiprocessing.resource_tracker" in " ".join(process.cmdline())


def test_the_next_command_clears_what_kill_9_has_left(start, scratch):
    training = start(
        "train",
        "experiment=tiny",
        "tracking=off",
        "collector=sync",
        "collector.processes=2",
        "budget.env_steps=10000000",
        env={"TMPDIR": str(scratch)},
    )
    training.wait_for_iterations(2)
    names = left(scratch)
    assert names, "nothing to be left"
    assert all(name.startswith("deepracer_exp-") for name in names), names

    def another() -> None:
        environment = os.environ | {"TMPDIR": str(scratch)}
        subprocess.run(command("runs"), cwd=training.cwd, env=environment, check=True, capture_output=True)

    another()
    assert left(scratch) == names, "the folder of a living command is gone"
    training.workers()  # notes what they have in shared memory
    killed = [process for process in training.processes() if not is_tracker(process)]
    for process in killed:
        process.kill()
    training.popen.wait()
    while not all(map(is_over, killed)):  # a killed process first gives its memory back
        time.sleep(0.05)
    assert left(scratch) == names
    another()
    assert not left(scratch)
    training.assert_nothing_left()


def test_a_command_that_ends_leaves_nothing(start, scratch):
    options = ("train", "experiment=tiny", "collector=sync", "collector.processes=2")
    training = start(*options, "budget.env_steps=100000000", env={"TMPDIR": str(scratch)})
    training.wait_for_iterations(1)
    training.workers()
    training.popen.send_signal(signal.SIGTERM)
    assert training.end().code == 143
    assert not left(scratch)
    training.assert_nothing_left()
