"""The scenery of a track for MuJoCo's renderer, built from the track's polygons: what our camera is compared with."""

from collections.abc import Sequence

import mujoco
import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from shapely.geometry.base import BaseGeometry

from deepracer_exp.sim.camera import Lens
from deepracer_exp.sim.scenery import (
    DASH_LENGTH_M,
    DASH_PITCH_M,
    DASH_WIDTH_M,
    LINE_WIDTH_M,
    MATERIALS,
    WALL_HEIGHT_M,
)
from deepracer_exp.tracks.track import Track

_UNSEEN_M = 1e-3
"""Thickness of what is flat; dashes lie half of it above the road."""


def build_scene(
    track: Track, lens: Lens, colors: NDArray[np.float32], samples: int, walls_beyond_m: float
) -> mujoco.MjModel:
    """Return a model with a body `car` to be moved and its camera `eye`; nothing is lit, all surfaces glow.

    Args:
        track: its road, borders and centre line.
        lens: of the camera.
        colors: of `scenery.MATERIALS`, 0 to 255, (materials, 3).
        samples: of a pixel, for anti-aliasing; 0: one.
        walls_beyond_m: as in `scenery.build_scenery`.
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
    lines = shapely.union_all(
        [shapely.LineString(line).buffer(LINE_WIDTH_M) for line in (track.inner, track.outer)]
    )
    _add_area(spec, "road", track.road.difference(lines), 0.0)
    _add_area(spec, "line", track.road.intersection(lines), 0.0)
    center = shapely.LineString(track.waypoints)
    starts = np.arange(0, center.length - DASH_LENGTH_M, DASH_PITCH_M)
    a, b = (shapely.line_interpolate_point(center, starts + more) for more in (0.0, DASH_LENGTH_M))
    ends = np.stack([shapely.get_coordinates(a), shapely.get_coordinates(b)], axis=1)
    dashes = shapely.buffer(shapely.linestrings(ends), 0.5 * DASH_WIDTH_M, cap_style="flat")
    _add_area(spec, "dash", shapely.multipolygons(dashes), 0.5 * _UNSEEN_M)
    low, high = np.array(track.road.bounds).reshape(2, 2) + np.array([[-walls_beyond_m], [walls_beyond_m]])
    (x, y), (half_x, half_y) = 0.5 * (low + high), 0.5 * (high - low)
    thick, tall = 0.01, 0.5 * WALL_HEIGHT_M
    _add_box(spec, "field", (x, y, -_UNSEEN_M - thick), (half_x, half_y, thick))
    for side in (-1, 1):
        _add_box(spec, "wall_x", (x + side * (half_x + thick), y, tall), (thick, half_y, tall))
        _add_box(spec, "wall_y", (x, y + side * (half_y + thick), tall), (half_x, thick, tall))
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


def _add_area(spec: mujoco.MjSpec, material: str, area: BaseGeometry, z_m: float) -> None:
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(area))
    corners = np.stack([shapely.get_coordinates(shapely.orient_polygons(one))[:3] for one in triangles])
    points = np.column_stack([corners.reshape(-1, 2), np.full(3 * len(corners), z_m)])
    # MuJoCo refuses a mesh without thickness; the lower points belong to no face.
    points = np.concatenate([points, points - [0, 0, _UNSEEN_M]])
    faces = np.arange(3 * len(corners), dtype=np.int32)
    shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    spec.add_mesh(name=material, uservert=points.ravel(), userface=faces, inertia=shell)
    mesh = mujoco.mjtGeom.mjGEOM_MESH
    spec.worldbody.add_geom(type=mesh, meshname=material, material=material, contype=0, conaffinity=0)


def _add_box(spec: mujoco.MjSpec, material: str, pos: tuple[float, ...], size: tuple[float, ...]) -> None:
    box = mujoco.mjtGeom.mjGEOM_BOX
    spec.worldbody.add_geom(type=box, pos=pos, size=size, material=material, contype=0, conaffinity=0)
