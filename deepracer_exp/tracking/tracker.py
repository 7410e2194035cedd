"""Trackers: what a training reports about its run, and who records it.

MLflow is written by a thread of our own, so that the training never waits; TensorBoard and W&B by TorchRL's loggers,
with the same names of metrics. Both are written from the run folder alone: a resumed run logs its rows again, so that
nothing has to be read back.
"""

import importlib.util
import logging
import math
import re
import shutil
import threading
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from typing_extensions import override

from deepracer_exp.config.own_class import OwnClass, build_own
from deepracer_exp.config.running import (
    MLflowTracking,
    TensorBoardTracking,
    TrackingConfig,
    TrackingOff,
    WandbTracking,
)
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.files import SUMMARY, TENSORBOARD, WANDB, read_object

from .calls import StoreRefusedError
from .metadata import END_TAG, Scalar, param_text
from .metrics import Point, now_ms, points_of
from .store import Store, resolve_store
from .store_thread import StoreThread
from .tracking_file import Status, TrackedRun, TrackingFile, read_tracked_run

if TYPE_CHECKING:
    from .mlflow_run import MLflowRun

_log = logging.getLogger(__name__)

_POINTS_PER_CALL = 1000
FINISH_S = 30.0
"""How long the end of a run waits for its store."""


class Tracker:
    """Records one run. This base class of all trackers, yours included, records nothing (`tracking=off`).

    No method waits for a store, except `finish`. Each metric is recorded once per step, even if processes are killed
    and resumed: points wait until a checkpoint covers them (`safe_until`), so that no resumed run contradicts them,
    and a resumed run (`reopen`) logs all rows of its metrics.jsonl again, of which only the missing ones are written.
    """

    failure: str | None = None
    """After `finish`: what was not recorded, and why, in one sentence; None: everything was."""

    @property
    def run_id(self) -> str | None:
        """Id of the run in MLflow, once it exists."""
        return None

    @property
    def outage(self) -> str | None:
        """Why the store does not answer at the moment, for which `finish` waits; None: it does."""
        return None

    def start(
        self,
        run_name: str,
        experiment: str,
        params: Mapping[str, Scalar],
        tags: Mapping[str, str],
        identity: Path,
    ) -> None:
        """Start a new run; either this or `reopen` is called first, once.

        Args:
            run_name: shown for the run.
            experiment: that the run belongs to.
            params: by which runs are compared.
            tags: of the run.
            identity: its `tracking.json`, which is written.

        Raises:
            BadInput: the run cannot be recorded.
        """

    def reopen(self, identity: Path) -> None:
        """Continue the run of `identity`, its `tracking.json`.

        Raises:
            BadInput: the file is missing or invalid, or the run cannot be recorded.
        """

    def log(self, metrics: Mapping[str, float | None], step: int) -> None:
        """Record a row of metrics.jsonl at `step` (env steps), without None, NaN and infinite values."""

    def log_machine(self, use: Mapping[str, float], step: int) -> None:
        """Record the use of the machine at `step`, which is not part of the run's record."""

    def safe_until(self, step: int) -> None:
        """Report that a checkpoint covers all steps until `step`: no resumed run will start before it."""

    def log_artifact(self, path: Path, folder: str | None = None) -> None:
        """Store a file, or all files of a folder, with the run.

        It is read later: `path` must not change until `finish` has returned.
        """

    def set_tag(self, key: str, value: str) -> None:
        """Set a tag of the run."""

    def finish(self, status: Status, deadline_s: float = FINISH_S) -> int:
        """Write what is left for at most `deadline_s`, end the run and return the number of lost points.

        A failed or killed run may be resumed from its last checkpoint: later points are not written.
        """
        return 0


