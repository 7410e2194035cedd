"""Trackers that write through TorchRL's loggers: TensorBoard and Weights & Biases.

Metrics have the same names as in MLflow.
"""

import logging
import math
import re
import shutil
import threading
from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from typing_extensions import override

from deepracer_exp.config.running import WandbTracking
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.files import TENSORBOARD, WANDB

from .metadata import Scalar, param_text
from .metrics import Point, now_ms, points_of
from .tracker import FINISH_S, Tracker
from .tracking_file import Status, read_tracked_run

_log = logging.getLogger(__name__)


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
