"""Databases of the tests of `sweeps`, and processes that race for what is in them."""

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path

import optuna
import pytest
import sqlalchemy as sa

from deepracer_exp.sweeps.queue.claims import TrialClaims
from deepracer_exp.sweeps.queue.storage import resolve_database
from tests.training.conftest import workers_start_early
from tests.waiting import PATIENCE_S

from .studies import season

__all__ = ["workers_start_early"]


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.processes)])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """The URL of an empty database, of each kind in turn."""
    if request.param == "sqlite":
        yield f"sqlite:///{tmp_path}/sweeps.db"
    else:
        yield request.getfixturevalue("postgres_server").new_database()


@pytest.fixture
def engine(url: str) -> Iterator[sa.Engine]:
    engine = sa.create_engine(url, **resolve_database(url, Path()).engine_options())
    yield engine
    engine.dispose()


@pytest.fixture
def claims(engine: sa.Engine) -> TrialClaims:
    return TrialClaims(engine, "study")


@pytest.fixture(scope="session")
def study(tmp_path_factory: pytest.TempPathFactory) -> optuna.Study:
    """A study of 60 trials with every kind of end, which no test changes."""
    return season(tmp_path_factory.mktemp("runs"), 60)


class Racers:
    """Processes that wait at the start line until all of them are there."""

    def __init__(
        self, what: Callable[..., None], url: str, files: Sequence[Path], arguments: Sequence[object]
    ):
        start = multiprocessing.Barrier(len(files) + 1, timeout=PATIENCE_S)
        self._files = files
        self._processes = [
            multiprocessing.Process(target=what, args=(url, file, start, *arguments)) for file in files
        ]
        for process in self._processes:
            process.start()
        start.wait()

    def __getitem__(self, number: int) -> BaseProcess:
        return self._processes[number]

    def lines(self) -> list[list[str]]:
        """Return what each of them wrote; they must end well, or by a SIGKILL."""
        for process in self._processes:
            process.join(PATIENCE_S)
            assert process.exitcode in (0, -signal.SIGKILL)
        return [file.read_text().splitlines() if file.exists() else [] for file in self._files]

    def destroy(self) -> None:
        for process in self._processes:
            process.kill()
            process.join()


@pytest.fixture
def race(tmp_path: Path, workers_start_early: None) -> Iterator[Callable[..., Racers]]:
    """Let each of some owners do the same in a process: `race(WHAT, URL, OWNERS, ARGUMENTS...)`."""
    started: list[Racers] = []

    def start(what: Callable[..., None], url: str, owners: Sequence[str], *arguments: object) -> Racers:
        started.append(Racers(what, url, [tmp_path / owner for owner in owners], arguments))
        return started[-1]

    yield start
    for racers in started:
        racers.destroy()
