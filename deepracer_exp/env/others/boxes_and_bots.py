"""Boxes and bots around every car: their places step by step, and crashes into them.

They are not bodies of the physics: on the service nothing touches a bot, and a box's crash rule applies before its body
is touched (deepracer-simapp, markov/agent_ctrl/obstacles_agent_ctrl.py and bot_cars_agent_ctrl.py).
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.racing import BoxesConfig, RaceConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.jit import njit
from deepracer_exp.tracks.lanes import Lanes, Paths
from deepracer_exp.tracks.track import Track, TrackIndex, Tracks

from .service_draws import END_M, uniform

_ROUNDING_S = 1e-9

Floats = NDArray[np.float64]
Ids = NDArray[np.intp]

_KEPT = (
    *("poses", "distance_m", "offset_m", "start_m", "lane"),
    *("changes", "change_begin_s", "change_end_s", "seed", "pauses", "resumes_s"),
)
"""The arrays that later steps depend on."""


class Others:
    """The K others of each of N cars, boxes first; every car has its own.

    Attributes:
        is_bot: which of the others are cars: bots, or a rival, (K,), bool.
        poses: x and y of the origins in metres and yaw in radians, (N, K, 3).
        distance_m: projections on the centre line, from waypoint 0, (N, K).
        offset_m: offsets to the left of the centre line, (N, K).
        half_m: half the extents of their crash rectangles along and across, (K, 2).
        pauses: how often the bots have stopped in the episode, (N,), int64.
    """

    def __init__(self, race: RaceConfig, lanes: Lanes, tracks: Tracks, n_cars: int):
        """Set up arrays; `place` puts the others on the road.

        `lanes` are those of the courses `tracks`.
        """
        self._race, self._lanes, self._tracks = race, lanes, tracks
        boxes, bots, count = race.boxes.count, race.bots.count, race.others
        self._boxes = boxes
        self.is_bot = np.arange(count) >= boxes
        self.half_m = 0.5 * np.where(self.is_bot[:, None], CAR_M, BOX_M)
        self._paths: Paths | None = lanes.paths() if bots else None
        self.poses = np.zeros((n_cars, count, 3))
        self.distance_m = np.zeros((n_cars, count))
        self.offset_m = np.zeros((n_cars, count))
        self.start_m = np.zeros((n_cars, bots))
        self.lane = np.zeros((n_cars, bots), np.int64)
        self.changes = np.zeros((n_cars, bots), np.int64)
        self.change_begin_s = np.zeros((n_cars, bots))
        self.change_end_s = np.zeros((n_cars, bots))
        self.seed = np.zeros(n_cars, np.uint64)
        self.pauses = np.zeros(n_cars, np.int64)
        self.resumes_s = np.zeros(n_cars)
        self._going_mps = np.where(self.is_bot, race.bots.speed_mps, 0.0)
        after_s = race.bots.lane_change_after_s or (math.inf, math.inf)
        speed_mps, pause_s = race.bots.speed_mps, race.bots.pause_s
        self._manner = Manner(speed_mps, pause_s, after_s[0], after_s[1], race.bots.lane_change_distance_m)
        self._bots = Bots(
            self.start_m,
            self.lane,
            self.changes,
            self.change_begin_s,
            self.change_end_s,
            self.seed,
            self.pauses,
            self.poses[:, boxes:],
            self.distance_m[:, boxes:],
            self.offset_m[:, boxes:],
        )

    def place(
        self,
        ids: Ids,
        track_index: TrackIndex,
        places_m: Floats,
        lanes: NDArray[np.int64],
        seed: NDArray[np.uint64],
    ) -> None:
        """Put the others of the cars `ids` on the road, as an episode begins.

        Args:
            ids: indices of the cars, (n,).
            track_index: of each of these cars' courses, (n,).
            places_m: distances from the start line along the centre line, (n, K).
            lanes: `tracks.lanes.INNER` or `OUTER`, (n, K).
            seed: decides when bots change lanes, (n,).
        """
        boxes = self._boxes
        if boxes:
            share = places_m[:, :boxes] / self._tracks.length_m[track_index, None]
            points = self._tracks.points_at(share, track_index).reshape(-1, 2)
            each = np.repeat(track_index, boxes)
            pose = self._lanes.poses(points, lanes[:, :boxes].ravel(), each)
            where = np.stack(pose, axis=-1)
            projection = self._tracks.project(where[:, :2], each)
            self.poses[ids, :boxes] = where.reshape(len(ids), boxes, 3)
            self.distance_m[ids, :boxes] = projection.distance_m.reshape(len(ids), boxes)
            self.offset_m[ids, :boxes] = projection.offset_m.reshape(len(ids), boxes)
        if self._paths is not None:
            self.start_m[ids], self.lane[ids], self.seed[ids] = places_m[:, boxes:], lanes[:, boxes:], seed
            for kept in (self.changes, self.change_begin_s, self.change_end_s, self.pauses, self.resumes_s):
                kept[ids] = 0
            # Lanes are not changed before the first control step.
            self.change_end_s[ids] = np.inf
            self._drive(ids, track_index, np.zeros(len(ids)))
            self.change_end_s[ids] = 0.0

    def drive(self, track_index: TrackIndex, time_s: Floats, running: NDArray[np.bool_]) -> None:
        """Move the bots.

        The car's course, the time since its episode's begin, and whether its bots have left their starts are (N,) each.
        """
        if self._paths is not None:
            # Pauses last to the rounding of a control period.
            going = running & (time_s >= self.resumes_s - _ROUNDING_S)
            ids = np.flatnonzero(going)
            self._drive(ids, track_index[ids], time_s[ids])

    def pause(self, hit: NDArray[np.bool_], time_s: Floats) -> None:
        """Stop the bots of cars that one of them has hit, unless they stand still already.

        `hit` selects these cars, `time_s` is the time since each episode's begin, (N,) each.
        """
        pause_s = self._race.bots.pause_s
        ids = np.flatnonzero(hit & (time_s >= self.resumes_s - _ROUNDING_S))
        self.pauses[ids] += 1
        self.resumes_s[ids] = time_s[ids] + pause_s
        self.change_begin_s[ids] += pause_s
        self.change_end_s[ids] += pause_s

    def hit(self, x_m: Floats, y_m: Floats, yaw_rad: Floats) -> NDArray[np.int64]:
        """Return the first of the others that each car has run into, -1 where there is none, (N,).

        Origins of the cars and headings are (N,) each.

        A car has run into another if one of the corners of its own rectangle is inside the other's; not the reverse
        (deepracer-simapp, track_geom/track_data.py: `get_collided_object_name`).
        """
        return np.asarray(first_hit(x_m, y_m, yaw_rad, self.poses, self.half_m))

    def speeds_mps(self, ids: Ids, time_s: Floats) -> Floats:
        """Return speeds in m/s of the others of the cars `ids`, (n, K), at times since their episodes' begin, (n,)."""
        moving = time_s >= self.resumes_s[ids] - _ROUNDING_S
        return self._going_mps * moving[:, None]

    def state_dict(self) -> dict[str, Any]:
        """Return copies of all arrays."""
        return {name: getattr(self, name).copy() for name in _KEPT}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore a `state_dict` of as many cars and others; the caller has checked the shapes."""
        for name in _KEPT:
            getattr(self, name)[:] = state[name]

    def _drive(self, ids: Ids, track_index: TrackIndex, time_s: Floats) -> None:
        assert self._paths is not None
        _drive_bots(ids, track_index, time_s, self._paths, self._manner, self._bots)


def check_room(race: RaceConfig, tracks: Sequence[tuple[str, Track]]) -> None:
    """Refuse more boxes or bots than fit on a track.

    Raises:
        BadInput: a track is too short, or open, so that bots could not drive round it.
    """
    for name, track in tracks:
        if race.bots.count and not track.closed:
            raise BadInput(
                f"race.bots.number={race.bots.count}",
                f"the open track {name} has no lap for bots to drive round",
                0,
            )
        if race.rivals is not None and not track.closed:
            raise BadInput(
                f"race.rivals.policy={race.rivals.policy}",
                f"the open track {name} has no room behind its start for a second car",
                "a closed track, or race.rivals=null",
            )
    for key, config in (("boxes", race.boxes), ("bots", race.bots)):
        if isinstance(config, BoxesConfig) and (config.placement == "fixed" or race.quirks == "service"):
            continue
        for name, track in tracks:
            least_m = config.min_distance_m
            if config.count and config.count * least_m > track.length_m - END_M:
                most = int((track.length_m - END_M) / least_m)
                raise BadInput(
                    f"race.{key}.number={config.count}",
                    f"the {track.length_m:.1f} m of {name} have no room for so many that are "
                    f"race.{key}.min_distance_m={least_m:g} apart",
                    f"up to {most}",
                )


CAR_M = (0.32352, 0.1961)
"""Crash rectangle of a car or bot, along and across, centred on its origin (deepracer-simapp,
track_geom/constants.py)."""
BOX_M = (0.50, 0.40)
"""Crash rectangle of a box of any type; the first number of the service's pair is the extent across."""


