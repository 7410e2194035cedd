"""Places where the car leaves the road, and its mistake before: understeer, oversteer, or a late correction."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from .racing_line import WHEELBASE_M
from .statistics import Values, wilson
from .step_columns import begins_of, first_rows

Rows = NDArray[np.intp]
PLACE_M = 1.5
"""Length of road that counts as one place."""
PLACES = 3
LEAST = 3
"""Off-tracks that make a place."""
BEFORE = 8
"""Control steps looked at before it leaves the road: half a second of the service's time."""
STEERS_DEG = 5.0
"""Mean steering below which the car counts as driving straight."""
UNUSUAL = 2.0
"""Turning this many standard deviations less than predicted is understeer; more, to the side it steers to,
oversteer."""
SLIDE_DEG = 15.0
"""Slide of the rear axle from which the car counts as spinning."""

UNDERSTEER, OVERSTEER, LATE, AWAY = "understeer", "oversteer", "late", "away"
JUDGEMENTS: Mapping[str, str] = {
    UNDERSTEER: "it understeers: it turns less than the same steering usually does",
    OVERSTEER: "it oversteers: the tail comes round or it turns more than the same steering usually does",
    LATE: "it steers back and turns as usual, but too late for its speed",
    AWAY: "it does not steer back",
}
"""Mistakes before the car leaves the road, in words."""

COLUMNS = (
    *("stream", "episode", "episode_status", "done", "all_wheels_on_track", "progress", "closest_waypoint"),
    *("track_len", "lap_position", "offset_m", "steer", "yaw_rate_dps", "track_speed_mps", "slide_deg"),
)
"""Columns of the steps that are read here."""


@dataclass(frozen=True, kw_only=True)
class OffTrackPlace:
    """A place where the car runs off."""

    lap_position: float
    """0 to 1, median of the times."""
    waypoint: int
    """Nearest one there."""
    side: str
    """`left` or `right` of the centre line."""
    count: int
    """Times it ran off here."""
    passes: int
    """Episodes that came here; at least `count`."""
    low: float
    """95 per cent interval of the risk, with `high`."""
    high: float
    judgement: str | None
    """Key of `JUDGEMENTS` for at least half of the times, None where there is none."""
    judgements: Mapping[str, int]


def off_track_rows(steps: pd.DataFrame) -> Rows:
    """Return the rows at which the car is off the road for the first time.

    Those are rows of status off_track, and where the generation has no status the last rows of episodes that ended
    with a wheel off the road before the lap was complete.
    """
    if not len(steps):
        return np.zeros(0, np.intp)
    status, first = steps["episode_status"], first_rows(steps)
    off = begins_of((status == "off_track").to_numpy(), first)
    ended = (
        (status == "").to_numpy()
        & steps["done"].to_numpy(bool)
        & ~steps["all_wheels_on_track"].to_numpy(bool)
    )
    return np.flatnonzero(off | (ended & (steps["progress"].to_numpy() < 100.0)))


