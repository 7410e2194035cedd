"""Boxes and bots in a race: their placement, who is at fault in a crash, and their features and params."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.racing import RaceConfig
from deepracer_exp.env.randomization.car_randomization import CarStreams, Purpose
from deepracer_exp.env.rules import Bools, Ids, RaceRules, StepResult, lap_clock_s
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.env.state import Floats, Measures, checked_array
from deepracer_exp.env.trace_columns import STATUS_CODE
from deepracer_exp.tracks.lanes import INNER, OUTER, Lanes
from deepracer_exp.tracks.track import Pose

from .boxes_and_bots import Others
from .nearby import Around, Here, Reach, next_ones
from .object_params import ObjectParams
from .placement import draw_placements
from .service_draws import episode_seeds

NEAR_M = 1.0
"""Distance along the lap within which a car that would start near a box or bot starts in the other lane."""
BEHIND_BOX_M = 1.0
"""Distance before a box at which a car that has run into it continues."""
BESIDE_M = 0.6
"""A box or bot counts as ahead until its origin is this far behind the car's front: until the rear has passed it,
too."""
_SIZE_M = {False: (0.40, 0.30, 0.25), True: (0.324, 0.188, 0.211)}
"""Length, width and height of boxes and, True, bots (deepracer-simapp, models/box_obstacle and models/bot_car)."""
_COLOR = {False: (123, 97, 79), True: (40, 40, 40)}
"""Red, green and blue of boxes and, True, bots."""
_GIVES_WAY = np.isin(
    np.arange(len(STATUS_CODE)),
    [STATUS_CODE[status] for status in ("in_progress", "off_track", "immobilized", "reversed")],
)
"""Statuses that a crash replaces; the end of a lap and of the time have priority."""


class RaceOthers:
    """The others of N cars under the service's rules.

    Attributes:
        others: where they are.
        held: cars that serve a penalty, (N,), bool: they stand, no rule is applied, and bots drive on.
        bots_stopped: cars whose bots stopped in the last step, (N,), bool.
    """

    _kind: type[Others] = Others

    def __init__(self, race: RaceConfig, setup: RaceSetup, rules: RaceRules):
        """Set up; call `seed` and then `begin` next."""
        self._race, self._rules = race, rules
        tracks = [track for course in setup.courses for track in course.tracks]
        self.lanes = Lanes(tracks)
        self.others = self._kind(race, self.lanes, rules.tracks, rules.n_cars)
        bots_mps = race.bots.speed_mps if race.bots.count else None
        self._params = ObjectParams(self.others, rules, race.quirks, bots_mps)
        self._inner_is_left = np.array([not track.is_clockwise for track in tracks])
        self._period_s = setup.car.control_period_s
        self._front_m = setup.car.front_point_m
        self._observation = setup.observation
        self._held_until = np.zeros(rules.n_cars, np.int64)
        self._in_bot = np.zeros(rules.n_cars, bool)
        self.held = np.zeros(rules.n_cars, bool)
        self.bots_stopped = np.zeros(rules.n_cars, bool)
        looks = [(*_SIZE_M[bot], *_COLOR[bot]) for bot in self.others.is_bot.tolist()]
        self._looks = np.array(looks, np.float32)

    def seed(self, seed: int) -> None:
        """Start all streams from `seed`."""
        self._keys = CarStreams(seed, self._rules.cars.tolist(), Purpose.OTHERS).keys

    def state_dict(self) -> dict[str, Any]:
        """Return copies of everything the next steps depend on."""
        return {**self.others.state_dict(), "held_until": self._held_until.copy()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a `state_dict`.

        Raises:
            BadInput: it is of other numbers of cars, boxes or bots.
        """
        held = self.state_dict()
        checked = {name: checked_array(state, name, values.shape) for name, values in held.items()}
        self.others.load_state_dict(checked)
        self._held_until = checked["held_until"]

    def begin(self, ids: Ids, pose: Pose, evaluated: bool) -> Pose:
        """Place the others of new episodes and return where the cars start, in another lane where one is near.

        `pose` is where they would start, on the centre line, (n,) each. At the start of an evaluation (`evaluated`) the
        service ignores the others.
        """
        self._held_until[ids] = 0
        return self._among_others(ids, pose, self._rules.start_ndist[ids], evaluated)

    def _among_others(self, ids: Ids, pose: Pose, ndist: Floats, evaluated: bool) -> Pose:
        """Place the boxes and bots of new episodes, and return where the cars start; arguments as for `begin`.

        `ndist` is where they would start as shares of the lap, (n,).
        """
        first = self._rules.episode[ids] <= 0
        if self._race.quirks == "fixed":
            self._place(ids)
            return self._beside(ids, pose, ndist, np.ones(len(ids), bool))
        # The service looks at the others of the episode before.
        self._place(ids[first])
        pose = self._beside(ids, pose, ndist, np.full(len(ids), not evaluated))
        self._place(ids[~first])
        return pose

    def judge(
        self, result: StepResult, time_s: Floats | None = None
    ) -> tuple[StepResult, dict[str, np.ndarray]]:
        """Apply the rules about others to the result of a step, and move the bots.

        Cars and reward function meet the bots where they were sent in the step before; who is ahead in a crash is
        decided by where they are now, as on the service (deepracer-simapp, agent_ctrl/rollout_agent_ctrl.py and
        environments/deepracer_racetrack_env.py).

        Args:
            result: of the step without others.
            time_s: since each episode's begin, (N,), as a recording has it; None: by the count of control steps.

        Returns:
            The result with crashes, and the columns about others, one row per car.
        """
        rules, others, now = self._rules, self.others, result.now
        time_s = lap_clock_s(rules.steps, self._period_s) if time_s is None else time_s
        hit = others.hit(now.x_m, now.y_m, now.yaw_rad)
        columns = self._params.columns(now, time_s)
        others.drive(rules.track_index, time_s, rules.steps > 1)
        self.held = rules.steps <= self._held_until
        if not self.held.any() and (hit < 0).all():
            for happened in (self._in_bot, self.bots_stopped):
                happened[:] = False
            return result, {**columns, "is_crashed": self._in_bot}
        result, is_crashed = self._with_crashes(result, hit, time_s)
        return result, {**columns, "is_crashed": is_crashed}

    def _with_crashes(
        self, result: StepResult, hit: NDArray[np.int64], time_s: Floats
    ) -> tuple[StepResult, Bools]:
        """Return the result of a step after crashes and pauses, and which cars have crashed.

        Args:
            result: of the step without others.
            hit: index of the box or bot that each car has run into, or -1, (N,).
            time_s: since each episode's begin, (N,).
        """
        rules, others = self._rules, self.others
        running = result.running & ~self.held
        has_hit = (hit >= 0) & running
        self._in_bot = has_hit & others.is_bot[hit]
        behind, ahead = self._who_is_behind(has_hit, hit, result.progress)
        pauses = others.pauses.copy()
        others.pause(ahead, time_s)
        self.bots_stopped = others.pauses > pauses
        status = with_crashes(result.status, has_hit, behind)
        status[self.held] = STATUS_CODE["pause"]
        rules.rest(np.flatnonzero(self.held))
        terminated, truncated = rules.ends(status)
        result = replace(result, running=running, status=status, terminated=terminated, truncated=truncated)
        return result, behind & (status > STATUS_CODE["in_progress"])

    def put_back(self, ids: Ids, pose: Pose, percent: Floats, crashed: Bools, hold_s: Floats) -> Pose:
        """Return the poses at which cars continue in the middle of their episodes, and hold them there.

        `pose` and `percent` are where they would continue without others, `hold_s` is how long each is held there, (n,)
        each.

        A car that has run into a bot stays where it is; one near a box continues 1 m before it in the other lane
        (deepracer-simapp, agent_ctrl/rollout_agent_ctrl.py: `_get_car_reset_model_state`).
        """
        rules, others = self._rules, self.others
        self._held_until[ids] = rules.steps[ids] + np.round(hold_s / self._period_s).astype(np.int64)
        now, track_index = rules.now, rules.track_index[ids]
        length_m = rules.tracks.length_m[track_index]
        boxes = self._race.boxes.count
        x, y, yaw_rad = (part.copy() for part in pose)
        stays = crashed & self._in_bot[ids]
        if boxes:
            at_m = np.mod(percent / 100 + rules.start_ndist[ids], 1.0) * length_m
            away_m = around(others.distance_m[ids, :boxes] - at_m[:, None], length_m[:, None])
            nearest = np.abs(away_m).argmin(axis=1)
            in_box = ~stays & (np.abs(away_m[np.arange(len(ids)), nearest]) < NEAR_M)
            box_m = others.distance_m[ids, nearest]
            before = rules.tracks.points_at((box_m - BEHIND_BOX_M) / length_m, track_index)
            lane = self._other_lane(track_index, others.offset_m[ids, nearest])
            for part, lane_values in zip(
                (x, y, yaw_rad), self.lanes.poses(before, lane, track_index), strict=True
            ):
                part[in_box] = lane_values[in_box]
        for part, here in zip((x, y, yaw_rad), (now.x_m, now.y_m, now.yaw_rad), strict=True):
            part[stays] = here[ids][stays]
        return Pose(x, y, yaw_rad)

    def features(self, ids: Ids, now: Measures) -> NDArray[np.float32]:
        """Return the features of the next others of the cars `ids`, (n, next_objects * 4), about -1..1.

        For each: `gap` from the car's front to its origin along the lap over `next_objects_reach_m`, below 0 beside the
        car; `side`, how far it is to the left of the car across the road, over half the road's width; `closing` speed
        over `speed_scale_mps`; `bot`, 1 for a bot and 0 for a box. One beyond the reach, or none: 1, 0, 0, 0.
        """
        others, rules, seen = self.others, self._rules, self._observation
        speeds_mps = others.speeds_mps(ids, lap_clock_s(rules.steps[ids], self._period_s))
        theirs = Around(others.distance_m, others.offset_m, others.is_bot, speeds_mps)
        length_m = rules.length_m[ids]
        here = Here(now.ndist * length_m, now.offset_m, now.speed_mps, now.track_width_m, length_m)
        reach = Reach(seen.next_objects, BESIDE_M, seen.next_objects_reach_m, seen.speed_scale_mps)
        return np.asarray(next_ones(ids, theirs, here, reach))

    def boxes(self, ids: Ids) -> NDArray[np.float32]:
        """Return the others of the cars `ids` for cameras and LIDARs, (n, K, 9); see `camera.take_pictures`."""
        poses = self.others.poses[ids].astype(np.float32)
        looks = np.broadcast_to(self._looks, (*poses.shape[:2], self._looks.shape[1]))
        return np.concatenate([poses, looks], axis=-1)

    def _place(self, ids: Ids) -> None:
        """Draw where the others of new episodes are, and put them there."""
        rules, race = self._rules, self._race
        seeds = self._episode_seeds(ids)
        places_m, lanes = draw_placements(race, rules.length_m[ids], rules.episode[ids], seeds)
        self.others.place(ids, rules.track_index[ids], places_m, lanes, seeds)

    def _episode_seeds(self, ids: Ids) -> NDArray[np.uint64]:
        """Return the seed of the episodes of the cars `ids`, which depends only on seed, car and episode, (n,)."""
        return np.asarray(episode_seeds(self._keys[ids], self._rules.episode[ids]))

    def _beside(self, ids: Ids, pose: Pose, ndist: Floats, checked: Bools) -> Pose:
        """Return start poses in the lane opposite to the nearest box or bot where one is near, (n,) each."""
        rules, others = self._rules, self.others
        track_index = rules.track_index[ids]
        length_m = rules.tracks.length_m[track_index, None]
        away_m = others.distance_m[ids, : self._race.boxes.count + self._race.bots.count]
        away_m = away_m - ndist[:, None] * length_m
        # The service does not see across the start line.
        away_m = around(away_m, length_m) if self._race.quirks == "fixed" else away_m
        nearest = np.abs(away_m).argmin(axis=1)
        row = np.arange(len(ids))
        near = np.flatnonzero(checked & (np.abs(away_m[row, nearest]) < NEAR_M))
        if len(near):
            lane = self._other_lane(track_index[near], others.offset_m[ids[near], nearest[near]])
            points = np.stack([pose.x, pose.y], axis=-1)[near]
            pose = Pose(*(part.copy() for part in pose))
            for part, lane_values in zip(
                pose, self.lanes.poses(points, lane, track_index[near]), strict=True
            ):
                part[near] = lane_values
        return pose

    def _other_lane(self, track_index: Ids, offset_m: Floats) -> NDArray[np.int64]:
        """Return the lane across the centre line from these offsets, (n,)."""
        return np.where((offset_m > 0) == self._inner_is_left[track_index], OUTER, INNER)

    def _who_is_behind(self, has_hit: Bools, hit: NDArray[np.int64], progress: Floats) -> tuple[Bools, Bools]:
        """Return which cars are at fault, being behind the bot or in a box, and which are ahead of the bot, (N,)."""
        behind, ahead = has_hit & ~self._in_bot, np.zeros(len(hit), bool)
        ids = np.flatnonzero(self._in_bot)
        if len(ids):
            rules = self._rules
            x, y, yaw_rad = self.others.poses[ids, hit[ids]].T
            fronts = np.stack(
                [x + self._front_m * np.cos(yaw_rad), y + self._front_m * np.sin(yaw_rad)], axis=-1
            )
            bot = 100 * rules.tracks.project(fronts, rules.track_index[ids]).ndist
            own_percent = np.mod(progress[ids] + 100 * rules.start_ndist[ids], 100)
            ahead_percent = self._ahead_percent(own_percent, bot)
            behind[ids], ahead[ids] = ahead_percent < 0, ahead_percent > 0
        return behind, ahead

    def _ahead_percent(self, own_percent: Floats, percent: Floats) -> Floats:
        """Return the lead of cars over others as a share of the lap, both counted from waypoint 0, (n,)."""
        return own_percent - percent


def with_crashes(status: NDArray[np.int64], has_hit: Bools, at_fault: Bools) -> NDArray[np.int64]:
    """Return status codes after crashes, (N,).

    Each of the arguments is (N,); `status` has the codes of `env.trace_columns.STATUS_CODE` without crashes.

    A car at fault has crashed. One that is not drives on, and leaving the road, driving backwards or standing in that
    step does not count either. The end of a lap and of the time have priority (deepracer-simapp,
    agent_ctrl/rollout_agent_ctrl.py: `_check_for_episode_termination`).
    """
    outcome = np.where(at_fault, STATUS_CODE["crashed"], STATUS_CODE["in_progress"])
    return np.where(has_hit & _GIVES_WAY[status], outcome, status)


def around(away_m: Floats, length_m: Floats) -> Floats:
    """Return distances along a lap in the shorter direction."""
    return np.mod(away_m + 0.5 * length_m, length_m) - 0.5 * length_m
