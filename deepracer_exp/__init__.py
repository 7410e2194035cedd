"""Hundreds of AWS-DeepRacer-style racing experiments a day."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .agents.ppo import PPO, Algorithm
    from .agents.schedules import Schedule
    from .api import (
        Callback,
        ComposedExperiment,
        Evaluation,
        RaceEnv,
        RunTables,
        Trainer,
        TrainResult,
        compose,
        evaluate,
        load_policy,
        make_env,
        read_run,
        train,
    )
    from .env.observation import ObservationPart
    from .runs.convergence import Decision, StoppingRule
    from .tracking.tracker import Tracker

__version__ = "0.1.0"
__all__ = [
    "PPO",
    "Algorithm",
    "Callback",
    "ComposedExperiment",
    "Decision",
    "Evaluation",
    "ObservationPart",
    "RaceEnv",
    "RunTables",
    "Schedule",
    "StoppingRule",
    "Tracker",
    "TrainResult",
    "Trainer",
    "__version__",
    "compose",
    "evaluate",
    "load_policy",
    "make_env",
    "read_run",
    "train",
]
_BASES = {
    "PPO": "agents.ppo",
    "Algorithm": "agents.ppo",
    "Decision": "runs.convergence",
    "ObservationPart": "env.observation",
    "Schedule": "agents.schedules",
    "StoppingRule": "runs.convergence",
    "Tracker": "tracking.tracker",
}
"""Modules of what classes of the user's own derive from; worker processes import no more than these."""


def __getattr__(name: str) -> Any:
    # Not before they are asked for: torch takes seconds to import, and the command line answers before that.
    if name in __all__:
        return getattr(import_module(f"deepracer_exp.{_BASES.get(name, 'api')}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
