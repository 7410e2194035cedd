"""An action space from driven laps: selection of laps, and the few actions nearest to their commands."""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.cluster.vq import kmeans2
from scipy.spatial.distance import cdist

from deepracer_exp.aws.logs.recorded import Recording
from deepracer_exp.aws.models.model_metadata import Action
from deepracer_exp.config.bounds import FEWEST_ACTIONS, MOST_ACTIONS
from deepracer_exp.config.car import CarConfig
from deepracer_exp.errors import BadInput, count
from deepracer_exp.evaluation.fastest.fastest_lap import FastestLap

from .log_view import prepare, prepare_races
from .statistics import Values

FAST = 0.05
"""Share by which a lap that counts may be slower than the fastest one of its track."""
DEGREES_PER_MPS = 10.0
"""Steering that counts as much as 1 m/s when commands are compared. At 2 m/s and a wheelbase of 0.164 m, a degree held
for half a second moves the car 5 cm sideways (speed^2 * steering * time^2 / (2 * wheelbase)), and 0.1 m/s move it 5 cm
along the road."""
RESCUE_MPS = 1.3
"""Highest speed of the actions that turn a car round or brake it, that of `conf/action_space/discrete_fast.yaml`."""
CORRECTION = 1 / 3
"""Share of full lock that brings a car back to its line at the laps' own speed."""
NEAR = 0.5
"""Distance from a chosen action, in m/s or equivalent steering, within which no action for recovery is added."""
STEERING_STEP_DEG, SPEED_STEP_MPS = 0.5, 0.05
"""Proposed actions are rounded to multiples of these."""
_LOWEST = 1.0
"""Percentile of the commanded speeds that counts as the lowest: exploring laps have odd single commands."""
_TRIES = 10
"""Starts of the clustering, the best of which counts."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Commands:
    """The commands of complete, fast laps, a row a control step."""

    laps: str
    """Description of the laps."""
    steering_deg: Values
    """(n,), positive to the left."""
    speed_mps: Values
    """(n,)"""

    def within(self, car: CarConfig) -> "Commands":
        """Return the commands as a car cuts them to its limits."""
        return replace(
            self,
            steering_deg=np.clip(self.steering_deg, -car.max_steering_deg, car.max_steering_deg),
            speed_mps=np.clip(self.speed_mps, car.min_speed_mps, car.max_speed_mps),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class ActionProposal:
    """A list of actions for given commands, sorted from right to left and from slow to fast."""

    commands: Commands
    actions: tuple[Action, ...]
    to_recover: tuple[bool, ...]
    """Whether each action was added for recovery."""
    nearest: NDArray[np.intp]
    """Number of the action that is nearest to each command (n,)."""

    @property
    def shares(self) -> Values:
        """Share of the commands that each action is the nearest of, 0 to 1, (number of actions,)."""
        return np.bincount(self.nearest, minlength=len(self.actions)) / len(self.nearest)

    @property
    def mean_deviation(self) -> tuple[float, float]:
        """Mean distance of the commands from the nearest action, in degrees and in m/s."""
        listed = np.array(self.actions)[self.nearest]
        commands = self.commands
        return (
            float(np.abs(commands.steering_deg - listed[:, 0]).mean()),
            float(np.abs(commands.speed_mps - listed[:, 1]).mean()),
        )


def fast_laps(lap_time_s: ArrayLike) -> NDArray[np.bool_]:
    """Return which laps of a track are at most `FAST` slower than the fastest one; NaN: not complete."""
    times_s = np.asarray(lap_time_s, np.float64)
    complete = np.isfinite(times_s)
    return times_s <= (1.0 + FAST) * times_s[complete].min() if complete.any() else complete


def fast_laps_in_words(fast: int, complete: int, fastest_s: float, where: str) -> str:
    """Describe the laps that count: `fast` of `complete`, driven `where`."""
    return (
        f"{fast:,} of {count(complete, 'complete lap')} without a reset {where}: those at most {FAST:.0%} slower "
        f"than the fastest, {fastest_s:.2f} s"
    )


def commands_of_log(recording: Recording, track: str | None = None) -> Commands:
    """Return the commands of a log's fast laps on one course, of its training and of its evaluations and races.

    `track` is one of several, as for `log_view.prepare`.

    Raises:
        BadInput: it has no complete lap without a reset, or as for `log_view.prepare`.
    """
    views = [prepare(recording, track)]
    if views[0].trained and len(views[0].evaluation_episodes):
        views.append(prepare_races(recording, track or views[0].track_name or None))
    times_s = [view.episodes["lap_time_s"].to_numpy(np.float64) for view in views]
    every_s = np.concatenate(times_s)
    complete, fast = int(np.isfinite(every_s).sum()), fast_laps(every_s)
    if not complete:
        raise BadInput(
            recording.name, "has no complete lap without a reset", "a run or log with laps, or a track"
        )
    of_view = np.split(fast, np.cumsum([len(times) for times in times_s])[:-1])
    sources = [
        f"{wanted.sum():,} of the {'training' if view.trained else 'evaluations and races'}"
        for view, wanted in zip(views, of_view, strict=True)
        if wanted.any()
    ]
    where = f"on {views[0].track_name or 'the track'}"
    words = fast_laps_in_words(int(fast.sum()), complete, float(np.nanmin(every_s)), where)
    rows = pd.concat(
        [view.of_episodes(wanted, "steer", "throttle") for view, wanted in zip(views, of_view, strict=True)]
    ).dropna()
    return Commands(
        laps=f"{words} ({', '.join(sources)})",
        steering_deg=rows["steer"].to_numpy(np.float64),
        speed_mps=rows["throttle"].to_numpy(np.float64),
    )


def commands_of_fastest(lap: FastestLap, car: str, track: str) -> Commands:
    """Return the commands of the fastest lap of a car on a track, without those of the prepare step."""
    return Commands(
        laps=f"the fastest lap of {car} on {track}, {lap.lap_time_s:.2f} s",
        steering_deg=lap.column("steering_deg")[1:],
        speed_mps=lap.column("commanded_mps")[1:],
    )


def check_count(wanted: int) -> None:
    """Check the wanted number of actions.

    Raises:
        BadInput: too few or too many.
    """
    if not FEWEST_ACTIONS <= wanted <= MOST_ACTIONS:
        raise BadInput(f"--count {wanted}", "", f"{FEWEST_ACTIONS} to {MOST_ACTIONS}")


def propose_actions(commands: Commands, wanted: int, car: CarConfig) -> ActionProposal:
    """Choose the actions nearest to the commands of fast laps, and add actions for recovery.

    `wanted` is a number of actions that `check_count` accepts.

    Actions are the centres of clusters (k-means) of the commands, in steering and speed weighted by `DEGREES_PER_MPS`.
    Laps that went well do not show how to come back to the line, and a policy has to learn that first. So these are
    added where no chosen action is `NEAR`: full lock to either side and straight ahead at the lowest speed of the laps
    and at most `RESCUE_MPS`, to turn and to brake, and `CORRECTION` of full lock to either side at the laps' median
    speed. Where rounded commands are the same, there are fewer actions.

    Raises:
        BadInput: another number of actions is asked for.
    """
    check_count(wanted)
    driven = np.column_stack([commands.steering_deg, commands.speed_mps])
    scale = np.array([DEGREES_PER_MPS, 1.0])
    needed = _to_recover(commands, car)
    added = np.zeros(len(needed), bool)
    while True:
        chosen = _rounded(_centers(driven / scale, wanted - int(added.sum())) * scale, car)
        lacking = cdist(needed / scale, chosen / scale).min(axis=1) > NEAR
        if not (lacking & ~added).any():
            break
        added |= lacking
    listed = np.unique(np.concatenate([chosen, needed[added]]), axis=0)
    return ActionProposal(
        commands=commands,
        actions=tuple(Action(*map(float, pair)) for pair in listed),
        to_recover=tuple(bool((needed[added] == pair).all(axis=1).any()) for pair in listed),
        nearest=cdist(driven / scale, listed / scale).argmin(axis=1),
    )


def _to_recover(commands: Commands, car: CarConfig) -> Values:
    """Return the actions for recovery, (5, 2) degrees and m/s."""
    lowest_mps, usual_mps = np.percentile(commands.speed_mps, [_LOWEST, 50.0])
    slow_mps, lock_deg = min(lowest_mps, RESCUE_MPS), car.max_steering_deg
    turns = [(side * lock_deg, slow_mps) for side in (-1, 0, 1)]
    corrections = [(side * CORRECTION * lock_deg, usual_mps) for side in (-1, 1)]
    return _rounded(np.array([*turns, *corrections]), car)


def _centers(points: Values, most: int) -> Values:
    """Return the centres of at most so many clusters of points (n, 2), (clusters, 2)."""
    different = np.unique(points, axis=0)
    if len(different) <= most:
        return different
    draws = np.random.default_rng(0)
    best, least = different[:0], np.inf
    for _ in range(_TRIES):
        _, label = kmeans2(points, most, iter=50, minit="++", rng=draws)
        centers = np.array([points[label == k].mean(axis=0) for k in np.unique(label)])
        spread = float((cdist(points, centers).min(axis=1) ** 2).mean())
        if spread < least:
            best, least = centers, spread
    return best


def _rounded(actions: Values, car: CarConfig) -> Values:
    """Return actions (n, 2) rounded within the limits of the car."""
    steps = np.array([STEERING_STEP_DEG, SPEED_STEP_MPS])
    low, high = (-car.max_steering_deg, car.min_speed_mps), (car.max_steering_deg, car.max_speed_mps)
    # Rounded once more for numbers such as 1.3 that have no exact multiple; + 0.0 for no -0.0.
    return np.clip((np.round(actions / steps) * steps).round(3), low, high) + 0.0
