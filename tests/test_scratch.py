"""What killed commands have left is cleared away, and nothing else."""

import os

import pytest

from deepracer_exp.scratch import clear, folder_aside


def test_a_folder_is_cleared_with_what_is_in_it(tmp_path):
    (tmp_path / "killed-one" / "below").mkdir(parents=True)
    (tmp_path / "kill").mkdir()
    clear(tmp_path, "killed-")
    assert [folder.name for folder in tmp_path.iterdir()] == ["kill"]


@pytest.mark.skipif(os.getuid() != 0, reason="only root may give a folder away")
def test_a_folder_of_another_user_is_left_alone(tmp_path):
    folder = tmp_path / "killed-one"
    folder.mkdir()
    os.chown(folder, 12345, 12345)
    clear(tmp_path, "killed-")
    assert folder.exists()


def test_a_folder_that_is_made_aside_is_whole_while_it_is_in_use_and_gone_after(tmp_path):
    (tmp_path / ".made-left").mkdir()
    with folder_aside(tmp_path, ".made-") as first, folder_aside(tmp_path, ".made-") as second:
        assert sorted(tmp_path.iterdir()) == sorted([first, second])
    assert not list(tmp_path.iterdir())
