"""Track, action space, observation, randomization, episode rules and reward."""

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

from pydantic import AfterValidator, Discriminator, Field, Tag

from .bounds import Divisor, Finite, Fraction, Natural, NonNegative, Positive, Seconds, UpTo100
from .own_class import OwnClass

SpeedMps = Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]
Pixels = Annotated[int, Field(ge=16, le=640)]
SteeringDeg = Annotated[float, Field(ge=-60, le=60, allow_inf_nan=False)]


@dataclass(frozen=True, kw_only=True)
class DiscreteAction:
    """One action of a discrete action space, with the keys of model_metadata.json."""

    steering_angle: SteeringDeg
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
class CameraConfig:
    """The pictures that the policy sees; where the camera sits is the car's (`car.camera_x_m`, ...)."""

    width: Pixels
    height: Pixels
    color: Literal["grey", "rgb"]
    frames: Annotated[int, Field(ge=1, le=8)]
    stereo_m: Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False)]
    field_of_view_deg: Annotated[float, Field(ge=10, le=150, allow_inf_nan=False)]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Channels, height and width of the policy's pictures."""
        channels = (3 if self.color == "rgb" else 1) * (2 if self.stereo_m else 1) * self.frames
        return channels, self.height, self.width


@dataclass(frozen=True, kw_only=True)
class LidarConfig:
    """The LIDAR readings that the policy sees; where the scanner sits is the service's."""

    kind: Literal["plain", "sectors", "discretized"]
    reach_m: Annotated[float, Field(ge=0.15, le=12, allow_inf_nan=False)] | None
    sectors: Literal[1, 2, 4, 8, 16, 32, 64]
    values_per_sector: Annotated[int, Field(ge=1, le=64)]
    noise_m: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
    yaw_deg: Annotated[float, Field(ge=-180, le=180, allow_inf_nan=False)]

    @property
    def furthest_m(self) -> float:
        """Distance beyond which nothing is seen."""
        services = {"plain": 1.0, "sectors": 0.5, "discretized": 2.0}[self.kind]
        return services if self.reach_m is None else self.reach_m

    @property
    def sector_shape(self) -> tuple[int, int]:
        """Number of sectors, and of values of each."""
        return (8, 1) if self.kind == "sectors" else (self.sectors, self.values_per_sector)

    @property
    def size(self) -> int:
        """Number of readings."""
        return 64 if self.kind == "plain" else self.sector_shape[0] * self.sector_shape[1]


@dataclass(frozen=True, kw_only=True)
class ObservationConfig:
    """The observation: the features, each divided by its scale, the pictures of a camera, and a LIDAR."""

    lookahead_m: Annotated[tuple[Positive, ...], Field(max_length=1000)]
    lookahead_scale_m: Divisor
    speed_scale_mps: Divisor
    yaw_rate_scale_radps: Divisor
    sliding: bool = False
    parts: tuple[OwnClass, ...] = ()
    next_objects: Annotated[int, Field(ge=0, le=20)] = 0
    next_objects_reach_m: Divisor = 5.0
    camera: CameraConfig | None = None
    lidar: LidarConfig | None = None


class ObservationShape(NamedTuple):
    """The inputs that networks are built for."""

    features: int
    picture: tuple[int, int, int] | None = None
    """Channels, height and width; None: there is no camera."""
    lidar: int | None = None
    """Number of readings; None: there is no LIDAR."""

    @property
    def seen(self) -> dict[str, tuple[int, ...]]:
        """Keys of the batch that the policy reads, and their shapes."""
        seen: dict[str, tuple[int, ...]] = {}
        if self.picture is not None:
            seen["pixels"] = self.picture
        if self.lidar is not None:
            seen["lidar"] = (self.lidar,)
        return seen or {"observation": (self.features,)}


@dataclass(frozen=True, kw_only=True)
class EpisodeConfig:
    """Start and end of an episode (rules of the service's simulator)."""

    start_offset: Annotated[float, Field(ge=0, lt=1)]
    start_advance: Fraction
    max_steps: Natural
    immobilized_steps: Natural
    immobilized_m: NonNegative
    reversed_steps: Natural
    lap_terminates: bool = True


@dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """A reward function of the zoo by name, or a file."""

    name: str
    file: str | None
    constants: dict[str, Finite]
    time_limit_s: Seconds


Number = TypeVar("Number", int, float)


def _ordered(pair: tuple[Number, ...]) -> tuple[Number, ...]:
    """Refuse a range whose first number is the larger one."""
    if pair[0] > pair[1]:
        raise ValueError("the first number of a range is the lowest, the second the highest")
    return pair


Range = Annotated[tuple[Number, ...], Field(min_length=2, max_length=2), AfterValidator(_ordered)]
"""The lowest and the highest value."""

# Beyond half and twice the configured values, light cars with strong motors and servos begin to hop; beyond a fifth
# and five times the physics diverges.
Friction = Annotated[float, Field(ge=0.1, le=2, allow_inf_nan=False)]
Scale = Annotated[float, Field(ge=0.5, le=2, allow_inf_nan=False)]
Delay = Annotated[int, Field(ge=0, le=15)]
Offset = Annotated[float, Field(ge=-15, le=15, allow_inf_nan=False)]
Deviation = Annotated[float, Field(ge=0, le=15, allow_inf_nan=False)]
Objects = Annotated[int, Field(ge=0, le=50)]
Height = Annotated[float, Field(ge=-0.1, le=0.5, allow_inf_nan=False)]
# From -1/3 on, the picture's corners would repeat parts nearer to its middle.
Distortion = Annotated[float, Field(ge=-0.3, le=0.3, allow_inf_nan=False)]

# Beyond, a policy would learn other clearances than the crash rule has.
OthersScale = Annotated[float, Field(ge=0.7, le=1.4, allow_inf_nan=False)]
Latency = Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False)]
FullLock = Annotated[float, Field(gt=0, le=30, allow_inf_nan=False)]
JpegQuality = Annotated[int, Field(ge=1, le=100)]


