"""The tracker that records a run, by `tracking.kind` or as a class of your own."""

import importlib.util
from pathlib import Path

from deepracer_exp.config.own_class import OwnClass, build_own
from deepracer_exp.config.running import MLflowTracking, TensorBoardTracking, TrackingConfig, TrackingOff
from deepracer_exp.errors import BadInput

from .loggers import TensorBoardTracker, WandbTracker
from .mlflow_tracker import MLflowTracker
from .store import resolve_store
from .tracker import Tracker


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
        return MLflowTracker(resolve_store(config.uri, runs_dir))
    if importlib.util.find_spec(config.kind) is None:
        raise BadInput(
            f"tracking={config.kind}: needs the package {config.kind}; install the project with its extra: "
            f"pip install 'deepracer-exp[{config.kind}]'"
        )
    return TensorBoardTracker() if isinstance(config, TensorBoardTracking) else WandbTracker(config)
