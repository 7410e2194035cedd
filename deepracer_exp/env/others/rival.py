"""The opponent in a head-to-head race, from the view of either car."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.racing import RaceConfig
from deepracer_exp.env.rules import Bools, Ids, RaceRules
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.env.state import Floats
from deepracer_exp.errors import BadInput
from deepracer_exp.sim.batch import CarState
from deepracer_exp.tracks.lanes import INNER, OUTER, Lanes
from deepracer_exp.tracks.track import Pose, Tracks

from .boxes_and_bots import Others
from .race_others import RaceOthers, around

_KEPT = ("speed_mps", "untouchable")


class _OtherCar(Others):
    """The boxes around each of N cars, and last its opponent, whose pose the opponent's own race sets.

    Attributes:
        speed_mps: how fast this car drives, (N,).
        untouchable: whether it serves a penalty, so that no car can run into it, (N,), bool.
    """

    def __init__(self, race: RaceConfig, lanes: Lanes, tracks: Tracks, n_cars: int):
        """Set up arrays; arguments as for `Others`."""
        super().__init__(race, lanes, tracks, n_cars)
        self.speed_mps, self.untouchable = np.zeros(n_cars), np.zeros(n_cars, bool)

    def pause(self, hit: NDArray[np.bool_], time_s: Floats) -> None:
        """Do nothing: a car that was run into drives on."""

    def hit(self, x_m: Floats, y_m: Floats, yaw_rad: Floats) -> NDArray[np.int64]:
        """Return the index of the object that each car has run into, as `Others.hit` does."""
        hit = super().hit(x_m, y_m, yaw_rad)
        return np.where(self.untouchable & (hit == len(self.is_bot) - 1), -1, hit)

    def speeds_mps(self, ids: Ids, time_s: Floats) -> Floats:
        """Return the speeds of the others of the cars `ids`, m/s, (n, K)."""
        return self.speed_mps[ids, None] * self.is_bot

    def state_dict(self) -> dict[str, Any]:
        """Return copies of all arrays."""
        return {**super().state_dict(), **{name: getattr(self, name).copy() for name in _KEPT}}

    def load_state_dict(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore a `state_dict`."""
        super().load_state_dict(state)
        for name in _KEPT:
            getattr(self, name)[:] = state[name]


class RaceRival(RaceOthers):
    """The other car of each of N cars, under the service's rules for two models (deepracer-simapp).

    There is no contact. Who runs into the other from behind is at fault; the other drives on. Both meet the same boxes:
    they have the same streams, and begin their episodes together.

    Attributes:
        is_rival: whether these cars are the rivals, whose other is the learner.
    """

    others: _OtherCar
    _kind = _OtherCar

    def __init__(self, race: RaceConfig, setup: RaceSetup, rules: RaceRules):
        """Set up; arguments as for `RaceOthers`."""
        super().__init__(race, setup, rules)
        assert race.rivals is not None
        self._start_gap_m = race.rivals.start_gap_m
        self.is_rival = False

    @property
    def serving(self) -> Bools:
        """Return which cars still serve a penalty at the next control step, (N,)."""
        return np.asarray(self._held_until > self._rules.steps)

    def begin(self, ids: Ids, pose: Pose, evaluated: bool) -> Pose:
        """Return the starts of the cars: one at its place in the outer lane, the other behind it in the inner one.

        The finish line of both is the place of the car in front. Who starts there is drawn, and in an evaluation
        alternates from trial to trial. A car that would start near a box starts in the other lane; this may move both
        cars.
        """
        self._held_until[ids] = 0
        rules = self._rules
        decides = rules.cars[ids] if evaluated else self._episode_seeds(ids)
        leads = (decides % 2 == 0) != self.is_rival
        track_index = rules.track_index[ids]
        back = np.where(leads, 0.0, self._start_gap_m / rules.tracks.length_m[track_index])
        ndist = np.mod(rules.start_ndist[ids] - back, 1.0)
        points = rules.tracks.points_at(ndist, track_index)
        pose = self.lanes.poses(points, np.where(leads, OUTER, INNER), track_index)
        return self._among_others(ids, pose, ndist, evaluated) if self._race.boxes.count else pose

    def show(self, ids: Ids, cars: CarState, serving: Bools) -> None:
        """Update the opponents of the cars `ids`.

        Args:
            ids: indices of the cars, (n,).
            cars: all opponents, (N,) each.
            serving: which of these serve a penalty, (N,).
        """
        rules, car = self._rules, self.others
        points = np.stack([cars.x_m[ids], cars.y_m[ids]], axis=-1)
        projection = rules.tracks.project(points, rules.track_index[ids])
        car.poses[ids, -1, :2], car.poses[ids, -1, 2] = points, cars.yaw_rad[ids]
        car.distance_m[ids, -1], car.offset_m[ids, -1] = projection.distance_m, projection.offset_m
        car.speed_mps[ids], car.untouchable[ids] = cars.speed_mps[ids], serving[ids]

    def _ahead_percent(self, own_percent: Floats, percent: Floats) -> Floats:
        # On the service the car that starts behind the line counts as ahead until it has crossed it.
        if self._race.quirks == "service":
            return super()._ahead_percent(own_percent, percent)
        return around(own_percent - percent, np.full(len(percent), 100.0))


def refuse_rivals(setup: RaceSetup, what: str) -> RaceSetup:
    """Return a setup whose cars have no rival.

    Args:
        setup: of any race.
        what: which kind of environment cannot have one.

    Raises:
        BadInput: they have.
    """
    if setup.others is not None and setup.others.rivals is not None:
        raise BadInput(
            f"race.rivals.policy={setup.others.rivals.policy}",
            f"{what} has no policy to drive the rival",
            "another race, or deepracer-exp train",
        )
    return setup
