"""Tyres, motors and steering of many cars at once: the forces that push them over the floor.

A tyre resists slip, the velocity of its contact point over the floor, along and across the wheel separately: in
proportion to a small slip, and with no more than friction times load. In the simulator of the service the directions
of friction are fixed to the turning wheel (deepracer-simapp, urdf/deepracer/racecar.gazebo: `fdir1`), so that the
friction along and across the floor varies with the cosine of the wheel's rotation. `_grip` is the mean over a rotation.

The forces are those of the end of the step (implicit Euler), so that stiff tyres are stable at any step.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.car import CarConfig
from deepracer_exp.jit import njit

GRAVITY_MPS2 = 9.8
"""The gravity of the service's worlds (deepracer-simapp)."""

CAR = np.dtype(
    [
        ("mass_kg", "f8"),
        ("mass_scale", "f8"),
        ("yaw_inertia_kgm2", "f8"),
        ("com_x_m", "f8"),
        ("com_z_m", "f8"),
        # Front and rear; from the chassis origin.
        ("axle_x_m", "f8", 2),
        ("wheel_y_m", "f8", 2),
        ("friction", "f8"),
        ("along_ns_per_m", "f8", 2),
        ("across_ns_per_m", "f8", 2),
        # Wheels and motors, as felt at the wheel's rim.
        ("wheel_kg", "f8"),
        ("motor_ns_per_m", "f8", 2),
        ("motor_n", "f8"),
        ("rim_per_commanded_speed", "f8"),
        ("max_commanded_mps", "f8"),
        ("steering_time_s", "f8"),
        ("steering_kick", "f8"),
        ("steering_trim_rad", "f8"),
        # Shares of a control period.
        ("steering_delay", "f8"),
        ("speed_delay", "f8"),
        ("ackermann", "?"),
    ],
    align=True,
)
"""Constants of a car that `send`, `tyre_forces` and `push_cars` read; `mass_scale` is in its masses already."""

DRIVE = np.dtype(
    [
        ("steering_rad", "f8"),
        ("sent_steering_rad", "f8"),
        ("sent_speed_mps", "f8"),
        ("ahead_mps2", "f8"),
        ("left_mps2", "f8"),
        ("wheel_mps", "f8", 4),
    ]
)
"""State of a driving car: steering angle without trim, last command, acceleration, speeds of the rims."""

Cars = NDArray[np.void]


def car_record(car: CarConfig) -> Cars:
    """Return a car as one `CAR` record, shape ()."""
    radius = car.wheel_radius_m
    record = np.zeros((), CAR)
    record["mass_scale"] = 1.0
    record["mass_kg"], record["yaw_inertia_kgm2"] = car.mass_kg, car.inertia_kgm2[2]
    record["com_x_m"], record["com_z_m"] = car.com_x_m, car.com_z_m
    record["axle_x_m"] = car.front_axle_x_m, car.rear_axle_x_m
    record["wheel_y_m"] = car.front_wheel_y_m, car.rear_wheel_y_m
    record["friction"] = car.tyre_friction
    record["along_ns_per_m"] = car.front_tyre_along_ns_per_m, car.rear_tyre_along_ns_per_m
    record["across_ns_per_m"] = car.front_tyre_across_ns_per_m, car.rear_tyre_across_ns_per_m
    record["wheel_kg"] = car.wheel_spin_inertia_kgm2 / radius**2
    record["motor_ns_per_m"] = np.array([car.front_motor_gain_nms, car.rear_motor_gain_nms]) / radius**2
    record["motor_n"] = car.motor_torque_nm / radius
    record["rim_per_commanded_speed"] = radius / car.drive_radius_m
    record["max_commanded_mps"] = car.max_wheel_speed_radps * car.drive_radius_m
    record["steering_time_s"], record["steering_kick"] = car.steering_time_s, car.steering_kick
    record["steering_trim_rad"] = np.deg2rad(car.steering_trim_deg)
    record["steering_delay"] = car.steering_delay_s * car.control_hz
    record["speed_delay"] = car.speed_delay_s * car.control_hz
    record["ackermann"] = car.ackermann
    return record


