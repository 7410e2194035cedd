"""The scenery of a track for MuJoCo's renderer, built from the track's polygons: what our camera is compared with."""

from collections.abc import Sequence
from itertools import pairwise

import mujoco
import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation
from shapely.affinity import affine_transform
from shapely.geometry.base import BaseGeometry

from deepracer_exp.sim.camera_boxes import FACE_LIGHT
from deepracer_exp.sim.lens import Lens
from deepracer_exp.sim.scenery import (
    DASH_WIDTH_M,
    KERB_GAP_M,
    KERB_LENGTH_M,
    KERB_WIDTH_M,
    LINE_WIDTH_M,
    MATERIALS,
    START_AHEAD_M,
    START_CHECKS,
    START_LENGTH_M,
    START_WIDTH_M,
    paved_area,
    wall_material,
    wall_ring,
)
from deepracer_exp.tracks.track import Track

_UNSEEN_M = 1e-3
"""Thickness of what is flat; dashes lie half of it above the road."""
_HIDDEN_M = 1e-4
"""How far the faces of one colour stand out of the boxes that have the colours of the other faces."""


def build_scene(
    track: Track,
    lens: Lens,
    colors: NDArray[np.float32],
    samples: int,
    boxes: NDArray[np.float32] | None = None,
) -> mujoco.MjModel:
    """Return a model with a body `car` to be moved and its camera `eye`; nothing is lit, all surfaces glow.

    Args:
        track: with walls.
        lens: of the camera.
        colors: of `scenery.MATERIALS`, 0 to 255, (materials, 3).
        samples: of a pixel, for anti-aliasing; 0: one.
        boxes: as in `camera.take_pictures`, in red, green and blue, (boxes, 9).
    """
    spec = mujoco.MjSpec()
    spec.visual.quality.offsamples, spec.visual.quality.shadowsize = samples, 0
    spec.visual.map.znear, spec.visual.map.zfar = 0.002, 30.0
    spec.stat.extent, spec.stat.center = 10.0, [0, 0, 0]
    for light in ("ambient", "diffuse", "specular"):
        setattr(spec.visual.headlight, light, [0, 0, 0])
    spec.visual.global_.offwidth, spec.visual.global_.offheight = lens.width, lens.height
    color = {name: rgb / 255 for name, rgb in zip(MATERIALS, colors.astype(float), strict=True)}
    for name, rgb in color.items():
        spec.add_material(name=name, rgba=[*rgb, 1], emission=1.0, specular=0.0, reflectance=0.0)
    flat = mujoco.mjtBuiltin.mjBUILTIN_FLAT
    kind = mujoco.mjtTexture.mjTEXTURE_SKYBOX
    spec.add_texture(
        name="sky", type=kind, builtin=flat, rgb1=color["sky"], rgb2=color["sky"], width=8, height=48
    )
    plain = track.road
    if track.floor.lines_inside:
        lines = [shapely.LineString(line).buffer(LINE_WIDTH_M) for line in (track.inner, track.outer)]
        plain = track.road.difference(shapely.union_all(lines))
    _add_area(spec, "road", plain, 0.0)
    _add_area(spec, "line", paved_area(track).difference(plain), 0.0)
    dashes = _dashes(track.waypoints, DASH_WIDTH_M, track.floor.dash_length_m, track.floor.dash_gap_m)
    if track.floor.start_line_color is not None:
        light, dark = _start_line(track)
        dashes = dashes[~shapely.intersects(dashes, light.union(dark))]
        _add_area(spec, "line", light.intersection(plain), 0.5 * _UNSEEN_M, "start_light")
        _add_area(spec, "start", dark.intersection(plain), 0.5 * _UNSEEN_M)
    _add_area(spec, "dash", shapely.multipolygons(dashes), 0.5 * _UNSEEN_M)
    if track.floor.kerb_color is not None:
        rings = shapely.get_rings(shapely.orient_polygons(paved_area(track, KERB_WIDTH_M / 2)))
        kerbs = [
            _dashes(shapely.get_coordinates(ring), KERB_WIDTH_M, KERB_LENGTH_M, KERB_GAP_M) for ring in rings
        ]
        _add_area(spec, "kerb", shapely.multipolygons(np.concatenate(kerbs)), 0.5 * _UNSEEN_M)
    ring = wall_ring(track)
    assert ring is not None
    (x, y), (half_x, half_y) = 0.5 * (ring.min(0) + ring.max(0)), 0.5 * np.ptp(ring, axis=0)
    thick, tall = 0.01, 0.5 * track.floor.walls_height_m
    _add_box(spec, "field", (x, y, -_UNSEEN_M - thick), (half_x, half_y, thick))
    for a, b in pairwise(ring):
        (x, y), length = b - a, float(np.linalg.norm(b - a))
        outwards = np.array([y, -x]) / length
        wall = MATERIALS[wall_material(track, ring, a, b)]
        middle = 0.5 * (a + b) + thick * outwards
        _add_box(spec, wall, (*middle, tall), (0.5 * length, thick, tall), np.arctan2(y, x))
    standing = [] if boxes is None else [box for box in boxes.astype(float) if box[5] > 0]
    for index, box in enumerate(standing):
        # For the top, for front and back, and for the sides.
        for out, share in zip((2, 0, 1), FACE_LIGHT, strict=True):
            half = 0.5 * box[3:6] - _HIDDEN_M * (np.arange(3) != out)
            name = f"box_{index}_{out}"
            rgba = [*(share * box[6:] / 255), 1]
            spec.add_material(name=name, rgba=rgba, emission=1.0, specular=0.0, reflectance=0.0)
            _add_box(spec, name, (box[0], box[1], 0.5 * box[5]), half, box[2])
    cos, sin = np.cos(lens.pitch_rad), np.sin(lens.pitch_rad)
    spec.worldbody.add_body(name="car", mocap=True).add_camera(
        name="eye",
        pos=[lens.x_m, lens.y_m, lens.z_m],
        xyaxes=[0, -1, 0, sin, 0, cos],
        fovy=np.degrees(2 * np.arctan(np.tan(0.5 * lens.field_of_view_rad) * lens.height / lens.width)),
    )
    return spec.compile()


