"""The database of a study: its URL checked, connection options, and a lock for creating things."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import ArgumentError, NoSuchModuleError

from deepracer_exp.addresses import with_password, without_passwords
from deepracer_exp.errors import BadInput, nearest

_KINDS = ("sqlite", "postgresql", "mysql")
_ACCEPTED = (
    "accepted: sqlite:////path/sweeps.db, postgresql+psycopg://user@host/name, mysql+pymysql://user@host/name"
)
_DRIVERS = {"psycopg": "psycopg[binary]", "pymysql": "pymysql", "mysqldb": "mysqlclient"}
"""Package of each driver."""

_CONNECT_S = 10
_STUCK_S = 60
"""How long a process may leave a transaction open, or wait for one: a suspended machine blocks others no longer."""
_LOCK = "deepracer_exp sweeps"
_LOCK_NUMBER = 0x64726578


@dataclass(frozen=True)
class Database:
    """A database that can hold studies."""

    url: sa.URL = field(repr=False)
    """With its password, if it has one."""
    shown: str
    """The setting it came from, for messages, without password."""

    @property
    def kind(self) -> str:
        """`sqlite`, `postgresql` or `mysql`."""
        return self.url.get_backend_name()

    @property
    def file(self) -> Path | None:
        """The file of an SQLite database."""
        return Path(str(self.url.database)) if self.kind == "sqlite" else None

    def engine_options(self) -> dict[str, Any]:
        """Return arguments of SQLAlchemy's `create_engine` besides the URL.

        Each transaction on a server has its own connection. A pool would keep one or two connections per worker open
        for hours, of which PostgreSQL allows 100 by default, and all of them would break when the server restarts.
        """
        if self.kind == "sqlite":
            return {"connect_args": {"timeout": _STUCK_S}}
        driver = self.url.get_driver_name()
        arguments: dict[str, Any] = {}
        if driver in ("psycopg", "psycopg2"):
            arguments = {
                "connect_timeout": _CONNECT_S,
                "keepalives_idle": 15,
                "keepalives_interval": 5,
                "keepalives_count": 4,
                "tcp_user_timeout": 30_000,
                "options": f"-c idle_in_transaction_session_timeout={_STUCK_S}s -c lock_timeout={_STUCK_S}s",
            }
        elif driver in ("pymysql", "mysqldb"):
            arguments = {
                "connect_timeout": _CONNECT_S,
                "read_timeout": 2 * _STUCK_S,
                "write_timeout": 2 * _STUCK_S,
                "init_command": f"SET SESSION wait_timeout={_STUCK_S}, innodb_lock_wait_timeout={_STUCK_S}",
            }
        given = {key: value for key, value in arguments.items() if key not in self.url.query}
        return {"poolclass": sa.NullPool, "connect_args": given}

    @contextmanager
    def creation_lock(self, engine: sa.Engine | None) -> Iterator[None]:
        """Let one process at a time create what must exist once: the tables, the study's run in MLflow.

        Optuna has no lock of its own here: of processes that start together all but one fail, with "table already
        exists" or with a version stored twice. The lock ends with the process that holds it.

        Args:
            engine: of a server; a file needs none.
        """
        if self.file is not None:
            with open(f"{self.file}.lock", "w", encoding="utf-8") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                yield
            return
        assert engine is not None
        with engine.connect() as connection:
            if self.kind == "postgresql":
                connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_LOCK_NUMBER)))
            else:
                connection.execute(sa.select(sa.func.get_lock(_LOCK, _STUCK_S)))
            yield


def resolve_database(url: str | None, runs_dir: Path) -> Database:
    """Return the database named by `sweep.storage`, or the file `sweeps.db` in `runs_dir`, without connecting.

    Raises:
        BadInput: not a URL, an unknown kind, a missing driver, a file that cannot be written.
    """
    if url is None:
        return _of_file(runs_dir / "sweeps.db", f"runs_dir={runs_dir}")
    try:
        parsed = sa.make_url(with_password(url))
    except (ArgumentError, ValueError):
        # Without a form it is unknown which part of it is the password.
        raise BadInput(f"sweep.storage: not the URL of a database; {_ACCEPTED}") from None
    shown = f"sweep.storage={without_passwords(url)}"
    kind = parsed.get_backend_name()
    if kind not in _KINDS:
        raise BadInput(
            f"{shown}: not a kind of database that holds sweeps{nearest(kind, _KINDS)}; {_ACCEPTED}"
        )
    if kind == "sqlite":
        name = parsed.database
        if not name or name.startswith((":", "file:")) or parsed.host or parsed.query:
            raise BadInput(f"{shown}: names no file; accepted: sqlite:////path/sweeps.db")
        _check_driver(parsed, shown)
        return _of_file(Path(name), shown)
    _check_driver(parsed, shown)
    if not parsed.database:
        raise BadInput(f"{shown}: names no database; accepted: {kind}://user@host/NAME")
    return Database(parsed, shown)


def _check_driver(url: sa.URL, shown: str) -> None:
    try:
        dialect = url.get_dialect()
        if dialect.is_async:
            raise BadInput(f"{shown}: a driver for asynchronous programs; {_ACCEPTED}")
        dialect.import_dbapi()
    except NoSuchModuleError:
        raise BadInput(f"{shown}: SQLAlchemy knows no such driver; {_ACCEPTED}") from None
    except ImportError as error:
        package = _DRIVERS.get(url.get_driver_name(), error.name)
        raise BadInput(f"{shown}: its driver is missing; install it with: pip install '{package}'") from None


def _of_file(file: Path, shown: str) -> Database:
    # The workers may have another working folder.
    file = file.absolute()
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"{shown}: folder {file.parent} cannot be created: {error.strerror}") from None
    if file.is_dir():
        raise BadInput(f"{shown}: {file} is a folder; a file name is needed")
    # SQLite keeps two files beside it, so the folder must be writable, too.
    if not all(os.access(path, os.W_OK) for path in (file, file.parent) if path.exists()):
        raise BadInput(f"{shown}: {file} cannot be written; choose a writable place")
    return Database(sa.URL.create("sqlite", database=str(file)), shown)
