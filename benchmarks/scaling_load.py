"""Workers of a sweep whose trainings are simulated: what a study's database and MLflow see of a hundred workers.

Driver, workers, leases, claims, Optuna's storage, MLflow tracker and HTTP are the real ones. A simulated training only
waits: it appends the rows of a real run to its metrics.jsonl, one a second, moves its checkpoint on, asks the pruners,
and leaves the files of the real run. A worker is a thread with connections of its own; some processes share them all.
"""

import contextlib
import itertools
import json
import multiprocessing
import os
import shutil
import threading
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import optuna
import requests
import sqlalchemy as sa

from deepracer_exp.errors import RunFailed
from deepracer_exp.runs.checkpoint_files import LINKS
from deepracer_exp.runs.files import CHECKPOINTS, METRICS, SUMMARY, TRACKING, read_run_id
from deepracer_exp.runs.result import FINISHED, INTERRUPTED, Ending
from deepracer_exp.sweeps.queue import worker
from deepracer_exp.sweeps.queue.claims import TrialClaims
from deepracer_exp.sweeps.queue.launcher import newest_beat
from deepracer_exp.sweeps.queue.lease import Answer, Beat
from deepracer_exp.sweeps.queue.storage import open_storage
from deepracer_exp.sweeps.queue.trial_run import TrialRun
from deepracer_exp.sweeps.queue.worker_config import WorkerConfig, owner_name
from deepracer_exp.sweeps.trial import SeedRun
from deepracer_exp.tracking.metrics import now_ms
from deepracer_exp.tracking.mlflow_tracker import MLflowTracker
from deepracer_exp.tracking.projection import MLflowProjection
from deepracer_exp.tracking.tracker import FINISH_S
from deepracer_exp.tracking.tracking_file import TrackedRun, read_tracked_run
from deepracer_exp.training.callback import TrainResult
from deepracer_exp.training.trainer import Trainer

from .command import read_metrics, read_summary

_RAMP_S = 15.0
"""Seconds over which the workers of a load start."""
_OF_A_RUN = threading.local()
"""What a worker's thread knows: whether it is asked to end, how long its first trial is, when a transaction began."""


@dataclass
class Measured:
    """What the workers of a process have measured: moments by the monotonic clock, and seconds."""

    seconds: dict[str, list[tuple[float, float]]] = field(default_factory=lambda: defaultdict(list))
    """By kind of call: when it ended, and how long it took."""
    failures: list[str] = field(default_factory=list)
    """Why runs were not recorded whole, and errors of workers."""

    def add(self, kind: str, began_s: float) -> None:
        """Note a call that has ended."""
        now_s = time.monotonic()
        self.seconds[kind].append((now_s, now_s - began_s))

    def join(self, other: "Measured") -> None:
        """Take over what another process has measured."""
        for kind, calls in other.seconds.items():
            self.seconds[kind] += calls
        self.failures += other.failures

    def within(self, kind: str, window: tuple[float, float]) -> list[float]:
        """Return how long the calls of a kind took that ended within a window of time."""
        return [took_s for ended_s, took_s in list(self.seconds[kind]) if window[0] <= ended_s < window[1]]


@dataclass(frozen=True)
class Template:
    """A real run whose files and rows the simulated ones leave."""

    folder: Path
    iterations: int
    """Iterations of each simulated training."""
    every: int
    """Iterations between two checkpoints, each with an evaluation."""

    def row(self, rows: Sequence[dict[str, Any]], iteration: int) -> dict[str, Any]:
        """Return the row of an iteration, of which each takes a second."""
        is_evaluated = iteration % self.every == 0
        some = [row for row in rows if (row["eval_completion"] is not None) == is_evaluated]
        steps = iteration * rows[0]["env_steps"]
        moment = {"iteration": iteration, "env_steps": steps, "wall_clock_s": float(iteration)}
        return {**some[iteration % len(some)], **moment}


