"""The database of studies: checks its address, opens it safely from many processes, and waits out its absence."""

import atexit
import logging
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import sqlalchemy as sa
from filelock import FileLock
from optuna.exceptions import StorageInternalError
from optuna.storages import RDBStorage
from sqlalchemy.exc import (
    ArgumentError,
    DBAPIError,
    InterfaceError,
    InternalError,
    NoSuchModuleError,
    OperationalError,
)
from sqlalchemy.exc import TimeoutError as PoolTimeout
from tenacity import RetryCallState, Retrying, retry_if_exception, stop_after_delay
from tenacity.wait import wait_exponential_jitter

from deepracer_exp.addresses import with_password, without_passwords
from deepracer_exp.errors import BadInput, RunFailed, nearest, reading
from deepracer_exp.sweeps import DEFAULT_FILE
from deepracer_exp.tracking.calls import redacted_line
from deepracer_exp.tracking.store import check_database_file

Result = TypeVar("Result")

DOWN = (OperationalError, InterfaceError, InternalError, PoolTimeout, StorageInternalError)
"""Errors of a database that is down or locked, among others; see `_may_pass`."""
_BUSY = ("SQLITE_BUSY", "SQLITE_LOCKED", "SQLITE_PROTOCOL")
_SAY_AFTER_S = 5.0
_PAUSES = wait_exponential_jitter(multiplier=0.1, max=10.0, jitter=0.1)
"""Pauses between retries while the database does not answer: exponential backoff, with jitter so that processes do not
retry in step."""

_KINDS = ("sqlite", "postgresql")
_ACCEPTED = "accepted: sqlite:////path/sweeps.db, postgresql+psycopg://user@host/name"
_DRIVERS = {"psycopg": "psycopg[binary]"}
"""Package of each driver."""
_CONNECT_S = 10
_STUCK_S = 60
"""Seconds a process may leave a transaction open, or wait for one: a suspended machine must not block others."""
_LOCK_NUMBER = 0x64726578
_POOL = {"pool_pre_ping": True, "pool_recycle": 300, "pool_size": 1}
"""Arguments of SQLAlchemy's `create_engine` for a server: a worker keeps one connection, and one that was broken by a
restart of the server or open while its machine slept is replaced before it is used."""

_log = logging.getLogger("deepracer_exp")


@dataclass(frozen=True)
class Database:
    """A database that can hold studies."""

    url: sa.URL = field(repr=False)
    """Address, with its password if it has one."""
    shown: str
    """The setting it came from, for messages, without password."""

    @property
    def file(self) -> Path | None:
        """The file of an SQLite database."""
        return Path(str(self.url.database)) if self.url.get_backend_name() == "sqlite" else None

    def engine_options(self) -> dict[str, Any]:
        """Return arguments of SQLAlchemy's `create_engine` besides the URL."""
        if self.file is not None:
            return {"connect_args": {"timeout": _STUCK_S}}
        if self.url.get_driver_name() not in ("psycopg", "psycopg2"):
            return dict(_POOL)
        arguments = {
            "connect_timeout": _CONNECT_S,
            "keepalives_idle": 15,
            "keepalives_interval": 5,
            "keepalives_count": 4,
            "tcp_user_timeout": 30_000,
            "options": f"-c idle_in_transaction_session_timeout={_STUCK_S}s -c lock_timeout={_STUCK_S}s",
        }
        chosen = {key: value for key, value in arguments.items() if key not in self.url.query}
        return {**_POOL, "connect_args": chosen}

    @contextmanager
    def creation_lock(self, engine: sa.Engine) -> Iterator[None]:
        """Lock the creation of things that must exist once: the tables, the study's run in MLflow.

        Optuna has no lock of its own here: of processes that start together all but one fail, with "table already
        exists" or with a version stored twice. The lock ends with the process that holds it.
        """
        if self.file is not None:
            with FileLock(f"{self.file}.lock"):
                yield
            return
        with engine.connect() as connection:
            # A wide search is composed meanwhile, and the server would end an idle transaction.
            connection.execute(sa.text("SET LOCAL idle_in_transaction_session_timeout = 0"))
            connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_LOCK_NUMBER)))
            yield


def resolve_database(url: str | None, runs_dir: Path) -> Database:
    """Return the database named by `sweep.storage`, or the file in `runs_dir`, without connecting.

    Raises:
        BadInput: not a URL, an unknown kind, a missing driver, a file that cannot be written.
    """
    if url is None:
        return _of_file(runs_dir / DEFAULT_FILE, f"runs_dir={runs_dir}")
    try:
        parsed = sa.make_url(with_password(url))
    except (ArgumentError, ValueError):
        # Without a form it is unknown which part of it is the password.
        raise BadInput("sweep.storage", f"not the URL of a database; {_ACCEPTED}") from None
    shown = f"sweep.storage={without_passwords(url)}"
    kind = parsed.get_backend_name()
    if kind not in _KINDS:
        raise BadInput(shown, f"not a kind of database that holds sweeps{nearest(kind, _KINDS)}; {_ACCEPTED}")
    name = parsed.database
    if kind == "sqlite" and (not name or name.startswith((":", "file:")) or parsed.host or parsed.query):
        raise BadInput(shown, "names no file", "sqlite:////path/sweeps.db")
    _check_driver(parsed, shown)
    if not name:
        raise BadInput(shown, "names no database", f"{kind}://user@host/NAME")
    return _of_file(Path(name), shown) if kind == "sqlite" else Database(parsed, shown)


