"""Action spaces: from a policy's action to steering in degrees and speed in metres per second."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepracer_exp.aws.models.model_metadata import Action, ModelMetadata
from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.driving import (
    ActionSpaceConfig,
    ContinuousActionSpace,
    DiscreteActionSpace,
    SpeedRange,
    SteeringRange,
)
from deepracer_exp.errors import BadInput

Commands = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Steering in degrees, positive to the left, and speed in metres per second, each (N,)."""


@dataclass(frozen=True, eq=False)
class DiscreteActions:
    """A list of actions; a policy chooses one by its index."""

    steering_deg: NDArray[np.float64]
    """(n,) degrees, positive to the left."""
    speed_mps: NDArray[np.float64]
    """(n,)"""

    @property
    def n(self) -> int:
        """Number of actions."""
        return len(self.steering_deg)

    @property
    def low(self) -> NDArray[np.float64]:
        """Lowest [steering_deg, speed_mps] of any action, (2,)."""
        return np.array([self.steering_deg.min(), self.speed_mps.min()])

    @property
    def high(self) -> NDArray[np.float64]:
        """Highest [steering_deg, speed_mps] of any action, (2,)."""
        return np.array([self.steering_deg.max(), self.speed_mps.max()])

    def commands(self, action: NDArray[Any]) -> Commands:
        """Look up the commands of N action numbers, (N,) integers from 0 to n - 1."""
        return self.steering_deg[action], self.speed_mps[action]


@dataclass(frozen=True, eq=False)
class ContinuousActions:
    """Two numbers from -1 to 1, [steering, speed], scaled linearly to low..high."""

    low: NDArray[np.float64]
    """[steering_deg, speed_mps] at -1, (2,)."""
    high: NDArray[np.float64]
    """[steering_deg, speed_mps] at 1, (2,)."""

    @property
    def n(self) -> None:
        """Number of actions; None if the space is continuous."""
        return None

    def commands(self, action: NDArray[Any]) -> Commands:
        """Clip N actions, (N, 2) floats, to -1..1 and scale them; NaN stays NaN."""
        # In float64, because float32 shares of both ends do not add up to one.
        # Minimum and maximum, because `np.clip` takes longer to begin than to clip a hundred numbers.
        share = (np.minimum(np.maximum(np.asarray(action, np.float64), -1.0), 1.0) + 1.0) * 0.5
        # This form is exact at both ends; in between, rounding may leave a range of zero width.
        scaled = self.low * (1.0 - share) + self.high * share
        scaled = np.minimum(np.maximum(scaled, self.low), self.high)
        return scaled[:, 0], scaled[:, 1]


ActionSpace = DiscreteActions | ContinuousActions


def build_action_space(config: ActionSpaceConfig) -> ActionSpace:
    """Build the action space of an experiment; `config.file` is null, its actions are in the other values.

    The simulator's limits of steering and speed are not applied here: the trace has the unclipped commands.

    Raises:
        BadInput: contradictory values, or an empty list.
    """
    if isinstance(config, DiscreteActionSpace):
        if not config.actions:
            raise BadInput("action_space.actions", "[] is empty", "at least one steering_angle and speed")
        return _discrete(
            [action.steering_angle for action in config.actions], [action.speed for action in config.actions]
        )
    steering, speed = config.steering_angle, config.speed
    for key, bounds in (("steering_angle", steering), ("speed", speed)):
        if bounds.low > bounds.high:
            raise BadInput(
                f"action_space.{key}", f"low {bounds.low:g} is above high {bounds.high:g}", "low <= high"
            )
    if isinstance(config, ContinuousActionSpace):
        low, high = (
            np.array([getattr(action, end) for action in (steering, speed)]) for end in ("low", "high")
        )
        return ContinuousActions(low.astype(np.float64), high.astype(np.float64))
    angles = _levels("steering", steering, config.steering_levels)
    speeds = _levels("speed", speed, config.speed_levels)
    # Steering in the outer loop, as the console has it.
    return _discrete(np.repeat(angles, len(speeds)), np.tile(speeds, len(angles)))


def describe_actions(actions: ActionSpace) -> str:
    """Return the actions in words: equal for equal spaces."""
    if isinstance(actions, DiscreteActions):
        pairs = zip(actions.steering_deg.tolist(), actions.speed_mps.tolist(), strict=True)
        return f"{actions.n} actions " + " ".join(f"{steering:g}°/{speed:g}" for steering, speed in pairs)
    low, high = actions.low.tolist(), actions.high.tolist()
    return f"continuous {low[0]:g} to {high[0]:g}°, {low[1]:g} to {high[1]:g} m/s"


def action_remarks(actions: ActionSpace, car: CarConfig) -> list[str]:
    """Return a line for each limit that clips an action, and for each set of actions that are equal once clipped."""
    low = np.array([-car.max_steering_deg, car.min_speed_mps])
    high = np.array([car.max_steering_deg, car.max_speed_mps])
    remarks = []
    for axis, (name, unit, limits) in enumerate(
        (
            ("steering_angle", "degrees", f"{-high[0]:g} to {high[0]:g}"),
            ("speed", "m/s", f"{low[1]:g} to {high[1]:g}"),
        )
    ):
        lowest, highest = actions.low[axis], actions.high[axis]
        if lowest < low[axis] or highest > high[axis]:
            remarks.append(
                f"action_space: {name} from {lowest:g} to {highest:g} {unit}: the car cuts it to {limits} "
                f"(car={car.name}), as the service does"
            )
    if isinstance(actions, DiscreteActions):
        cut = np.clip(np.column_stack([actions.steering_deg, actions.speed_mps]), low, high)
        alike: dict[tuple[float, ...], list[int]] = {}
        for number, action in enumerate(cut.tolist()):
            alike.setdefault(tuple(action), []).append(number)
        for (steering, speed), numbers in alike.items():
            if len(numbers) > 1:
                remarks.append(
                    f"action_space: actions {', '.join(map(str, numbers))} are the same, {steering:g} degrees at "
                    f"{speed:g} m/s: {len(alike)} of {actions.n} actions differ"
                )
    return remarks


def _discrete(steering_deg: ArrayLike, speed_mps: ArrayLike) -> DiscreteActions:
    return DiscreteActions(np.array(steering_deg, dtype=np.float64), np.array(speed_mps, dtype=np.float64))


def _levels(name: str, bounds: SteeringRange | SpeedRange, levels: int) -> NDArray[np.float64]:
    if (levels == 1) != (bounds.low == bounds.high):
        raise BadInput(
            f"action_space.{name}_levels: {levels} from low {bounds.low:g} to high {bounds.high:g};"
            " accepted: 1 level with low = high, or at least 2 with low < high"
        )
    return np.linspace(bounds.low, bounds.high, levels)


def metadata_of(actions: ActionSpace) -> ModelMetadata:
    """Return an action space as model metadata, with the service's default camera as its sensor."""
    if isinstance(actions, DiscreteActions):
        listed = map(Action, actions.steering_deg.tolist(), actions.speed_mps.tolist())
        return ModelMetadata(actions=tuple(listed))
    return ModelMetadata(low=Action(*actions.low.tolist()), high=Action(*actions.high.tolist()))
