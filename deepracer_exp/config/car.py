"""The car's dimensions, masses, drives and physics settings (`conf/car/`)."""

import math
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from .bounds import Finite, NonNegative, Positive, UpTo100


@dataclass(frozen=True, kw_only=True)
class CarConfig:
    """A four-wheel-driven, front-steered 1/18 scale car.

    Lengths are measured from the chassis origin: on the ground plane, between the axles, x ahead, y left,
    z up. Sources and meanings of the values are in `conf/car/deepracer_v5.yaml`.
    """

    name: str

    front_axle_x_m: Positive
    rear_axle_x_m: Finite
    front_wheel_y_m: Positive
    rear_wheel_y_m: Positive
    wheel_radius_m: Positive
    wheel_width_m: Positive
    front_point_m: Finite
    body_length_m: Positive
    body_width_m: Positive
    camera_x_m: Finite
    camera_z_m: Finite
    camera_pitch_deg: Finite
    tilt_deg_per_mps2: Annotated[float, Field(ge=0, le=2, allow_inf_nan=False)] = 0.0

    mass_kg: Positive
    com_x_m: Finite
    com_z_m: Positive
    inertia_kgm2: tuple[Positive, Positive, Positive]
    wheel_spin_inertia_kgm2: Positive

    tyre_friction: Positive
    front_tyre_along_ns_per_m: Positive
    rear_tyre_along_ns_per_m: Positive
    front_tyre_across_ns_per_m: Positive
    rear_tyre_across_ns_per_m: Positive

    drive_radius_m: Positive
    max_wheel_speed_radps: Positive
    front_motor_gain_nms: NonNegative
    rear_motor_gain_nms: NonNegative
    motor_torque_nm: Positive
    speed_delay_s: NonNegative
    steering_time_s: Positive
    steering_kick: Annotated[float, Field(ge=-0.95, lt=1)]
    steering_delay_s: NonNegative
    steering_trim_deg: Finite
    ackermann: bool

    max_steering_deg: Positive
    min_speed_mps: NonNegative
    max_speed_mps: Positive

    control_hz: Annotated[float, Field(ge=1, le=1000)]
    substeps: UpTo100

    def __post_init__(self) -> None:
        """Refuse limits that contradict each other."""
        if self.min_speed_mps > self.max_speed_mps:
            raise ValueError(
                f"min_speed_mps ({self.min_speed_mps}) is above max_speed_mps ({self.max_speed_mps})"
            )
        if self.rear_axle_x_m >= self.front_axle_x_m:
            raise ValueError(
                f"rear_axle_x_m ({self.rear_axle_x_m}) is not behind front_axle_x_m ({self.front_axle_x_m})"
            )
        if not self.rear_axle_x_m < self.com_x_m < self.front_axle_x_m:
            raise ValueError(f"com_x_m ({self.com_x_m}) is not between the axles")
        for key in ("speed_delay_s", "steering_delay_s"):
            if getattr(self, key) >= self.control_period_s:
                raise ValueError(f"{key} ({getattr(self, key)}) is not below a control period")
        if self.front_motor_gain_nms == self.rear_motor_gain_nms == 0.0:
            raise ValueError(
                "front_motor_gain_nms and rear_motor_gain_nms are both 0: nothing drives the car"
            )

    @property
    def wheelbase_m(self) -> float:
        """Distance between the axles in metres."""
        return self.front_axle_x_m - self.rear_axle_x_m

    @property
    def control_period_s(self) -> float:
        """Seconds between two actions."""
        return 1.0 / self.control_hz

    @property
    def reach_m(self) -> float:
        """Distance of the farthest wheel centre from the origin: how far off the road this is with a wheel on it."""
        return max(math.hypot(*wheel) for wheel in self.wheel_points_m)

    @property
    def wheel_points_m(self) -> tuple[tuple[float, float], ...]:
        """Wheel centres (x, y) in metres from the origin: front left and right, rear left and right."""
        front, rear = (self.front_axle_x_m, self.front_wheel_y_m), (self.rear_axle_x_m, self.rear_wheel_y_m)
        return tuple((x, side * y) for x, y in (front, rear) for side in (1, -1))
