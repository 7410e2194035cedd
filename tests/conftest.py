"""The command line, called in this process or started as a process of its own."""

import atexit
import contextlib
import functools
import gc
import hashlib
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import pytest
from filelock import FileLock
from hypothesis import settings

from deepracer_exp.cli import main
from deepracer_exp.errors import BadInput

from .browser import chromium, tab
from .busy_machine import depends_on_the_machine
from .postgres import postgres, postgres_server
from .waiting import PATIENCE_S

__all__ = ["chromium", "postgres", "postgres_server", "tab"]

# A deadline is a timed test: it fails on a busy machine. `make test` draws the same examples every time, for everyone;
# `make test-long` draws new ones by `--hypothesis-profile=new`.
settings.register_profile("same", deadline=None, derandomize=True)
settings.register_profile("new", deadline=None, print_blob=True)
settings.load_profile("same")

# Read when torch and NumPy are loaded. Two processes of tests share the cores, and more threads of each wait for one
# another: beside other work they took twice as long. What a training sets itself counts, as for everyone.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Where containers forbid it, every process would compile the tests and the package again: ten seconds of each worker.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# What an account's or a job's terminal can do decides how commands write: without it they write alike everywhere.
for _variable in ("TERM", "COLUMNS", "LINES", "NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
    os.environ.pop(_variable, None)

# A proxy for the world outside answers in place of servers that tests start or that are not there.
for _variable in ("NO_PROXY", "no_proxy"):
    os.environ[_variable] = ",".join(filter(None, (os.environ.get(_variable), "127.0.0.1,localhost")))

# A job that a script starts in the background ignores Ctrl-C, and so would the processes that the tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)

# What the tests train with is no part of the account that runs them. Commands clear unlocked folders `deepracer_exp-*`.
os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp(prefix="account-of-tests-")
atexit.register(shutil.rmtree, os.environ["XDG_STATE_HOME"], ignore_errors=True)

REFERENCE = Path(__file__).parents[2] / "shared" / "reference"
"""What the real service recorded."""


def pytest_collection_finish() -> None:
    """Leave what is imported so far out of garbage collection, which took a seventh of the time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests whose outcome could depend on how busy the machine is; others are marked where they stand."""
    for item in items:
        if depends_on_the_machine(item):
            item.add_marker("processes")


_MARK = "DEEPRACER_EXP_STARTED_BY"
"""Variable of the environment that a command hands on to all that it starts."""


@dataclass(frozen=True)
class Ended:
    """What a command left behind."""

    code: int
    stdout: str
    stderr: str
    cwd: Path

    @property
    def folders(self) -> list[Path]:
        """Return the run folders under `runs/`, oldest first."""
        return sorted(path.parent for path in self.cwd.glob("runs/*/*/config.yaml"))

    @property
    def folder(self) -> Path:
        (folder,) = self.folders
        return folder

    @property
    def summary(self) -> dict[str, Any]:
        return json.loads((self.folder / "summary.json").read_text(encoding="utf-8"))

    @property
    def metrics(self) -> list[dict[str, Any]]:
        text = (self.folder / "metrics.jsonl").read_text(encoding="utf-8")
        return [json.loads(line) for line in text.splitlines()]

    @property
    def complaint(self) -> str:
        """Return the one line that says what is wrong."""
        assert "Traceback" not in self.stderr, self.stderr
        (line,) = [line for line in self.stderr.splitlines() if line.startswith("deepracer-exp: ")]
        return line

    def assert_refused(self, *words: str) -> None:
        """Refused with one line that has these words."""
        assert self.code == 2, self.stderr
        for word in words:
            assert word in self.complaint
        assert self.stdout == ""

    def assert_bad_input(self, *words: str) -> None:
        """Refused before anything began."""
        self.assert_refused(*words)
        assert not list(self.cwd.glob("runs/*/*")), "a run folder was made"

    def assert_run_failed(self, *words: str) -> None:
        """Failed with one line, and says so in its folder."""
        assert self.code == 3, self.stderr
        assert self.complaint.startswith("deepracer-exp: run failed: ")
        for word in words:
            assert word in self.complaint
        assert f"details: {self.folder.relative_to(self.cwd)}" in self.stderr
        assert self.summary["status"] == "failed"
        assert self.summary["reason"] in self.complaint
        assert "finished" not in self.stdout
        assert not (self.folder / ".heartbeat").exists()


class Started:
    """A command that runs in a session of its own, with everything it has started."""

    def __init__(self, arguments: Sequence[str], cwd: Path, env: dict[str, str] | None = None):
        self.cwd = cwd
        self._shm: set[Path] = set()
        self._mark = uuid.uuid4().hex
        self._out, self._err = cwd / "stdout.txt", cwd / "stderr.txt"
        with self._out.open("w") as out, self._err.open("w") as err:
            self.popen = subprocess.Popen(
                command(*arguments),
                cwd=cwd,
                stdout=out,
                stderr=err,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
                env=os.environ | {_MARK: self._mark} | (env or {}),
            )

    def processes(self) -> list[psutil.Process]:
        """Return the command and all that it has started, in whatever session or below whatever parent they are."""
        return [process for process in psutil.process_iter() if _is_marked(process, self._mark)]

    def note_shared_memory(self) -> set[Path]:
        """Return what its processes have in shared memory by a name; `assert_nothing_left` expects that it is gone."""
        self.workers()
        return set(self._shm)

    def workers(self) -> list[psutil.Process]:
        """Return the processes forked for the collector or the sweep, in the order of their start."""
        found = []
        for process in self.processes():
            try:
                self._shm |= shared_memory(process)
                parent = process.parent()
                if _is_fork(process) and parent is not None and _is_fork(parent):
                    found.append(process)
            except psutil.NoSuchProcess:
                continue
        return sorted(found, key=lambda process: (process.create_time(), process.pid))

    def wait_for_worker(self) -> psutil.Process:
        """Wait until the first worker of the collector is being started and return it."""
        return self.wait_for(self.workers, "worker")[0]

    def wait_for(self, condition: Callable[[], Any], what: str) -> Any:
        """Wait until a condition holds and return it."""
        give_up_at = time.monotonic() + PATIENCE_S
        while (began := time.monotonic()) < give_up_at:
            value = condition()
            if value:
                return value
            assert self.popen.poll() is None, f"ended before {what}: {self._said()}"
            # A condition that looks at all processes must not take a core from those that it waits for.
            time.sleep(max(0.02, 4.0 * (time.monotonic() - began)))
        pytest.fail(f"no {what} within {PATIENCE_S:g} s: {self._said()}")

    def _said(self) -> str:
        """Return what the command has written to stderr, and the workers of a sweep to their log."""
        return "\n".join(file.read_text() for file in (self._err, *self.cwd.glob("runs/*/workers.log")))

    def wait_for_iterations(self, count: int = 1) -> None:
        """Wait until as many iterations are recorded."""

        self.wait_for(lambda: iterations(self.cwd) >= count, f"{count} iterations")

    def signal_group(self, signum: signal.Signals) -> None:
        """Send a signal to all processes of the session, as a terminal does."""
        os.killpg(self.popen.pid, signum)

    def end(self) -> Ended:
        """Wait for the end and return what is left."""
        code = self.popen.wait(PATIENCE_S)
        return Ended(code, self._out.read_text(), self._err.read_text(), self.cwd)

    def assert_nothing_left(self) -> None:
        """Nothing that was started lives, and nothing of what `workers` saw mapped lies in shared memory."""
        give_up_at = time.monotonic() + PATIENCE_S
        while True:
            alive, shm = self.processes(), [path for path in self._shm if path.exists()]
            if not alive and not shm:
                return
            if time.monotonic() > give_up_at:
                pytest.fail(f"left behind: {alive} {shm}")
            time.sleep(0.05)

    def destroy(self) -> None:
        """End whatever is left of what was started."""
        for process in self.processes():
            try:
                process.kill()
            except psutil.NoSuchProcess:
                continue
        self.popen.wait()


def iterations(cwd: Path) -> int:
    """Return how many iterations are recorded of the first run there."""
    files = list(cwd.glob("runs/*/*/metrics.jsonl"))
    return files[0].read_text().count("\n") if files else 0


def command(*arguments: str) -> list[str]:
    """Return the command line as a racer types it."""
    script = shutil.which("deepracer-exp", path=str(Path(sys.executable).parent))
    return [script or "deepracer-exp", *arguments]


def _is_fork(process: psutil.Process) -> bool:
    """Return whether it is the fork server or forked from it."""
    return "multiprocessing.forkserver" in " ".join(process.cmdline())


def _is_marked(process: psutil.Process, mark: str) -> bool:
    try:
        return process.environ().get(_MARK) == mark and process.status() != psutil.STATUS_ZOMBIE
    except psutil.Error:
        return False


def shared_memory(process: psutil.Process) -> set[Path]:
    """Return the files in shared memory that a process has mapped and that have a name."""
    try:
        lines = Path(f"/proc/{process.pid}/maps").read_text().splitlines()
    except OSError:  # it has ended
        return set()
    # The path is of no use: a semaphore is named after it is mapped.
    inodes = {int(line.split()[4]) for line in lines if "/dev/shm/" in line}
    found = set()
    for file in Path("/dev/shm").iterdir() if inodes else ():
        with contextlib.suppress(FileNotFoundError):  # another process has removed it
            if file.stat().st_ino in inodes:
                found.add(file)
    return found


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Started]]:
    """Start `deepracer-exp ARGUMENTS` in `tmp_path` as a process of its own."""
    started: list[Started] = []

    def go(*arguments: str, env: dict[str, str] | None = None) -> Started:
        started.append(Started(arguments, tmp_path, env))
        return started[-1]

    yield go
    for one in started:
        one.destroy()