def _check_driver(url: sa.URL, shown: str) -> None:
    try:
        dialect = url.get_dialect()
        if dialect.is_async:
            raise BadInput(shown, f"a driver for asynchronous programs; {_ACCEPTED}")
        dialect.import_dbapi()
    except NoSuchModuleError:
        raise BadInput(shown, f"SQLAlchemy knows no such driver; {_ACCEPTED}") from None
    except ImportError as error:
        package = _DRIVERS.get(url.get_driver_name(), error.name)
        raise BadInput(shown, f"its driver is missing; install it with: pip install '{package}'") from None


def _of_file(file: Path, shown: str) -> Database:
    # The workers may have another working folder.
    file = file.absolute()
    check_database_file(file, shown)
    return Database(sa.URL.create("sqlite", database=str(file)), shown)


def open_storage(url: str | None, runs_dir: Path, patience_s: float = 0.0) -> RDBStorage:
    """Connect to a database, see `resolve_database`; create what is missing.

    Waits up to `patience_s` for a server that does not answer.

    Raises:
        BadInput: unknown kind, missing driver, unreachable, not writable, or used by another program.
    """
    database = resolve_database(url, runs_dir)
    with reading(database.shown, "a place where files can be written, or a server"):
        try:
            storage = _waiting(lambda: _open(database), patience_s)
        except (DBAPIError, StorageInternalError) as error:
            raise BadInput(database.shown, _reason(error)) from None
    # SQLite then moves its last writes into the file itself, which may be copied alone.
    atexit.register(storage.engine.dispose)
    return storage


def patiently(call: Callable[[], Result], patience_s: float) -> Result:
    """Call until the database answers; a call that was under way when it went down may take effect twice.

    Raises:
        RunFailed: it has not answered for `patience_s`, or its error is one that waiting does not change.
    """
    try:
        return _waiting(call, patience_s)
    except DOWN as error:
        what = f"has not answered for {patience_s:g} s" if _may_pass(error) else "cannot be used"
        raise RunFailed(f"the study's database {what}: {_reason(error)}") from None


@contextmanager
def answering() -> Iterator[None]:
    """Report a database that does not answer where nothing waits for it.

    Raises:
        RunFailed: it does not answer.
    """
    try:
        yield
    except DOWN as error:
        raise RunFailed(f"the study's database cannot be used: {_reason(error)}") from None


def _waiting(call: Callable[[], Result], patience_s: float) -> Result:
    said = False

    def say(state: RetryCallState) -> None:
        nonlocal said
        error = state.outcome.exception() if state.outcome is not None else None
        if not said and error is not None and (state.seconds_since_start or 0.0) >= _SAY_AFTER_S:
            said = True
            _log.warning("waiting up to %g s for the study's database: %s", patience_s, _reason(error))

    return Retrying(
        retry=retry_if_exception(_may_pass),
        wait=_PAUSES,
        stop=stop_after_delay(patience_s),
        before_sleep=say,
        reraise=True,
    )(call)


def _may_pass(error: BaseException) -> bool:
    """Return whether an error may pass: the database is down, starting, out of connections, or locked."""
    if isinstance(error, StorageInternalError):
        # Optuna wraps errors of SQLAlchemy in it.
        return error.__cause__ is None or _may_pass(error.__cause__)
    if not isinstance(error, DOWN):
        return isinstance(error, DBAPIError) and error.connection_invalidated
    cause = error.orig if isinstance(error, DBAPIError) else None
    if isinstance(cause, sqlite3.Error):
        return getattr(cause, "sqlite_errorname", "").startswith(_BUSY)
    return True


def _reason(error: BaseException) -> str:
    """Return the error in one line, without the statement and its values."""
    if isinstance(error, StorageInternalError) and error.__cause__ is not None:
        return _reason(error.__cause__)
    return redacted_line(error.orig if isinstance(error, DBAPIError) and error.orig is not None else error)


def _open(database: Database) -> RDBStorage:
    probe = sa.create_engine(database.url, **database.engine_options())
    try:
        if _is_ready(database, probe):
            return _rdb(database, create=False)
        with database.creation_lock(probe):
            if database.file is not None:
                _write_ahead(database.file)
            # A process that was killed here leaves some of the tables: Optuna creates the missing ones.
            return _rdb(database, create=True)
    finally:
        probe.dispose()


def _write_ahead(file: Path) -> None:
    """Let processes read while another one writes; the file itself keeps this setting."""
    connection = sqlite3.connect(file, timeout=60.0)
    try:
        connection.execute("PRAGMA journal_mode=WAL")
    except sqlite3.OperationalError as error:
        # Another process has it open. It stays as it is, which is slower but just as safe.
        _log.warning("%s: %s", file, error)
    finally:
        connection.close()


def _is_ready(database: Database, engine: sa.Engine) -> bool:
    """Return whether all of Optuna's tables exist; it writes the version last."""
    with engine.connect() as connection:
        tables = set(sa.inspect(connection).get_table_names())
        if "alembic_version" not in tables:
            return False
        versions = connection.execute(sa.text("SELECT version_num FROM alembic_version")).all()
        if versions and "version_info" not in tables:
            raise BadInput(
                f"{database.shown}: holds the tables of another program (MLflow?); give sweeps a database of their own"
            )
        return bool(versions)


def _rdb(database: Database, *, create: bool) -> RDBStorage:
    # Optuna formats the URL, so braces of a password or a folder are doubled.
    url = database.url.render_as_string(hide_password=False).replace("{", "{{").replace("}", "}}")
    try:
        storage = RDBStorage(url, engine_kwargs=database.engine_options(), skip_table_creation=not create)
    except RuntimeError as error:
        raise BadInput(database.shown, redacted_line(error)) from None
    return storage
