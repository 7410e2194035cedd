"""The car as a MuJoCo model, built in code from its dimensions."""

import mujoco
import numpy as np

from deepracer_exp.config.car import CarConfig

from .tyres import DRIVE

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
"""The order of the wheels in everything that is per wheel."""
STEERED = WHEELS[:2]

# Features that this model does not use. AUTORESET is off so that a blown-up state stays visible instead of
# being replaced by the initial one.
_DISABLED = (
    mujoco.mjtDisableBit.mjDSBL_AUTORESET
    | mujoco.mjtDisableBit.mjDSBL_ISLAND
    | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    | mujoco.mjtDisableBit.mjDSBL_GRAVITY
    | mujoco.mjtDisableBit.mjDSBL_ACTUATION
    | mujoco.mjtDisableBit.mjDSBL_SPRING
    | mujoco.mjtDisableBit.mjDSBL_DAMPER
    | mujoco.mjtDisableBit.mjDSBL_SENSOR
    | mujoco.mjtDisableBit.mjDSBL_MIDPHASE
)
_SHELL_RGBA = (0.32, 0.18, 0.62, 1.0)
_DARK_RGBA = (0.08, 0.08, 0.09, 1.0)
_RIM_RGBA = (0.75, 0.75, 0.78, 1.0)


def build_spec(car: CarConfig, visual: bool = False) -> mujoco.MjSpec:
    """Build the car: a body that slides over the plane and turns; `tyres` push it.

    With `visual`, for films, the car also has a shell, a camera housing, wheels that steer and spin, and a light: for
    pictures of given poses, not for simulation.

    The joints `x` and `y` move the centre of mass, `yaw` turns the body about it: with all at zero the chassis origin
    is at the world's.
    """
    spec = mujoco.MjSpec()
    spec.modelname = car.name
    spec.option.timestep = car.control_period_s / car.substeps
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.disableflags = int(_DISABLED)
    spec.nuserdata = DRIVE.itemsize // np.dtype(np.float64).itemsize
    chassis = spec.worldbody.add_body(name="chassis")
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    chassis.add_joint(name="x", type=slide, axis=[1, 0, 0])
    chassis.add_joint(name="y", type=slide, axis=[0, 1, 0])
    chassis.add_joint(name="yaw", type=hinge, axis=[0, 0, 1], pos=[car.com_x_m, 0, 0])
    chassis.mass = car.mass_kg
    chassis.ipos = [car.com_x_m, 0, car.com_z_m]
    chassis.inertia = car.inertia_kgm2
    chassis.explicitinertial = True
    if visual:
        _add_visuals(spec, chassis, car)
    return spec


def _add_visuals(spec: mujoco.MjSpec, chassis: mujoco.MjsBody, car: CarConfig) -> None:
    """Add the visible parts: floor, shell, cockpit, camera, tyres and spokes, and a light."""
    spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=0, conaffinity=0
    )
    spec.worldbody.add_light(pos=[0, 0, 4], dir=[0, 0, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    axis_z, hinge = car.wheel_radius_m, mujoco.mjtJoint.mjJNT_HINGE
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
    for name, (x_m, y_m) in zip(WHEELS, car.wheel_points_m, strict=True):
        wheel = chassis.add_body(name=name, pos=[x_m, y_m, car.wheel_radius_m])
        if name in STEERED:
            wheel.add_joint(name=f"{name}_steer", type=hinge, axis=[0, 0, 1])
        wheel.add_joint(name=f"{name}_spin", type=hinge, axis=[0, 1, 0])
        # MuJoCo requires a mass of every moving body.
        wheel.mass, wheel.inertia, wheel.explicitinertial = 1e-3, [1e-6, 1e-6, 1e-6], True
        size = (car.wheel_radius_m, 0.5 * car.wheel_width_m, 0)
        _add_visual(wheel, f"{name}_tyre", cylinder, (0, 0, 0), size, _DARK_RGBA, across)
        # A spoke wider than the tyre, so that one sees the wheel turn.
        size = (0.7 * car.wheel_radius_m, 0.5 * car.wheel_width_m + 0.001, 0.005)
        _add_visual(wheel, f"{name}_spoke", box, (0, 0, 0), size, _RIM_RGBA)


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
