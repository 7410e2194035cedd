"""Zig-zag: frequency, amplitude and cost of steering from side to side on straights."""

import math
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.env.state import STILL_M
from deepracer_exp.tracks.sectors import sector_at, sectors_of
from deepracer_exp.tracks.track import Track

Values = NDArray[np.float64]

CENTRED_DEG = 2.0
"""Steering below which the wheels count as straight: less than the smallest angle of usual action spaces."""
AROUND = 7
"""Control steps before and after, over which a car's direction is averaged: about a second in all."""
DRIVES = ("", "in_progress", "lap_complete")
"""Status of the rows in which the car drives; formats without a status have none."""
PASS_M = 1.0
"""Rows further apart are not of one pass: the car was moved."""
ZIGZAG_PER_M = 1.0
"""Changes of steering a metre of straight from which on a car zig-zags: fast policies of the service's races change 0.2
to 0.4 times, those of its first trainings 1 to 7 times."""
ZIGZAG_DEG = 5.0
"""Angle to either side below which zig-zag is invisible."""
CURE = "an action space with smaller angles"

CONSOLE_CURE = "smaller steering angles in the action space"
"""Remedy for a training of the service, in the terms of its console."""


@dataclass(frozen=True, kw_only=True)
class ZigZag:
    """Sums of a car's zig-zag on straights; two of them can be added.

    A straight is a sector of the course without a bend (`tracks.sectors.sectors_of`), whatever line the car takes on
    it; standing starts count like the rest of a lap. The first change of steering each time a straight is driven is not
    counted: the way from a bend to the left into one to the right needs it, and many straights are short.
    """

    straight_m: float = 0.0
    """Driven on straights, m."""
    laps: float = 0.0
    """Driven length in laps: over the length of all straights of a lap."""
    changes: int = 0
    """Times the steering changed from at least `CENTRED_DEG` to one side to as much to the other, without leaving the
    straight and without the first of them; in between it may be less for any time."""
    swings_deg: float = 0.0
    """Sum over the changes of half the difference between the largest angles before and after, degrees."""
    detour_s: float = 0.0
    """See `lost_s`."""

    def __add__(self, other: "ZigZag") -> "ZigZag":
        """Return the sums of both."""
        return ZigZag(**{name: value + getattr(other, name) for name, value in asdict(self).items()})

    @property
    def changes_per_m(self) -> float | None:
        """Changes of steering a metre of straight; None without a metre."""
        return self.changes / self.straight_m if self.straight_m else None

    @property
    def amplitude_deg(self) -> float | None:
        """Mean angle to either side, degrees; None without a change."""
        return self.swings_deg / self.changes if self.changes else None

    @property
    def lost_s(self) -> float | None:
        """Seconds a lap that go into the detour; None without a metre of straight.

        It is the time on straights times 1 - cos(a), where a is the angle between the direction of travel and its mean
        over the second around: how much longer the way is than the line through its middle, at the speed driven. It is
        a lower bound. The loss of speed by steering is not in it, because a log does not show how fast the car would
        have been: the simulated car loses another 0.5% of its speed at 20 degrees to either side, four control steps
        each, which is about half as much as its detour. Neither is the caution that a swerving car needs.
        """
        return self.detour_s / self.laps if self.laps else None

    def words(self) -> str:
        """Return the figures: ``1.84 changes of steering a metre, 12 degrees to either side, 0.051 s a lap``."""
        return zigzag_in_words(self.changes_per_m, self.amplitude_deg, self.lost_s)


def zigzag_in_words(changes_per_m: float | None, amplitude_deg: float | None, lost_s: float | None) -> str:
    """Return the figures of a `ZigZag` in words."""
    if changes_per_m is None or lost_s is None:
        return "no straight was driven"
    amplitude = (
        ""
        if not amplitude_deg or math.isnan(amplitude_deg)
        else f", {amplitude_deg:.0f} degrees to either side"
    )
    return f"{changes_per_m:.2f} changes of steering a metre{amplitude}, {lost_s:.3f} s a lap"


