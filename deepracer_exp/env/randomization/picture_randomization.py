"""Pictures that differ from episode to episode: light, colours, sharpness, noise, the camera, objects by the road."""

from collections.abc import Sequence
from dataclasses import fields

import numpy as np
import shapely
from numpy.typing import NDArray

from deepracer_exp.config.driving import PictureRandomizationConfig
from deepracer_exp.jit import njit
from deepracer_exp.sim.scenery import MATERIALS, paved_area, wall_ring
from deepracer_exp.tracks.track import Track

from .car_randomization import CarStreams, Ids, Purpose

QUANTITIES = tuple(field.name for field in fields(PictureRandomizationConfig))
_COLUMN = {name: column for column, name in enumerate(QUANTITIES)}
_LENS, _OTHERS = _COLUMN["lens_k1"], _COLUMN["others_scale"]
_OFF = np.array([1.0 if name.endswith("_scale") else 0.0 for name in QUANTITIES])
_FIRST_QUANTITIES, _FIRST_MATERIALS, _DRAWN_MATERIALS = 10, 8, 12
"""Quantities and materials added later are drawn after everything else, so that they change no earlier draw. The lens
and the looks of others were added after the objects, which draw a varying number of values, and so have streams of
their own."""
_FACTOR_OF = [MATERIALS.index(name.removeprefix("far_").replace("high", "low")) for name in MATERIALS]
"""Material whose colour factor each material shares: a line keeps its colour farther ahead, and opposite walls
match."""
_MIDDLE = 127.5
_SPOT_SIZE = (0.1, 0.5)
"""Standard deviation of a shadow or spot of light, as a share of the picture's width."""
_DIRT_SPOTS, _DIRT_SIZE = 4, (0.015, 0.06)
"""Number of dirt spots, and their standard deviation as a share of the picture's width."""
_OBJECT_LOW_M, _OBJECT_HIGH_M = np.array([0.1, 0.1, 0.1]), np.array([0.6, 0.6, 0.9])
"""Length, width and height of objects: lower than the default walls."""
_PLACES, _CLEARANCE_M, _BESIDE_M = 256, 0.05, 1.6
"""Places of objects per track, their least distance from road and walls, and largest from the border."""
_NOISE_NUMBERS = 2**18
"""Standard normal numbers that all pictures share as noise: drawing new ones would take longer than the picture."""
_NEXT_PICTURE = 7919
"""Offset among these numbers from one picture to the next."""

Floats = NDArray[np.float64]