class SimulatedTrial(TrialRun):
    """A trial whose runs wait instead of driving."""

    template: Template
    measured: Measured

    def _trained(self, overrides: Sequence[str]) -> TrainResult:
        template, config = self.template, self._config
        rows, tracked = (
            read_metrics(template.folder),
            read_tracked_run(template.folder / TRACKING),
        )
        folder = config.folder / f"trial-{self._number}-{self._lease.claim.attempt}"
        _link(template.folder, folder, only_files=True)
        self._begin(folder)
        assert config.store is not None
        tracker = MLflowTracker(config.store)
        title, tags = self._title_and_tags()
        tags = {**tracked.tags, **tags, "run_dir": str(folder)}
        tracker.open(folder, TrackedRun(title, config.study, now_ms(), tracked.params, tags))
        began_s = time.monotonic()
        first, _OF_A_RUN.first = _OF_A_RUN.first, template.iterations
        for iteration in range(1, first + 1):
            if _OF_A_RUN.stop.is_set() or _OF_A_RUN.stop.wait(began_s + iteration - time.monotonic()):
                tracker.finish("KILLED", 2.0)
                return TrainResult(Ending(INTERRUPTED, "the load has ended"), 143, folder, {})
            row = template.row(rows, iteration)
            with (folder / METRICS).open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
            if iteration % template.every == 0 or iteration == first:
                _cover(folder, iteration)
            budget = SimpleNamespace(used=lambda share=iteration / first: (None, share))
            stand_in = SimpleNamespace(row=row, budget=budget, usage=(), request_stop=lambda ending: None)
            self.on_iteration_end(cast("Trainer", stand_in))
        self._lease.confirm()
        for link in LINKS:
            _link(template.folder / CHECKPOINTS / link, folder / CHECKPOINTS / f"{first:06d}")
        summary = {**read_summary(template.folder), "iteration": first, "status": FINISHED}
        (folder / SUMMARY).write_text(json.dumps(summary), encoding="utf-8")
        ended_s = time.monotonic()
        tracker.finish("FINISHED", FINISH_S)
        self.measured.add("end of a run", ended_s)
        if tracker.failure is not None:
            self.measured.failures.append(tracker.failure)
        return TrainResult(Ending.by_budget("iterations"), 0, folder, summary)

    def _resumed(self, run: SeedRun) -> TrainResult | None:
        return None  # begun again, in another folder

    def _evaluated(self, folder: Path) -> dict[str, Any]:
        self._lease.confirm()
        values = [10.0 + self._number % 7] * len(self._config.config.objectives)
        return {"values": values, "completion": 100.0, "mlflow_run_id": read_run_id(folder)}


def _link(source: Path, target: Path, *, only_files: bool = False) -> None:
    """Give a run the files of another, which stay as they are; its metrics begin again."""
    target.mkdir(parents=True, exist_ok=True)
    for path in source.iterdir():
        if path.is_file() and path.name not in (METRICS, SUMMARY, TRACKING):
            (target / path.name).unlink(missing_ok=True)
            os.link(path, target / path.name)
        elif path.is_dir() and not only_files:
            _link(path, target / path.name)


_COVERED: dict[Path, dict[int, float]] = defaultdict(dict)
"""When a checkpoint of a run covered its rows until an iteration."""


def _cover(folder: Path, iteration: int) -> None:
    checkpoints = folder / CHECKPOINTS
    (checkpoints / f"{iteration:06d}").mkdir(parents=True)
    for link in LINKS:
        before = (checkpoints / link).resolve()
        (checkpoints / link).unlink(missing_ok=True)
        (checkpoints / link).symlink_to(f"{iteration:06d}")
        if before.name.isdecimal():
            shutil.rmtree(before, ignore_errors=True)
    _COVERED[folder][iteration] = time.monotonic()


def measure_calls(measured: Measured) -> None:
    """Time every transaction and request of this process, and how late each row of metrics is."""
    connect, send = sa.Engine.raw_connection, requests.adapters.HTTPAdapter.send
    write, renew = MLflowProjection._write_metrics, TrialClaims.renew

    def timed_connect(self: sa.Engine) -> Any:
        _OF_A_RUN.began_s = time.monotonic()
        return connect(self)

    def timed_send(self: Any, request: Any, *args: Any, **options: Any) -> Any:
        began_s = time.monotonic()
        try:
            return send(self, request, *args, **options)
        finally:
            measured.add("log_batch" if "log-batch" in request.path_url else "other request", began_s)

    def timed_write(self: MLflowProjection, *args: Any) -> None:
        before = self._rows
        write(self, *args)
        for covered, at_s in _COVERED[self._folder].items():
            if before < covered <= self._rows:
                measured.add("row until it is in MLflow", at_s)

    def counted_renew(self: TrialClaims, *args: Any) -> bool:
        measured.add("renewal by a worker itself", time.monotonic())
        return renew(self, *args)

    setattr(sa.Engine, "raw_connection", timed_connect)  # noqa: B010 - mypy refuses an assignment
    setattr(requests.adapters.HTTPAdapter, "send", timed_send)  # noqa: B010
    setattr(MLflowProjection, "_write_metrics", timed_write)  # noqa: B010
    setattr(TrialClaims, "renew", counted_renew)  # noqa: B010
    sa.event.listen(sa.pool.Pool, "checkin", lambda *_: measured.add("transaction", _OF_A_RUN.began_s))
    sa.event.listen(sa.pool.Pool, "connect", lambda *_: measured.add("connection", time.monotonic()))


