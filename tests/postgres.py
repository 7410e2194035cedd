"""A real PostgreSQL, from Debian's package."""

import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa

from .ports import find_port
from .waiting import PATIENCE_S, wait_until


class Postgres:
    """A server of its own on a loopback port, which can be stopped, killed and started again."""

    password = "s3cr/t@{0}%25 word"

    def __init__(self, programs: Path) -> None:
        # PostgreSQL does not run as root, and cannot see what lies in a folder of root's.
        self._user = pwd.getpwnam("postgres") if os.getuid() == 0 else None
        self._programs = programs
        self.folder = Path(tempfile.mkdtemp(prefix="sweeps-pg-", dir="/tmp"))
        self.port = find_port()
        words = self.folder / "password"
        words.write_text(self.password)
        if self._user:
            for path in (self.folder, words):
                try:
                    os.chown(path, self._user.pw_uid, self._user.pw_gid)
                except OSError as error:  # in some containers root may not
                    pytest.skip(f"files cannot be given to PostgreSQL's user: {error}")
        self._call(
            "initdb",
            *("-D", str(self.folder / "data"), "-U", "racer", "--auth=scram-sha-256"),
            *("--pwfile", str(words), "--encoding=UTF8", "--locale=C", "--no-sync"),
        )
        self._process: subprocess.Popen[bytes] | None = None

    def _as_user(self) -> dict[str, object]:
        if self._user is None:
            return {}
        return {"user": self._user.pw_uid, "group": self._user.pw_gid, "extra_groups": []}

    def _call(self, program: str, *arguments: str) -> None:
        subprocess.run(
            [self._programs / program, *arguments],
            check=True, capture_output=True, cwd=self.folder, **self._as_user(),
        )  # fmt: skip

    def url(self, database: str = "postgres", password: str | None = None) -> str:
        return sa.URL.create(
            *("postgresql+psycopg", "racer", password or self.password, "127.0.0.1", self.port, database)
        ).render_as_string(hide_password=False)

    def new_database(self) -> str:
        """Make an empty database and return its URL."""
        name = f"study_{uuid.uuid4().hex[:12]}"
        self.execute(f"CREATE DATABASE {name}")
        return self.url(name)

    def execute(self, statement: str) -> list[sa.Row]:
        engine = sa.create_engine(self.url(), poolclass=sa.NullPool, isolation_level="AUTOCOMMIT")
        with engine.connect() as connection:
            result = connection.execute(sa.text(statement))
            return list(result.all()) if result.returns_rows else []

    def start(self) -> None:
        settings = {
            "port": self.port,
            "listen_addresses": "127.0.0.1",
            "unix_socket_directories": self.folder,
            "fsync": "off",
            "shared_buffers": "16MB",
        }
        with (self.folder / "log").open("ab") as log:
            self._process = subprocess.Popen(
                [
                    *(self._programs / "postgres", "-D", self.folder / "data"),
                    *(f"--{key}={value}" for key, value in settings.items()),
                ],
                cwd=self.folder, stdin=subprocess.DEVNULL, stdout=log, stderr=log, **self._as_user(),
            )  # fmt: skip
        wait_until(self._answers, "answer of PostgreSQL")

    def _answers(self) -> bool:
        assert self._process is not None
        assert self._process.poll() is None, (self.folder / "log").read_text()
        try:
            self.execute("SELECT 1")
        except sa.exc.OperationalError:
            return False
        return True

    @property
    def runs(self) -> bool:
        return self._process is not None

    def stop(self, how: signal.Signals = signal.SIGINT) -> None:
        """Stop the server: SIGINT breaks connections off, SIGQUIT leaves the recovery to the next start."""
        if self._process is not None:
            self._process.send_signal(how)
            self._process.wait(PATIENCE_S)
            self._process = None


@pytest.fixture(scope="session")
def postgres_server() -> Iterator[Postgres]:
    programs = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    if not programs:
        pytest.skip("PostgreSQL is not installed here (Debian: apt-get install postgresql)")
    server = Postgres(programs[-1].parent)
    try:
        server.start()
        yield server
    finally:
        server.stop(signal.SIGQUIT)
        shutil.rmtree(server.folder)


@pytest.fixture
def postgres(postgres_server: Postgres) -> Iterator[Postgres]:
    """The server of all tests, which this one may stop: it runs again afterwards."""
    yield postgres_server
    if not postgres_server.runs:
        postgres_server.start()
