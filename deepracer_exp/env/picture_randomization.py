"""Pictures that differ from episode to episode: light, colours, sharpness, noise, and where the camera sits."""

from collections.abc import Sequence
from dataclasses import fields

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deepracer_exp.config.driving import PictureRandomizationConfig
from deepracer_exp.sim.scenery import MATERIALS

from .randomization import CarStreams, Ids, Purpose

QUANTITIES = tuple(field.name for field in fields(PictureRandomizationConfig))
_COLUMN = {name: column for column, name in enumerate(QUANTITIES)}
_OFF = np.array([1.0 if name.endswith("_scale") else 0.0 for name in QUANTITIES])
_MIDDLE = 127.5
_SPOT_SIZE = (0.1, 0.5)
"""Standard deviation of a shadow or spot of light, as a share of the picture's width."""
_NOISE_NUMBERS = 2**18
"""Standard normal numbers that all pictures take their noise from: drawing each would take longer than the picture."""
_NEXT_PICTURE = 7919
"""Numbers by which the noise of successive pictures is apart."""

Floats = NDArray[np.float64]


class PictureRandomization:
    """Draws the camera and the light of each episode of N cars, and disturbs their pictures.

    What an episode draws depends only on the seed, the car's number and the episode's number.
    """

    def __init__(self, configs: Sequence[PictureRandomizationConfig | None], cars: Sequence[int]) -> None:
        """Take each car's ranges and its number over all processes; call `seed` and then `begin` next."""
        none = np.stack([_OFF, _OFF], axis=1)
        ranges = np.array(
            [none if one is None else [getattr(one, name) for name in QUANTITIES] for one in configs],
            np.float64,
        )
        self._low: Floats = ranges[..., 0]
        self._span: Floats = ranges[..., 1] - self._low
        self._cars = list(cars)
        n_cars = len(self._cars)
        self._values = np.tile(_OFF, (n_cars, 1))
        self._color_factor = np.ones((n_cars, len(MATERIALS), 3))
        # Depth (negative: a shadow), and middle and size as shares of the width.
        self._spot = np.zeros((n_cars, 4))
        self._noise_at = np.zeros(n_cars, np.int64)
        self._noise = np.random.default_rng(0).standard_normal(_NOISE_NUMBERS).astype(np.float32)

    def seed(self, seed: int) -> None:
        """Start all streams from `seed`."""
        self._streams = CarStreams(seed, self._cars, Purpose.PICTURE)

    def begin(self, ids: Ids, episodes: NDArray[np.int64]) -> None:
        """Draw for new episodes of the cars `ids`; episodes are numbered per car from 0."""
        for car, episode in zip(ids.tolist(), episodes.tolist(), strict=True):
            stream = self._streams.at(car, episode)
            values = self._low[car] + self._span[car] * stream.random(len(QUANTITIES))
            self._values[car] = values
            factor = 1.0 + values[_COLUMN["color_noise"]] * stream.standard_normal(
                self._color_factor.shape[1:]
            )
            self._color_factor[car] = factor
            sign, x, y, size = stream.random(4)
            depth = values[_COLUMN["light"]] * (1.0 if sign < 0.5 else -1.0)
            self._spot[car] = depth, x, y, _SPOT_SIZE[0] + (_SPOT_SIZE[1] - _SPOT_SIZE[0]) * size
            self._noise_at[car] = stream.integers(_NOISE_NUMBERS)

    def mounts(self, ids: Ids, mount: Floats) -> Floats:
        """Return the mounts (n, 5) of cameras that `camera.Lens.mount` describes, (5,)."""
        out = np.tile(mount, (len(ids), 1))
        out[:, 2] += self._of("height_m", ids)
        out[:, 3] += np.radians(self._of("pitch_deg", ids))
        out[:, 4] /= self._of("field_of_view_scale", ids)
        return out

    def colors(self, ids: Ids, colors: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the colours that cars see, given those of their tracks, (n, materials, 3), 0 to 255."""
        seen = np.clip(colors * self._color_factor[ids], 0, 255)
        seen = 255 * (seen / 255) ** self._of("gamma_scale", ids)[:, None, None]
        seen = (seen - _MIDDLE) * self._of("contrast_scale", ids)[:, None, None] + _MIDDLE
        seen = np.clip(seen * self._of("brightness_scale", ids)[:, None, None], 0, 255)
        return seen.astype(np.float32)

    def disturb(self, ids: Ids, pictures: NDArray[np.uint8], steps: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Add light, blur and noise to pictures (n, channels, height, width), taken `steps` after the start, (n,)."""
        noise_at = (self._noise_at[ids] + _NEXT_PICTURE * steps) % _NOISE_NUMBERS
        blur, noise = self._of("blur", ids), 255 * self._of("pixel_noise", ids)
        return _disturb(pictures, self._spot[ids], blur, noise, self._noise, noise_at)

    def _of(self, name: str, ids: Ids) -> Floats:
        return self._values[ids, _COLUMN[name]]


@njit(cache=True, fastmath=True, error_model="numpy", nogil=True)
def _disturb(pictures, spots, blurs, deviations, numbers, noise_at):  # type: ignore[no-untyped-def]
    """Return the pictures with light, blur and noise."""
    count, channels, height, width = pictures.shape
    out = np.empty_like(pictures)
    across = np.empty(width, np.float32)
    for at in range(count):
        depth, x, y, size = spots[at]
        side = np.float32(0.25 * blurs[at])
        own = np.float32(1.0 - blurs[at])
        deviation = np.float32(deviations[at])
        for column in range(width):
            across[column] = np.exp(-0.5 * (((column + 0.5) / width - x) / size) ** 2)
        number = noise_at[at]
        for channel in range(channels):
            picture = pictures[at, channel]
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
                    value = own * np.float32(middle[column]) + side * around
                    value *= np.float32(1.0) + down * across[column]
                    value += deviation * numbers[number + column] + np.float32(0.5)
                    out[at, channel, row, column] = np.uint8(min(max(value, np.float32(0)), np.float32(255)))
                number += width
    return out
