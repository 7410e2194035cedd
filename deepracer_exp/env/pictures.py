"""The pictures of an observation: each car's present and earlier camera frames."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.driving import CameraConfig, FloorConfig
from deepracer_exp.env.randomization.car_randomization import Ids
from deepracer_exp.env.randomization.picture_randomization import PictureRandomization
from deepracer_exp.sim.batch import CarState, cores
from deepracer_exp.sim.camera import take_pictures
from deepracer_exp.sim.lens import Lens
from deepracer_exp.sim.scenery import MATERIALS, build_scenery, join_sceneries
from deepracer_exp.tracks.track import Track

from .real_car import AS_SIMULATED, FRAME_SCALE, car_pictures

GREY = np.array([0.299, 0.587, 0.114], np.float32)
"""Weights of red, green and blue in the service's grey (ITU-R BT.601; deepracer-simapp turns RGB into luminance)."""
_WALLS = ("wall_low_x", "wall_low_y", "wall_high_x", "wall_high_y")
_FRAMES_AT_ONCE, _PICTURES_AT_ONCE = 16, 256
"""Frames of the physical car's camera, and pictures of the simulator's, that a thread renders at once: 5 MB in grey."""

Pixels = NDArray[np.uint8]


class Pictures:
    """The cameras of N cars.

    Attributes:
        shape: channels, height and width of an observation; the channels of the oldest picture come first.
    """

    def __init__(
        self,
        config: CameraConfig,
        car: CarConfig,
        tracks: Sequence[Track],
        varied: PictureRandomization | None,
        jpeg_quality: NDArray[np.int64],
        threads: int = 1,
    ) -> None:
        """Build the scenery; `threads` take the pictures, 0 means one per core.

        `varied` differs from episode to episode and is drawn before the pictures are taken. `jpeg_quality` of each car,
        (N,), makes pictures as the physical car does; `AS_SIMULATED` leaves each pixel the mean of what it sees. Later
        values count.
        """
        self._jpeg_quality = jpeg_quality
        self._varied = varied
        self._threads = threads or cores()
        # They begin with the first pictures: a process may still fork.
        self._pool = ThreadPoolExecutor(self._threads)
        self.shape = config.shape
        self._now = config.shape[0] // config.frames  # channels of one moment
        sides_m = (0.5 * config.stereo_m, -0.5 * config.stereo_m) if config.stereo_m else (0.0,)
        self._lenses = [
            Lens(
                width=config.width,
                height=config.height,
                field_of_view_rad=np.radians(config.field_of_view_deg),
                x_m=car.camera_x_m,
                y_m=side_m,
                z_m=car.camera_z_m,
                pitch_rad=np.radians(car.camera_pitch_deg),
            )
            for side_m in sides_m
        ]
        self._tilt_rad_per_mps2 = np.radians(car.tilt_deg_per_mps2)
        self._scenery = join_sceneries([build_scenery(track) for track in tracks])
        self._floor_colors = np.stack([floor_colors(track.floor) for track in tracks])
        self._grey = config.color == "grey"

    def first(
        self,
        ids: Ids,
        state: CarState,
        course: NDArray[np.intp],
        others: NDArray[np.float32] | None = None,
    ) -> Pixels:
        """Return the first observations of the cars `ids`, (n, *shape): earlier pictures equal the present one.

        Args:
            ids: indices of the cars, (n,).
            state: of these cars, arrays (n,).
            course: index of each of these cars' track, (n,).
            others: boxes and bots on the road, in red, green and blue, (n, K, 9), see `camera.take_pictures`.
        """
        still = np.zeros((len(course), 2))
        now = self._take(ids, state, still, course, np.zeros(len(course), np.int64), others)
        return np.tile(now, (1, self.shape[0] // self._now, 1, 1))

    def next(
        self,
        before: Pixels,
        state: CarState,
        acceleration_mps2: NDArray[np.float64],
        course: NDArray[np.intp],
        steps: NDArray[np.int64],
        dropped: NDArray[np.bool_] | None,
        others: NDArray[np.float32] | None = None,
    ) -> Pixels:
        """Return the observations of all cars after `before`, (N, *shape).

        Args:
            before: observations of the step before, (N, *shape).
            state: arrays (N,).
            acceleration_mps2: ahead and to the left, (N, 2).
            course: index of each car's track, (N,).
            steps: control steps of each car's episode, (N,).
            dropped: cars that see nothing new, (N,); None: there are none.
            others: boxes and bots on the road, (N, K, 9), as for `first`.
        """
        now = self._take(np.arange(len(before)), state, acceleration_mps2, course, steps, others)
        out = now if self._now == self.shape[0] else np.concatenate([before[:, self._now :], now], axis=1)
        if dropped is not None:
            out[dropped] = before[dropped]
        return out

    def _take(
        self,
        ids: Ids,
        state: CarState,
        acceleration_mps2: NDArray[np.float64],
        course: NDArray[np.intp],
        steps: NDArray[np.int64],
        others: NDArray[np.float32] | None,
    ) -> Pixels:
        ahead, left = self._tilt_rad_per_mps2 * acceleration_mps2.T
        poses = np.stack([state.x_m, state.y_m, state.yaw_rad, -ahead, left], axis=1)
        most = _FRAMES_AT_ONCE if (self._jpeg_quality[ids] != AS_SIMULATED).any() else _PICTURES_AT_ONCE
        size = min(most, -(-len(ids) // self._threads))
        if len(ids) <= size:
            return self._take_some(ids, poses, course, steps, others)

        def take(first: int) -> Pixels:
            rows = slice(first, first + size)
            around = None if others is None else others[rows]
            return self._take_some(ids[rows], poses[rows], course[rows], steps[rows], around)

        # Drawing, most of the work, does not hold Python's lock.
        how = map if self._threads == 1 else self._pool.map
        return np.concatenate(list(how(take, range(0, len(ids), size))))

    def _take_some(
        self,
        ids: Ids,
        poses: NDArray[np.float64],
        course: NDArray[np.intp],
        steps: NDArray[np.int64],
        others: NDArray[np.float32] | None,
    ) -> Pixels:
        varied = self._varied
        colors, boxes = self._floor_colors[course], others
        if varied is not None:
            colors, boxes = varied.colors(ids, colors), varied.boxes(ids)
            if others is not None:
                others = varied.others(ids, others)
                boxes = others if boxes is None else np.concatenate([boxes, others], axis=1)
        if self._grey:
            colors = (colors @ GREY)[..., None]
            if boxes is not None:
                boxes = np.concatenate([boxes[..., :6], (boxes[..., 6:] @ GREY)[..., None]], axis=-1)
        shots = [self._shoot(lens, ids, poses, course, colors, boxes) for lens in self._lenses]
        now = shots[0] if len(shots) == 1 else np.concatenate(shots, axis=1)
        return now if varied is None else varied.disturb(ids, now, steps)

    def _shoot(
        self,
        lens: Lens,
        ids: Ids,
        poses: NDArray[np.float64],
        course: NDArray[np.intp],
        colors: NDArray[np.float32],
        boxes: NDArray[np.float32] | None,
    ) -> Pixels:
        """Return the cars' pictures through a lens, (n, channels, height, width): arguments as for `take_pictures`."""
        is_real = self._jpeg_quality[ids] != AS_SIMULATED
        if is_real.any() and not is_real.all():
            out = np.empty((len(ids), colors.shape[-1], lens.height, lens.width), np.uint8)
            for rows in (np.flatnonzero(is_real), np.flatnonzero(~is_real)):
                around = None if boxes is None else boxes[rows]
                out[rows] = self._shoot(lens, ids[rows], poses[rows], course[rows], colors[rows], around)
            return out
        if is_real.any():
            lens = replace(lens, width=FRAME_SCALE * lens.width, height=FRAME_SCALE * lens.height)
        mounts = None if self._varied is None else self._varied.mounts(ids, lens.mount)
        out = np.empty((len(ids), colors.shape[-1], lens.height, lens.width), np.uint8)
        take_pictures(lens, self._scenery, poses, course, colors, out, mounts, boxes)
        return car_pictures(out, self._jpeg_quality[ids]) if is_real.any() else out


def floor_colors(floor: FloorConfig) -> NDArray[np.float32]:
    """Return red, green and blue of MATERIALS, 0 to 255, (materials, 3)."""
    road, line, wall = _rgb(floor.road_color), _rgb(floor.line_color), _rgb(floor.wall_color)
    dash, kerb, start = (
        _rgb(color or floor.line_color)
        for color in (floor.dash_color, floor.kerb_color, floor.start_line_color)
    )
    dashes = floor.dash_length_m / (floor.dash_length_m + floor.dash_gap_m)
    colors = {
        "sky": _rgb(floor.sky_color),
        "field": _rgb(floor.ground_color),
        "road": road,
        "line": line,
        "dash": dash,
        "far_dash": road + dashes * (dash - road),
        **{
            name: np.minimum(light * wall, 255) for name, light in zip(_WALLS, floor.walls_light, strict=True)
        },
        "kerb": kerb,
        "far_kerb": 0.5 * (kerb + line),
        "start": start,
        "far_start": 0.5 * (start + line),
    }
    return np.array([colors[material] for material in MATERIALS], np.float32)


def _rgb(color: str) -> NDArray[np.float32]:
    return np.array([int(color[begin : begin + 2], 16) for begin in (1, 3, 5)], np.float32)