class MLflowTracker(Tracker):
    """Records one run in MLflow; what the store lacks in the end can be recorded later from the run folder."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._file: TrackingFile
        self._lock = threading.Lock()
        self._held: deque[tuple[Point, ...]] = deque()
        """Rows that no checkpoint covers yet."""
        self._ready: deque[Point] = deque()
        self._safe_step: float = -math.inf
        self._logged = 0
        self._recorded = 0
        self._thread = StoreThread(store, "the training continues")

    @property
    @override
    def run_id(self) -> str | None:
        return self._thread.run.run_id if self._thread.run else None

    @property
    @override
    def outage(self) -> str | None:
        reason = self._thread.outage
        return None if reason is None else f"MLflow ({self._store.shown}): {reason}"

    @property
    def waiting(self) -> int:
        """Metric points logged and not yet recorded."""
        with self._lock:
            return self._logged - self._recorded

    @override
    def start(
        self,
        run_name: str,
        experiment: str,
        params: Mapping[str, Scalar],
        tags: Mapping[str, str],
        identity: Path,
    ) -> None:
        texts = {key: param_text(value) for key, value in params.items()}
        tracked = TrackedRun(None, run_name, experiment, now_ms(), self._store.shown, texts, dict(tags))
        self._begin(
            TrackingFile(identity, tracked), lambda run, tracked, again: run.create(tracked, again=again)
        )

    @override
    def reopen(self, identity: Path) -> None:
        file = TrackingFile.read(identity, self._store.shown)
        tags = {key: value for key, value in file.run.tags.items() if key != END_TAG}
        file.change(status=None, end_ms=None, complete=False, files={}, tags=tags)
        self._begin(file, lambda run, tracked, _: run.reopen(tracked))

    @override
    def log(self, metrics: Mapping[str, float | None], step: int) -> None:
        if points := points_of(metrics, step, self._file.run.start_ms):
            with self._lock:
                self._logged += len(points)
                self._held.append(points)
            self._release()

    @override
    def log_machine(self, use: Mapping[str, float], step: int) -> None:
        self.log(use, step)

    @override
    def safe_until(self, step: float) -> None:
        self._safe_step = max(self._safe_step, step)
        self._release()

    @override
    def log_artifact(self, path: Path, folder: str | None = None) -> None:
        self._file.add_file(path, folder)
        self._thread.put(f"file {path}", lambda run, _: run.log_artifact(path, folder))

    @override
    def set_tag(self, key: str, value: str) -> None:
        self._file.add_tag(key, value)
        self._thread.put(f"tag {key}", lambda run, _: run.set_tags({key: value}))

    @override
    def finish(self, status: Status, deadline_s: float = FINISH_S) -> int:
        end_ms = now_ms()
        self._file.change(status=status, end_ms=end_ms)
        if status == "FINISHED":
            self.safe_until(math.inf)
        if summary := read_object(self._file.folder / SUMMARY):
            self._thread.put("the result", lambda run, _: run.conclude(self._file.run, summary))
        is_ended = self._thread.finish(lambda run, _: run.end(status, end_ms), deadline_s)
        lost = self.waiting - sum(map(len, self._held))
        complete = is_ended and not lost and self._thread.refusal is None
        if not complete:
            reason = self._thread.refusal or self._thread.outage or f"no answer within {deadline_s:g} s"
            what = f"{lost:,} of {self._logged:,} metric points were" if lost else "some of this run was"
            self.failure = f"MLflow ({self._store.shown}): {what} not recorded: {reason}"
            if not self._thread.is_rejected:  # which was logged
                _log.warning("%s; the run folder has everything", self.failure)
        self._file.change(complete=complete)
        return lost

    def _begin(self, file: TrackingFile, open_run: Callable[["MLflowRun", TrackedRun, bool], None]) -> None:
        self._file = file

        def begin(run: "MLflowRun", again: bool) -> None:
            open_run(run, file.run, again)
            file.change(run_id=run.run_id)

        self._thread.put("the run", begin, vital=True)
        self._thread.put("the parameters", lambda run, _: run.log_params(file.run.params))

    def _release(self) -> None:
        """Record the rows that a checkpoint covers."""
        with self._lock:
            while self._held and self._held[0][-1][-1] <= self._safe_step:
                self._ready.extend(self._held.popleft())
            if not self._ready:
                return
        self._thread.put("metrics", self._write_points)

    def _write_points(self, run: "MLflowRun", _: bool) -> None:
        while True:
            with self._lock:
                points = [self._ready[i] for i in range(min(len(self._ready), _POINTS_PER_CALL))]
            if not points:
                return
            refusal: StoreRefusedError | None = None
            try:
                run.log_metrics(points)
            except StoreRefusedError as error:
                refusal = error
            with self._lock:
                for _point in points:
                    self._ready.popleft()
                self._recorded += 0 if refusal else len(points)
            if refusal is not None:
                raise refusal


class LoggerTracker(Tracker):
    """Records a run through a logger of TorchRL, which writes in the background itself."""

    def __init__(self) -> None:
        self._logger: Any = None
        self._start_ms = now_ms()

    @override
    def start(
        self,
        run_name: str,
        experiment: str,
        params: Mapping[str, Scalar],
        tags: Mapping[str, str],
        identity: Path,
    ) -> None:
        self._open(run_name, experiment, identity.parent)
        self._describe({key: param_text(value) for key, value in params.items()}, tags)

    @override
    def reopen(self, identity: Path) -> None:
        run = read_tracked_run(identity)
        self._start_ms = run.start_ms
        self._open(run.run_name, run.experiment, identity.parent)
        self._describe(run.params, run.tags)

    @override
    def log(self, metrics: Mapping[str, float | None], step: int) -> None:
        self._write(points_of(metrics, step, self._start_ms))

    @abstractmethod
    def _open(self, run_name: str, experiment: str, run_dir: Path) -> None:
        """Open the logger of a run, new or resumed."""

    @abstractmethod
    def _describe(self, params: Mapping[str, str], tags: Mapping[str, str]) -> None:
        """Record what describes the run besides its metrics."""

    @abstractmethod
    def _write(self, points: tuple[Point, ...]) -> None:
        """Record the points of one row."""


class TensorBoardTracker(LoggerTracker):
    """Writes event files into the run folder; a resumed run writes them again from its metrics.jsonl."""

    @override
    def _open(self, run_name: str, experiment: str, run_dir: Path) -> None:
        from torchrl.record.loggers import get_logger

        try:
            shutil.rmtree(run_dir / TENSORBOARD, ignore_errors=True)
            self._logger = get_logger(TENSORBOARD, logger_name=str(run_dir), experiment_name=TENSORBOARD)
        except OSError as error:
            raise BadInput(
                f"tracking=tensorboard: {run_dir / TENSORBOARD}: cannot be written: {error.strerror}"
            ) from error

    @override
    def _describe(self, params: Mapping[str, str], tags: Mapping[str, str]) -> None:
        rows = "\n".join(f"| {key} | {value} |" for key, value in params.items())
        self._logger.experiment.add_text("parameters", f"| key | value |\n|---|---|\n{rows}")
        for key, value in tags.items():
            self.set_tag(key, value)

    @override
    def _write(self, points: tuple[Point, ...]) -> None:
        for key, value, _, step in points:
            self._logger.log_scalar(key, value, step=step)

    @override
    def set_tag(self, key: str, value: str) -> None:
        self._logger.experiment.add_text(key, value)

    @override
    def finish(self, status: Status, deadline_s: float = FINISH_S) -> int:
        self._logger.experiment.close()
        return 0


class WandbTracker(LoggerTracker):
    """Records a run in Weights & Biases, which knows a resumed run by its id and a row by its step.

    Rows wait until a checkpoint covers them, because recorded steps cannot be changed.
    """

    def __init__(self, config: WandbTracking) -> None:
        super().__init__()
        self._config = config
        self._held: list[tuple[Point, ...]] = []
        self._safe_step: float = -math.inf
        self._first_step = 0

    @override
    def _open(self, run_name: str, experiment: str, run_dir: Path) -> None:
        import wandb
        from torchrl.record.loggers import get_logger

        config, run_id = self._config, re.sub(r"[^A-Za-z0-9_-]", "-", f"{experiment}-{run_dir.name}")[-128:]
        offline = config.mode == "offline"
        if offline:  # the new one will have all rows
            for earlier in (run_dir / WANDB).glob(f"offline-run-*-{run_id}"):
                shutil.rmtree(earlier, ignore_errors=True)
        try:
            self._logger = get_logger(
                WANDB,
                logger_name=str(run_dir),
                experiment_name=run_name,
                wandb_kwargs={
                    **{"id": run_id, "project": config.project, "entity": config.entity, "group": experiment},
                    **{"offline": offline, "log_env_packages": False},
                    "settings": wandb.Settings(silent=True, console="off"),
                },
            )
        except (wandb.Error, OSError) as error:
            reason = " ".join(str(error).split())[:300]
            raise BadInput(
                f"tracking=wandb: {reason}; accepted: a machine that is logged in (`wandb login`), or "
                "tracking.mode=offline"
            ) from error
        self._first_step = self._logger.experiment.step

    @override
    def _describe(self, params: Mapping[str, str], tags: Mapping[str, str]) -> None:
        self._logger.log_hparams({**params, "tags": dict(tags)})

    @override
    def _write(self, points: tuple[Point, ...]) -> None:
        if points and points[0][-1] >= self._first_step:
            self._held.append(points)
            self._release()

    @override
    def safe_until(self, step: int) -> None:
        self._safe_step = max(self._safe_step, step)
        self._release()

    def _release(self) -> None:
        while self._held and self._held[0][0][-1] <= self._safe_step:
            row = self._held.pop(0)
            self._logger.log_metrics(
                {key: value for key, value, *_ in row}, step=row[0][-1], override_global_step=True
            )

    @override
    def log_artifact(self, path: Path, folder: str | None = None) -> None:
        if path.is_file():
            self._logger.experiment.save(str(path), base_path=str(path.parent), policy="now")

    @override
    def set_tag(self, key: str, value: str) -> None:
        self._logger.experiment.summary[key] = value

    @override
    def finish(self, status: Status, deadline_s: float = FINISH_S) -> int:
        if status == "FINISHED":
            self.safe_until(2**62)
        # W&B waits without a limit for a server that does not answer.
        code = 0 if status == "FINISHED" else 1
        ending = threading.Thread(target=self._logger.experiment.finish, args=(code,), daemon=True)
        ending.start()
        ending.join(deadline_s)
        if ending.is_alive():
            self.failure = "W&B does not answer; `wandb sync` in the run folder uploads what is missing"
            _log.warning(self.failure)
        return 0


def open_tracker(config: TrackingConfig, runs_dir: Path) -> Tracker:
    """Return the tracker of a config; MLflow is loaded in the background.

    Raises:
        BadInput: `tracking.uri` can never work, a package is not installed, or a class cannot be used.
    """
    if isinstance(config, OwnClass):
        return build_own(config, "tracking.target", Tracker)
    if isinstance(config, TrackingOff):
        return Tracker()
    if isinstance(config, MLflowTracking):
        return MLflowTracker(resolve_store(config.uri, runs_dir))
    if importlib.util.find_spec(config.kind) is None:
        raise BadInput(
            f"tracking={config.kind}: needs the package {config.kind}; install the project with its extra: "
            f"pip install 'deepracer-exp[{config.kind}]'"
        )
    return TensorBoardTracker() if isinstance(config, TensorBoardTracking) else WandbTracker(config)
