"""The car as a MuJoCo model, built in code from its dimensions."""

from typing import NamedTuple

import mujoco
import numpy as np

from deepracer_exp.config.car import CarConfig

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
"""The order of the wheels in everything that is per wheel."""
STEERED = WHEELS[:2]

_INTEGRATOR = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "discrete": mujoco.mjtIntegrator.mjINT_DISCRETE,
}
_SOLVER = {"newton": mujoco.mjtSolver.mjSOL_NEWTON, "cg": mujoco.mjtSolver.mjSOL_CG}
_CONTACT = {
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
}
# What this model has none of. AUTORESET is off so that a blown-up state stays visible instead of being
# replaced by the initial one; ISLAND is off because one car is one island and looking for it costs time.
_DISABLED = (
    mujoco.mjtDisableBit.mjDSBL_AUTORESET
    | mujoco.mjtDisableBit.mjDSBL_ISLAND
    | mujoco.mjtDisableBit.mjDSBL_EQUALITY
    | mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
    | mujoco.mjtDisableBit.mjDSBL_LIMIT
    | mujoco.mjtDisableBit.mjDSBL_SPRING
    | mujoco.mjtDisableBit.mjDSBL_DAMPER
    | mujoco.mjtDisableBit.mjDSBL_SENSOR
    | mujoco.mjtDisableBit.mjDSBL_MIDPHASE
    | mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
)
_SHELL_RGBA = (0.32, 0.18, 0.62, 1.0)
_DARK_RGBA = (0.08, 0.08, 0.09, 1.0)
_RIM_RGBA = (0.75, 0.75, 0.78, 1.0)

PHYSICS_GROUP = 3
"""Geom group of the wheel contacts, hidden by MuJoCo's renderer; the visual geoms are in group 0."""


class WheelPlace(NamedTuple):
    """Where a wheel's centre is in the chassis frame."""

    name: str
    x_m: float
    y_m: float


def wheel_places(car: CarConfig) -> tuple[WheelPlace, ...]:
    """Return the four wheel centres in the order of `WHEELS`."""
    return (
        WheelPlace(WHEELS[0], car.front_axle_x_m, car.front_wheel_y_m),
        WheelPlace(WHEELS[1], car.front_axle_x_m, -car.front_wheel_y_m),
        WheelPlace(WHEELS[2], car.rear_axle_x_m, car.rear_wheel_y_m),
        WheelPlace(WHEELS[3], car.rear_axle_x_m, -car.rear_wheel_y_m),
    )


def build_spec(car: CarConfig, visual: bool = False) -> mujoco.MjSpec:
    """Build the car on an endless flat floor.

    Args:
        car: the car's dimensions and physics settings.
        visual: also give the car a body, rims and a camera housing to look at, and add a light. They touch
            nothing and weigh nothing: state vectors of both variants are interchangeable.

    Returns:
        A spec with a free chassis, two steered hubs, four driven wheels; actuators are the two servos
        (position, rad) followed by the four motors (velocity, rad/s) in the order of `WHEELS`.
    """
    spec = mujoco.MjSpec()
    spec.modelname = car.name
    _set_options(spec, car)
    spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=0, conaffinity=0
    )
    chassis = spec.worldbody.add_body(name="chassis")
    chassis.add_freejoint(name="chassis")
    chassis.mass = car.chassis_mass_kg
    chassis.ipos = car.chassis_com_m
    chassis.inertia = car.chassis_inertia_kgm2
    chassis.explicitinertial = True
    for place in wheel_places(car):
        _add_wheel(chassis, car, place)
        _add_contact(spec, car, place.name)
    _add_actuators(spec, car)
    if visual:
        _add_visuals(spec, chassis, car)
    return spec


def build_model(car: CarConfig, visual: bool = False) -> mujoco.MjModel:
    """Compile `build_spec`."""
    return build_spec(car, visual).compile()


def _set_options(spec: mujoco.MjSpec, car: CarConfig) -> None:
    option = spec.option
    option.timestep = car.control_period_s / car.substeps
    option.integrator = _INTEGRATOR[car.integrator]
    option.solver = _SOLVER[car.solver]
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.iterations = car.solver_iterations
    option.ls_iterations = car.line_search_iterations
    option.tolerance = car.solver_tolerance
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.disableflags = int(_DISABLED)


