"""Hundreds of AWS-DeepRacer-style racing experiments a day."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from deepracer_exp.evaluation.results import Evaluation
    from deepracer_exp.training.stopping.stopping_rules import Decision, StoppingRule
    from deepracer_exp.training.train_result import TrainResult

    from .agents.algorithm import Algorithm, UpdateMetrics
    from .agents.ppo import PPO
    from .agents.schedules import Schedule
    from .api import (
        ComposedExperiment,
        RunTables,
        compose,
        evaluate,
        load_policy,
        make_env,
        read_run,
        resume,
        train,
    )
    from .env.observation import ObservationPart
    from .env.race_env import RaceEnv
    from .errors import BadInput, RunFailed
    from .tracking.tracker import Tracker
    from .training.trainer import Callback, Trainer

__version__ = "0.1.0"
__all__ = [
    "PPO",
    "Algorithm",
    "BadInput",
    "Callback",
    "ComposedExperiment",
    "Decision",
    "Evaluation",
    "ObservationPart",
    "RaceEnv",
    "RunFailed",
    "RunTables",
    "Schedule",
    "StoppingRule",
    "Tracker",
    "TrainResult",
    "Trainer",
    "UpdateMetrics",
    "__version__",
    "compose",
    "evaluate",
    "load_policy",
    "make_env",
    "read_run",
    "resume",
    "train",
]
_MODULES = {
    "agents.algorithm": ("Algorithm", "UpdateMetrics"),
    "agents.ppo": ("PPO",),
    "agents.schedules": ("Schedule",),
    "env.observation": ("ObservationPart",),
    "env.race_env": ("RaceEnv",),
    "errors": ("BadInput", "RunFailed"),
    "evaluation.results": ("Evaluation",),
    "training.stopping.stopping_rules": ("Decision", "StoppingRule"),
    "tracking.tracker": ("Tracker",),
    "training.train_result": ("TrainResult",),
    "training.trainer": ("Callback", "Trainer"),
}
"""The module of each class; a worker process imports only those whose classes the user's own classes derive from."""


def __getattr__(name: str) -> Any:
    # Imported on first use: torch takes seconds to import, and the command line need not wait for it.
    if name in __all__:
        module = next((module for module, names in _MODULES.items() if name in names), "api")
        return getattr(import_module(f"deepracer_exp.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
