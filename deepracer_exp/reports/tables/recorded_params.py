"""Rebuild a reward function's params from recorded control steps."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from deepracer_exp.config.car import CarConfig
from deepracer_exp.rewards.params import TrackParams, rows, scalar_params, select
from deepracer_exp.tracks.track import Track, Tracks

from .log_course import driven_against, recorded_wheels_on_road

Ids = NDArray[np.intp]
Floats = NDArray[np.float64]

UNPAID = ("prepare", "pause", "park")
"""Statuses at which the service gives no reward and calls no function (deepracer-simapp, rollout_agent_ctrl.py)."""
_DECIDED = {"in_progress": False, "off_track": True}
"""Statuses that determine `is_offtrack`; for the others it is computed from the wheels."""


class RecordedParams:
    """Rebuilds params from a trace, as the environment's rules compute them from poses.

    Progress, steps, commands, time and `all_wheels_on_track` are as recorded; the rest is derived from X, Y and yaw.
    Objects on the track are missing, because a trace does not record them.

    Attributes:
        known: whether a row's params can be rebuilt: its numbers are finite, (n,).
        paid: known rows at which the service calls the reward function, (n,).
        track_params: params of a reward function that are constant, of the course and of its other direction.
        track_index: index of each row's direction in `track_params`, (n,).
    """

    def __init__(
        self, steps: pd.DataFrame, episode: NDArray[np.int64], course: Track, car: CarConfig
    ) -> None:
        """Find the direction of each episode.

        Args:
            steps: `aws.logs.recorded.STEP_COLUMNS`, grouped by episode and in the order of time.
            episode: number of each row's episode, non-decreasing, (n,).
            course: on which all of them were driven.
            car: with the positions of its wheels and front.
        """
        self._steps = steps
        self._car = car
        tracks = [course, _other_way(course)]
        self.track_params = tuple(map(TrackParams.of, tracks))
        self._tracks = Tracks(tracks)
        self.known = np.isfinite(steps[["X", "Y", "yaw", "progress"]].to_numpy()).all(axis=1)
        self.paid = self.known & ~steps["episode_status"].isin(UNPAID).to_numpy()
        self.track_index: Ids = driven_against(course, steps, episode).astype(np.intp)
        self._previous_progress = self._progress_before(episode)

    @property
    def is_reversed(self) -> NDArray[np.bool_]:
        """Whether each row was driven against the order of its course's waypoints, (n,)."""
        return np.array([road.is_reversed for road in self.track_params])[self.track_index]

    def columns(self, chosen: Ids) -> dict[str, np.ndarray]:
        """Return the columns `rewards.params.BATCH_COLUMNS` of some rows, which must be known."""
        part, track_index = self._steps.iloc[chosen], self.track_index[chosen]
        front = part[["X", "Y"]].to_numpy(np.float64)
        projected = self._tracks.project(front, track_index)
        width_m, is_left = self._tracks.border_distances(front, projected.center, track_index)
        return {
            "all_wheels_on_track": part["all_wheels_on_track"].to_numpy(bool),
            "x": front[:, 0],
            "y": front[:, 1],
            "heading": part["yaw"].to_numpy(np.float64),
            "distance_from_center": np.abs(projected.offset_m),
            "projection_distance": projected.ndist * self._tracks.length_m[track_index],
            "progress": part["progress"].to_numpy(np.float64),
            "steps": part["steps"].to_numpy(np.float64),
            "speed": part["throttle"].to_numpy(np.float64),
            "steering_angle": part["steer"].to_numpy(np.float64),
            "track_width": width_m,
            "closest_waypoints": np.column_stack([projected.previous, projected.next]),
            "is_left_of_center": is_left,
            "is_offtrack": self._off_track(part, track_index),
            "sim_time": part["tstamp"].to_numpy(np.float64),
            "previous_progress": self._previous_progress[chosen],
        }

    def dicts(self, chosen: Ids) -> Iterator[dict[str, Any]]:
        """Yield the params of some rows one by one."""
        columns = rows(select(self.columns(chosen), None))
        for row, index in zip(columns, self.track_index[chosen].tolist(), strict=True):
            yield scalar_params(row, self.track_params[index])

    def _off_track(self, part: pd.DataFrame, track_index: Ids) -> NDArray[np.bool_]:
        status = part["episode_status"].astype("category")
        off = np.array([_DECIDED.get(word, -1) for word in status.cat.categories] + [-1])[status.cat.codes]
        open_ = np.flatnonzero(off < 0)
        if len(open_):
            on_road = recorded_wheels_on_road(self._tracks, track_index[open_], part.iloc[open_], self._car)
            off[open_] = ~on_road.any(axis=1)
        return off.astype(bool)

    def _progress_before(self, episode: NDArray[np.int64]) -> Floats:
        """Return the progress one step before each row, (n,); its own where that was not rewarded or is missing."""
        progress, number = (self._steps[key].to_numpy(np.float64) for key in ("progress", "steps"))
        follows = (np.diff(episode, prepend=-1) == 0) & (np.diff(number, prepend=np.nan) == 1)
        follows &= np.roll(self.paid, 1)
        return np.where(follows, np.roll(progress, 1), progress)


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