def refused(call: Callable[..., object], *arguments: object, **options: object) -> str:
    """Return the one line with which a call refuses its arguments."""
    with pytest.raises(BadInput) as caught:
        call(*arguments, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


IN_PROCESS = ("experiment=tiny", "tracking=off", "collector=in_process", "collector.threads=1")
IN_WORKERS = ("experiment=tiny", "tracking=off", "collector=sync", "collector.processes=2")

OFTEN = (
    *("episode.max_steps=60", "evaluation.time_s=4", "evaluation.trials=1", "checkpoints.every=2"),
    *("collector.cars=8", "algorithm.frames_per_iteration=256", "algorithm.batch_size=128"),
)
"""Episodes end often, sooner than with a lap, and evaluations come soon."""
THREE = ("budget.env_steps=null", "budget.iterations=3")
RACE = ("race=head_to_head", "observation.next_objects=1")
POOL = (*RACE, "race.rivals.policy=pool", "race.rivals.snapshot_every=1", "race.rivals.pool_size=3")


def call_in(cwd: Path, *arguments: str) -> Ended:
    """Call `deepracer-exp ARGUMENTS` in this process with `cwd` as the working folder."""
    out, err = io.StringIO(), io.StringIO()
    with (
        contextlib.chdir(cwd),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        pytest.raises(SystemExit) as exit_,
    ):
        main(arguments)
    return Ended(exit_.value.code or 0, out.getvalue(), err.getvalue(), cwd)


@pytest.fixture(scope="session")
def call_at() -> Callable[..., Ended]:
    """Call `deepracer-exp ARGUMENTS` in this process: `call_at(FOLDER, ARGUMENTS...)`."""
    return call_in


@pytest.fixture(scope="session")
def run_at() -> Callable[..., Ended]:
    """Run `deepracer-exp ARGUMENTS` as a process of its own to its end: `run_at(FOLDER, ARGUMENTS...)`."""

    def run(cwd: Path, *arguments: str) -> Ended:
        started = Started(arguments, cwd)
        try:
            return started.end()
        finally:
            started.destroy()

    return run


@pytest.fixture
def call(tmp_path: Path) -> Callable[..., Ended]:
    """Call `deepracer-exp ARGUMENTS` in this process, with `tmp_path` as the working folder."""
    return functools.partial(call_in, tmp_path)


@pytest.fixture
def train_here(call: Callable[..., Ended]) -> Callable[..., Ended]:
    """Train the tiny experiment in this process, its cars too."""
    return functools.partial(call, "train", *IN_PROCESS)


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Ended]:
    """Train the tiny experiment in this process, once for each set of overrides and for both processes of tests.

    Nothing may be changed in its folder: see `copied`.
    """
    own = tmp_path_factory.getbasetemp()
    shared = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "trained"

    @functools.cache
    def train(*overrides: str) -> Ended:
        folder = shared / hashlib.sha256("\0".join(overrides).encode()).hexdigest()[:16]
        folder.mkdir(parents=True, exist_ok=True)
        said = folder / "ended.json"
        with FileLock(folder / "lock"):
            if not said.exists():
                ended = call_in(folder, "train", *IN_PROCESS, *overrides)
                said.write_text(json.dumps([ended.code, ended.stdout, ended.stderr]), encoding="utf-8")
        return Ended(*json.loads(said.read_text(encoding="utf-8")), folder)

    return train