@njit(cache=True, nogil=True)
def first_hit(x_m, y_m, yaw_rad, poses, half_m):  # type: ignore[no-untyped-def]
    """Return the index of the first of K others whose rectangle contains a corner of each of N cars, or -1, (N,).

    Args:
        x_m: of the cars' origins, (N,), metres.
        y_m: of the cars' origins, (N,), metres.
        yaw_rad: headings of the cars, (N,).
        poses: x, y and yaw of the others, (N, K, 3).
        half_m: half the others' extents along and across, (K, 2).
    """
    cars, count = poses.shape[:2]
    hit = np.full(cars, -1)
    half_length, half_width = 0.5 * CAR_M[0], 0.5 * CAR_M[1]
    reach = math.hypot(half_length, half_width)
    for car in range(cars):
        cos, sin = math.cos(yaw_rad[car]), math.sin(yaw_rad[car])
        for other in range(count):
            dx, dy = x_m[car] - poses[car, other, 0], y_m[car] - poses[car, other, 1]
            near = reach + math.hypot(half_m[other, 0], half_m[other, 1])
            if dx * dx + dy * dy >= near * near:
                continue
            turn_cos, turn_sin = math.cos(poses[car, other, 2]), math.sin(poses[car, other, 2])
            for corner in range(4):
                along = half_length if corner < 2 else -half_length
                across = half_width if corner % 2 else -half_width
                px, py = dx + cos * along - sin * across, dy + sin * along + cos * across
                ahead, left = turn_cos * px + turn_sin * py, turn_cos * py - turn_sin * px
                if abs(ahead) < half_m[other, 0] and abs(left) < half_m[other, 1]:
                    hit[car] = other
                    break
            if hit[car] >= 0:
                break
    return hit


