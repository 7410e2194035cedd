import multiprocessing
from collections.abc import Iterator

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