@pytest.fixture
def copied(trained: Callable[..., Ended], tmp_path: Path) -> Callable[..., Path]:
    """Train with these overrides, once for all tests, and return a copy of the run, which may be changed."""

    def copy(*overrides: str) -> Path:
        ended = trained(*overrides)
        assert ended.code == 0, ended.stderr
        return shutil.copytree(ended.folder, tmp_path / "runs" / "tiny" / ended.folder.name, symlinks=True)

    return copy


@pytest.fixture(scope="session")
def empty_database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database of MLflow with tables and no runs; creating the tables takes a second or two each time."""
    from deepracer_exp.tracking.mlflow_run import MLflowRun
    from deepracer_exp.tracking.store import resolve_store

    runs = tmp_path_factory.mktemp("template")
    MLflowRun(resolve_store(None, runs))
    return runs / "mlflow.db"


@pytest.fixture
def mlflow_here(tmp_path: Path, empty_database: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Let trainings record below `runs/` in a thread of this process; return a client of their store."""
    from mlflow import MlflowClient

    from tests.tracking.conftest import ProjectorHere

    for module in ("projector", "tracker"):
        monkeypatch.setattr(f"deepracer_exp.tracking.{module}.Projector", ProjectorHere)
    (tmp_path / "runs").mkdir(exist_ok=True)
    database = shutil.copy(empty_database, tmp_path / "runs" / "mlflow.db")
    return MlflowClient(tracking_uri=f"sqlite:///{database}")


@pytest.fixture
def mounted(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """Mount a file system of its own at `tmp_path/runs`, with the given options; it is taken away again."""
    # Half of these can be mounted by root only; modes of files do not hold root back.
    if sys.platform != "linux" or os.getuid() != 0 or shutil.which("mount") is None:
        pytest.skip("needs root to mount")
    folder = tmp_path / "runs"
    folder.mkdir()

    def mount(options: str) -> Path:
        done = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], check=False)
        if done.returncode:
            pytest.skip("mount is not allowed here")
        return folder

    yield mount
    subprocess.run(["umount", "--lazy", str(folder)], check=False)


@pytest.fixture(scope="session")
def reference() -> Path:
    """The folder of what the real service recorded."""
    if not REFERENCE.is_dir():
        pytest.skip("the recordings of the real service are not on this machine")
    return REFERENCE


@pytest.fixture
def start_training(start: Callable[..., Started]) -> Callable[..., Started]:
    """Start a training of two workers that would take an hour."""
    return lambda *overrides: start(
        "train",
        "experiment=tiny",
        "tracking=off",
        "collector.processes=2",
        "budget.env_steps=100000000",
        *overrides,
    )