def _add_wheel(chassis: mujoco.MjsBody, car: CarConfig, place: WheelPlace) -> None:
    steered = place.name in STEERED
    wheel = chassis.add_body(name=place.name, pos=[place.x_m, place.y_m, car.wheel_radius_m])
    if steered:
        # The hub turns with the wheel and is light: its mass is added to the wheel's.
        wheel.add_joint(name=f"{place.name}_steer", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
    wheel.add_joint(name=f"{place.name}_spin", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
    wheel.mass = car.wheel_mass_kg + (car.front_hub_mass_kg if steered else 0.0)
    wheel.ipos = [0, 0, 0]
    wheel.inertia = [
        car.wheel_turn_inertia_kgm2,
        car.wheel_spin_inertia_kgm2,
        car.wheel_turn_inertia_kgm2,
    ]
    wheel.explicitinertial = True
    radius, half_width = car.wheel_radius_m, 0.5 * car.wheel_width_m
    size, quat = {
        "sphere": ([radius, 0, 0], [1, 0, 0, 0]),
        "ellipsoid": ([radius, half_width, radius], [1, 0, 0, 0]),
        # A cylinder's axis is z: turn it about x by 90 degrees onto the wheel's axis.
        "cylinder": ([radius, half_width, 0], [np.sqrt(0.5), np.sqrt(0.5), 0, 0]),
    }[car.wheel_contact]
    wheel.add_geom(
        name=place.name,
        type=_CONTACT[car.wheel_contact],
        size=size,
        quat=quat,
        contype=0,
        conaffinity=0,
        group=PHYSICS_GROUP,
        rgba=[0.1, 0.1, 0.1, 1],
    )


def _add_contact(spec: mujoco.MjSpec, car: CarConfig, wheel: str) -> None:
    """Let a wheel touch the floor: the only contacts there are, so that each has its own slip."""
    slip_time_s = car.front_slip_time_s if wheel in STEERED else car.rear_slip_time_s
    pair = spec.add_pair(
        name=wheel,
        geomname1="floor",
        geomname2=wheel,
        condim=3,
        friction=[car.tyre_friction, car.tyre_friction, 0, 0, 0],
        solref=[car.contact_time_s, 1],
        solreffriction=[slip_time_s, 1],
        # The same at any depth, so that the width (1 mm) and shape of the transition have no part.
        solimp=[car.contact_impedance, car.contact_impedance, 0.001, 0.5, 2],
    )
    assert pair is not None


def _add_actuators(spec: mujoco.MjSpec, car: CarConfig) -> None:
    for name in STEERED:
        servo = spec.add_actuator(
            name=f"{name}_servo", target=f"{name}_steer", trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        servo.set_to_position(kp=car.servo_gain_nm, kv=car.servo_damping_nms)
        servo.forcelimited = True
        servo.forcerange = [-car.servo_torque_nm, car.servo_torque_nm]
    for name in WHEELS:
        motor = spec.add_actuator(
            name=f"{name}_motor", target=f"{name}_spin", trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        motor.set_to_velocity(kv=car.front_motor_gain_nms if name in STEERED else car.rear_motor_gain_nms)
        motor.forcelimited = True
        motor.forcerange = [-car.motor_torque_nm, car.motor_torque_nm]


def _add_visuals(spec: mujoco.MjSpec, chassis: mujoco.MjsBody, car: CarConfig) -> None:
    """Add what the renderer shows: shell, cockpit, camera, tyres and spokes, and a light."""
    spec.worldbody.add_light(pos=[0, 0, 4], dir=[0, 0, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    axis_z = car.wheel_radius_m
    middle_x = 0.5 * (car.front_axle_x_m + car.rear_axle_x_m)
    inner_half_width = min(car.front_wheel_y_m, car.rear_wheel_y_m) - 0.5 * car.wheel_width_m - 0.004
    half_length = 0.5 * car.body_length_m
    box, cylinder = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
    # Sizes are half lengths; a tub between the wheels, a nose, a raised rear with battery, and the camera.
    shell = (
        ("tub", (middle_x, 0, axis_z), (half_length, inner_half_width, 0.014), _SHELL_RGBA),
        ("bumper", (middle_x + half_length, 0, axis_z), (0.008, 0.5 * car.body_width_m, 0.012), _DARK_RGBA),
        ("deck", (middle_x - 0.02, 0, axis_z + 0.03), (0.09, inner_half_width, 0.018), _SHELL_RGBA),
        ("cabin", (middle_x - 0.03, 0, axis_z + 0.06), (0.055, 0.7 * inner_half_width, 0.014), _DARK_RGBA),
    )
    for name, pos, size, rgba in shell:
        _add_visual(chassis, name, box, pos, size, rgba)
    pitch = np.deg2rad(car.camera_pitch_deg)
    quat = (np.cos(0.5 * pitch), 0, np.sin(0.5 * pitch), 0)
    mast_half = 0.5 * (car.camera_z_m - axis_z)
    mast_pos = (car.camera_x_m - 0.02, 0, axis_z + mast_half)
    _add_visual(chassis, "camera_mast", box, mast_pos, (0.006, 0.012, mast_half), _DARK_RGBA)
    camera_pos = (car.camera_x_m - 0.01, 0, car.camera_z_m)
    _add_visual(chassis, "camera", box, camera_pos, (0.012, 0.03, 0.014), _DARK_RGBA, quat)
    across = (np.sqrt(0.5), np.sqrt(0.5), 0, 0)
    for place in wheel_places(car):
        wheel = spec.body(place.name)
        size = (car.wheel_radius_m, 0.5 * car.wheel_width_m, 0)
        _add_visual(wheel, f"{place.name}_tyre", cylinder, (0, 0, 0), size, _DARK_RGBA, across)
        # A spoke wider than the tyre, so that one sees the wheel turn.
        size = (0.7 * car.wheel_radius_m, 0.5 * car.wheel_width_m + 0.001, 0.005)
        _add_visual(wheel, f"{place.name}_spoke", box, (0, 0, 0), size, _RIM_RGBA)


def _add_visual(
    body: mujoco.MjsBody,
    name: str,
    shape: mujoco.mjtGeom,
    pos: tuple[float, ...],
    size: tuple[float, ...],
    rgba: tuple[float, ...],
    quat: tuple[float, ...] = (1, 0, 0, 0),
) -> None:
    body.add_geom(
        name=name, type=shape, pos=pos, size=size, quat=quat, rgba=rgba, contype=0, conaffinity=0, mass=0
    )