@njit(cache=True, error_model="numpy", inline="always")
def _grip(stiffness, limit, slip):  # type: ignore[no-untyped-def]
    """Return the force of a tyre per slip velocity, N s/m, along or across the wheel.

    The mean of min(stiffness * slip, limit * |cos(angle)|) over a rotation of the wheel, divided by slip.
    """
    if limit <= 0.0:
        return 0.0
    share = stiffness * abs(slip) / limit
    if share < 1e-9:
        return stiffness
    if share >= 1.0:
        return 2.0 / np.pi * limit / abs(slip)
    return 2.0 / np.pi * stiffness * (np.arccos(share) + (1.0 - np.sqrt(1.0 - share * share)) / share)


@njit(cache=True, error_model="numpy")
def tyre_forces(car, drive, ahead_mps, left_mps, rate_radps, dt_s):  # type: ignore[no-untyped-def]
    """Return the force of the floor on one car during a physics step, and update the speeds of its wheels.

    Args:
        car: a `CAR` record.
        drive: its `DRIVE` record; `wheel_mps` and accelerations are advanced to the end of the step.
        ahead_mps: velocity of the centre of mass along the heading.
        left_mps: the same to the left.
        rate_radps: yaw rate.
        dt_s: length of the step.

    Returns:
        Force ahead and to the left at the centre of mass, N, and torque about it, N m: those of the velocity that they
        lead to at the end of the step.
    """
    front_m, rear_m = car.axle_x_m[0] - car.com_x_m, car.com_x_m - car.axle_x_m[1]
    base_m = front_m + rear_m
    # Load: at rest, plus the shift by acceleration ahead and to the left at the height of the centre of mass.
    shifted_n = car.mass_kg * drive.ahead_mps2 * car.com_z_m / base_m
    tilted_n = 0.25 * car.mass_kg * drive.left_mps2 * car.com_z_m
    angle = drive.steering_rad + car.steering_trim_rad
    wheel_kg_per_s = car.wheel_kg / dt_s
    target_mps = min(drive.sent_speed_mps, car.max_commanded_mps) * car.rim_per_commanded_speed
    # matrix @ velocity = push: momentum kept, plus forces that depend on the velocity at the end.
    m00 = m11 = car.mass_kg / dt_s
    m22 = car.yaw_inertia_kgm2 / dt_s
    m01 = m02 = m12 = 0.0
    p0, p1, p2 = m00 * ahead_mps, m11 * left_mps, m22 * rate_radps
    follow = np.empty((4, 4))
    for wheel in range(4):
        axle, side = wheel // 2, 1.0 - 2.0 * (wheel % 2)
        x_m = front_m if axle == 0 else -rear_m
        y_m = side * car.wheel_y_m[axle]
        load_n = 0.5 * car.mass_kg * GRAVITY_MPS2 * (rear_m if axle == 0 else front_m) / base_m
        load_n += (-0.5 if axle == 0 else 0.5) * shifted_n - side * tilted_n / car.wheel_y_m[axle]
        limit_n = car.friction * max(load_n, 0.0)
        turn = 0.0
        if axle == 0:
            turn = angle
            if car.ackermann:
                # The centre of the turn is on the line of the rear axle.
                turn = np.arctan(base_m * np.tan(angle) / (base_m - y_m * np.tan(angle)))
        cos, sin = np.cos(turn), np.sin(turn)
        along_rate, across_rate = x_m * sin - y_m * cos, x_m * cos + y_m * sin
        along_mps = cos * ahead_mps + sin * left_mps + along_rate * rate_radps
        across_mps = -sin * ahead_mps + cos * left_mps + across_rate * rate_radps
        rim_mps = drive.wheel_mps[wheel]
        along = _grip(car.along_ns_per_m[axle], limit_n, rim_mps - along_mps)
        across = _grip(car.across_ns_per_m[axle], limit_n, across_mps)
        motor = car.motor_ns_per_m[axle]
        motor_n = motor * (target_mps - rim_mps)
        if abs(motor_n) > car.motor_n:
            motor, motor_n = 0.0, np.copysign(car.motor_n, motor_n)
        else:
            motor_n = motor * target_mps
        # The rim's speed at the end of the step, linear in the floor's: free + share * floor.
        total = wheel_kg_per_s + motor + along
        free_mps, share = (wheel_kg_per_s * rim_mps + motor_n) / total, along / total
        push, drag = along * free_mps, along * (1.0 - share)
        m00 += drag * cos * cos + across * sin * sin
        m01 += (drag - across) * cos * sin
        m11 += drag * sin * sin + across * cos * cos
        m02 += drag * cos * along_rate - across * sin * across_rate
        m12 += drag * sin * along_rate + across * cos * across_rate
        m22 += drag * along_rate * along_rate + across * across_rate * across_rate
        p0, p1, p2 = p0 + push * cos, p1 + push * sin, p2 + push * along_rate
        follow[wheel, 0] = free_mps
        follow[wheel, 1], follow[wheel, 2], follow[wheel, 3] = share * cos, share * sin, share * along_rate
    # Cramer's rule for the symmetric 3 x 3 matrix.
    c00, c01, c02 = m11 * m22 - m12 * m12, m02 * m12 - m01 * m22, m01 * m12 - m02 * m11
    c11, c12, c22 = m00 * m22 - m02 * m02, m01 * m02 - m00 * m12, m00 * m11 - m01 * m01
    determinant = m00 * c00 + m01 * c01 + m02 * c02
    ahead_end = (c00 * p0 + c01 * p1 + c02 * p2) / determinant
    left_end = (c01 * p0 + c11 * p1 + c12 * p2) / determinant
    rate_end = (c02 * p0 + c12 * p1 + c22 * p2) / determinant
    drive.ahead_mps2 = (ahead_end - ahead_mps) / dt_s
    drive.left_mps2 = (left_end - left_mps) / dt_s
    for wheel in range(4):
        drive.wheel_mps[wheel] = (
            follow[wheel, 0]
            + follow[wheel, 1] * ahead_end
            + follow[wheel, 2] * left_end
            + follow[wheel, 3] * rate_end
        )
    return (
        car.mass_kg * drive.ahead_mps2,
        car.mass_kg * drive.left_mps2,
        car.yaw_inertia_kgm2 * (rate_end - rate_radps) / dt_s,
    )


