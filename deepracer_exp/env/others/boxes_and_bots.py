"""Boxes and bots around every car: their places step by step, and crashes into them.

They are not bodies of the physics: on the service nothing touches a bot, and a box's crash rule applies before its body
is touched (deepracer-simapp, markov/agent_ctrl/obstacles_agent_ctrl.py and bot_cars_agent_ctrl.py).
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.racing import BoxesConfig, RaceConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.tracks.lanes import Lanes, Paths
from deepracer_exp.tracks.track import Track, TrackIndex, Tracks

from .bots import Bots, Manner, drive
from .collisions import BOX_M, CAR_M, first_hit
from .service_draws import END_M

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
        drive(ids, track_index, time_s, self._paths, self._manner, self._bots)


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
