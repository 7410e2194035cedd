import multiprocessing
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from deepracer_exp.commands.startup import start_workers_early

# As a training does: on a busy machine threads of torch wait for one another, and saving a small network took 20 s.
torch.set_num_threads(1)


@pytest.fixture(scope="session")
def workers_start_early() -> Iterator[None]:
    """Let workers fork from a process that has imported torch, as the command does: a second instead of five each."""
    before = multiprocessing.get_start_method(allow_none=True)
    start_workers_early(True)
    yield
    multiprocessing.set_start_method(before, force=True)


@pytest.fixture
def copied(trained, tmp_path: Path) -> Callable[..., Path]:
    """Train with these overrides, once for all tests, and return a copy of the run, which may be changed."""

    def copy(*overrides: str) -> Path:
        ended = trained(*overrides)
        assert ended.code == 0, ended.stderr
        return shutil.copytree(ended.folder, tmp_path / "runs" / "tiny" / ended.folder.name, symlinks=True)

    return copy