class PictureRandomization:
    """Draws the camera and the light of each episode of N cars, and disturbs their pictures.

    What an episode draws depends only on the seed, the car's number and the episode's number.

    Attributes:
        most_boxes: boxes around a car, those that are left out included.
    """

    def __init__(
        self,
        configs: Sequence[PictureRandomizationConfig | None],
        cars: Sequence[int],
        tracks: Sequence[Track],
        others: int = 0,
    ) -> None:
        """Take each car's ranges, its number over all processes and the number of others around it.

        Call `seed` and then `begin` next.
        """
        none = np.stack([_OFF, _OFF], axis=1)
        ranges = np.array(
            [
                none if config is None else [getattr(config, name) for name in QUANTITIES]
                for config in configs
            ],
            np.float64,
        )
        self._low: Floats = ranges[..., 0]
        self._span: Floats = ranges[..., 1] - self._low
        self._cars = list(cars)
        n_cars = len(self._cars)
        self._values = np.tile(_OFF, (n_cars, 1))
        self._color_factor = np.ones((n_cars, len(MATERIALS), 3))
        # Depth (negative: a shadow), middle as shares of width and height, and size as a share of the width.
        self._spot = np.zeros((n_cars, 4))
        self._noise_start = np.zeros(n_cars, np.int64)
        # Middle as shares of width and height, and size as a share of the width.
        self._dirt = np.zeros((n_cars, _DIRT_SPOTS, 3))
        self.most_boxes = most = int(ranges[:, _COLUMN["objects"], 1].max())
        self._span[:, _COLUMN["objects"]] += 1  # 0, 1 and 2 objects are equally probable
        self._places = [_places(track) for track in tracks] if most else []
        self._boxes = np.zeros((n_cars, most, 9), np.float32)
        # Factors on the size and on red, green and blue.
        self._looks = np.ones((n_cars, others, 4))
        self._noise = np.random.default_rng(0).standard_normal(_NOISE_NUMBERS).astype(np.float32)

    def seed(self, seed: int) -> None:
        """Start all streams from `seed`."""
        self._streams = CarStreams(seed, self._cars, Purpose.PICTURE)
        self._lens_streams = CarStreams(seed, self._cars, Purpose.LENS)
        self._look_streams = CarStreams(seed, self._cars, Purpose.LOOKS)

    def begin(self, ids: Ids, episodes: NDArray[np.int64], course: NDArray[np.intp]) -> None:
        """Draw for new episodes of the cars `ids` on tracks `course`; episodes are numbered per car from 0."""
        draws = np.empty(len(QUANTITIES))
        normal = np.empty(self._color_factor.shape[1:])
        for car, episode, track in zip(ids.tolist(), episodes.tolist(), course.tolist(), strict=True):
            stream = self._streams.stream(car, episode)
            stream.random(out=draws[:_FIRST_QUANTITIES])
            stream.standard_normal(out=normal[:_FIRST_MATERIALS])
            sign, x, y, size = stream.random(4)
            self._noise_start[car] = stream.integers(_NOISE_NUMBERS)
            stream.random(out=draws[_FIRST_QUANTITIES:_LENS])
            stream.standard_normal(out=normal[_FIRST_MATERIALS:_DRAWN_MATERIALS])
            draws[_LENS] = self._lens_streams.stream(car, episode).random()
            draws[_OTHERS] = 0.0  # each other has one of its own
            values = self._low[car] + self._span[car] * draws
            self._values[car] = values
            self._color_factor[car] = 1.0 + values[_COLUMN["color_noise"]] * normal[_FACTOR_OF]
            self._draw_looks(car, episode, values[_COLUMN["color_noise"]])
            depth = values[_COLUMN["light"]] * (1.0 if sign < 0.5 else -1.0)
            self._spot[car] = depth, x, y, _SPOT_SIZE[0] + (_SPOT_SIZE[1] - _SPOT_SIZE[0]) * size
            self._dirt[car] = stream.random((_DIRT_SPOTS, 3))
            self._dirt[car, :, 2] = _DIRT_SIZE[0] + (_DIRT_SIZE[1] - _DIRT_SIZE[0]) * self._dirt[car, :, 2]
            if len(self._boxes[car]):
                objects = stream.random((int(values[_COLUMN["objects"]]), 8))
                self._place_objects(car, objects, self._places[track])

    def _draw_looks(self, car: int, episode: int, color_noise: float) -> None:
        """Draw the factors on size and colours of the boxes and bots around a car."""
        looks = self._looks[car]
        if len(looks):
            stream = self._look_streams.stream(car, episode)
            looks[:, 0] = self._low[car, _OTHERS] + self._span[car, _OTHERS] * stream.random(len(looks))
            looks[:, 1:] = 1.0 + color_noise * stream.standard_normal((len(looks), 3))

    def _place_objects(self, car: int, objects: Floats, places: Floats) -> None:
        """Set the car's boxes from uniform draws (n, 8); those that would overlap others are left out."""
        boxes = self._boxes[car]
        boxes[:] = 0
        taken = np.empty((0, 3))
        for row, draw in zip(boxes, objects if len(places) else (), strict=False):
            x, y, free_m = places[int(draw[0] * len(places))]
            length, width, height = _OBJECT_LOW_M + (_OBJECT_HIGH_M - _OBJECT_LOW_M) * draw[1:4]
            radius = 0.5 * np.hypot(length, width)
            fit = min(1.0, free_m / radius)
            radius *= fit
            if (np.hypot(taken[:, 0] - x, taken[:, 1] - y) > taken[:, 2] + radius).all():
                taken = np.concatenate([taken, [[x, y, radius]]])
                row[:6] = x, y, 2 * np.pi * draw[4], fit * length, fit * width, height
        boxes[: len(objects), 6:] = self.exposed(np.array([car]), 255 * objects[None, :, 5:])[0]

    def mounts(self, ids: Ids, mount: Floats) -> Floats:
        """Return the randomized mounts (n, 5) of the cars' cameras, given the lens's `camera.Lens.mount`, (5,)."""
        out = np.tile(mount, (len(ids), 1))
        out[:, 2] += self._of("height_m", ids)
        out[:, 3] += np.radians(self._of("pitch_deg", ids))
        out[:, 4] /= self._of("field_of_view_scale", ids)
        # Wide enough for the corners.
        out[:, 4] /= 1 + np.maximum(self._of("lens_k1", ids), 0)
        return out

    def colors(self, ids: Ids, colors: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the colours that cars see, given those of their tracks, (n, materials, 3), 0 to 255."""
        return self.exposed(ids, np.clip(colors * self._color_factor[ids], 0, 255))

    def exposed(self, ids: Ids, colors: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return colours as the light of the episode and the camera make them, (n, any number, 3), 0 to 255."""
        seen = 255 * (colors / 255) ** self._of("gamma_scale", ids)[:, None, None]
        seen = (seen - _MIDDLE) * self._of("contrast_scale", ids)[:, None, None] + _MIDDLE
        seen = np.clip(seen * self._of("brightness_scale", ids)[:, None, None], 0, 255)
        return seen.astype(np.float32)

    def boxes(self, ids: Ids) -> NDArray[np.float32] | None:
        """Return the boxes beside the road, in red, green and blue, (n, most, 9); see `camera.take_pictures`."""
        return self._boxes[ids] if self._boxes.size else None

    def others(self, ids: Ids, others: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return boxes and bots on the road as they look in the episodes, (n, K, 9); see `camera.take_pictures`."""
        looks = self._looks[ids]
        colors = self.exposed(ids, np.clip(others[..., 6:] * looks[..., 1:], 0, 255))
        sizes = others[..., 3:6] * looks[..., :1]
        return np.concatenate([others[..., :3], sizes.astype(np.float32), colors], axis=-1)

    def disturb(self, ids: Ids, pictures: NDArray[np.uint8], steps: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Add the lens's distortion, dirt, light, blur and noise to pictures (n, channels, height, width).

        They are those at control steps `steps` of the episodes, (n,). Dirt is written into `pictures` itself.
        """
        k1 = self._of("lens_k1", ids)
        if k1.any():
            pictures = _distort(pictures, k1)
        dirt = self._of("dirt", ids)
        if dirt.any():
            _darken_spots(pictures, self._dirt[ids], dirt)
        noise_start = (self._noise_start[ids] + _NEXT_PICTURE * steps) % _NOISE_NUMBERS
        blur, noise = self._of("blur", ids), 255 * self._of("pixel_noise", ids)
        return _disturb(pictures, self._spot[ids], blur, noise, self._noise, noise_start)

    def _of(self, name: str, ids: Ids) -> Floats:
        return self._values[ids, _COLUMN[name]]


def _places(track: Track) -> Floats:
    """Return places beside the road and how far each is from the road and the walls, (n, 3), metres."""
    generator = np.random.default_rng(0)
    pose = track.start_pose((np.arange(_PLACES) + generator.random(_PLACES)) / _PLACES)
    side = generator.choice([-1.0, 1.0], _PLACES)
    side *= 0.5 * track.width_max_m + generator.uniform(0, _BESIDE_M, _PLACES)
    x, y = pose.x - side * np.sin(pose.yaw_rad), pose.y + side * np.cos(pose.yaw_rad)
    points = shapely.points(x, y)
    free_m = shapely.distance(paved_area(track), points)
    ring = wall_ring(track)
    if ring is not None:
        beyond = ~shapely.contains(shapely.Polygon(ring), points)
        free_m = np.minimum(free_m, np.where(beyond, 0.0, shapely.distance(shapely.LineString(ring), points)))
    places = np.column_stack([x, y, free_m - _CLEARANCE_M])
    return places[places[:, 2] > 0.5 * np.hypot(*_OBJECT_LOW_M[:2])]


@njit(cache=True, fastmath=True, error_model="numpy", nogil=True)
def _distort(pictures, k1s):  # type: ignore[no-untyped-def]
    """Return pictures as lenses with radial distortion show them.

    A pixel at distance r from the middle, in half diagonals, shows what a pinhole shows at r (1 + k1 r^2). For a
    positive k1, `pictures` have 1 / (1 + k1) of the focal length, so that the corners stay where they are.
    """
    count, channels, height, width = pictures.shape
    out = pictures.copy()
    middle_x, middle_y = np.float32(0.5 * width - 0.5), np.float32(0.5 * height - 0.5)
    # There is always a pixel to the right and one below.
    last_x, last_y = np.float32(width - 1.001), np.float32(height - 1.001)
    places = np.empty(width, np.int32)
    across, down = np.empty(width, np.float32), np.empty(width, np.float32)
    for car in range(count):
        if k1s[car] == 0.0:
            continue
        shrunk = np.float32(1.0 / (1.0 + max(k1s[car], 0.0)))
        per_square = np.float32(shrunk * k1s[car] * 4.0 / (width * width + height * height))
        for row in range(height):
            y = np.float32(row) - middle_y
            for column in range(width):
                x = np.float32(column) - middle_x
                scale = shrunk + per_square * (x * x + y * y)
                from_x = min(max(middle_x + scale * x, np.float32(0)), last_x)
                from_y = min(max(middle_y + scale * y, np.float32(0)), last_y)
                left, top = np.int32(from_x), np.int32(from_y)
                across[column], down[column] = from_x - np.float32(left), from_y - np.float32(top)
                places[column] = top * np.int32(width) + left
            # A loop of its own, so that the one above is vectorised.
            for channel in range(channels):
                flat = pictures[car, channel].reshape(-1)
                for column in range(width):
                    place = np.uint64(places[column])
                    above = np.float32(flat[place])
                    above_right = np.float32(flat[place + np.uint64(1)])
                    below = np.float32(flat[place + np.uint64(width)])
                    below_right = np.float32(flat[place + np.uint64(width + 1)])
                    above += across[column] * (above_right - above)
                    below += across[column] * (below_right - below)
                    out[car, channel, row, column] = np.uint8(
                        above + down[column] * (below - above) + np.float32(0.5)
                    )
    return out


@njit(cache=True, fastmath=True, error_model="numpy", nogil=True)
def _darken_spots(pictures, spots, depths):  # type: ignore[no-untyped-def]
    """Darken spots of the pictures."""
    count, channels, height, width = pictures.shape
    across = np.empty(width, np.float32)
    for car in range(count):
        for x, y, size in spots[car] if depths[car] > 0 else spots[car, :0]:
            reach = 3 * size * width
            first, last = max(int(x * width - reach), 0), min(int(x * width + reach), width)
            for column in range(first, last):
                across[column] = np.exp(-0.5 * (((column + 0.5) / width - x) / size) ** 2)
            for row in range(max(int(y * height - reach), 0), min(int(y * height + reach), height)):
                down = np.float32(
                    depths[car] * np.exp(-0.5 * (((row + 0.5) / width - y * height / width) / size) ** 2)
                )
                for channel in range(channels):
                    for column in range(first, last):
                        left = np.float32(1) - down * across[column]
                        pictures[car, channel, row, column] = np.uint8(
                            left * np.float32(pictures[car, channel, row, column]) + np.float32(0.5)
                        )


@njit(cache=True, fastmath=True, error_model="numpy", nogil=True)
def _disturb(pictures, spots, blurs, deviations, numbers, noise_start):  # type: ignore[no-untyped-def]
    """Return the pictures with light, blur and noise."""
    count, channels, height, width = pictures.shape
    out = np.empty_like(pictures)
    across = np.empty(width, np.float32)
    for car in range(count):
        depth, x, y, size = spots[car]
        side = np.float32(0.25 * blurs[car])
        center = np.float32(1.0 - blurs[car])
        deviation = np.float32(deviations[car])
        for column in range(width):
            across[column] = np.exp(-0.5 * (((column + 0.5) / width - x) / size) ** 2)
        number = noise_start[car]
        for channel in range(channels):
            picture = pictures[car, channel]
            for row in range(height):
                above, below = picture[max(row - 1, 0)], picture[min(row + 1, height - 1)]
                middle = picture[row]
                down = np.float32(
                    depth * np.exp(-0.5 * (((row + 0.5) / width - y * height / width) / size) ** 2)
                )
                if number + width > len(numbers):
                    number = 0
                for column in range(width):
                    around = (
                        np.float32(above[column])
                        + np.float32(below[column])
                        + np.float32(middle[max(column - 1, 0)])
                        + np.float32(middle[min(column + 1, width - 1)])
                    )
                    value = center * np.float32(middle[column]) + side * around
                    value *= np.float32(1.0) + down * across[column]
                    value += deviation * numbers[number + column] + np.float32(0.5)
                    out[car, channel, row, column] = np.uint8(min(max(value, np.float32(0)), np.float32(255)))
                number += width
    return out
