"""Projections of a run folder to TensorBoard and Weights & Biases, through TorchRL's loggers.

Metrics have the same names as in MLflow.
"""

import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from typing_extensions import override

from deepracer_exp.config.running import WandbTracking
from deepracer_exp.runs.run_files import TENSORBOARD, WANDB

from .mlflow_metrics import recordable_values
from .projection import RunProjection, files_to_keep
from .tracking_file import TrackedRun


class LoggerProjection(RunProjection):
    """The record of a run in a TorchRL logger; each process that records the run opens one of its own."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._logger: Any = None
        self._rows_logged, self._last_logged = 0, dict[str, float]()
        """Number of recorded rows of metrics.jsonl, and the values of the last one."""
        self._tags: dict[str, str] = {}
        self._is_closed = False

    @override
    def _project(self, tracked: TrackedRun) -> Mapping[str, str]:
        if self._is_closed:
            return {}
        if self._logger is None:
            self._open(tracked)
        for step, values in self._new_values(tracked):
            self._log(values, step)
        for key, value in tracked.tags.items():
            if self._tags.get(key) != value:
                self._tag(key, value)
        self._tags = tracked.tags
        if tracked.status is not None:
            self._close(tracked)
            self._is_closed = True
        return {}

    def _new_values(self, tracked: TrackedRun) -> Iterator[tuple[int, dict[str, float]]]:
        """Yield step and values of each row that the logger lacks at least in part."""
        # The last row is read again: it gets an evaluation when the run ends.
        for number, row in enumerate(self._rows(tracked), 1):
            if number < self._rows_logged:
                continue
            values = recordable_values(row)
            had = self._last_logged if number == self._rows_logged else {}
            if new := {key: value for key, value in values.items() if key not in had}:
                yield row["env_steps"], new
            self._rows_logged, self._last_logged = number, values

    def _open(self, tracked: TrackedRun) -> None:
        raise NotImplementedError

    def _log(self, values: Mapping[str, float], step: int) -> None:
        raise NotImplementedError

    def _tag(self, key: str, value: str) -> None:
        raise NotImplementedError

    def _close(self, tracked: TrackedRun) -> None:
        raise NotImplementedError


class TensorBoardProjection(LoggerProjection):
    """Event files in the run folder; each process that records the run writes them again."""

    kind = TENSORBOARD

    @override
    def _open(self, tracked: TrackedRun) -> None:
        from torchrl.record.loggers import get_logger

        shutil.rmtree(self.folder / TENSORBOARD, ignore_errors=True)
        self._logger = get_logger(TENSORBOARD, logger_name=str(self.folder), experiment_name=TENSORBOARD)
        rows = "\n".join(f"| {key} | {value} |" for key, value in tracked.params.items())
        self._logger.experiment.add_text("parameters", f"| key | value |\n|---|---|\n{rows}")

    @override
    def _log(self, values: Mapping[str, float], step: int) -> None:
        for key, value in values.items():
            self._logger.log_scalar(key, value, step=step)
        self._logger.experiment.flush()

    @override
    def _tag(self, key: str, value: str) -> None:
        self._logger.experiment.add_text(key, value)

    @override
    def _close(self, tracked: TrackedRun) -> None:
        self._logger.experiment.close()


class WandbProjection(LoggerProjection):
    """A run in Weights & Biases, which knows a resumed run by its id and a row by its step."""

    kind = WANDB

    def __init__(self, config: WandbTracking, folder: Path) -> None:
        super().__init__(folder)
        self._config = config
        self._first_step = 0

    @override
    def _open(self, tracked: TrackedRun) -> None:
        import wandb
        from torchrl.record.loggers import get_logger

        config = self._config
        run_id = re.sub(r"[^A-Za-z0-9_-]", "-", f"{tracked.experiment}-{self.folder.name}")[-128:]
        offline = config.mode == "offline"
        if offline:  # the new one will have all rows
            for earlier in (self.folder / WANDB).glob(f"offline-run-*-{run_id}"):
                shutil.rmtree(earlier, ignore_errors=True)
        self._logger = get_logger(
            WANDB,
            logger_name=str(self.folder),
            experiment_name=tracked.run_name,
            wandb_kwargs={
                "id": run_id,
                "project": config.project,
                "entity": config.entity,
                "group": tracked.experiment,
                "offline": offline,
                "log_env_packages": False,
                "settings": wandb.Settings(silent=True, console="off"),
            },
        )
        self._first_step = self._logger.experiment.step
        self._logger.log_hparams({**tracked.params, "tags": tracked.tags})

    @override
    def _log(self, values: Mapping[str, float], step: int) -> None:
        # Recorded steps cannot be changed.
        if step >= self._first_step:
            self._logger.log_metrics(values, step=step, override_global_step=True)

    @override
    def _tag(self, key: str, value: str) -> None:
        self._logger.experiment.summary[key] = value

    @override
    def _close(self, tracked: TrackedRun) -> None:
        for file, _ in files_to_keep(self.folder):
            if file.is_file():
                self._logger.experiment.save(str(file), base_path=str(file.parent), policy="now")
        # W&B waits without a limit for a server that does not answer; who waits for this process has one.
        self._logger.experiment.finish(0 if tracked.status == "FINISHED" else 1)