def serve(orders: Connection, template: Template) -> None:
    """Run simulated workers, as the driver orders, until it ends the process; the target of one."""
    measured, stops = Measured(), dict[str, threading.Event]()
    SimulatedTrial.template, SimulatedTrial.measured = template, measured
    measure_calls(measured)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    worker.TrialRun = SimulatedTrial  # type: ignore[misc]
    lock = threading.Lock()

    def work(config: WorkerConfig, token: str, line: Connection, share: float) -> None:
        stop = _OF_A_RUN.stop = stops[token]
        _OF_A_RUN.first = max(2, round(share * template.iterations))
        code = 0
        try:
            stop.wait(share * _RAMP_S)
            storage = open_storage(config.config.storage, config.runs_dir, config.config.patience_s)
            owner = owner_name(os.getpid(), token)
            worker.Worker(config, storage, owner, line).work(cast("Any", _Interruption(stop)))
        except RunFailed as error:
            measured.failures.append(str(error))
            code = error.exit_code
        with lock:
            orders.send((token, code))

    while True:
        what, *order = orders.recv()
        if what == "start":
            stops[order[1]] = threading.Event()
            threading.Thread(target=work, args=order, daemon=True).start()
        elif what == "terminate":
            stops[order[0]].set()
        else:
            with lock:
                orders.send(("measured", measured))
            return


class _Interruption:
    """What a worker looks at to see whether it is asked to end."""

    def __init__(self, stop: threading.Event):
        self._stop = stop

    @property
    def signum(self) -> int | None:
        return 15 if self._stop.is_set() else None


class SimulatedWorker:
    """A thread as the driver sees it; attributes and methods as of `LocalWorker`."""

    is_seen = True

    def __init__(self, token: str, owner: str, line: Connection, orders: Connection):
        self.owner = owner
        self.exitcode: int | None = None
        self.ended = threading.Event()
        self._token, self._line, self._orders = token, line, orders

    def hear(self) -> Beat | None:
        """Return its newest sign of life."""
        return newest_beat(self._line)

    def answer(self, answer: Answer) -> None:
        """Answer that."""
        with contextlib.suppress(OSError):
            self._line.send(answer)

    def terminate(self) -> None:
        """Ask it to end."""
        self._orders.send(("terminate", self._token))

    def join(self, timeout_s: float) -> None:
        """Wait for its end."""
        self.ended.wait(timeout_s)

    def kill(self) -> None:
        """Leave it alone: it ends with its process."""
        self.exitcode = self.exitcode or -9


class SimulatedLauncher:
    """Starts simulated workers in a few processes; methods as of `LocalLauncher`."""

    cores = 1

    def __init__(self, workers: int, processes: int, template: Template):
        self.workers = workers
        context = multiprocessing.get_context("fork")
        self._lines = []
        self.processes = []
        for _ in range(processes):
            ours, theirs = context.Pipe()
            process = context.Process(target=serve, args=(theirs, template), daemon=True)
            process.start()
            self._lines.append(ours)
            self.processes.append(process)
        self._started: dict[str, SimulatedWorker] = {}
        self._numbers = itertools.count()
        self._measured = Measured()
        self._readers = [
            threading.Thread(target=self._read, args=(line,), daemon=True) for line in self._lines
        ]
        for reader in self._readers:
            reader.start()

    def folder(self, runs_dir: Path) -> Path:
        """Return the folder of runs."""
        return runs_dir

    def start(self, config: WorkerConfig, token: str) -> SimulatedWorker:
        """Start a worker; the first trials of all of them end at different times."""
        number = next(self._numbers)
        place = number % len(self._lines)
        ours, theirs = multiprocessing.Pipe()
        owner = owner_name(self.processes[place].pid or 0, token)
        self._started[token] = SimulatedWorker(token, owner, ours, self._lines[place])
        share = (number % self.workers + 1) / self.workers
        self._lines[place].send(("start", config, token, theirs, share))
        return self._started[token]

    def measured(self) -> Measured:
        """End the processes and return what they have measured."""
        for line in self._lines:
            line.send(("end",))
        for reader in self._readers:
            reader.join(60.0)
        return self._measured

    def _read(self, line: Connection) -> None:
        while True:
            token, what = line.recv()
            if token == "measured":
                self._measured.join(what)
                return
            self._started[token].exitcode = what
            self._started[token].ended.set()
