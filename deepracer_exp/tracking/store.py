"""MLflow stores of runs: addresses without secrets, clients, errors and time limits.

MLflow takes seconds to import, so only the code that opens a store imports it.
"""

import logging
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, cast
from urllib.parse import unquote, urlsplit

from filelock import FileLock

from deepracer_exp.addresses import with_password, without_passwords
from deepracer_exp.errors import BadInput, nearest
from deepracer_exp.runs.run_files import MLFLOW_DB

from . import calls
from .calls import (
    BoundedClient,
    StoreRefusedError,
    StoreUnavailableError,
    ended_within,
    store_errors,
)

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.store.artifact.artifact_repo import ArtifactRepository

ARTIFACTS = "mlflow-artifacts"
"""The folder, in `runs_dir`, of the files that MLflow keeps of runs in a database of this machine."""
_SERVERS = ("http", "https")
_DATABASES = ("sqlite", "postgresql", "mysql", "mssql")
_SQLITE_PREFIX = "sqlite:///"
_USER, _PASSWORD = "MLFLOW_TRACKING_USERNAME", "MLFLOW_TRACKING_PASSWORD"
_GIVEN = {name: os.environ.get(name) for name in (_USER, _PASSWORD)}


@dataclass(frozen=True)
class Store:
    """An MLflow tracking store that a run can be recorded in."""

    uri: str = field(repr=False)
    """Address of the store, with a database's password: for MLflow only, never for a log."""
    artifact_location: str | None
    """Folder of the files of new experiments; None if the server decides."""
    user: str | None = None
    """User name on a server."""
    password: str | None = field(default=None, repr=False)
    """Password on a server; None for that of MLFLOW_TRACKING_PASSWORD."""

    @property
    def shown(self) -> str:
        """The uri without password."""
        return without_passwords(self.uri)

    @property
    def is_server(self) -> bool:
        """Whether the uri is that of an MLflow server, not of a database."""
        return self.uri.startswith(("http://", "https://"))

    @property
    def sqlite_file(self) -> Path | None:
        """The file of an SQLite store."""
        if not self.uri.startswith("sqlite"):
            return None
        return Path(self.uri.removeprefix(_SQLITE_PREFIX))

    def is_named(self, recorded: str | None) -> bool:
        """Return whether this is the store that a run folder names.

        A file may be reached by a link, or may have been moved with its folder.
        """
        if recorded is None or recorded == self.shown or self.sqlite_file is None:
            return recorded == self.shown
        if not recorded.startswith(_SQLITE_PREFIX):
            return False
        file = Path(recorded.removeprefix(_SQLITE_PREFIX))
        return file.resolve() == self.sqlite_file.resolve() or (
            file.name == self.sqlite_file.name and not file.exists()
        )

    def files_at(self, place: str) -> "ArtifactRepository":
        """Return the files that the store keeps at a place of its own choice.

        A server must hold them itself: it could name another server, to obtain this user's password, or a folder or
        bucket, to have it read or written in the user's name. Those of a database must be in a folder.

        Raises:
            StoreRefusedError: they are elsewhere.
        """
        parts, server = urlsplit(place), urlsplit(self.uri).netloc
        if self.is_server:
            is_own = parts.scheme in ("http", "https", "mlflow-artifacts") and parts.netloc in (
                "",
                server,
            )
        else:
            is_own = parts.scheme in ("", "file") and parts.netloc in ("", "localhost")
        if not is_own:
            raise StoreRefusedError(
                f"keeps the files at {without_passwords(place)[:200]}; accepted: "
                + ("on the server itself" if self.is_server else "a folder")
            )
        if (moved := self.moved_folder(place)) is not None:
            place = moved.as_uri()
        from mlflow.store.artifact.artifact_repository_registry import get_artifact_repository

        return get_artifact_repository(place, tracking_uri=self.uri)

    def moved_folder(self, place: str) -> Path | None:
        """Return the present place of artifacts if the store was moved or copied with its folder; None if not.

        MLflow stores absolute paths, and has no call that changes that of a run or an experiment. `place` is such a
        path or URI, of a folder in `mlflow-artifacts`.
        """
        if self.sqlite_file is None or urlsplit(place).scheme not in ("", "file"):
            return None
        then = Path(unquote(urlsplit(place).path))
        root = next((folder for folder in then.parents if folder.name == ARTIFACTS), None)
        now = self.sqlite_file.with_name(ARTIFACTS)
        if root is None or root.resolve() == now.resolve():
            return None
        # It belongs to another runs_dir recorded in this store, unless it lies beside this store's original.
        if root.exists() and not root.with_name(self.sqlite_file.name).exists():
            return None
        return now / then.relative_to(root)

    @contextmanager
    def creation_lock(self) -> Iterator[None]:
        """Let one process at a time create the tables of an SQLite store.

        MLflow's client does not lock: of two processes that start together, one fails halfway ("duplicate column
        name"). The tables of a database server are created with it.
        """
        if (file := self.sqlite_file) is None:
            yield
            return
        with FileLock(f"{file}.lock"):
            yield