class Clock(NamedTuple):
    """A physics step of a control period."""

    step: int
    """Number of the step, from 0."""
    steps: int
    """Number of steps in the period."""
    dt_s: float
    """Length of one."""


@njit(cache=True, error_model="numpy")
def send(car, drive, command, clock):  # type: ignore[no-untyped-def]
    """Advance a car's steering, and the command that its motors follow, by one physics step.

    A command takes effect after the car's delay: in part in the physics step in which the delay ends.

    Args:
        car: a `CAR` record.
        drive: its `DRIVE` record, changed in place.
        command: commanded speed_mps and steering_rad, (2,).
        clock: a `Clock`.
    """
    step, steps, dt_s = clock
    speed_mps, steering_rad = command[0], command[1]
    arrived = min(max(step + 1 - car.speed_delay * steps, 0.0), 1.0)
    drive.sent_speed_mps += arrived * (speed_mps - drive.sent_speed_mps)
    arrived = min(max(step + 1 - car.steering_delay * steps, 0.0), 1.0)
    change = arrived * (steering_rad - drive.sent_steering_rad)
    drive.sent_steering_rad += change
    drive.steering_rad += car.steering_kick * change
    drive.steering_rad += (drive.sent_steering_rad - drive.steering_rad) * -np.expm1(
        -dt_s / car.steering_time_s
    )


@njit(cache=True, error_model="numpy")
def push_cars(cars, drives, motion, commands, clock, forces):  # type: ignore[no-untyped-def]
    """Compute the forces on all cars for one physics step of a control period.

    Args:
        cars: `CAR` records, (N,).
        drives: `DRIVE` records, changed in place, (N, 1).
        motion: headings in radians, (N,), and velocities of the centres of mass in the world, (N, 3), in m/s, m/s and
            rad/s.
        commands: commanded speed_mps and steering_rad, (N, 2).
        clock: a `Clock`.
        forces: written: force in the world, N, N, and torque, N m, divided by `mass_scale`, (N, 3): MuJoCo moves
            all cars with the configured mass.
    """
    yaw_rad, velocity = motion
    for n in range(len(cars)):
        car, drive = cars[n], drives[n, 0]
        send(car, drive, (commands[n, 0], commands[n, 1]), clock)
        cos, sin = np.cos(yaw_rad[n]), np.sin(yaw_rad[n])
        vx, vy = velocity[n, 0], velocity[n, 1]
        ahead_n, left_n, torque_nm = tyre_forces(
            car, drive, cos * vx + sin * vy, cos * vy - sin * vx, velocity[n, 2], clock.dt_s
        )
        forces[n, 0] = (cos * ahead_n - sin * left_n) / car.mass_scale
        forces[n, 1] = (sin * ahead_n + cos * left_n) / car.mass_scale
        forces[n, 2] = torque_nm / car.mass_scale
