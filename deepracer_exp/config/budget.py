"""What a run, and all runs of an experiment together, may use up (`conf/budget/`)."""

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from .bounds import Count, Positive

EnvironmentVariable = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
Percent = Annotated[int, Field(ge=1, le=100)]


@dataclass(frozen=True, kw_only=True)
class BudgetConfig:
    """Limits that end a run; null means none. The first one reached ends it."""

    env_steps: Count | None
    iterations: Count | None
    minutes: Positive | None
    max_cost: Positive | None
    """In the currency of `price_per_hour`."""
    experiment_env_steps: Count | None
    """This and the next two: of all runs of the same name in `runs_dir` together."""
    experiment_minutes: Positive | None
    experiment_max_cost: Positive | None
    price_per_hour: Positive | None
    """Of the machine; what a run costs is only known with it."""
    alerts: tuple[Percent, ...]
    """Per cent of a limit at which it is told."""
    alert_command: Annotated[str, Field(min_length=1)] | None
    """A program and its arguments, no shell; the message and the run's folder are added as two more."""
    alert_webhook: EnvironmentVariable | None
    """The environment variable that holds the address: an address is a secret, and this file is kept."""

    def __post_init__(self) -> None:
        """Refuse a run without an end, and costs that nobody can know."""
        ends = ("env_steps", "iterations", "minutes", "max_cost")
        limits = (*ends, *(f"experiment_{name}" for name in ends if name != "iterations"))
        if all(getattr(self, name) is None for name in limits):
            raise ValueError(f"{', '.join(limits)} are all null; at least one must end the run")
        for name in ("max_cost", "experiment_max_cost"):
            if getattr(self, name) is not None and self.price_per_hour is None:
                raise ValueError(
                    f"{name} is {getattr(self, name):g} and price_per_hour null; give the price as well"
                )
