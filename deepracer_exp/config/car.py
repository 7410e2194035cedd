"""The car's dimensions, masses, drives and physics settings (`conf/car/`)."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from .bounds import Finite, NonNegative, Positive, UpTo100, UpTo1000


@dataclass(frozen=True, kw_only=True)
class CarConfig:
    """A four-wheel-driven, front-steered 1/18 scale car.

    Lengths are measured from the chassis origin: on the ground plane, between the axles, x ahead, y left,
    z up. Sources and meanings of the values stand in `conf/car/deepracer.yaml`.
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

    chassis_mass_kg: Positive
    chassis_com_m: tuple[Finite, Finite, Finite]
    chassis_inertia_kgm2: tuple[Positive, Positive, Positive]
    front_hub_mass_kg: NonNegative
    wheel_mass_kg: Positive
    wheel_spin_inertia_kgm2: Positive
    wheel_turn_inertia_kgm2: Positive

    tyre_friction: Positive

    drive_radius_m: Positive
    front_motor_gain_nms: NonNegative
    rear_motor_gain_nms: NonNegative
    motor_torque_nm: Positive
    servo_gain_nm: Positive
    servo_damping_nms: Positive
    servo_torque_nm: Positive
    servo_kick: Annotated[float, Field(ge=0, lt=1)]
    steering_trim_deg: Finite
    ackermann: bool

    max_steering_deg: Positive
    min_speed_mps: NonNegative
    max_speed_mps: Positive

    control_hz: Annotated[float, Field(ge=1, le=1000)]
    substeps: UpTo100
    integrator: Literal["euler", "implicitfast", "discrete"]
    solver: Literal["newton", "cg"]
    solver_iterations: UpTo1000
    line_search_iterations: UpTo1000
    solver_tolerance: NonNegative
    wheel_contact: Literal["sphere", "ellipsoid", "cylinder"]
    contact_time_s: Positive
    contact_impedance: Annotated[float, Field(gt=0, lt=1)]
    front_slip_time_s: Positive
    rear_slip_time_s: Positive

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
    def wheel_points_m(self) -> tuple[tuple[float, float], ...]:
        """Wheel centres (x, y) in metres from the origin: front left and right, rear left and right."""
        front, rear = (self.front_axle_x_m, self.front_wheel_y_m), (self.rear_axle_x_m, self.rear_wheel_y_m)
        return tuple((x, side * y) for x, y in (front, rear) for side in (1, -1))
