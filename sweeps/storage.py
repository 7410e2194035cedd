"""The storage of studies: Optuna's tables, opened safely by many processes at once, and the wait for a database."""

import glob
import logging
import sqlite3
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import sqlalchemy as sa
from optuna.exceptions import StorageInternalError
from optuna.storages import RDBStorage
from sqlalchemy.exc import DBAPIError, InterfaceError, InternalError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from tenacity import RetryCallState, Retrying, retry_if_exception, stop_after_delay
from tenacity.wait import wait_exponential_jitter

from deepracer_exp.addresses import redact
from deepracer_exp.errors import BadInput, RunFailed, reading
from deepracer_exp.tracking.store import one_line

from .database import Database, resolve_database

Result = TypeVar("Result")

DOWN = (OperationalError, InterfaceError, InternalError, PoolTimeout, StorageInternalError)
"""Errors of a database that is down or locked, among others; see `_may_pass`."""
_BUSY = ("SQLITE_BUSY", "SQLITE_LOCKED", "SQLITE_PROTOCOL")
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.1, 10.0
_SAY_AFTER_S = 5.0

_log = logging.getLogger("deepracer_exp")


@dataclass(frozen=True)
class Storage:
    """A connected database of studies."""

    optuna: RDBStorage = field(repr=False)
    """Optuna's view of it."""
    engine: sa.Engine = field(repr=False)
    url: str
    """Without password."""


def open_storage(url: str | None, runs_dir: Path, patience_s: float = 0.0) -> Storage:
    """Connect to the database named by `sweep.storage`, or to `sweeps.db` in `runs_dir`; create what is missing.

    Args:
        url: as SQLAlchemy reads it; None: the file.
        runs_dir: of the file; created if it is missing.
        patience_s: how long to wait for a server that does not answer, seconds.

    Raises:
        BadInput: unknown kind, missing driver, unreachable, not writable, or used by another program.
    """
    database = resolve_database(url, runs_dir)
    with reading(database.shown, "a place where files can be written, or a server"):
        try:
            optuna = _waiting(lambda: _open(database), patience_s)
        except (DBAPIError, StorageInternalError) as error:
            raise BadInput(f"{database.shown}: {_reason(error)}") from None
    return Storage(optuna, optuna.engine, redact(str(database.url)))


def patiently(call: Callable[[], Result], patience_s: float) -> Result:
    """Call until the database answers; a call that was under way when it went down may take effect twice.

    Waits longer and longer between calls, up to ten seconds, with jitter, so that processes that began to wait
    together do not return together.

    Raises:
        RunFailed: it has not answered for `patience_s`, or its error is one that waiting does not change.
    """
    try:
        return _waiting(call, patience_s)
    except DOWN as error:
        what = f"has not answered for {patience_s:g} s" if _may_pass(error) else "cannot be used"
        raise RunFailed(f"the study's database {what}: {_reason(error)}") from None


def _waiting(call: Callable[[], Result], patience_s: float) -> Result:
    said = False

    def say(state: RetryCallState) -> None:
        nonlocal said
        if said or (state.seconds_since_start or 0.0) < _SAY_AFTER_S:
            return
        said = True
        error = state.outcome.exception() if state.outcome is not None else None
        reason = _reason(error) if isinstance(error, Exception) else ""
        _log.warning("waiting up to %g s for the study's database: %s", patience_s, reason)

    return Retrying(
        retry=retry_if_exception(_may_pass),
        wait=wait_exponential_jitter(multiplier=_FIRST_WAIT_S, max=_LONGEST_WAIT_S, jitter=_FIRST_WAIT_S),
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
    if isinstance(error, DBAPIError) and isinstance(error.orig, Exception):
        return one_line(error.orig)
    return one_line(error) if isinstance(error, Exception) else type(error).__name__


def _open(database: Database) -> RDBStorage:
    if database.file is not None:
        return _open_file(database, database.file)
    probe = sa.create_engine(database.url, **database.engine_options())
    if _is_ready(database, probe):
        return _rdb(database, create=False)
    with database.creation_lock(probe):
        return _rdb(database, create=True)


def _open_file(database: Database, file: Path) -> RDBStorage:
    if not _is_ready_file(database, file):
        with database.creation_lock(None):
            if not file.exists() or file.stat().st_size == 0:
                _create_file(database, file)
            elif not _is_ready_file(database, file):
                _rdb(database, create=True).engine.dispose()
                _write_ahead(file)
    return _rdb(database, create=False)


def _create_file(database: Database, file: Path) -> None:
    """Create the file under another name and rename it when it is complete: a killed process leaves no half of it."""
    new = file.with_name(f"{file.name}.new")
    for left in file.parent.glob(f"{glob.escape(new.name)}*"):
        left.unlink()
    aside = Database(sa.URL.create("sqlite", database=str(new)), database.shown)
    rdb = _rdb(aside, create=True)
    rdb.remove_session()
    rdb.engine.dispose()
    _write_ahead(new)
    new.replace(file)


def _write_ahead(file: Path) -> None:
    """Let processes read while another one writes; the file itself keeps this setting."""
    connection = sqlite3.connect(file, timeout=60.0)
    try:
        connection.execute("PRAGMA journal_mode=WAL")
    except sqlite3.OperationalError as error:
        # Another process has it open. It stays as it is, which is slower and as safe.
        _log.warning("%s: %s", file, error)
    finally:
        connection.close()


def _is_ready_file(database: Database, file: Path) -> bool:
    if not file.exists() or file.stat().st_size == 0:
        return False
    engine = sa.create_engine(database.url, poolclass=sa.NullPool, **database.engine_options())
    return _is_ready(database, engine)


def _is_ready(database: Database, engine: sa.Engine) -> bool:
    """Return whether all of Optuna's tables exist; it writes the version last.

    Raises:
        BadInput: there is a version without the tables: that of another program.
    """
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
        return RDBStorage(url, engine_kwargs=database.engine_options(), skip_table_creation=not create)
    except RuntimeError as error:
        raise BadInput(f"{database.shown}: {one_line(error)}") from None
