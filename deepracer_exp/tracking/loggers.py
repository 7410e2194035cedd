"""The tracker of a run: by `tracking.kind`, here those that write through TorchRL's loggers, or a class of your own.

Metrics have the same names as in MLflow.
"""

import importlib.util
import logging
import re
import shutil
import threading
from collections import deque
from collections.abc import Mapping
from pathlib import Path

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
from deepracer_exp.patience import ends, wait_patiently
from deepracer_exp.runs.files import TENSORBOARD, WANDB

from .metrics import recordable_values
from .mlflow_process import RemoteRun
from .mlflow_tracker import MLflowTracker
from .store import resolve_store
from .tracker import FINISH_S, Tracker
from .tracking_file import Status, TrackedRun

_log = logging.getLogger(__name__)


class TensorBoardTracker(Tracker):
    """Writes event files into the run folder; a resumed run writes them again from its metrics.jsonl."""

    @override
    def open(self, folder: Path, run: TrackedRun) -> None:
        from torchrl.record.loggers import get_logger

        try:
            shutil.rmtree(folder / TENSORBOARD, ignore_errors=True)
            self._logger = get_logger(TENSORBOARD, logger_name=str(folder), experiment_name=TENSORBOARD)
        except OSError as error:
            raise BadInput(
                "tracking=tensorboard", f"{folder / TENSORBOARD}: cannot be written: {error.strerror}"
            ) from error
        rows = "\n".join(f"| {key} | {value} |" for key, value in run.params.items())
        self._logger.experiment.add_text("parameters", f"| key | value |\n|---|---|\n{rows}")
        for key, value in run.tags.items():
            self.set_tag(key, value)

    @override
    def log(self, metrics: Mapping[str, float | None], step: int) -> None:
        for key, value in recordable_values(metrics).items():
            self._logger.log_scalar(key, value, step=step)

    @override
    def set_tag(self, key: str, value: str) -> None:
        self._logger.experiment.add_text(key, value)

    @override
    def finish(self, status: Status, deadline_s: float = FINISH_S) -> None:
        self._logger.experiment.close()


class WandbTracker(Tracker):
    """Records a run in Weights & Biases, which knows a resumed run by its id and a row by its step.

    Rows wait until a checkpoint covers them, because recorded steps cannot be changed.
    """

    def __init__(self, config: WandbTracking) -> None:
        self._config = config
        self._held: deque[tuple[int, dict[str, float]]] = deque()
        """Steps and values of the rows that wait."""

    @override
    def open(self, folder: Path, run: TrackedRun) -> None:
        import wandb
        from torchrl.record.loggers import get_logger

        config, run_id = (
            self._config,
            re.sub(r"[^A-Za-z0-9_-]", "-", f"{run.experiment}-{folder.name}")[-128:],
        )
        offline = config.mode == "offline"
        if offline:  # the new one will have all rows
            for earlier in (folder / WANDB).glob(f"offline-run-*-{run_id}"):
                shutil.rmtree(earlier, ignore_errors=True)
        try:
            self._logger = get_logger(
                WANDB,
                logger_name=str(folder),
                experiment_name=run.run_name,
                wandb_kwargs={
                    **{
                        "id": run_id,
                        "project": config.project,
                        "entity": config.entity,
                        "group": run.experiment,
                    },
                    **{"offline": offline, "log_env_packages": False},
                    "settings": wandb.Settings(silent=True, console="off"),
                },
            )
        except (wandb.Error, OSError) as error:
            reason = " ".join(str(error).split())[:300]
            raise BadInput(
                "tracking=wandb",
                reason,
                "a machine that is logged in (`wandb login`), or tracking.mode=offline",
            ) from error
        self._first_step = self._logger.experiment.step
        self._logger.log_hparams({**run.params, "tags": run.tags})

    @override
    def log(self, metrics: Mapping[str, float | None], step: int) -> None:
        if step >= self._first_step:
            self._held.append((step, recordable_values(metrics)))

    @override
    def safe_until(self, step: int) -> None:
        while self._held and self._held[0][0] <= step:
            covered, values = self._held.popleft()
            self._logger.log_metrics(values, step=covered, override_global_step=True)

    @override
    def log_artifact(self, path: Path, folder: str | None = None) -> None:
        if path.is_file():
            self._logger.experiment.save(str(path), base_path=str(path.parent), policy="now")

    @override
    def set_tag(self, key: str, value: str) -> None:
        self._logger.experiment.summary[key] = value

    @override
    def finish(self, status: Status, deadline_s: float = FINISH_S) -> None:
        if status == "FINISHED":
            self.safe_until(2**62)
        # W&B waits without a limit for a server that does not answer.
        code = 0 if status == "FINISHED" else 1
        ending = threading.Thread(target=self._logger.experiment.finish, args=(code,), daemon=True)
        ending.start()
        wait_patiently(ends(ending), deadline_s)
        if ending.is_alive():
            self.failure = "W&B does not answer; `wandb sync` in the run folder uploads what is missing"
            _log.warning(self.failure)


def open_tracker(config: TrackingConfig, runs_dir: Path) -> Tracker:
    """Return the tracker of a config.

    Raises:
        BadInput: `tracking.uri` can never work, a package is not installed, or a class cannot be used.
    """
    if isinstance(config, OwnClass):
        return build_own(config, "tracking.target", Tracker)
    if isinstance(config, TrackingOff):
        return Tracker()
    if isinstance(config, MLflowTracking):
        return MLflowTracker(resolve_store(config.uri, runs_dir), RemoteRun)
    if importlib.util.find_spec(config.kind) is None:
        raise BadInput(
            f"tracking={config.kind}: needs the package {config.kind}; install the project with its extra: "
            f"pip install 'deepracer-exp[{config.kind}]'"
        )
    return TensorBoardTracker() if isinstance(config, TensorBoardTracking) else WandbTracker(config)
