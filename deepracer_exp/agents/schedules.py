"""Learning-rate schedules, as factors of `algorithm.lr`.

Functions of the progress, where torch.optim.lr_scheduler counts steps: lengths may be fractions of the budget, and a
resumed run needs no replay of past steps. Only `adaptive_kl` has a state.
"""

import math

from deepracer_exp.config.learning import AdaptiveKLLR, FallingLR, LRScheduleConfig, MultipliedLR, PresetLR
from deepracer_exp.config.own_class import OwnClass, build_own

# A warm-up counted in fractions of the budget begins at fraction 0; its first update must still have a rate above 0.
_LOWEST_WARMUP_FACTOR = 0.01


class Schedule:
    """The factor of the learning rate at each point of a run; base class of your own schedules."""

    def factor(self, iteration: int, fraction: float) -> float:
        """Return the factor of `algorithm.lr` for the coming update.

        Args:
            iteration: Updates made before this one.
            fraction: Share of the budget spent, 0 to 1.
        """
        raise NotImplementedError

    def observe(self, kl: float) -> None:
        """Observe the KL divergence, in nats, of the last update."""

    def state_dict(self) -> dict[str, float]:
        """Return the state that `observe` has changed, for a resumed run."""
        return {}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Restore a `state_dict`."""


class PresetSchedule(Schedule):
    """Warm-up and decay, both counted from the start of the run and multiplied."""

    def __init__(self, config: PresetLR) -> None:
        self._config = config
        self._adapted = 1.0

    def factor(self, iteration: int, fraction: float) -> float:
        """Return the product of warm-up and decay."""
        by_iteration = self._config.by == "iteration"
        position = iteration if by_iteration else fraction
        # The first of n warm-up iterations has 1/n of the rate, the last all of it.
        return self._warmup(iteration + 1 if by_iteration else fraction) * self._decay(position)

    def observe(self, kl: float) -> None:
        """Adapt the rate of `adaptive_kl`: down where `kl` is above twice the target, up where it is below half of it.

        The rule of torchrl.objectives.KLAdaptiveLR, kept apart from the optimizer so that a warm-up can multiply it.
        """
        if not isinstance(self._config, AdaptiveKLLR):
            return
        step, target = self._config.step_factor, self._config.target_kl
        change = 1 / step if kl > 2 * target else step if kl < target / 2 else 1.0
        lowest, highest = self._config.lowest_factor, self._config.highest_factor
        self._adapted = min(highest, max(lowest, self._adapted * change))

    def state_dict(self) -> dict[str, float]:
        """Return the adapted factor."""
        return {"adapted": self._adapted}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Restore it."""
        self._adapted = state["adapted"]

    def _warmup(self, position: float) -> float:
        if position >= self._config.warmup:
            return 1.0
        return max(position / self._config.warmup, _LOWEST_WARMUP_FACTOR)

    def _decay(self, position: float) -> float:
        match self._config:
            case FallingLR(kind="linear", length=length, end_factor=end):
                return 1 + (end - 1) * min(position / length, 1.0)
            case FallingLR(length=length, end_factor=end):
                return end + (1 - end) * (1 + math.cos(math.pi * min(position / length, 1.0))) / 2
            case MultipliedLR(kind="step", length=length, factor=factor):
                return factor ** math.floor(position / length)
            case MultipliedLR(length=length, factor=factor):
                return factor ** (position / length)
        return self._adapted


def build_schedule(config: LRScheduleConfig) -> Schedule:
    """Return the schedule of the group `lr_schedule`.

    Raises:
        BadInput: a class of the user's own cannot be used.
    """
    if isinstance(config, OwnClass):
        return build_own(config, "lr_schedule.target", Schedule)
    return PresetSchedule(config)
