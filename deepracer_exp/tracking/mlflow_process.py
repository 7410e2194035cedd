"""Calls of MLflow runs in a process beside the training, whose own thread they would take.

MLflow takes two seconds to import, and its calls are mostly Python: in a thread they delay the training, which holds
the interpreter, and the end of a short training waits for them. The process is kept for the next run of its owner, and
ends with it.
"""

import atexit
import contextlib
import gc
import os
import subprocess
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from deepracer_exp.addresses import take_over, taken_out
from deepracer_exp.lifeline import running

from .calls import StoreRefusedError, StoreUnavailableError
from .metrics import Point
from .store import Store
from .tracking_file import TrackedRun

if TYPE_CHECKING:
    from .mlflow_run import MLflowRun

_MODULE = "deepracer_exp.tracking.mlflow_process"
_ERRORS = {error.__name__: error for error in (StoreRefusedError, StoreUnavailableError)}


class RemoteRun:
    """An `MLflowRun` whose calls another process makes; its methods, errors and attributes are those of `MLflowRun`.

    If that process is lost, a call raises StoreUnavailableError, and the next one is made by a new process.
    """

    def __init__(self, store: Store) -> None:
        """Open the store, creating it if necessary."""
        self.run_id: str | None = None
        self.metrics: dict[str, float] = {}
        self._store = store
        self._process: _Process | None = None
        self._connected()

    def open(self, tracked: TrackedRun, *, is_first: bool = False) -> None:
        """Create the run, or continue it."""
        self._ask("open", tracked, is_first=is_first)

    def open_only(self, tracked: TrackedRun, mark: Sequence[str]) -> None:
        """Create a run, or continue the one with the same values of the tags `mark`."""
        self._ask("open_only", tracked, mark)

    def read(self, run_id: str) -> None:
        """Read a run, which stays as it is."""
        self._ask("read", run_id)

    def lacking(self, points: Sequence[Point]) -> list[Point]:
        """Return the points that the store lacks."""
        lacking: list[Point] = self._ask("lacking", points)
        return lacking

    def log(
        self,
        points: Sequence[Point] = (),
        params: Mapping[str, str] | None = None,
        tags: Mapping[str, str] | None = None,
    ) -> None:
        """Write points, parameters and tags."""
        self._ask("log", points, params, tags)

    def set_experiment_tags(self, tags: Mapping[str, str]) -> None:
        """Write tags of the run's experiment."""
        self._ask("set_experiment_tags", tags)

    def adopt(self, tags: Mapping[str, str], but: str) -> None:
        """Nest the runs of its experiment that have these tags, and not the tag `but`, under this one."""
        self._ask("adopt", tags, but)

    def conclude(self, tracked: TrackedRun, summary: Mapping[str, Any], files: Collection[str]) -> None:
        """Record the best checkpoint."""
        self._ask("conclude", tracked, summary, files)

    def describe_study(self, winner: str) -> None:
        """Name a study's winner in the description of its experiment."""
        self._ask("describe_study", winner)

    def log_artifact(self, path: Path, folder: str | None) -> None:
        """Copy a file, or all files of a folder, to the run's artifacts under `folder`."""
        self._ask("log_artifact", path.absolute(), folder)

    def end(self, status: str, end_ms: int) -> None:
        """Write the status and the end of the run."""
        self._ask("end", status, end_ms)

    def release(self) -> None:
        """Leave the process to the next run; no other method may be called from then on."""
        if self._process is not None:
            _idle.append(self._process)
            self._process = None

    def discard(self) -> None:
        """End the process, whatever it waits for; no other method may be called from then on."""
        if self._process is not None:
            self._process.close()
            self._process = None

    def _connected(self) -> "_Process":
        if self._process is None:
            process = _idle.pop() if _idle else _Process()
            try:
                process.ask("connect", self._store)
                if self.run_id is not None:  # another process had opened it
                    process.ask("read", self.run_id)
            except (StoreRefusedError, StoreUnavailableError):
                if not process.is_lost:
                    _idle.append(process)
                raise
            self._process = process
        return self._process

    def _ask(self, method: str, *arguments: Any, **options: Any) -> Any:
        process = self._connected()
        try:
            value, self.run_id, self.metrics = process.ask(method, *arguments, **options)
        except StoreUnavailableError:
            if process.is_lost:
                self._process = None
            raise
        return value


