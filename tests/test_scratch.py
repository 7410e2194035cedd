"""What killed commands have left is cleared away, and nothing else."""

import os
import uuid
from pathlib import Path

import pytest

from deepracer_exp.scratch import clear, folder_aside

SHM = Path("/dev/shm")


@pytest.fixture
def semaphore():
    """Make a semaphore's file of another command; return it and the beginning of the names of all commands' folders."""
    prefix = f"test-{uuid.uuid4().hex}-"
    file = SHM / f"sem.{prefix}another-1"
    file.touch()
    yield file, prefix
    file.unlink(missing_ok=True)


def test_a_folder_is_cleared_with_its_own_semaphores(tmp_path, semaphore):
    file, prefix = semaphore
    (tmp_path / f"{prefix}another").mkdir()
    clear(tmp_path, prefix)
    assert not list(tmp_path.iterdir())
    assert not file.exists()


@pytest.mark.parametrize("name", ["*", "[a-z]*", "anothe?", "**", "an"])
def test_a_name_with_characters_of_patterns_stands_for_no_other(tmp_path, semaphore, name):
    file, prefix = semaphore
    (tmp_path / f"{prefix}{name}").mkdir()
    clear(tmp_path, prefix)
    assert not list(tmp_path.iterdir())
    assert file.exists()


@pytest.mark.skipif(os.getuid() != 0, reason="only root may give a folder away")
def test_a_folder_of_another_user_is_left_alone(tmp_path, semaphore):
    file, prefix = semaphore
    folder = tmp_path / f"{prefix}another"
    folder.mkdir()
    os.chown(folder, 12345, 12345)
    clear(tmp_path, prefix)
    assert folder.exists()
    assert file.exists()


def test_a_folder_that_is_made_aside_is_whole_while_it_is_in_use_and_gone_after(tmp_path):
    (tmp_path / ".made-left").mkdir()
    with folder_aside(tmp_path, ".made-") as first, folder_aside(tmp_path, ".made-") as second:
        assert sorted(tmp_path.iterdir()) == sorted([first, second])
    assert not list(tmp_path.iterdir())
