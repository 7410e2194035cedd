import multiprocessing
from collections.abc import Iterator

import pytest

from tests.training.conftest import workers_start_early  # noqa: F401 - a fixture


@pytest.fixture
def nothing_left() -> Iterator[None]:
    """No process is left when the test ends; asked for last, it looks before other fixtures close what is open."""
    before = set(multiprocessing.active_children())
    yield
    assert set(multiprocessing.active_children()) == before
