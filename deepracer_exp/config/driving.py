"""What the car may do, sees, suffers and is paid for."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from .bounds import Finite, Fraction, Natural, NonNegative, Positive, Seconds, UpTo100

SpeedMps = Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]
SteeringDeg = Annotated[float, Field(ge=-60, le=60, allow_inf_nan=False)]


@dataclass(frozen=True, kw_only=True)
class DiscreteAction:
    """One choice of a discrete action space, in the words of model_metadata.json."""

    steering_angle: SteeringDeg
    """Degrees, positive to the left."""
    speed: SpeedMps


@dataclass(frozen=True, kw_only=True)
class SteeringRange:
    """Lowest and highest steering in degrees, positive to the left."""

    low: SteeringDeg
    high: SteeringDeg


@dataclass(frozen=True, kw_only=True)
class SpeedRange:
    """Lowest and highest speed in metres per second."""

    low: SpeedMps
    high: SpeedMps


@dataclass(frozen=True, kw_only=True)
class DiscreteActionSpace:
    """A list of actions; the position in the list is the action's number."""

    kind: Literal["discrete"]
    actions: Annotated[tuple[DiscreteAction, ...], Field(max_length=1000)]
    file: str | None
    """A model_metadata.json that takes the place of this whole group."""


@dataclass(frozen=True, kw_only=True)
class GridActionSpace:
    """Every steering level with every speed level, steering in the outer loop."""

    kind: Literal["grid"]
    steering_angle: SteeringRange
    steering_levels: UpTo100
    speed: SpeedRange
    speed_levels: UpTo100
    file: str | None


@dataclass(frozen=True, kw_only=True)
class ContinuousActionSpace:
    """Steering and speed as two numbers between -1 and 1, scaled linearly to the ranges."""

    kind: Literal["continuous"]
    steering_angle: SteeringRange
    speed: SpeedRange
    file: str | None


ActionSpaceConfig = Annotated[
    DiscreteActionSpace | GridActionSpace | ContinuousActionSpace, Field(discriminator="kind")
]


@dataclass(frozen=True, kw_only=True)
class ObservationConfig:
    """The features the policy sees, each divided by its scale."""

    lookahead_m: Annotated[tuple[Positive, ...], Field(max_length=1000)]
    """Distances along the centre line at which the road ahead is seen."""
    lookahead_scale_m: Positive
    speed_scale_mps: Positive
    yaw_rate_scale_radps: Positive


@dataclass(frozen=True, kw_only=True)
class EpisodeConfig:
    """Where an episode starts and what ends it (rules of the service's simulator)."""

    start_offset: Annotated[float, Field(ge=0, lt=1)]
    """Start of the first episode as a fraction of the lap."""
    start_advance: Fraction
    """Fraction of the lap by which the start moves on after each episode."""
    max_steps: Natural
    """Control steps after which an episode is cut off (0: never)."""
    immobilized_steps: Natural
    """Steps in a row without movement that end an episode (0: never)."""
    immobilized_m: NonNegative
    """Movement per step up to which a car counts as standing."""
    reversed_steps: Natural
    """Steps in a row of falling progress that end an episode (0: never)."""


@dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """A reward function of the zoo by name, or a file."""

    name: str
    file: str | None
    """A Python file with `reward_function(params)`; takes the place of `name`."""
    constants: dict[str, Finite]
    """Values for UPPERCASE constants of the module."""
    time_limit_s: Seconds
    """Seconds of CPU that one control step's reward calls may take before the run is failed."""