def off_track_places(steps: pd.DataFrame) -> list[OffTrackPlace]:
    """Return the places where the car runs off most often, at most `PLACES`; the steps are those of whole episodes."""
    rows = off_track_rows(steps)
    position = steps["lap_position"].to_numpy(np.float64)
    rows = rows[np.isfinite(position[rows])]
    if len(rows) < LEAST:
        return []
    half = PLACE_M / 2 / float(steps["track_len"].median())
    judged = judge(steps, rows)
    episode = np.cumsum(first_rows(steps))
    offset = np.nan_to_num(steps["offset_m"].to_numpy(np.float64))
    places, left = position[rows], np.ones(len(rows), bool)
    found_places: list[OffTrackPlace] = []
    while len(found_places) < PLACES and left.any():
        center = places[neighbours(places, places[left], half).argmax()]
        here = left & (_lap_distance(places, center) <= half)
        offs = int(here.sum())
        if offs < LEAST:
            break
        left &= _lap_distance(places, center) > 2 * half
        judgements = Counter(judged[here].tolist())
        most, times = judgements.most_common(1)[0]
        # A car that is put back on the road passes the place again.
        passes = max(len(np.unique(episode[_lap_distance(position, center) <= half])), offs)
        low, high = map(float, wilson(offs, passes))
        middle = rows[here][np.argsort((places[here] - center + 0.5) % 1.0, kind="stable")[offs // 2]]
        found_places.append(
            OffTrackPlace(
                lap_position=float(position[middle]),
                waypoint=int(steps["closest_waypoint"].to_numpy()[middle]),
                side="left" if np.median(offset[rows[here]]) > 0 else "right",
                count=offs,
                passes=passes,
                low=low,
                high=high,
                judgement=most if 2 * times >= offs else None,
                judgements=judgements,
            )
        )
    return found_places


def judge(steps: pd.DataFrame, rows: Rows) -> NDArray[np.str_]:
    """Classify the mistake before each off-track: keys of `JUDGEMENTS`.

    The `BEFORE` control steps up to the row count. A simulated car turns less and later than a bicycle, so its turning
    is compared with the usual effect of the same steering in the same recording. The yaw rate follows the commanded
    one, u = speed * tan(steering) / wheelbase, with a lag: r' = a r + b u + c, fitted to all steps by least squares. It
    is predicted from the yaw rate `BEFORE` steps ago and the steering since; it is unusual if it differs by more than
    `UNUSUAL` standard deviations (1.4826 times the median deviation) of all such predictions that do not end off the
    road.
    """
    steer, turned_more, slide = _stretches(steps)
    near_end = np.zeros(len(steps), bool)
    for back in range(2 * BEFORE):
        near_end[np.maximum(rows - back, 0)] = True
    usual = turned_more[np.isfinite(turned_more) & ~near_end]
    unusual = UNUSUAL * 1.4826 * float(np.median(np.abs(usual))) if len(usual) else np.inf
    side = np.sign(steps["offset_m"].to_numpy(np.float64)[rows])
    steers = np.where(np.abs(steer[rows]) >= STEERS_DEG, np.sign(steer[rows]), 0.0)
    back = (steers != 0) & (steers == -side)
    more = turned_more[rows] * steers
    over = (slide[rows] >= SLIDE_DEG) | ((steers == side) & (more >= unusual))
    return np.select([over, back & (more <= -unusual), back], [OVERSTEER, UNDERSTEER, LATE], AWAY)


def _stretches(steps: pd.DataFrame) -> tuple[Values, Values, Values]:
    """Summarise the `BEFORE` steps up to each row; NaN in the first rows of an episode.

    Returns:
        Mean steering in degrees, mean yaw rate minus the predicted one in degrees a second (positive to the left), and
        the largest slide in degrees, of which no row is NaN.
    """
    first = first_rows(steps)
    row = np.arange(len(steps))
    since = row - np.maximum.accumulate(np.where(first, row, 0))
    steer, rate, speed = (
        np.nan_to_num(steps[name].to_numpy(np.float64))
        for name in ("steer", "yaw_rate_dps", "track_speed_mps")
    )
    # A command acts until the next row.
    commanded = np.degrees(_shifted(speed, 1) * np.tan(np.radians(_shifted(steer, 1))) / WHEELBASE_M)
    # Least squares by the normal equations: three unknowns, of millions of rows.
    columns = np.stack([_shifted(rate, 1), commanded, np.ones(len(rate))]) * (since >= 2)
    lag, gain, trim = np.linalg.lstsq(columns @ columns.T, columns @ rate, rcond=None)[0]
    predicted, more, mean_steer = _shifted(rate, BEFORE), np.zeros(len(rate)), np.zeros(len(rate))
    slide = np.abs(np.nan_to_num(steps["slide_deg"].to_numpy(np.float64)))
    largest = slide.copy()
    for back in range(BEFORE - 1, -1, -1):
        predicted = lag * predicted + gain * _shifted(commanded, back) + trim
        more += (_shifted(rate, back) - predicted) / BEFORE
        mean_steer += _shifted(steer, back + 1) / BEFORE
        largest = np.where(since >= back, np.maximum(largest, _shifted(slide, back)), largest)
    whole = since > BEFORE
    return np.where(whole, mean_steer, np.nan), np.where(whole, more, np.nan), largest


def _shifted(values: Values, rows: int) -> Values:
    """Return the values shifted down by `rows` rows, with zeros filled in at the top."""
    return values if not rows else np.concatenate([np.zeros(min(rows, len(values))), values[:-rows]])


def neighbours(places: Values, others: Values, within: float) -> NDArray[np.intp]:
    """Count for each lap position the others near it in the shorter direction."""
    around = np.sort(np.concatenate([others - 1.0, others, others + 1.0]))
    return np.searchsorted(around, places + within, "right") - np.searchsorted(
        around, places - within, "left"
    )


def _lap_distance(a: Values | float, b: Values | float) -> Values:
    """Return the distance of lap positions in the shorter direction."""
    difference = np.abs(np.asarray(a) - np.asarray(b))
    return np.minimum(difference, 1.0 - difference)


def risk_counts(episodes: pd.DataFrame, n: int, reach: int = 0) -> tuple[Values, Values]:
    """Return the number of episodes that passed each of n waypoints, and of those that left the road there.

    An episode passes every waypoint from that of its first row to that of its last row, also those that a control step
    jumped over; a complete lap passes all of them. `reach` waypoints to either side count as well.
    """
    first, last = (episodes[name].to_numpy(np.int64) for name in ("start_at", "last_waypoint"))
    progress = episodes["progress"].to_numpy(np.float64)
    ahead = (last - first) % n
    # A car that ends a little before or behind its start drove hardly anything or nearly the whole lap.
    back = (ahead > 0.75 * n) & (progress < 50.0)
    first, ahead = np.where(back, last, first), np.where(back, 0, ahead)
    whole = episodes["complete"].to_numpy(bool) | ((ahead < 0.25 * n) & (progress > 50.0))
    ahead = np.minimum(np.where(whole, n, ahead) + 2 * reach, n - 1)
    first = (first - reach) % n
    change = np.zeros(2 * n + 1)
    np.add.at(change, first, 1.0)
    np.add.at(change, first + ahead + 1, -1.0)
    passed = np.cumsum(change)[: 2 * n]
    left = np.bincount(last[(episodes["status"] == "off_track").to_numpy()], minlength=n)
    near = np.sum([np.roll(left, by) for by in range(-reach, reach + 1)], axis=0)
    return passed[:n] + passed[n:], near.astype(np.float64)
