"""What killed commands have left is cleared away, and nothing else."""

import fcntl
import multiprocessing
import os
import secrets
import sys
from pathlib import Path

import pytest

from deepracer_exp.scratch import clear, clear_semaphores, folder_aside

SHM = Path("/dev/shm")
on_linux = pytest.mark.skipif(sys.platform != "linux", reason="semaphores have files on Linux only")


def test_a_folder_is_cleared_with_what_is_in_it(tmp_path):
    (tmp_path / "killed-one" / "below").mkdir(parents=True)
    (tmp_path / "kill").mkdir()
    clear(tmp_path, "killed-")
    assert [folder.name for folder in tmp_path.iterdir()] == ["kill"]


def give_away(path: Path) -> None:
    """Make another user the owner; in some containers root may not."""
    try:
        os.chown(path, 12345, 12345)
    except OSError as error:
        pytest.skip(f"files cannot be given away: {error}")


def test_a_folder_of_another_user_is_left_alone(tmp_path):
    folder = tmp_path / "killed-one"
    folder.mkdir()
    give_away(folder)
    clear(tmp_path, "killed-")
    assert folder.exists()


def test_a_folder_that_is_made_aside_is_whole_while_it_is_in_use_and_gone_after(tmp_path):
    (tmp_path / ".made-left").mkdir()
    with folder_aside(tmp_path, ".made-") as first, folder_aside(tmp_path, ".made-") as second:
        assert sorted(tmp_path.iterdir()) == sorted([first, second])
    assert not list(tmp_path.iterdir())


@pytest.fixture
def semaphores():
    """Make files named as semaphores that no process has open, and remove the remaining ones."""
    made = []

    def make(name: str) -> Path:
        made.append(SHM / name)
        made[-1].write_bytes(bytes(32))
        return made[-1]

    yield make
    for file in made:
        file.unlink(missing_ok=True)


@pytest.mark.processes
@on_linux
def test_a_semaphore_that_no_process_has_open_is_removed(semaphores):
    killed = semaphores(f"sem.mp-{secrets.token_hex(4)}")
    try:
        with killed.open("rb") as file:
            fcntl.fcntl(file, fcntl.F_SETLEASE, fcntl.F_RDLCK)
    except OSError as error:  # in gVisor; each command leaves such files then
        pytest.skip(f"this kernel grants no lease: {error}")
    clear_semaphores(SHM)
    assert not killed.exists()


@on_linux
def test_a_semaphore_in_use_is_left_alone():
    lock = multiprocessing.get_context("spawn").Lock()
    in_use = SHM / f"sem.{lock._semlock.name.removeprefix('/')}"
    assert in_use.exists()
    clear_semaphores(SHM)
    assert in_use.exists()


@pytest.mark.processes
@on_linux
def test_nothing_else_in_shared_memory_is_removed(semaphores):
    others = [semaphores(f"{name}.test-{os.getpid()}") for name in ("sem", "sem.mp-test_k2l", "torch")]
    clear_semaphores(SHM)
    assert all(other.exists() for other in others)


@pytest.mark.processes
@on_linux
def test_a_semaphore_of_another_user_is_left_alone(semaphores):
    made = semaphores(f"kept.test-{os.getpid()}")
    give_away(made)
    # Given away before it has the name of a semaphore: commands of other tests clear those of this user.
    other = made.rename(SHM / f"sem.mp-{secrets.token_hex(4)}")
    try:
        clear_semaphores(SHM)
        assert other.exists()
    finally:
        other.unlink()
