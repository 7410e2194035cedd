"""Evaluation protocols (`conf/evaluation/`), and the entry point of evaluate."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from .bounds import Natural, NonNegative, UpTo1000
from .driving import FullLock, JpegQuality, Latency

Trials = Annotated[int, Field(ge=1, le=4096)]
Share = Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)]
# More than an hour of driving in one trial is a mistake of units.
Seconds = Annotated[float, Field(gt=0, le=3600, allow_inf_nan=False)]


@dataclass(frozen=True, kw_only=True)
class PenaltyConfig:
    """Seconds added to the lap each time the car is put back."""

    off_track: NonNegative
    reversed: NonNegative
    immobilized: NonNegative
    crashed: NonNegative = 0.0


@dataclass(frozen=True, kw_only=True)
class CarPictureConfig:
    """The car's conversion of 640x480 camera frames to a model's pictures."""

    jpeg_quality: JpegQuality | None


@dataclass(frozen=True, kw_only=True)
class CarTimingConfig:
    """Timing of the car's frames and commands."""

    frames_per_s: Annotated[float, Field(ge=5, le=60, allow_inf_nan=False)]
    latency_s: Latency


@dataclass(frozen=True, kw_only=True)
class CarControlsConfig:
    """The car's response to actions, see `aws.models.car_controls`."""

    full_lock_deg: FullLock
    full_throttle_mps: Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)] | None


@dataclass(frozen=True, kw_only=True)
class RealCarConfig:
    """The physical car's camera, timing and controls; a part that is null is as in the simulator."""

    picture: CarPictureConfig | None
    timing: CarTimingConfig | None
    controls: CarControlsConfig | None


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig:
    """The protocol: kind and number of trials, tracks and conditions."""

    laps: UpTo1000 | None
    time_s: Seconds
    resets_per_lap: Natural
    failed_lap: Literal["ends_trial", "restarts_lap"]
    penalty_s: PenaltyConfig
    trials: Trials
    starts: Annotated[tuple[Share, ...], Field(min_length=1, max_length=4096)] | None
    tracks: Annotated[tuple[str, ...], Field(min_length=1)] | str | None
    usual: str | None
    held_out: str | None
    sample: bool
    seed: Annotated[int, Field(ge=0, lt=2**31)]
    race: str | None = None
    real_car: RealCarConfig | None = None


@dataclass(frozen=True, kw_only=True)
class StoreConfig:
    """The MLflow store in which ids and aliases are looked up."""

    uri: str | None


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig:
    """The request of `deepracer-exp evaluate`: protocol, checkpoint, and where to look up the run."""

    evaluation: EvaluationConfig
    checkpoint: Annotated[str, Field(min_length=1)] | None
    rival: Annotated[str, Field(min_length=1)] | None
    rival_checkpoint: Annotated[str, Field(min_length=1)] | None
    runs_dir: Annotated[str, Field(min_length=1)]
    tracking: StoreConfig
    debug: bool

    def __post_init__(self) -> None:
        """Refuse a rival's checkpoint without a rival."""
        if self.rival_checkpoint is not None and self.rival is None:
            raise ValueError(
                f"rival_checkpoint={self.rival_checkpoint}: of which run? accepted: with rival=RUN, or null"
            )