_MOST_BOTS = 1000
"""Numbers of an episode's seed for each change of lanes, one for each bot."""


@njit(cache=True, nogil=True, inline="always")
def _between(rows, lane, cell, part, column):  # type: ignore[no-untyped-def]
    before = rows[lane, cell, column]
    return before + part * (rows[lane, cell + 1, column] - before)


class Manner(NamedTuple):
    """Settings of the bots' driving; see `conf/race`."""

    speed_mps: float
    pause_s: float
    least_after_s: float
    """Least and most time between two changes of lanes; infinite: none is changed."""
    most_after_s: float
    change_m: float


class Bots(NamedTuple):
    """The bots of N cars: arrays with a row per car, changed in place; see `env.others.boxes_and_bots.Others`."""

    start_m: np.ndarray
    lane: np.ndarray
    changes: np.ndarray
    change_begin_s: np.ndarray
    change_end_s: np.ndarray
    seed: np.ndarray
    pauses: np.ndarray
    poses: np.ndarray
    distance_m: np.ndarray
    offset_m: np.ndarray


@njit(cache=True, nogil=True)
def _drive_bots(ids, track_index, time_s, paths, manner, bots):  # type: ignore[no-untyped-def]
    """Move the bots of the cars `ids` on their tracks to a time, (n,) each, and change their lanes."""
    speed_mps, pause_s, least_after_s, most_after_s, change_m = manner
    start_m, lane, changes, change_begin_s, change_end_s, seed, pauses, poses, distance_m, offset_m = bots
    changing, rows = math.isfinite(least_after_s), paths.rows
    for place in range(len(ids)):
        car, track, now_s = ids[place], track_index[place], time_s[place]
        length_m, first, cells = paths.length_m[track], paths.first_row[track], paths.cells[track]
        driven_m = speed_mps * max(now_s - pauses[car] * pause_s, 0.0)
        for bot in range(start_m.shape[1]):
            if changing and now_s >= change_end_s[car, bot]:
                if changes[car, bot] > 0:
                    lane[car, bot] = 1 - lane[car, bot]
                share = uniform(seed[car], _MOST_BOTS * changes[car, bot] + bot)
                changes[car, bot] += 1
                begin_s = now_s + least_after_s + share * (most_after_s - least_after_s)
                change_begin_s[car, bot] = begin_s
                change_end_s[car, bot] = begin_s + change_m / speed_mps
            at_m = (start_m[car, bot] + driven_m) % length_m
            cell = at_m / length_m * cells
            index = min(int(cell), cells - 1)
            part = cell - index
            here, cell_at = lane[car, bot], first + index
            x, y = _between(rows, here, cell_at, part, 0), _between(rows, here, cell_at, part, 1)
            dx, dy = _between(rows, here, cell_at, part, 2), _between(rows, here, cell_at, part, 3)
            ahead, offset = _between(rows, here, cell_at, part, 4), _between(rows, here, cell_at, part, 5)
            if changing and now_s > change_begin_s[car, bot] and changes[car, bot] > 0:
                # From lane to lane as a cubic with the lanes' here directions at both ends.
                share = min((now_s - change_begin_s[car, bot]) * speed_mps / change_m, 1.0)
                weight, slope = share * share * (3.0 - 2.0 * share), 6.0 * share * (1.0 - share) / change_m
                to_x = _between(rows, 1 - here, cell_at, part, 0) - x
                to_y = _between(rows, 1 - here, cell_at, part, 1) - y
                dx += weight * (_between(rows, 1 - here, cell_at, part, 2) - dx) + slope * to_x
                dy += weight * (_between(rows, 1 - here, cell_at, part, 3) - dy) + slope * to_y
                x, y = x + weight * to_x, y + weight * to_y
                ahead += weight * (_between(rows, 1 - here, cell_at, part, 4) - ahead)
                offset += weight * (_between(rows, 1 - here, cell_at, part, 5) - offset)
            poses[car, bot, 0], poses[car, bot, 1], poses[car, bot, 2] = x, y, math.atan2(dy, dx)
            distance_m[car, bot] = (at_m + ahead) % length_m
            offset_m[car, bot] = offset
