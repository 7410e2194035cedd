"""Databases of the tests of `sweeps`, and processes that race for what is in them."""

import os
import signal
import subprocess
import sys
import uuid
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest
import sqlalchemy as sa

from sweeps.claims import TrialClaims
from sweeps.storage import resolve_database

PATIENCE_S = 120.0
MYSQL = "SWEEPS_TEST_MYSQL"
"""Names a variable with the URL of a MySQL server whose user may make databases; the tests run on it, too."""


@pytest.fixture(params=["sqlite", "postgresql", *(["mysql"] if MYSQL in os.environ else [])])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """The URL of an empty database, of each kind in turn."""
    if request.param == "sqlite":
        yield f"sqlite:///{tmp_path}/sweeps.db"
    elif request.param == "postgresql":
        yield request.getfixturevalue("postgres_server").new_database()
    else:
        server = sa.make_url(os.environ[MYSQL])
        name = f"study_{uuid.uuid4().hex[:12]}"
        with sa.create_engine(server, poolclass=sa.NullPool).begin() as connection:
            connection.execute(sa.text(f"CREATE DATABASE {name}"))
        yield server.set(database=name).render_as_string(hide_password=False)
        with sa.create_engine(server, poolclass=sa.NullPool).begin() as connection:
            connection.execute(sa.text(f"DROP DATABASE {name}"))


@pytest.fixture
def engine(url: str) -> Iterator[sa.Engine]:
    engine = sa.create_engine(url, **resolve_database(url, Path()).engine_options())
    yield engine
    engine.dispose()


@pytest.fixture
def claims(engine: sa.Engine) -> TrialClaims:
    return TrialClaims(engine, "study")


class Racers:
    """Processes that wait at the start line until all of them are there."""

    def __init__(self, arguments: Sequence[Sequence[str]]) -> None:
        racer = str(Path(__file__).with_name("racer.py"))
        self._processes = [
            subprocess.Popen(
                [sys.executable, racer, *each],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                env=os.environ | {"OMP_NUM_THREADS": "1"},
            )
            for each in arguments
        ]  # fmt: skip

    def __getitem__(self, number: int) -> subprocess.Popen[str]:
        return self._processes[number]

    def go(self) -> None:
        for process in self._processes:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n", process.communicate()
        for process in self._processes:
            assert process.stdin is not None
            process.stdin.write("go\n")
            process.stdin.flush()

    def lines(self) -> list[list[str]]:
        """Return what each of them printed; they must end well, or by a SIGKILL."""
        printed = []
        for process in self._processes:
            out, err = process.communicate(timeout=PATIENCE_S)
            assert process.returncode in (0, -signal.SIGKILL), err
            printed.append(out.splitlines())
        return printed

    def destroy(self) -> None:
        for process in self._processes:
            process.kill()
            process.communicate()


@pytest.fixture
def race() -> Iterator[Callable[..., Racers]]:
    """Start `racer.py WHAT URL OWNER ARGUMENT...` for each of some owners and let them go together."""
    started: list[Racers] = []

    def start(what: str, url: str, owners: Sequence[str], *arguments: object) -> Racers:
        more = [str(argument) for argument in arguments]
        started.append(Racers([[what, url, owner, *more] for owner in owners]))
        started[-1].go()
        return started[-1]

    yield start
    for racers in started:
        racers.destroy()