class SceneRenderer:
    """MuJoCo's renderer of a scene, with everything switched off that costs time."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        """Open a context; the size is that of the pictures."""
        self._model, self._data = model, mujoco.MjData(model)
        self._renderer = mujoco.Renderer(model, height, width)
        flag = mujoco.mjtRndFlag
        for off in (flag.mjRND_SHADOW, flag.mjRND_REFLECTION, flag.mjRND_FOG, flag.mjRND_HAZE):
            self._renderer.scene.flags[off] = False

    def take(self, pose: Sequence[float]) -> NDArray[np.uint8]:
        """Return the picture at x, y, yaw, pitch, roll: (height, width, 3)."""
        x, y, *angles = pose
        quaternion = Rotation.from_euler("ZYX", angles).as_quat(scalar_first=True)
        self._data.mocap_pos[0], self._data.mocap_quat[0] = (x, y, 0.0), quaternion
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._renderer.update_scene(self._data, "eye")
        picture: NDArray[np.uint8] = self._renderer.render()
        return picture

    def take_all(self, poses: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Return the pictures at several poses, (N, height, width, 3)."""
        return np.stack([self.take(pose) for pose in poses])

    def close(self) -> None:
        """Close the context."""
        self._renderer.close()


def _dashes(
    center: NDArray[np.float64], width_m: float, length_m: float, gap_m: float
) -> NDArray[np.object_]:
    line = shapely.LineString(center)
    starts = np.arange(0, line.length - length_m, length_m + gap_m)
    a, b = (shapely.line_interpolate_point(line, starts + more) for more in (0.0, length_m))
    ends = np.stack([shapely.get_coordinates(a), shapely.get_coordinates(b)], axis=1)
    dashes: NDArray[np.object_] = shapely.buffer(shapely.linestrings(ends), 0.5 * width_m, cap_style="flat")
    return dashes


def _start_line(track: Track) -> tuple[BaseGeometry, BaseGeometry]:
    """Return the light and the dark fields of the start line."""
    (ax, ay), (bx, by) = track.waypoints[:2]
    cos, sin = np.array([bx - ax, by - ay]) / np.hypot(bx - ax, by - ay)
    along, across = START_CHECKS
    wide, long = START_WIDTH_M / across, START_LENGTH_M / along
    fields: tuple[list[BaseGeometry], list[BaseGeometry]] = ([], [])
    for i in range(along):
        for j in range(across):
            x, y = START_AHEAD_M + (i - 0.5 * along) * long, (j - 0.5 * across) * wide
            turned = [cos, -sin, sin, cos, ax, ay]
            fields[(i + j + 1) % 2].append(affine_transform(shapely.box(x, y, x + long, y + wide), turned))
    return shapely.multipolygons(fields[0]), shapely.multipolygons(fields[1])


def _add_area(
    spec: mujoco.MjSpec, material: str, area: BaseGeometry, z_m: float, name: str | None = None
) -> None:
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(area))
    corners = np.stack([shapely.get_coordinates(shapely.orient_polygons(one))[:3] for one in triangles])
    points = np.column_stack([corners.reshape(-1, 2), np.full(3 * len(corners), z_m)])
    # MuJoCo refuses a mesh without thickness; the lower points belong to no face.
    points = np.concatenate([points, points - [0, 0, _UNSEEN_M]])
    faces = np.arange(3 * len(corners), dtype=np.int32)
    shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    spec.add_mesh(name=name or material, uservert=points.ravel(), userface=faces, inertia=shell)
    mesh = mujoco.mjtGeom.mjGEOM_MESH
    spec.worldbody.add_geom(type=mesh, meshname=name or material, material=material, contype=0, conaffinity=0)


def _add_box(
    spec: mujoco.MjSpec, material: str, pos: Sequence[float], size: ArrayLike, yaw: float = 0.0
) -> None:
    box = mujoco.mjtGeom.mjGEOM_BOX
    quat = [np.cos(0.5 * yaw), 0, 0, np.sin(0.5 * yaw)]
    spec.worldbody.add_geom(
        type=box, pos=pos, size=size, quat=quat, material=material, contype=0, conaffinity=0
    )
