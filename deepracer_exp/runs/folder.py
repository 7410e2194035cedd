"""The folder of a run in training: lock, log, files, and crash dumps."""

import contextlib
import datetime
import fcntl
import json
import logging
import math
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from filelock import FileLock, Timeout

from deepracer_exp.addresses import redact, without_passwords
from deepracer_exp.config.compose import Composition
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.files import atomic_write, read_json
from deepracer_exp.rewards.source import RewardSource, source_with_constants

from .run_files import (
    BEST_LAP,
    CONFIG,
    CRASH_DUMPS,
    LEARNING,
    LOG,
    MACHINE_USE,
    METRICS,
    OVERRIDES,
    PROVENANCE,
    REPORT,
    REWARD,
    RUNNING,
    SUMMARY,
    TRACE,
    read_metrics,
    who_and_where,
)
from .stored_run import track_hashes

logger = logging.getLogger("deepracer_exp")

_PACKAGES = ("deepracer-exp", "torch", "torchrl", "tensordict", "mujoco", "hydra-core", "mlflow", "numpy")


class RunFolder:
    """`runs_dir/<experiment>/<run>/` and the files that lie directly in it."""

    def __init__(self, path: Path):
        """Open a folder that is there; no other process may write into it until this one releases it.

        Raises:
            BadInput: another process trains in it.
            OSError: it cannot be written.
        """
        self.path = path
        self.name = path.name
        self._metrics = path / METRICS
        self._lock = _locked(path / RUNNING)
        self._log: logging.FileHandler | None = None

    @classmethod
    def create(cls, runs_dir: str, experiment: str, label: str) -> "RunFolder":
        """Create a new folder, named by the time and `label`.

        Raises:
            BadInput: the folder cannot be created.
        """
        stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
        name = f"{stamp}-{re.sub(r'[^A-Za-z0-9._-]+', '_', label)}"
        parent = Path(runs_dir) / experiment
        try:
            parent.mkdir(parents=True, exist_ok=True)
            return cls(_make_new(parent, name))
        except OSError as error:
            raise BadInput(
                f"runs_dir={runs_dir}",
                f"cannot create {parent / name}: {error.strerror}; give a folder that can be written",
            ) from error

    def describe(
        self, composition: Composition, reward: RewardSource, experiment: Experiment, names: Mapping[str, str]
    ) -> str | None:
        """Write the configuration and the provenance of code and files; return the git commit if there is one.

        config.yaml makes a folder a run, and is written last: a run that was killed at any moment can be resumed.
        `names` are readable names of its choices.
        """
        overrides = "".join(f"- {json.dumps(override)}\n" for override in composition.overrides)
        self.write(OVERRIDES, overrides or "[]\n")
        self.write(REWARD, source_with_constants(reward))
        commit = git_commit()
        provenance = {
            "versions": {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES},
            "git_commit": commit,
            "seed": experiment.seed,
            "names": dict(names),
            "machine": {
                **who_and_where(),
                "system": platform.platform(),
                "cores": psutil.cpu_count(),
                "memory_gib": round(psutil.virtual_memory().total / 2**30, 1),
            },
            "reward": {"name": reward.name, "path": str(reward.path), "sha256": reward.sha256},
            "tracks": track_hashes(experiment),
            # A script's arguments have not been checked for passwords yet.
            "command": [redact(without_passwords(word)) for word in sys.argv[1:]],
        }
        self.write(PROVENANCE, json.dumps(provenance, indent=2) + "\n")
        self.write(CONFIG, composition.yaml())
        return commit

    def append_metrics(self, row: dict[str, Any]) -> None:
        """Add one line to metrics.jsonl.

        Raises:
            RunFailed: the folder is not the one that was opened.
            OSError: the file cannot be written.
        """
        # Other writers would create a removed folder again, with nothing else in it.
        if not (self.path / RUNNING).exists():
            raise RunFailed(f"{self.path}: the folder of the run is gone")
        with self._metrics.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def append_machine_use(self, use: Mapping[str, float]) -> None:
        """Add one line to machine.jsonl.

        Raises:
            OSError: the file cannot be written.
        """
        with (self.path / MACHINE_USE).open("a", encoding="utf-8") as file:
            file.write(json.dumps(use) + "\n")

    def metrics(self) -> list[dict[str, Any]]:
        """Return the lines of metrics.jsonl."""
        return read_metrics(self._metrics) if self._metrics.exists() else []

    def write_metrics(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write metrics.jsonl again, a line a row."""
        self.write(METRICS, "".join(json.dumps(row) + "\n" for row in rows))

    def rewind(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Truncate metrics.jsonl after the last of these rows."""
        self.write_metrics(rows)
        if (self.path / MACHINE_USE).exists():
            steps = {row["env_steps"] for row in rows}
            uses = [use for use in read_metrics(self.path / MACHINE_USE) if use["env_steps"] in steps]
            self.write(MACHINE_USE, "".join(json.dumps(use) + "\n" for use in uses))
        for name in (SUMMARY, REPORT, BEST_LAP, LEARNING):
            (self.path / name).unlink(missing_ok=True)
        from .trace import rewind_trace  # imports pyarrow, which `is_held` does without

        rewind_trace(self.path / TRACE, len(rows))
        shutil.rmtree(self.path / CRASH_DUMPS, ignore_errors=True)

    def write(self, name: str, text: str) -> Path:
        """Write a file whole or not at all."""
        return atomic_write(self.path / name, text)

    def open_log(self) -> None:
        """Copy the project's log to log.txt until the folder is released."""
        self._log = _LogFile(self.path / LOG, encoding="utf-8")
        self._log.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        logger.addHandler(self._log)
        logger.setLevel(logging.INFO)

    def remove(self) -> None:
        """Remove a folder in which no run has begun."""
        self.release()
        shutil.rmtree(self.path, ignore_errors=True)

    def release(self) -> None:
        """Close the log, and let others write into the folder."""
        if self._log is not None:
            logger.removeHandler(self._log)
            self._log.close()
        with contextlib.suppress(OSError):  # a full disk
            (self.path / RUNNING).unlink(missing_ok=True)
        self._lock.release()


def is_held(run_dir: Path) -> bool:
    """Return whether a process is training in a run's folder."""
    try:
        with (run_dir / RUNNING).open("rb") as file:  # only read: it may be another user's
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except FileNotFoundError:
        return False
    return False


def git_commit() -> str | None:
    """Return the commit of the checkout this code runs from, `-dirty` if changed, None outside a checkout."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return None
    try:
        commit = _git(root, "rev-parse", "HEAD")
        return f"{commit}-dirty" if _git(root, "status", "--porcelain") else commit
    except (OSError, subprocess.CalledProcessError):
        # No git, a checkout without a commit, or one of another owner.
        return None


def _git(root: Path, *arguments: str) -> str:
    done = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def _locked(file: Path) -> FileLock:
    lock = FileLock(file, timeout=0, thread_local=False)
    try:
        lock.acquire()
    except Timeout:
        raise BadInput(file.parent, "a process is training in it; end that one first") from None
    return lock


def _make_new(parent: Path, name: str) -> Path:
    """Make a folder that was not there: two runs may start in the same second."""
    attempt = 1
    while True:
        path = parent / (name if attempt == 1 else f"{name}-{attempt}")
        try:
            path.mkdir()
        except FileExistsError:
            attempt += 1
        else:
            return path


class _LogFile(logging.FileHandler):
    """Ignores a full disk, which the end of the run reports in one line."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - the base class's name
        pass

    def close(self) -> None:
        with contextlib.suppress(OSError):
            super().close()


def write_crash_dump(run_dir: Path, error: BaseException, worker: int | None = None) -> None:
    """Write the error's line, and its `params` and `arrays` if it has them, under `faults/` as JSON and .npz.

    On a full disk, parts that do not fit are left out, so that the error itself is not lost. `worker` is the number of
    the process, None for the training process.
    """
    folder = run_dir / CRASH_DUMPS
    stem = "training" if worker is None else f"worker-{worker}"
    report = {
        "error": type(error).__name__,
        "message": str(error),
        "worker": worker,
        "params": _plain(getattr(error, "params", None)),
    }
    with contextlib.suppress(OSError):
        folder.mkdir(exist_ok=True)
        atomic_write(folder / f"{stem}.json", json.dumps(report, indent=2) + "\n")
        arrays: dict[str, np.ndarray] = getattr(error, "arrays", {})
        if arrays:
            with (folder / f"{stem}.npz").open("wb") as file:
                np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def read_crash_dump(run_dir: Path, worker: int) -> str | None:
    """Return the error line of a worker, None if it wrote none."""
    path = run_dir / CRASH_DUMPS / f"worker-{worker}.json"
    return str(read_json(path, "what a worker writes there")["message"]) if path.exists() else None


def _plain(value: Any) -> Any:
    """Return the value in JSON's types; NaN and infinities as text."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return repr(value)