def resolve_store(uri: str | None, runs_dir: Path) -> Store:
    """Return the store named by `tracking.uri`, or the default one in `runs_dir`; MLflow is not imported.

    Raises:
        BadInput: `uri` can never work: unknown scheme, no host, a folder that cannot be made or written.
    """
    artifacts = (runs_dir.absolute() / ARTIFACTS).as_uri()
    if uri is None:
        file = runs_dir.absolute() / MLFLOW_DB
        _check_sqlite_file(file, f"runs_dir={runs_dir}")
        return Store(f"{_SQLITE_PREFIX}{file}", artifacts)
    uri, shown = with_password(uri), f"tracking.uri={without_passwords(uri)}"
    scheme, colon, _ = uri.partition("://")
    base = scheme.partition("+")[0]
    schemes = (*_DATABASES, *_SERVERS)
    if not colon or base not in schemes:
        raise BadInput(
            shown,
            f"not a store that MLflow can record in{nearest(base, schemes)}",
            f"http(s)://host:port, {_SQLITE_PREFIX}/path/mlflow.db, postgresql://, mysql://, mssql://",
        )
    if base == "sqlite":
        return Store(_check_sqlite_uri(uri, shown), artifacts)
    try:
        parts = urlsplit(uri)
        host, _ = parts.hostname, parts.port
    except ValueError:  # which may quote a piece of the password
        raise BadInput(shown, "no host and port can be read", f"{scheme}://host:port/...") from None
    # A database may be reached through a local socket, named by parameters instead of a host.
    if base in _SERVERS and not host:
        raise BadInput(shown, "no host", f"{scheme}://host:port")
    if base not in _SERVERS:
        return Store(uri, artifacts)
    user, password = (value and unquote(value) for value in (parts.username, parts.password))
    return Store(without_passwords(uri), None, user, password)


def _check_sqlite_uri(uri: str, shown: str) -> str:
    path = uri.removeprefix(_SQLITE_PREFIX)
    if not uri.startswith(_SQLITE_PREFIX) or not path or path.startswith((":", "file:")):
        raise BadInput(shown, "names no file", f"{_SQLITE_PREFIX}/path/mlflow.db")
    # The UI's server has another working folder than the training may have had.
    file = Path(path).absolute()
    _check_sqlite_file(file, shown)
    return f"{_SQLITE_PREFIX}{file}"


def _check_sqlite_file(file: Path, shown: str) -> None:
    # SQLAlchemy splits the uri at the first "?" and does not unquote the path, so no escape exists.
    if "?" in str(file):
        raise BadInput(shown, f"MLflow's SQLite store cannot be at a path with '?' ({file}); rename it")
    check_database_file(file, shown)


