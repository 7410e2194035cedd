"""What makes every episode a little different (`conf/randomization/`)."""

from dataclasses import dataclass, fields
from typing import Annotated, TypeVar

from pydantic import AfterValidator, Field

from .bounds import Fraction

Number = TypeVar("Number", int, float)


def _ordered(pair: tuple[Number, ...]) -> tuple[Number, ...]:
    """Refuse a range that ends before it begins."""
    if pair[0] > pair[1]:
        raise ValueError("the first number of a range is the lowest, the second the highest")
    return pair


_TWO = Field(min_length=2, max_length=2)
_ORDERED = AfterValidator(_ordered)

# Beyond half and twice the configured car, light cars with strong motors and servos begin to hop, and from a fifth
# and five times on the physics breaks down.
Friction = Annotated[float, Field(ge=0.1, le=2, allow_inf_nan=False)]
Scale = Annotated[float, Field(ge=0.5, le=2, allow_inf_nan=False)]
Delay = Annotated[int, Field(ge=0, le=15)]
Offset = Annotated[float, Field(ge=-15, le=15, allow_inf_nan=False)]
Deviation = Annotated[float, Field(ge=0, le=15, allow_inf_nan=False)]

FrictionRange = Annotated[tuple[Friction, ...], _TWO, _ORDERED]
ScaleRange = Annotated[tuple[Scale, ...], _TWO, _ORDERED]
ShareRange = Annotated[tuple[Fraction, ...], _TWO, _ORDERED]
DelayRange = Annotated[tuple[Delay, ...], _TWO, _ORDERED]
OffsetRange = Annotated[tuple[Offset, ...], _TWO, _ORDERED]
DeviationRange = Annotated[tuple[Deviation, ...], _TWO, _ORDERED]


@dataclass(frozen=True, kw_only=True)
class RandomizationConfig:
    """The lowest and highest value of each quantity; every episode of every car draws its own in between.

    Draws are uniform, ends included, and hold for the whole episode. Their names are columns of the trace.
    """

    friction_scale: FrictionRange
    """Factor on the grip of the tyres (1: as the car's and the floor's configuration say)."""
    mass_scale: ScaleRange
    """Factor on all masses and inertias."""
    motor_scale: ScaleRange
    """Factor on the motors' gain and largest torque."""
    servo_scale: ScaleRange
    """Factor on the steering servos' gain: how fast the wheels turn."""
    battery_sag: ShareRange
    """Share of the commanded speed that is lost little by little over the first 20 s of driving."""
    action_delay_steps: DelayRange
    """Control steps by which a command acts late; whole numbers."""
    steering_offset_deg: OffsetRange
    """Degrees added to every steering command: a badly calibrated centre, positive to the left."""
    steering_noise_deg: DeviationRange
    """Standard deviation of the Gaussian noise added to each steering command, degrees."""
    speed_noise: ShareRange
    """Standard deviation of the Gaussian noise on each speed command, as a fraction of it."""
    observation_noise: ShareRange
    """Standard deviation of the Gaussian noise on each measured feature, in units of its scale."""
    observation_dropout: ShareRange
    """Probability at each step that the policy sees the previous observation again."""


QUANTITIES = tuple(field.name for field in fields(RandomizationConfig))
OFF = {name: 1.0 if name.endswith("_scale") else 0.0 for name in QUANTITIES}
"""The value of each quantity that changes nothing."""
