"""The params that a reward function would get at recorded control steps."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from deepracer_exp.config.car import CarConfig
from deepracer_exp.env.params import Road
from deepracer_exp.tracks.track import Track
from deepracer_exp.tracks.tracks import Tracks

Ids = NDArray[np.intp]

_DIRECTION_ROWS = 60
"""Rows of an episode that are looked at for the direction it drives in: 4 s."""
_JUMP = 20.0
"""Per cent of progress between neighbouring rows beyond which the car was put elsewhere."""
_DECIDED = {"in_progress": False, "off_track": True}
"""Statuses that say whether a wheel was on the road; of the others the wheels are looked at."""


class RecordedParams:
    """Rebuilds params from what a trace tells, as `env.referee` does from poses.

    Progress, steps, commands, time and `all_wheels_on_track` are the recorded ones, all else comes from X, Y and yaw.
    There are no other objects on the road: a trace does not tell them.

    Attributes:
        known: whether a row's params can be told: its course is known and its numbers are finite, (n,).
        roads: what reward functions are told of the courses.
        which: place of each row's course in `roads`, (n,); -1 where it is not known.
    """

    def __init__(
        self, steps: pd.DataFrame, episode: NDArray[np.int64], courses: Mapping[str, Track], car: CarConfig
    ) -> None:
        """Find the course and the direction of each row.

        Args:
            steps: `formats.recording.STEP_COLUMNS`, the rows of an episode together and in the order of time.
            episode: number of each row's episode, growing, (n,).
            courses: by their names in `steps.track`.
            car: where its wheels and its front are.
        """
        self._steps = steps
        self._car = car
        names = list(courses)
        pairs = [(track, _other_way(track)) for track in courses.values()]
        tracks = [track for pair in pairs for track in pair]
        self.roads: Sequence[Road] = tuple(map(Road.of, tracks))
        self.which: Ids = _place_of(steps["track"], names)
        finite = np.isfinite(steps[["X", "Y", "yaw", "progress"]].to_numpy()).all(axis=1)
        self.known = (self.which >= 0) & finite
        self._tracks = Tracks(tracks) if tracks else None
        if self._tracks is not None:
            self.which = np.where(self.known, 2 * self.which + self._against(episode), -1)

    @property
    def is_reversed(self) -> NDArray[np.bool_]:
        """Return whether each row was driven against the order of its course's own waypoints, (n,)."""
        return np.array([road.is_reversed for road in self.roads] + [False])[self.which]

    def columns(self, rows: Ids) -> dict[str, np.ndarray]:
        """Return the columns of `env.params.COLUMNS` of some rows, which must be known."""
        assert self._tracks is not None
        part, which = self._steps.iloc[rows], self.which[rows]
        front = part[["X", "Y"]].to_numpy(np.float64)
        at = self._tracks.project(front, which)
        width_m, is_left = self._tracks.border_distances(front, at.center, which)
        return {
            "all_wheels_on_track": part["all_wheels_on_track"].to_numpy(bool),
            "x": front[:, 0],
            "y": front[:, 1],
            "heading": part["yaw"].to_numpy(np.float64),
            "distance_from_center": np.abs(at.offset_m),
            "projection_distance": at.ndist * self._tracks.length_m[which],
            "progress": part["progress"].to_numpy(np.float64),
            "steps": part["steps"].to_numpy(np.float64),
            "speed": part["throttle"].to_numpy(np.float64),
            "steering_angle": part["steer"].to_numpy(np.float64),
            "track_width": width_m,
            "closest_waypoints": np.column_stack([at.previous, at.next]),
            "is_left_of_center": is_left,
            "is_offtrack": self._off_track(part, front, which),
            "sim_time": part["tstamp"].to_numpy(np.float64),
        }

    def _off_track(self, part: pd.DataFrame, front: NDArray[np.float64], which: Ids) -> NDArray[np.bool_]:
        status = part["episode_status"].astype("category")
        told = np.array([_DECIDED.get(word, -1) for word in status.cat.categories] + [-1])[status.cat.codes]
        open_ = np.flatnonzero(told < 0)
        if len(open_):
            assert self._tracks is not None
            yaw = np.radians(part["yaw"].to_numpy(np.float64)[open_])[:, None]
            # The front is where the pose is told; wheels are measured from the chassis origin.
            ahead, aside = np.array(self._car.wheel_points_m).T
            ahead = ahead - self._car.front_point_m
            points = np.stack(
                [
                    front[open_, :1] + np.cos(yaw) * ahead - np.sin(yaw) * aside,
                    front[open_, 1:] + np.sin(yaw) * ahead + np.cos(yaw) * aside,
                ],
                axis=-1,
            )
            on_road = self._tracks.on_road(points.reshape(-1, 2), which[open_]).reshape(len(open_), -1)
            told[open_] = ~on_road.any(axis=1)
        return told.astype(bool)

    def _against(self, episode: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return 1 for the rows of episodes whose progress grows against the course as it was given, (n,)."""
        assert self._tracks is not None
        steps, count = self._steps, len(self._steps)
        begins = np.flatnonzero(np.diff(episode, prepend=-1) != 0)
        within = np.arange(count) - np.repeat(begins, np.diff(np.r_[begins, count]))
        rows = np.flatnonzero(self.known & (within < _DIRECTION_ROWS))
        which = 2 * self.which[rows]
        ndist = self._tracks.project(steps[["X", "Y"]].to_numpy(np.float64)[rows], which).ndist
        gone = np.diff(ndist, prepend=np.nan)
        gone = np.where(self._tracks.closed[which], (gone + 0.5) % 1.0 - 0.5, gone)
        gained = np.diff(steps["progress"].to_numpy(np.float64)[rows], prepend=np.nan)
        told = np.diff(episode[rows], prepend=-1) == 0
        told &= np.abs(gained) < _JUMP
        # An episode that does not move says nothing; it counts as driven the way the course is given.
        along = np.bincount(
            episode[rows[told]], (gone * gained)[told], minlength=int(episode.max(initial=0)) + 1
        )
        return (along < 0).astype(np.int64)[episode]


def _place_of(track: pd.Series, names: Sequence[str]) -> Ids:
    words = track.astype("category")
    place = [names.index(str(word)) if str(word) in names else -1 for word in words.cat.categories]
    return np.array([*place, -1], np.intp)[words.cat.codes]


def _other_way(track: Track) -> Track:
    """Return the course driven in the other direction."""
    rows = np.hstack([track.waypoints, track.inner, track.outer])
    return Track.from_route(
        rows[::-1] if track.reversed else rows,
        track.name,
        title=track.title,
        reversed=not track.reversed,
        floor=track.floor,
    )