Connect: TypeAlias = "Callable[[Store], MLflowRun | RemoteRun]"
"""Opens a store for the calls of one run: `connect_here` or `RemoteRun`."""


def connect_here(store: Store) -> "MLflowRun":
    """Open a store for calls that this process makes itself."""
    from .mlflow_run import MLflowRun

    return MLflowRun(store)


def released(run: "MLflowRun | RemoteRun | None", *, is_done: bool = True) -> None:
    """Release a run; `is_done`: no call of it can still be under way."""
    if isinstance(run, RemoteRun):
        run.release() if is_done else run.discard()


class _Process:
    """A process that makes the calls of one run after the other."""

    def __init__(self) -> None:
        self.is_lost = False
        self._life = contextlib.ExitStack()
        pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        try:
            # -P: modules come from where they are installed, not from the working folder.
            started = self._life.enter_context(running([sys.executable, "-P", "-m", _MODULE], **pipes))
        except OSError as error:
            raise StoreUnavailableError(f"no process for it: {error.strerror}") from error
        assert started.stdin is not None
        assert started.stdout is not None
        self._questions = Connection(os.dup(started.stdin.fileno()), readable=False)
        self._answers = Connection(os.dup(started.stdout.fileno()), writable=False)
        started.stdin.close()
        started.stdout.close()
        self.ask("take_over", taken_out())

    def ask(self, method: str, *arguments: Any, **options: Any) -> Any:
        """Return the value of a method of its `MLflowRun`, the run's id, and its metrics.

        Raises:
            StoreUnavailableError, StoreRefusedError: the method did, or the process is lost.
            RuntimeError: the method raised another error.
        """
        try:
            self._questions.send((method, arguments, options))
            error, answer = self._answers.recv()
        except (EOFError, OSError) as lost:
            self.is_lost = True
            self.close()
            raise StoreUnavailableError("the process that recorded there was lost") from lost
        if error is not None:
            raise _ERRORS.get(error, RuntimeError)(answer)
        return answer

    def close(self) -> None:
        """End it at once."""
        self._life.close()


_idle: list[_Process] = []
"""Processes that wait for their next run."""


@atexit.register
def _close_idle() -> None:
    while _idle:
        _idle.pop().close()


def _answer(questions: Connection, answers: Connection) -> None:
    """Make the calls that are asked for until the pipe is closed."""
    run: MLflowRun | None = None
    while True:
        try:
            method, arguments, options = questions.recv()
        except EOFError:
            return
        value: Any = None
        try:
            if method == "take_over":
                take_over(*arguments)
            elif method == "connect":
                run = connect_here(*arguments)
                gc.freeze()
                gc.enable()
            else:
                value = getattr(run, method)(*arguments, **options)
            about = (None, {}) if run is None else (run.run_id, run.metrics)
            answers.send((None, (value, *about)))
        except Exception as error:  # noqa: BLE001 - raised again where it was asked for
            name = type(error).__name__
            answers.send((name, str(error) if name in _ERRORS else f"{name}: {error}"))


def _main() -> None:
    # Its calls are repeated (`StoreThread`); a command, whose user waits, has MLflow's own patience of 120 s.
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")
    gc.disable()  # while MLflow is imported, of which nothing is garbage
    questions, answers = Connection(os.dup(0), writable=False), Connection(os.dup(1), readable=False)
    # What MLflow prints is not shown.
    with open(os.devnull, "r+b") as nothing:
        os.dup2(nothing.fileno(), 0)
        os.dup2(nothing.fileno(), 1)
    _answer(questions, answers)


if __name__ == "__main__":
    _main()