def check_database_file(file: Path, shown: str) -> None:
    """Refuse a file that SQLite cannot write, or create; its folder is created. `shown` begins the message."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(shown, f"folder {file.parent} cannot be created: {error.strerror}") from None
    if file.is_dir():
        raise BadInput(shown, f"{file} is a folder; a file name is needed")
    try:
        # SQLite keeps two files beside it. Permissions alone do not decide it: root has all of them, even in /proc.
        tempfile.TemporaryFile(dir=file.parent).close()
        writable = not file.exists() or os.access(file, os.W_OK)
    except OSError:
        writable = False
    if not writable:
        raise BadInput(shown, f"{file} cannot be written; choose a writable place")


def prepare_mlflow() -> None:
    """Set the options that MLflow reads only from the environment, some of them when it is imported."""
    # Its own 7 retries would hold the queue for minutes after a server is back: `project.serve` retries instead.
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    # It would print the address of each ended run, with its password.
    os.environ.setdefault("MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT", "true")
    # Without a network it would be retried during the whole run.
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")


def silence_mlflow() -> None:
    """Silence MLflow's loggers, which its import sets up.

    Creating tables is logged in INFO lines, and a busy store with a traceback per attempt, both into the middle of the
    live view. Each failure is raised as well, and reported once and redacted.
    """
    for name in ("mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def client_of(store: Store) -> "MlflowClient":
    """Return a client of a store, with a time limit on every call.

    All clients use the user and password of the latest one's store.

    MLflow reads both from the environment at each request. In the address they would appear in its messages.
    """
    for name, setting in ((_USER, store.user), (_PASSWORD, store.password)):
        if (value := setting or _GIVEN[name]) is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value
    prepare_mlflow()
    from mlflow import MlflowClient

    silence_mlflow()

    # The model registry may be set elsewhere (MLFLOW_REGISTRY_URI), but it refers to these runs.
    def connect() -> MlflowClient:
        return MlflowClient(tracking_uri=store.uri, registry_uri=store.uri)

    # A file answers, but its tables may have to be created first.
    client = connect() if store.sqlite_file else ended_within(calls.CALL_S, connect)
    return cast("MlflowClient", BoundedClient(client))


def is_run_id(text: str) -> bool:
    """Return whether this looks like MLflow's id of a run."""
    return re.fullmatch(r"[0-9a-f]{32}", text) is not None


def has_store(uri: str | None, runs_dir: Path) -> bool:
    """Return whether a store is named or `runs_dir` has one."""
    return uri is not None or (runs_dir / MLFLOW_DB).is_file()


def existing_store(uri: str | None, runs_dir: Path) -> Store:
    """Return a store to read from; `resolve_store` returns one to record in.

    Raises:
        BadInput: `uri` can never work, or the file does not exist.
    """
    default = runs_dir / MLFLOW_DB
    if uri is None and not default.exists():
        raise BadInput(
            default, "no runs recorded yet; run `deepracer-exp train` first, or give tracking.uri="
        )
    # Before `resolve_store`, which creates the file's folder.
    path = (uri or "").removeprefix(_SQLITE_PREFIX)
    if uri is not None and uri.startswith(_SQLITE_PREFIX) and path and not Path(path).exists():
        raise BadInput(f"tracking.uri={uri}", "no such file; train with this tracking.uri first")
    return resolve_store(uri, runs_dir)


@contextmanager
def open_client(what: str, uri: str | None, runs_dir: Path) -> "Iterator[MlflowClient]":
    """Open a store and turn its errors into BadInput.

    `what` begins the message; `uri` is the store, as in `tracking.uri`, None: the one in `runs_dir`.

    Raises:
        BadInput: there is no store, it does not answer in time, or it refuses.
    """
    if not has_store(uri, runs_dir):
        raise BadInput(
            what, f"{runs_dir} has no mlflow.db to look it up in; give tracking.uri=URI or a run's folder"
        )
    store = existing_store(uri, runs_dir)
    try:
        # Imported here: it takes three seconds, and nothing else needs it.
        with store_errors():
            yield client_of(store)
    except (StoreRefusedError, StoreUnavailableError) as error:
        raise BadInput(what, f"MLflow ({store.shown}): {error}") from error
