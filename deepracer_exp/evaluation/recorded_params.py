"""Rebuild the params of a reward function from recorded control steps."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from deepracer_exp.config.car import CarConfig
from deepracer_exp.rewards.params import TrackParams
from deepracer_exp.tracks.track import Track, Tracks

Ids = NDArray[np.intp]

_DIRECTION_ROWS = 60
"""Rows of an episode from which its driving direction is determined: 4 s."""
_JUMP = 20.0
"""Per cent of progress between adjacent rows beyond which the car must have been reset."""
_DECIDED = {"in_progress": False, "off_track": True}
"""Statuses that determine `is_offtrack`; for the others it is computed from the wheels."""


class RecordedParams:
    """Rebuilds params from a trace, as the environment's rules compute them from poses.

    Progress, steps, commands, time and `all_wheels_on_track` are as recorded; the rest is derived from X, Y and yaw.
    Objects on the track are missing, because a trace does not record them.

    Attributes:
        known: whether a row's params can be rebuilt: its course is known and its numbers are finite, (n,).
        track_params: params of a reward function that are constant on each course.
        track_index: index of each row's course in `track_params`, (n,); -1 if unknown.
    """

    def __init__(
        self, steps: pd.DataFrame, episode: NDArray[np.int64], courses: Mapping[str, Track], car: CarConfig
    ) -> None:
        """Find the course and the direction of each row.

        Args:
            steps: `deepracer.recording.STEP_COLUMNS`, grouped by episode and in the order of time.
            episode: number of each row's episode, non-decreasing, (n,).
            courses: by name in `steps.track`.
            car: with the positions of its wheels and front.
        """
        self._steps = steps
        self._car = car
        names = list(courses)
        pairs = [(track, _other_way(track)) for track in courses.values()]
        tracks = [track for pair in pairs for track in pair]
        self.track_params: Sequence[TrackParams] = tuple(map(TrackParams.of, tracks))
        self.track_index: Ids = _place_of(steps["track"], names)
        finite = np.isfinite(steps[["X", "Y", "yaw", "progress"]].to_numpy()).all(axis=1)
        self.known = (self.track_index >= 0) & finite
        self._tracks = Tracks(tracks) if tracks else None
        if self._tracks is not None:
            self.track_index = np.where(self.known, 2 * self.track_index + self._against(episode), -1)

    @property
    def is_reversed(self) -> NDArray[np.bool_]:
        """Whether each row was driven against the order of its course's waypoints, (n,)."""
        return np.array([road.is_reversed for road in self.track_params] + [False])[self.track_index]

    def columns(self, rows: Ids) -> dict[str, np.ndarray]:
        """Return the columns `rewards.params.COLUMNS` of some rows, which must be known."""
        assert self._tracks is not None
        part, track_index = self._steps.iloc[rows], self.track_index[rows]
        front = part[["X", "Y"]].to_numpy(np.float64)
        at = self._tracks.project(front, track_index)
        width_m, is_left = self._tracks.border_distances(front, at.center, track_index)
        return {
            "all_wheels_on_track": part["all_wheels_on_track"].to_numpy(bool),
            "x": front[:, 0],
            "y": front[:, 1],
            "heading": part["yaw"].to_numpy(np.float64),
            "distance_from_center": np.abs(at.offset_m),
            "projection_distance": at.ndist * self._tracks.length_m[track_index],
            "progress": part["progress"].to_numpy(np.float64),
            "steps": part["steps"].to_numpy(np.float64),
            "speed": part["throttle"].to_numpy(np.float64),
            "steering_angle": part["steer"].to_numpy(np.float64),
            "track_width": width_m,
            "closest_waypoints": np.column_stack([at.previous, at.next]),
            "is_left_of_center": is_left,
            "is_offtrack": self._off_track(part, front, track_index),
            "sim_time": part["tstamp"].to_numpy(np.float64),
        }

    def _off_track(
        self, part: pd.DataFrame, front: NDArray[np.float64], track_index: Ids
    ) -> NDArray[np.bool_]:
        status = part["episode_status"].astype("category")
        off = np.array([_DECIDED.get(word, -1) for word in status.cat.categories] + [-1])[status.cat.codes]
        open_ = np.flatnonzero(off < 0)
        if len(open_):
            assert self._tracks is not None
            yaw = np.radians(part["yaw"].to_numpy(np.float64)[open_])[:, None]
            # Recorded poses are of the front point; wheels are measured from the chassis origin.
            ahead, aside = np.array(self._car.wheel_points_m).T
            ahead = ahead - self._car.front_point_m
            points = np.stack(
                [
                    front[open_, :1] + np.cos(yaw) * ahead - np.sin(yaw) * aside,
                    front[open_, 1:] + np.sin(yaw) * ahead + np.cos(yaw) * aside,
                ],
                axis=-1,
            )
            on_road = self._tracks.on_road(points.reshape(-1, 2), track_index[open_]).reshape(len(open_), -1)
            off[open_] = ~on_road.any(axis=1)
        return off.astype(bool)

    def _against(self, episode: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return 1 for the rows of episodes driven against the course's own direction, (n,)."""
        assert self._tracks is not None
        steps, count = self._steps, len(self._steps)
        begins = np.flatnonzero(np.diff(episode, prepend=-1) != 0)
        within = np.arange(count) - np.repeat(begins, np.diff(np.r_[begins, count]))
        rows = np.flatnonzero(self.known & (within < _DIRECTION_ROWS))
        track_index = 2 * self.track_index[rows]
        ndist = self._tracks.project(steps[["X", "Y"]].to_numpy(np.float64)[rows], track_index).ndist
        moved = np.diff(ndist, prepend=np.nan)
        moved = np.where(self._tracks.closed[track_index], (moved + 0.5) % 1.0 - 0.5, moved)
        gained = np.diff(steps["progress"].to_numpy(np.float64)[rows], prepend=np.nan)
        counted = np.diff(episode[rows], prepend=-1) == 0
        counted &= np.abs(gained) < _JUMP
        # An episode that does not move counts as driven in the course's own direction.
        along = np.bincount(
            episode[rows[counted]], (moved * gained)[counted], minlength=int(episode.max(initial=0)) + 1
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
