"""How a trained policy is put to the test (`conf/evaluation/`), and the entry point that does it."""

import re
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from .bounds import Natural, NonNegative, UpTo1000

Trials = Annotated[int, Field(ge=1, le=4096)]
Share = Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)]
# An hour and more of driving in one trial is a mistake of units.
Seconds = Annotated[float, Field(gt=0, le=3600, allow_inf_nan=False)]


def checkpoint_name(name: str) -> str:
    """Return a name that a checkpoint may have."""
    if not re.fullmatch(r"best|last|\d{1,9}", name):
        raise ValueError("a checkpoint is best, last or the number of an iteration")
    return name


@dataclass(frozen=True, kw_only=True)
class PenaltyConfig:
    """Seconds added to the lap for each time the car is put back."""

    off_track: NonNegative
    reversed: NonNegative
    immobilized: NonNegative


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig:
    """What a trial is, how many there are and on what."""

    laps: UpTo1000 | None
    """Completed laps that end a trial; null: as many as fit into `time_s`."""
    time_s: Seconds
    """Race clock of a trial, penalties included; a lap that is not complete by then does not count."""
    resets_per_lap: Natural
    """How often a lap the car is put back at its last progress, standing; the fault after that fails the lap."""
    failed_lap: Literal["ends_trial", "starts_anew"]
    """After a failed lap the trial is over, or the car begins the next lap, standing."""
    penalty_s: PenaltyConfig
    trials: Trials
    """On each track, on each of `usual` and `held_out`."""
    starts: Annotated[tuple[Share, ...], Field(min_length=1, max_length=4096)] | None
    """Where laps begin, as shares of the lap, the trials taking them in turn; null: spread evenly."""
    tracks: Annotated[tuple[str, ...], Field(min_length=1)] | str | None
    """Options of `track`, or `all`; null: those of the run."""
    usual: str | None
    """Option of `randomization`; null: the run's own."""
    held_out: str | None
    """Option of `randomization` that the policy was not trained on; null: only `usual` is driven."""
    sample: bool
    """Draw actions as in training; false: the most probable one, of a continuous policy the mean."""
    seed: Annotated[int, Field(ge=0, lt=2**31)]
    """Of what the conditions draw: the same for every checkpoint, so that they can be compared."""


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig:
    """What `deepracer-exp evaluate` is asked for."""

    run: Annotated[str, Field(min_length=1)]
    """Folder, its name under `runs_dir` or the beginning of it, MLflow's id, `best:EXPERIMENT`, or the alias of a
    registered model."""
    checkpoint: Annotated[str, AfterValidator(checkpoint_name)] | None
    """`best`, `last` or an iteration; null: what the alias names that the run is given by, else `best`."""
    runs_dir: Annotated[str, Field(min_length=1)]
    tracking_uri: str | None
    """MLflow store in which ids and aliases are looked up; null: the one in `runs_dir`."""
    debug: bool
    evaluation: EvaluationConfig
