"""Video of a lap, rendered by MuJoCo."""

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console

from deepracer_exp.config.car import CarConfig
from deepracer_exp.sim import mujoco
from deepracer_exp.sim.mujoco_model import STEERED, WHEELS, build_spec
from deepracer_exp.tracks.outline import draw_track, extent
from deepracer_exp.tracks.track import Track

from .film import FRAMES_PER_S, Lap, in_frames, png, write_film

WIDTH, HEIGHT = 960, 544
"""Multiples of 16, as video codecs want them."""

_PIXELS_PER_M, _MOST_PIXELS = 160, 4096
_SMOOTHING = 0.13
"""Share of a heading change that the chase camera follows per frame."""


def can_draw() -> bool:
    """Return whether MuJoCo can draw with the graphics library that it was imported with."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # glfw's, before it fails
            mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16).close()
    except Exception:  # noqa: BLE001 - graphics libraries raise anything
        return False
    return True


def render_lap(lap: Lap, car: CarConfig) -> Iterator[NDArray[np.uint8]]:
    """Render a lap in frames with MuJoCo, (HEIGHT, WIDTH, 3) each; poses are given, nothing is simulated."""
    others = np.zeros((len(lap), 0, 9)) if lap.others is None else lap.others
    model, camera = _build(lap.track, car, others[0]), mujoco.MjvCamera()
    data = mujoco.MjData(model)
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    place, steer, spin = (
        [model.joint(name).qposadr[0] for name in names]
        for names in (
            ("x", "y", "yaw"),
            (f"{name}_steer" for name in STEERED),
            (f"{name}_spin" for name in WHEELS),
        )
    )
    # Recorded poses are of the front point; the joints move the centre of mass.
    to_com_m = car.com_x_m - car.front_point_m
    com_x_m, com_y_m = lap.x_m + to_com_m * np.cos(lap.yaw_rad), lap.y_m + to_com_m * np.sin(lap.yaw_rad)
    turned_rad = np.cumsum(lap.speed_mps) / FRAMES_PER_S / car.wheel_radius_m
    azimuth_rad = float(lap.yaw_rad[0])
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        for frame, yaw_rad in enumerate(lap.yaw_rad.tolist()):
            data.qpos[place] = com_x_m[frame] - car.com_x_m, com_y_m[frame], yaw_rad
            data.qpos[steer] = lap.steering_rad[frame]
            data.qpos[spin] = turned_rad[frame]
            data.mocap_pos[:, :2] = others[frame, :, :2]
            data.mocap_quat[:, 0], data.mocap_quat[:, 3] = (
                np.cos(0.5 * others[frame, :, 2]),
                np.sin(0.5 * others[frame, :, 2]),
            )
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_camlight(model, data)
            azimuth_rad += _SMOOTHING * ((yaw_rad - azimuth_rad + np.pi) % (2 * np.pi) - np.pi)
            ahead = np.array([np.cos(azimuth_rad), np.sin(azimuth_rad)])
            camera.lookat[:] = *(np.array([lap.x_m[frame], lap.y_m[frame]]) + 0.25 * ahead), 0.05
            camera.distance, camera.elevation = 1.3, -24.0
            camera.azimuth = np.degrees(azimuth_rad)
            renderer.update_scene(data, camera)
            # Shadows of the distant light cost more than the rest of the image.
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
            yield renderer.render()


def _build(track: Track, car: CarConfig, others: NDArray[np.float64]) -> mujoco.MjModel:
    """Build the scene: the car on its track, and movable boxes and bots, (K, 9)."""
    low, high = extent(track)
    spec = build_spec(car, visual=True)
    vis = spec.visual
    vis.global_.offwidth, vis.global_.offheight = WIDTH, HEIGHT
    vis.headlight.ambient[:] = 0.45
    vis.headlight.diffuse[:] = 0.35
    vis.headlight.specular[:] = 0.0
    vis.map.znear, vis.map.zfar = 0.01, 100.0
    spec.stat.extent = float(np.max(high - low))
    # The floor itself is invisible; the image of the track lies on it.
    spec.geom("floor").rgba = [0, 0, 0, 0]
    # Textures are shaded differently from plain shapes, so the surrounding ground is a texture, too.
    pictures = {
        "track": draw_track(track, min(_PIXELS_PER_M, _MOST_PIXELS / float(np.max(high - low)))),
        "ground": Image.new("RGB", (4, 4), track.floor.ground_color),
    }
    spec.assets = {f"{name}.png": png(picture) for name, picture in pictures.items()}
    for name in pictures:
        spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, file=f"{name}.png")
        material = spec.add_material(name=name, specular=0.0, reflectance=0.0)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    plane, middle, half = mujoco.mjtGeom.mjGEOM_PLANE, 0.5 * (low + high), 0.5 * (high - low)
    seen = {"contype": 0, "conaffinity": 0}
    for name, pos, size in (
        ("track", [*middle, 0.001], [*half, 1.0]),
        ("ground", [0, 0, -0.01], [0, 0, 1]),
    ):
        spec.worldbody.add_geom(name=name, type=plane, pos=pos, size=size, material=name, **seen)
    for length, width, height, *color in others[:, 3:].tolist():
        body = spec.worldbody.add_body(mocap=True)
        half_m = (0.5 * length, 0.5 * width, 0.5 * height)
        rgba = (*(part / 255 for part in color), 1.0)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=(0, 0, half_m[2]), size=half_m, rgba=rgba, **seen)
    return spec.compile()


def write_video(file: Path, lap: Lap, car: CarConfig, err: Console) -> None:
    """Render a lap as an .mp4 file, seen from behind the car.

    Raises:
        RunFailed: the file cannot be written.
    """
    shown, _ = in_frames(lap, car.control_hz)
    frames = (_overlay(picture, shown, frame) for frame, picture in enumerate(render_lap(shown, car)))
    write_film(file, frames, len(shown), (WIDTH, HEIGHT), err)


def _overlay(picture: NDArray[np.uint8], lap: Lap, frame: int) -> NDArray[np.uint8]:
    """Draw lap time, speed and progress onto a frame."""
    image = Image.fromarray(picture).convert("RGBA")
    shade = Image.new("RGBA", image.size)
    draw = ImageDraw.Draw(shade)
    large, small = ImageFont.load_default(34), ImageFont.load_default(18)
    right = 330
    draw.rounded_rectangle((16, 16, right + 14, 122), 10, fill=(0, 0, 0, 150))
    draw.text((30, 22), lap.title, font=small, fill=(235, 235, 235, 255))
    white = (255, 255, 255, 255)
    # Right-aligned, so that the numbers do not jump.
    draw.text((150, 46), f"{lap.time_s[frame]:.2f} s", font=large, fill=white, anchor="ra")
    if lap.held is not None and lap.held[frame]:
        draw.text((right + 30, 22), "penalty", font=small, fill=(245, 166, 35, 255))
    draw.text((right, 46), f"{max(lap.speed_mps[frame], 0.0):.2f} m/s", font=large, fill=white, anchor="ra")
    draw.rectangle((30, 98, right, 108), fill=(255, 255, 255, 60))
    draw.rectangle((30, 98, 30 + (right - 30) * lap.share(frame), 108), fill=(245, 166, 35, 255))
    framed: NDArray[np.uint8] = np.asarray(Image.alpha_composite(image, shade).convert("RGB"))
    return np.ascontiguousarray(framed)
