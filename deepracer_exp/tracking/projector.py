"""The client of the process that records runs (`project`): sends it folders, and waits for its answer."""

import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Self

from deepracer_exp.addresses import taken_out
from deepracer_exp.config.running import TensorBoardTracking, WandbTracking
from deepracer_exp.lifeline import running
from deepracer_exp.patience import wait_patiently
from deepracer_exp.runs.run_files import METRICS

from .store import Store
from .tracking_file import Recorded, TrackedRun, read_recorded, write_tracked_run

UPDATE_S = 5.0
"""Pause between two updates of a tracker that answers; everything new is one request."""
_LOOK_S = 0.02
_MODULE = "deepracer_exp.tracking.project"

Target = Store | TensorBoardTracking | WandbTracking
"""The target of a run's records."""


def kind_of(target: Target) -> str:
    """Return the kind of tracker, as in `tracking.kind`."""
    return "mlflow" if isinstance(target, Store) else target.kind


class Projector:
    """A process that records the runs of this one, one after the other; it starts when it is first needed.

    It ends with the block, or with this process, however that ends. If it is lost, the next line starts another.
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._life = contextlib.ExitStack()
        self._folder: Path | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def begin(self, folder: Path, target: Target, *, is_training: bool = True) -> None:
        """Start recording the run of a folder, in place of the last one.

        `is_training`: it has metrics.jsonl once it has begun, and its start needs the cores itself.
        """
        self._folder = folder
        first = str((folder / METRICS).absolute()) if is_training else None
        # Through a pipe, and in no argument or file: addresses have passwords.
        line = {"folder": str(folder.absolute()), "kind": kind_of(target), "options": asdict(target)}
        self.send({**line, "addresses": taken_out(), "every_s": UPDATE_S, "first": first})

    def look(self, folder: Path, target: Target) -> None:
        """Record a folder now; arguments and errors as for `begin`."""
        if self._folder == folder and not self.is_lost:
            self.send({})
        else:
            self.begin(folder, target, is_training=False)

    @property
    def is_lost(self) -> bool:
        """Whether no process runs."""
        return self._process is None or self._process.poll() is not None

    def end(self) -> None:
        """End the process at once, whatever it waits for."""
        self._life.close()
        self._process = None

    def send(self, line: dict[str, Any]) -> None:
        """Write a line (`project.serve`) to the process, which is started if there is none."""
        pipes: Any = {
            "stdin": subprocess.PIPE,
            "stdout": subprocess.DEVNULL,
            "stderr": subprocess.DEVNULL,
        }
        # Not started, or just ended: the line is lost, which does not harm the training.
        with contextlib.suppress(OSError):
            if self.is_lost:
                self.end()
                # -P: modules come from where they are installed, not from the working folder.
                command = [sys.executable, "-P", "-m", _MODULE]
                self._process = self._life.enter_context(running(command, bufsize=0, **pipes))
            assert self._process is not None
            assert self._process.stdin is not None
            self._process.stdin.write(json.dumps(line).encode() + b"\n")


class ProjectedRun:
    """A run that this process describes in a folder, and a projector records from there."""

    def __init__(self, folder: Path, run: TrackedRun, target: Target, projector: Projector) -> None:
        self.folder, self.run = folder, run
        self._target, self._projector = target, projector

    def begin(self, *, is_training: bool) -> None:
        """Write `tracking.json` and start recording the run, a training's once it begins.

        Raises:
            OSError: the folder cannot be written.
        """
        write_tracked_run(self.folder, self.run)
        self._projector.begin(self.folder, self._target, is_training=is_training)

    @property
    def recorded(self) -> Recorded:
        """The record so far."""
        return read_recorded(self.folder, kind_of(self._target))

    def change(self, **changes: Any) -> None:
        """Set fields of the run.

        Raises:
            OSError: the folder cannot be written.
        """
        self.run = replace(self.run, **changes)
        write_tracked_run(self.folder, self.run)

    def wait_for_end(self, deadline_s: float) -> str | None:
        """Record the end of the run; return a sentence on what was not recorded and why, None if everything was.

        It is waited for at most `deadline_s`. The limit is the tracker's: of a process that records and has not enough
        of a core, its CPU time counts.
        """
        self._projector.look(self.folder, self._target)
        wait_patiently(partial(_arrives, self._is_settled), deadline_s)
        recorded = self.recorded
        if recorded.end_ms == self.run.end_ms:
            return recorded.problem
        reason = "the process that recorded it was lost" if self._projector.is_lost else None
        self._projector.end()
        return reason or recorded.problem or f"no answer within {deadline_s:g} s"

    def wait_for_answer(self, deadline_s: float) -> Recorded:
        """Return the record once the tracker has created or refused the run, or after the time limit."""
        kind = kind_of(self._target)

        def has_answered() -> bool:
            recorded = self.recorded
            is_open = recorded.run_id is not None or (
                kind != "mlflow" and (self.folder / f"{kind}.json").exists()
            )
            return is_open or recorded.is_refused or self._projector.is_lost

        wait_patiently(partial(_arrives, has_answered), deadline_s)
        return self.recorded

    def _is_settled(self) -> bool:
        return self.recorded.end_ms == self.run.end_ms or self._projector.is_lost


def _arrives(what: Callable[[], bool], seconds: float) -> bool:
    """Return whether an answer arrives within the given seconds."""
    end = time.monotonic() + seconds
    while not what() and time.monotonic() < end:
        time.sleep(_LOOK_S)
    return what()
