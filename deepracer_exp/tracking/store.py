"""Where runs are recorded: a tracking uri checked, resolved and shown without its secrets."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote, urlsplit

from deepracer_exp.addresses import redact, with_password, without_passwords
from deepracer_exp.errors import BadInput, nearest

_SERVERS = ("http", "https")
_DATABASES = ("sqlite", "postgresql", "mysql", "mssql")
_SQLITE_PREFIX = "sqlite:///"


def one_line(error: Exception) -> str:
    """Return what an error of a store says, short and without passwords."""
    return redact(" ".join(str(error).split()))[:300]


@dataclass(frozen=True)
class Store:
    """An MLflow tracking store that a run can be recorded in."""

    uri: str = field(repr=False)
    """A database's with its password, if it has one: for MLflow only, never for a log."""
    artifact_location: str | None
    """Where new experiments keep their files; None: the server decides."""
    user: str | None = None
    """Of a server."""
    password: str | None = field(default=None, repr=False)
    """Of a server; None: what MLFLOW_TRACKING_PASSWORD says."""

    @property
    def shown(self) -> str:
        """The uri without password."""
        return without_passwords(self.uri)

    @property
    def is_server(self) -> bool:
        """Whether an MLflow server answers at the uri (otherwise it is a database)."""
        return self.uri.startswith(("http://", "https://"))

    @property
    def sqlite_file(self) -> Path | None:
        """The file of an SQLite store."""
        if not self.uri.startswith("sqlite"):
            return None
        return Path(self.uri.removeprefix(_SQLITE_PREFIX))

    @contextmanager
    def creation_lock(self) -> Iterator[None]:
        """Let one process at a time create the tables of an SQLite store.

        MLflow's client has no lock of its own here: of two processes that begin together, one fails in the
        middle ("duplicate column name"). Whoever runs a database server creates its tables with it.
        """
        if (file := self.sqlite_file) is None:
            yield
            return
        with open(f"{file}.lock", "w", encoding="utf-8") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield


def resolve_store(uri: str | None, runs_dir: Path) -> Store:
    """Return the store named by `tracking.uri`, or the default one in `runs_dir`; MLflow is not imported.

    Raises:
        BadInput: `uri` can never work: unknown scheme, no host, a folder that cannot be made or written.
    """
    artifacts = (runs_dir.absolute() / "mlflow-artifacts").as_uri()
    if uri is None:
        file = runs_dir.absolute() / "mlflow.db"
        _check_sqlite_file(file, f"runs_dir={runs_dir}")
        return Store(f"{_SQLITE_PREFIX}{file}", artifacts)
    uri, shown = with_password(uri), f"tracking.uri={without_passwords(uri)}"
    scheme, colon, _ = uri.partition("://")
    base = scheme.partition("+")[0]
    known = (*_DATABASES, *_SERVERS)
    if not colon or base not in known:
        raise BadInput(
            f"{shown}: not a store that MLflow can record in{nearest(base, known)};"
            f" accepted: http(s)://host:port, {_SQLITE_PREFIX}/path/mlflow.db, postgresql://, mysql://, mssql://"
        )
    if base == "sqlite":
        return Store(_check_sqlite_uri(uri, shown), artifacts)
    try:
        parts = urlsplit(uri)
        host, _ = parts.hostname, parts.port
    except ValueError:  # which may quote a piece of the password
        raise BadInput(f"{shown}: no host and port can be read; accepted: {scheme}://host:port/...") from None
    # A database may be reached through a local socket, named by parameters instead of a host.
    if base in _SERVERS and not host:
        raise BadInput(f"{shown}: no host; accepted: {scheme}://host:port")
    if base not in _SERVERS:
        return Store(uri, artifacts)
    user, password = (value and unquote(value) for value in (parts.username, parts.password))
    return Store(without_passwords(uri), None, user, password)


def _check_sqlite_uri(uri: str, shown: str) -> str:
    path = uri.removeprefix(_SQLITE_PREFIX)
    if not uri.startswith(_SQLITE_PREFIX) or not path or path.startswith((":", "file:")):
        raise BadInput(f"{shown}: names no file; accepted: {_SQLITE_PREFIX}/path/mlflow.db")
    # The UI's server has another working folder than the training may have had.
    file = Path(path).absolute()
    _check_sqlite_file(file, shown)
    return f"{_SQLITE_PREFIX}{file}"


def _check_sqlite_file(file: Path, shown: str) -> None:
    # SQLAlchemy splits the uri at the first "?" and does not unquote the path, so no escape exists.
    if "?" in str(file):
        raise BadInput(f"{shown}: MLflow's SQLite store cannot lie under a path with '?' ({file}); rename it")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"{shown}: folder {file.parent} cannot be made: {error.strerror}") from None
    if file.is_dir():
        raise BadInput(f"{shown}: {file} is a folder; a file name is needed")
    if not os.access(file if file.exists() else file.parent, os.W_OK):
        raise BadInput(f"{shown}: {file} cannot be written; choose a writable place or tracking=off")
