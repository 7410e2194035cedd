"""How a policy is evaluated (`conf/evaluation/`), and the entry points of evaluate and export."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from .bounds import Natural, NonNegative, UpTo1000

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


@dataclass(frozen=True, kw_only=True)
class CarPictureConfig:
    """How the car turns its camera's 640x480 into what a model sees."""

    jpeg_quality: Annotated[int, Field(ge=1, le=100)] | None
    """Of the frames between the car's programs; null: they are not compressed, as in AWS's software."""


@dataclass(frozen=True, kw_only=True)
class CarTimingConfig:
    """When the car sees and acts."""

    frames_per_s: Annotated[float, Field(ge=5, le=60, allow_inf_nan=False)]
    """The car acts once a frame."""
    latency_s: Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False)]
    """From the exposure of a frame to the turn of the wheels."""


@dataclass(frozen=True, kw_only=True)
class CarControlsConfig:
    """What the car makes of actions, see `aws.models.car_controls`."""

    full_lock_deg: Annotated[float, Field(gt=0, le=30, allow_inf_nan=False)]
    """Angle of the wheels at full lock."""
    full_throttle_mps: Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)] | None
    """Speed at full throttle; null: that of the fastest action."""


@dataclass(frozen=True, kw_only=True)
class RealCarConfig:
    """How the physical car sees and acts; a part that is null is as in the simulator."""

    picture: CarPictureConfig | None
    timing: CarTimingConfig | None
    controls: CarControlsConfig | None


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig:
    """What a trial is, how many there are, and on which tracks and conditions."""

    laps: UpTo1000 | None
    """Completed laps that end a trial; null: as many as fit into `time_s`."""
    time_s: Seconds
    """Duration of a trial, penalties included; a lap that is not complete by then does not count."""
    resets_per_lap: Natural
    """How often in a lap the car is put back at its last progress, standing; after one more the lap has failed."""
    failed_lap: Literal["ends_trial", "restarts_lap"]
    """After a failed lap the trial ends, or the car starts a new lap, standing."""
    penalty_s: PenaltyConfig
    trials: Trials
    """Number of trials on each track, for each of `usual` and `held_out`."""
    starts: Annotated[tuple[Share, ...], Field(min_length=1, max_length=4096)] | None
    """Where laps start, as shares of the lap, used by the trials in turn; null: spread evenly."""
    tracks: Annotated[tuple[str, ...], Field(min_length=1)] | str | None
    """Options of `track`, or `all`; null: those of the run."""
    usual: str | None
    """Option of `randomization`; null: the run's own."""
    held_out: str | None
    """Option of `randomization` that the policy was not trained on; null: only `usual` is driven."""
    sample: bool
    """Sample actions as in training; false: the most probable action, of a continuous policy the mean."""
    seed: Annotated[int, Field(ge=0, lt=2**31)]
    """Seed of the conditions: the same for every checkpoint, so that they can be compared."""
    real_car: RealCarConfig | None = None
    """How the car sees and acts; null: as the simulator does."""


@dataclass(frozen=True, kw_only=True)
class StoreConfig:
    """The MLflow store in which ids and aliases are looked up."""

    uri: str | None
    """null: the one in `runs_dir`."""


@dataclass(frozen=True, kw_only=True)
class StoredRunConfig:
    """A stored run, where it is looked up, and which of its checkpoints is meant."""

    run: Annotated[str, Field(min_length=1)]
    """The run: a folder, its name under `runs_dir` or the beginning of it, MLflow's id, `best:EXPERIMENT`, or the alias
    of a registered model."""
    checkpoint: Annotated[str, Field(min_length=1)] | None
    """`best`, `last` or an iteration; null: the one of the alias that names the run, else `best`."""
    runs_dir: Annotated[str, Field(min_length=1)]
    tracking: StoreConfig
    debug: bool


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig(StoredRunConfig):
    """The request of `deepracer-exp evaluate`."""

    evaluation: EvaluationConfig


@dataclass(frozen=True, kw_only=True)
class ExportConfig(StoredRunConfig):
    """The request of `deepracer-exp export`."""

    format: Literal["onnx", "car", "aws", "aws-model", "aws-logs"]
    """The network as a file or as an archive for a car, the files that AWS trains from, with the weights as well, or
    the run's logs as AWS writes them."""
    layout: Literal["console", "deepracer-for-cloud"]
    """The folder layout of `aws-logs`."""