def zigzag_of(
    course: Track,
    x_m: Values,
    y_m: Values,
    steering_deg: Values,
    time_s: Values,
    number: NDArray[np.integer],
    drives: NDArray[np.bool_],
) -> ZigZag:
    """Measure the zig-zag of recorded driving.

    Args:
        course: of the drive.
        x_m: position of the car (n,), with `y_m`.
        y_m: see `x_m`.
        steering_deg: as commanded (n,).
        time_s: clock (n,).
        number: of the episode or trial of each row (n,); its rows are contiguous and in the order of time.
        drives: whether the car drives at each row (n,), instead of waiting or having left the road.
    """
    sectors = sectors_of(course)
    straights = np.array([part.name.startswith("straight") for part in sectors])
    lap_m = course.length_m * sum(
        part.end - part.begin for part, straight in zip(sectors, straights, strict=True) if straight
    )
    if not lap_m or len(x_m) < 2:
        return ZigZag()
    sector = sector_at(sectors, course.project(np.column_stack([x_m, y_m])).ndist)
    here = drives & straights[sector]
    dx, dy, passed_s = np.diff(x_m), np.diff(y_m), np.diff(time_s)
    moved_m = np.hypot(dx, dy)
    # Of a closed course the last sector and the first may be one straight.
    together = here[1:] & here[:-1] & (np.diff(number) == 0) & (moved_m < PASS_M)
    together &= (np.diff(sector) == 0) | (straights[0] & straights[-1])
    one_pass = np.concatenate([[0], np.cumsum(~together)])
    changes, swings_deg = _changes(one_pass[here], steering_deg[here])
    straight_m = float(moved_m[together].sum())
    moves = together & (moved_m >= STILL_M) & (passed_s > 0)
    aside = _aside(one_pass[1:][moves], np.arctan2(dy, dx)[moves])
    return ZigZag(
        straight_m=straight_m,
        laps=straight_m / lap_m,
        changes=changes,
        swings_deg=swings_deg,
        detour_s=float((passed_s[moves] * (1 - np.cos(aside))).sum()),
    )


def _changes(one_pass: NDArray[np.integer], steering_deg: Values) -> tuple[int, float]:
    """Return the changes of steering within a pass, except the first, and the sum of half the swings in degrees."""
    side = np.where(np.abs(steering_deg) >= CENTRED_DEG, np.sign(steering_deg), 0.0)
    steers = np.flatnonzero(side)
    if not len(steers):
        return 0, 0.0
    side, one_pass = side[steers], one_pass[steers]
    begins = np.ones(len(steers), bool)
    begins[1:] = (np.diff(one_pass) != 0) | (np.diff(side) != 0)
    starts = np.flatnonzero(begins)
    largest_deg = np.maximum.reduceat(np.abs(steering_deg[steers]), starts)
    again = np.diff(one_pass[starts]) == 0
    again[1:] &= again[:-1]
    again[:1] = False
    swings_deg = (largest_deg[1:] + largest_deg[:-1]) / 2
    return int(again.sum()), float(swings_deg[again].sum())


def _aside(one_pass: NDArray[np.integer], bearing_rad: Values) -> Values:
    """Return the difference of each direction from the mean over `AROUND` rows on both sides, rad.

    Near the ends of a pass there are fewer rows, as many before as after: the mean of a car in a steady bend is then
    its own direction, and nothing is aside.
    """
    count = len(bearing_rad)
    if not count:
        return bearing_rad
    begin = np.flatnonzero(np.diff(one_pass, prepend=-1))
    length = np.diff(np.append(begin, count))
    place = np.arange(count) - np.repeat(begin, length)
    half = np.minimum(AROUND, np.minimum(place, np.repeat(length, length) - 1 - place))
    # Unwrapped over all passes; whole turns between two of them do not matter.
    unwrapped = np.unwrap(bearing_rad)
    sums = np.concatenate([[0.0], np.cumsum(unwrapped - unwrapped[0])])
    row = np.arange(count)
    mean = (sums[row + half + 1] - sums[row - half]) / (2 * half + 1)
    return unwrapped - unwrapped[0] - mean
