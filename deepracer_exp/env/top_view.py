"""Pictures of a car on its track from above."""

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from deepracer_exp.tracks.outline import draw_track, extent
from deepracer_exp.tracks.track import Track

from .race import Race

_LONG_PX = 640
"""Length of the longer side of the picture."""
_CAR_COLOR, _NOSE_COLOR, _MARK_COLOR = "#d62728", "#ffffff", "#ffbf00"
_CAR_M = ((0.2, 0.1), (0.2, -0.1), (-0.2, -0.1), (-0.2, 0.1))
_NOSE_M = ((0.2, 0.1), (0.2, -0.1), (0.08, -0.1), (0.08, 0.1))
"""Corners ahead and to the left of the middle of the car."""
_MARK_SHARE = 0.03
"""Radius of the ring around the car, which is small on a long track, as a share of the picture's longer side."""


class TopView:
    """Draws the cars of a race, each on its own track."""

    def __init__(self, race: Race) -> None:
        """Set up; a track is drawn when a car is first seen on it."""
        self._race = race
        self._tracks: dict[int, tuple[Image.Image, NDArray[np.float64], float]] = {}

    def picture(self, car: int) -> NDArray[np.uint8]:
        """Return the picture of the car with this index, (height, width, 3), height and width even for video codecs."""
        race = self._race
        course = int(race.rules.course[car])
        if course not in self._tracks:
            self._tracks[course] = _drawn(race.setup.courses[course].tracks[0])
        track, low, scale = self._tracks[course]
        image = track.copy()
        draw = ImageDraw.Draw(image)
        now = race.rules.now
        middle, yaw = np.array([now.x_m[car], now.y_m[car]]), now.yaw_rad[car]
        ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])

        def pixel(point: NDArray[np.float64]) -> tuple[float, float]:
            x, y = (point - low) * scale
            return float(x), float(image.height - y)

        draw.circle(pixel(middle), _MARK_SHARE * _LONG_PX, outline=_MARK_COLOR, width=3)
        for corners, color in ((_CAR_M, _CAR_COLOR), (_NOSE_M, _NOSE_COLOR)):
            draw.polygon([pixel(middle + a * ahead + b * left) for a, b in corners], fill=color)
        return np.array(image)


def _drawn(track: Track) -> tuple[Image.Image, NDArray[np.float64], float]:
    """Return a picture of a track, where its lower left corner lies, and its pixels per metre."""
    low, high = extent(track)
    scale = _LONG_PX / float(np.max(high - low))
    image = draw_track(track, scale)
    # Row 0 is cut rather than the last one, which lies at the lower end of the extent.
    width, height = (size - size % 2 for size in image.size)
    return image.crop((0, image.height - height, width, image.height)), low, scale
