import multiprocessing
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from benchmarks.same import different_rows, different_tensors, different_traces
from deepracer_exp.collectors.forking import start_workers_early
from deepracer_exp.runs.run_files import read_metrics, read_object

# As a training does: on a busy machine threads of torch wait for one another, and saving a small network took 20 s.
torch.set_num_threads(1)


def assert_same_run(one: Path, other: Path) -> None:
    """Two run folders have the same rows, weights, traces, and best and fastest checkpoint."""
    both = (one, other)
    assert different_rows(*(read_metrics(folder / "metrics.jsonl") for folder in both)) is None
    assert different_tensors(*(folder / "checkpoints" / "last" for folder in both)) is None
    assert different_traces(one, other) is None
    bests = [read_object(folder / "summary.json")["best"] for folder in both]
    assert bests[0] == bests[1]
    for label in ("best", "fastest"):
        links = [folder / "checkpoints" / label for folder in both]
        assert len({link.readlink() if link.is_symlink() else None for link in links}) == 1


@pytest.fixture(scope="session")
def workers_start_early() -> Iterator[None]:
    """Let workers, of sweeps too, fork from a process that has imported what they need, as commands do."""
    before = multiprocessing.get_start_method(allow_none=True)
    start_workers_early(True, "deepracer_exp.collectors.car_worker", "deepracer_exp.sweeps.queue.worker")
    yield
    multiprocessing.set_start_method(before, force=True)
