"""Action space, observation, randomization, episode rules and reward."""

from dataclasses import dataclass, fields
from typing import Annotated, Literal, NamedTuple, TypeVar

from pydantic import AfterValidator, Field

from .bounds import Divisor, Finite, Fraction, Natural, NonNegative, Positive, Seconds, UpTo100
from .own_class import OwnClass

SpeedMps = Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]
Pixels = Annotated[int, Field(ge=16, le=640)]
SteeringDeg = Annotated[float, Field(ge=-60, le=60, allow_inf_nan=False)]


@dataclass(frozen=True, kw_only=True)
class DiscreteAction:
    """One action of a discrete action space, with the keys of model_metadata.json."""

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
    """A model_metadata.json that replaces this whole group."""


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
    """The last so many pictures, oldest first."""
    stereo_m: Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False)]
    """Distance between two cameras side by side, left first; 0: one camera."""
    field_of_view_deg: Annotated[float, Field(ge=10, le=150, allow_inf_nan=False)]
    """Horizontal."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Channels, height and width of what the policy sees."""
        channels = (3 if self.color == "rgb" else 1) * (2 if self.stereo_m else 1) * self.frames
        return channels, self.height, self.width


@dataclass(frozen=True, kw_only=True)
class LidarConfig:
    """The LIDAR readings that the policy sees; where the scanner sits is the service's."""

    kind: Literal["plain", "sectors", "discretized"]
    """The service's LIDAR (distances), SECTOR_LIDAR (is something near?), DISCRETIZED_SECTOR_LIDAR (how near?)."""
    reach_m: Annotated[float, Field(ge=0.15, le=12, allow_inf_nan=False)] | None
    """Distance beyond which nothing is seen; None: the service's of this kind."""
    sectors: Literal[1, 2, 4, 8, 16, 32, 64]
    """With `discretized`: parts into which the rays are divided."""
    values_per_sector: Annotated[int, Field(ge=1, le=64)]
    """With `discretized`: steps of distance that are distinguished."""
    noise_m: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
    """Standard deviation of the Gaussian noise on each distance."""
    yaw_deg: Annotated[float, Field(ge=-180, le=180, allow_inf_nan=False)]
    """Direction of the middle ray, 0: ahead."""

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
    """What is observed: the features, each divided by its scale, the pictures of a camera, and a LIDAR."""

    lookahead_m: Annotated[tuple[Positive, ...], Field(max_length=1000)]
    """Distances ahead along the centre line at which the road is observed."""
    lookahead_scale_m: Divisor
    speed_scale_mps: Divisor
    yaw_rate_scale_radps: Divisor
    parts: tuple[OwnClass, ...] = ()
    """Classes of your own that add features."""
    camera: CameraConfig | None = None
    """Pictures for the policy; with them or a LIDAR it does not see the features."""
    lidar: LidarConfig | None = None


class ObservationShape(NamedTuple):
    """What networks are built for."""

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
    """Where an episode starts and what ends it (rules of the service's simulator)."""

    start_offset: Annotated[float, Field(ge=0, lt=1)]
    """Start of the first episode as a fraction of the lap."""
    start_advance: Fraction
    """Fraction of the lap by which the start advances after each episode."""
    max_steps: Natural
    """Control steps after which an episode is cut off (0: never)."""
    immobilized_steps: Natural
    """Steps in a row without movement that end an episode (0: never)."""
    immobilized_m: NonNegative
    """Movement per step, in metres, up to which a car counts as standing."""
    reversed_steps: Natural
    """Steps in a row of falling progress that end an episode (0: never)."""
    lap_terminates: bool = True
    """Whether a complete lap of a closed track ends an episode as leaving the road does: no reward can follow."""


@dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """A reward function of the zoo by name, or a file."""

    name: str
    file: str | None
    """A Python file with `reward_function(params)`; replaces `name`."""
    constants: dict[str, Finite]
    """Values for UPPERCASE constants of the module."""
    time_limit_s: Seconds
    """Seconds of CPU that one control step's reward calls may take before the run is failed."""


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
# From -1/3 on, the picture's corners would show what lies nearer to its middle once more.
Distortion = Annotated[float, Field(ge=-0.3, le=0.3, allow_inf_nan=False)]


@dataclass(frozen=True, kw_only=True)
class PictureRandomizationConfig:
    """What pictures differ in: the lowest and highest value of each quantity, drawn for each episode of each car."""

    brightness_scale: Range[Scale] = (1.0, 1.0)
    """Factor on all values."""
    contrast_scale: Range[Scale] = (1.0, 1.0)
    """Factor on the distance of all values from the middle grey."""
    gamma_scale: Range[Scale] = (1.0, 1.0)
    """Exponent of all values, where white is 1: above 1 dark colours become darker."""
    color_noise: Range[Fraction] = (0.0, 0.0)
    """Standard deviation of the factor on red, green and blue of each material."""
    light: Range[Fraction] = (0.0, 0.0)
    """How much darker a shadow in the picture is at its middle, or a spot of light brighter."""
    blur: Range[Fraction] = (0.0, 0.0)
    """Share of a pixel that comes from its four neighbours."""
    pixel_noise: Range[Fraction] = (0.0, 0.0)
    """Standard deviation of the Gaussian noise on each pixel at each step, as a fraction of white."""
    height_m: Range[Height] = (0.0, 0.0)
    """Added to the height of the camera."""
    pitch_deg: Range[Offset] = (0.0, 0.0)
    """Added to the pitch of the camera, downwards."""
    field_of_view_scale: Range[Scale] = (1.0, 1.0)
    """Factor on the tangent of half the field of view."""
    dirt: Range[Fraction] = (0.0, 0.0)
    """How much darker spots of dirt on the lens are at their middle."""
    objects: Range[Objects] = (0, 0)
    """How many boxes stand beside the road; whole numbers."""
    lens_k1: Range[Distortion] = (0.0, 0.0)
    """Radial distortion: how much farther out the corners look than through a pinhole, as a share."""


@dataclass(frozen=True, kw_only=True)
class RandomizationConfig:
    """Domain randomization: the lowest and highest value of each quantity; each episode of each car draws its own.

    Draws are uniform, ends included, and constant for the episode. Their names are columns of the trace.
    """

    friction_scale: Range[Friction]
    """Factor on the grip of the tyres (1: as configured for the car and the floor)."""
    mass_scale: Range[Scale]
    """Factor on all masses and inertias."""
    motor_scale: Range[Scale]
    """Factor on the motors' gain and largest torque."""
    servo_scale: Range[Scale]
    """Factor on the steering servos' gain: how fast the wheels turn."""
    battery_sag: Range[Fraction]
    """Share of the commanded speed that is lost linearly over the first 20 s of driving."""
    action_delay_steps: Range[Delay]
    """Control steps by which commands are delayed; whole numbers."""
    steering_offset_deg: Range[Offset]
    """Degrees added to every steering command, as by a badly calibrated centre; positive to the left."""
    steering_noise_deg: Range[Deviation]
    """Standard deviation of the Gaussian noise added to each steering command, degrees."""
    speed_noise: Range[Fraction]
    """Standard deviation of the Gaussian noise on each speed command, as a fraction of it."""
    observation_noise: Range[Fraction]
    """Standard deviation of the Gaussian noise on each measured feature, in units of its scale."""
    observation_dropout: Range[Fraction]
    """Probability at each step that the previous observation is repeated."""
    pictures: PictureRandomizationConfig | None = None
    """Of a camera's pictures; None: nothing."""


QUANTITIES = tuple(field.name for field in fields(RandomizationConfig) if field.name != "pictures")
OFF = {name: 1.0 if name.endswith("_scale") else 0.0 for name in QUANTITIES}
"""The value of each quantity that has no effect."""