@dataclass(frozen=True, kw_only=True)
class PictureRandomizationConfig:
    """Randomization of pictures: the lowest and highest value of each quantity, drawn for each episode of each car."""

    brightness_scale: Range[Scale] = (1.0, 1.0)
    contrast_scale: Range[Scale] = (1.0, 1.0)
    gamma_scale: Range[Scale] = (1.0, 1.0)
    color_noise: Range[Fraction] = (0.0, 0.0)
    light: Range[Fraction] = (0.0, 0.0)
    blur: Range[Fraction] = (0.0, 0.0)
    pixel_noise: Range[Fraction] = (0.0, 0.0)
    height_m: Range[Height] = (0.0, 0.0)
    pitch_deg: Range[Offset] = (0.0, 0.0)
    field_of_view_scale: Range[Scale] = (1.0, 1.0)
    dirt: Range[Fraction] = (0.0, 0.0)
    objects: Range[Objects] = (0, 0)
    lens_k1: Range[Distortion] = (0.0, 0.0)
    others_scale: Range[OthersScale] = (1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class CarPictureRanges:
    """The pictures of `evaluation.real_car.picture`, with ranges."""

    jpeg_quality: Range[JpegQuality]


@dataclass(frozen=True, kw_only=True)
class CarTimingRanges:
    """The latency of `evaluation.real_car.timing`, with a range; the control period stays the simulator's."""

    latency_s: Range[Latency]


@dataclass(frozen=True, kw_only=True)
class CarControlsRanges:
    """The controls of `evaluation.real_car.controls`, with ranges."""

    full_lock_deg: Range[FullLock]
    throttle_curve: Range[Fraction]


@dataclass(frozen=True, kw_only=True)
class CarRandomizationConfig:
    """Similarity to the physical car, drawn for each episode; a part that is null is as in the simulator."""

    picture: CarPictureRanges | None = None
    timing: CarTimingRanges | None = None
    controls: CarControlsRanges | None = None


@dataclass(frozen=True, kw_only=True)
class RandomizationConfig:
    """Domain randomization: the lowest and highest value of each quantity; each episode of each car draws its own.

    Draws are uniform, ends included, and constant for the episode. Their names are columns of the trace.
    """

    friction_scale: Range[Friction]
    mass_scale: Range[Scale]
    motor_scale: Range[Scale]
    servo_scale: Range[Scale]
    battery_sag: Range[Fraction]
    action_delay_steps: Range[Delay]
    steering_offset_deg: Range[Offset]
    steering_noise_deg: Range[Deviation]
    speed_noise: Range[Fraction]
    observation_noise: Range[Fraction]
    observation_dropout: Range[Fraction]
    pictures: PictureRandomizationConfig | None = None
    real_car: CarRandomizationConfig | None = None
    car_share: Fraction = 1.0
    """Share of the cars that are randomized."""


_GOLDEN_RATIO = (math.sqrt(5) - 1) / 2


def car_differs(number: int, car_share: float) -> bool:
    """Return whether a car, by its number among those on its track, is in the share that is randomized.

    Multiples of the golden ratio, modulo 1, are spread evenly (Weyl's theorem), however many cars there are. Car 0 is
    randomized with a share of 1 only.
    """
    return number * _GOLDEN_RATIO % 1 >= 1 - car_share


QUANTITIES = {
    "friction_scale": "factor on the grip of the tyres",
    "mass_scale": "factor on all masses",
    "motor_scale": "factor on the motors' gain and torque",
    "servo_scale": "factor on the steering servos' gain",
    "battery_sag": "share of the commanded speed lost in the end",
    "action_delay_steps": "control steps by which commands are delayed",
    "steering_offset_deg": "degrees added to the steering, positive to the left",
    "steering_noise_deg": "degrees, standard deviation of the noise on the steering",
    "speed_noise": "standard deviation of the noise on the speed, as a fraction of it",
    "observation_noise": "standard deviation of the noise on measured features",
    "observation_dropout": "probability that the last observation is repeated",
}
"""Meaning and unit of each quantity that `RandomizationConfig` has a range for; each is a column of the trace."""
OFF = {name: 1.0 if name.endswith("_scale") else 0.0 for name in QUANTITIES}
"""The value of each quantity that has no effect."""


Point = tuple[Finite, Finite]
Color = Annotated[str, Field(pattern=r"^#[0-9a-fA-F]{6}$")]
# Each dash is drawn.
DashLength = Annotated[float, Field(ge=0.01, allow_inf_nan=False)]


@dataclass(frozen=True, kw_only=True)
class FloorConfig:
    """Grip, lines and colours of a track and its surroundings."""

    friction: Positive
    road_color: Color
    ground_color: Color
    line_color: Color
    lines_inside: bool = True
    dash_color: Color = "#e38b05"
    dash_length_m: DashLength = 0.0508
    dash_gap_m: DashLength = 0.0508
    start_line_color: Color | None = None
    kerb_color: Color | None = None
    wall_color: Color = "#244651"
    sky_color: Color = "#272727"
    walls_beyond_m: Positive | None = 0.91
    walls_height_m: Positive = 1.0
    walls_follow_road: bool = False
    walls_light: tuple[NonNegative, NonNegative, NonNegative, NonNegative] = (1.0, 0.3, 1.0, 0.3)


@dataclass(frozen=True, kw_only=True)
class TrackConfig:
    """A course: a world of the service, spline knots, or a file."""

    name: str
    title: str
    direction: Literal["forward", "reversed", "alternate"]
    weight: Positive
    file: str | None
    knots: tuple[Point, ...] | None
    width_m: Positive | tuple[Positive, ...] | None
    closed: bool
    floor: FloorConfig


def _kind(value: Any) -> str:
    """Return whether this is one track or several; the values of one are not all mappings."""
    several = isinstance(value, dict) and value and all(isinstance(item, dict) for item in value.values())
    return "several" if several else "one"


Tracks = Annotated[
    Annotated[TrackConfig, Tag("one")] | Annotated[dict[str, TrackConfig], Tag("several")],
    Discriminator(_kind),
]
