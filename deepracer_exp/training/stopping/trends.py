"""Moving averages over the rows of a run, and the rules of `stopping=entropy` built on them."""

import math

from deepracer_exp.config.stopping import CollapsedRule, LapsSlowerRule, NotLearningRule, OverfittingRule

Reason = tuple[str, dict[str, float]]
"""The reason why a rule applies, in words, and the values that it compared."""


class Average:
    """A moving average over the last known values of a column; rows without a value leave it unchanged."""

    def __init__(self, window: int):
        self._window = window
        self._known: list[float] = []
        self._has_value: list[bool] = []
        self._averages: list[float | None] = []
        self.first = math.nan
        self.best, self._worst = -math.inf, math.inf

    def add(self, value: float | None) -> None:
        """Add the value of the newest row, None or NaN where it has none."""
        self._has_value.append(value is not None and math.isfinite(value))
        if value is not None and self._has_value[-1]:
            self._known = [*self._known, value][-self._window :]
        average = sum(self._known) / self._window if len(self._known) == self._window else None
        if average is not None:
            if math.isinf(self.best):
                self.first = average
            self.best, self._worst = max(self.best, average), min(self._worst, average)
        self._averages.append(average)

    def reaches_back(self, patience: int) -> bool:
        """Return whether there is an average before the last `patience` rows."""
        return len(self._averages) > patience and self._averages[-patience - 1] is not None

    def is_fresh(self, rows: int) -> bool:
        """Return whether the newest average contains only values of the last rows."""
        return sum(self._has_value[-rows:]) >= self._window

    @property
    def now(self) -> float:
        """The newest average, which must be known."""
        (last,) = self.last(1)
        return last

    @property
    def range(self) -> float:
        """Difference of the highest and the lowest average."""
        return self.best - self._worst

    def last(self, rows: int) -> list[float]:
        """Return the averages of the last rows."""
        return [average for average in self._averages[-rows:] if average is not None]

    def change(self, patience: int) -> float | None:
        """Return the range of the averages in the last `patience` rows, None where there is none before them."""
        if not self.reaches_back(patience):
            return None
        last = self.last(patience)
        return max(last) - min(last)

    def row_of_best(self) -> int:
        """Return the number of the first row with the highest average, which must be known."""
        return self._averages.index(self.best)

    def bests(self, patience: int) -> tuple[float, float]:
        """Return the highest average before the last `patience` rows, and within them."""
        before = (average for average in self._averages[:-patience] if average is not None)
        return max(before), max(self.last(patience))


def collapsed(rule: CollapsedRule, entropy: Average, completion: Average) -> Reason | None:
    """Return why a run whose policy is almost deterministic and drives badly should end."""
    highest, best = max(entropy.last(rule.patience)), max(completion.last(rule.patience))
    if highest >= rule.entropy_floor or best >= rule.completion_poor:
        return None
    why = f"entropy at {highest:.1%} with {best:.0f}% completion"
    return why, {"entropy": highest, "completion": best}


def not_learning(
    rule: NotLearningRule, entropy: Average, completion: Average, is_led: bool = False
) -> Reason | None:
    """Return why a run whose policy has hardly changed since the start should end.

    With `is_led` its entropy follows a target whether it learns or not, so only its completion decides.
    """
    lowest, best = min(entropy.last(rule.patience)), max(completion.last(rule.patience))
    start = completion.first
    if (
        (lowest <= rule.entropy_near and not is_led)
        or best - start > rule.completion_gain
        or best >= rule.completion_poor
    ):
        return None
    at_entropy = f"entropy at {lowest:.1%} of its target" if is_led else f"entropy still at {lowest:.1%}"
    why = f"{at_entropy}, completion {start:.1f}% at the start and {best:.1f}% since"
    return why, {"entropy": lowest, "completion_start": start, "completion": best}


def overfits(rule: OverfittingRule, held_out: Average, returns: Average, speed: Average) -> Reason | None:
    """Return why a run should end whose policy completes less under held-out conditions for hardly faster laps.

    `speed` as in `laps_slower`; where it has no average before the last `patience` rows, the return alone says whether
    the policy still improves.
    """
    before, since = held_out.bests(rule.patience)
    lowest_return = returns.best - rule.return_drop * returns.range
    if since > before - rule.held_out_drop or returns.now < lowest_return:
        return None
    values = {"held_out_completion_before": before, "held_out_completion_since": since}
    values |= {"return": returns.now, "return_best": returns.best}
    meanwhile = "the return holds"
    if speed.reaches_back(rule.patience):
        speed_before, speed_since = speed.bests(rule.patience)
        if speed_since > speed_before * (1 + rule.lap_gain):
            return None
        meanwhile = f"the fastest laps went from {1 / speed_before:.2f} to {1 / speed_since:.2f} s"
        values |= {"lap_time_s_before": 1 / speed_before, "lap_time_s_since": 1 / speed_since}
    return f"held-out completion fell from {before:.0f}% to {since:.0f}% while {meanwhile}", values


def laps_slower(rule: LapsSlowerRule, speed: Average, returns: Average) -> Reason | None:
    """Return why a run whose evaluated laps have become slower, at an unchanged return, should end.

    `speed` is 1 / lap time, 1/s, of evaluations that completed `RELIABLE` of their laps.
    """
    before, since = speed.bests(rule.patience)
    lowest_return = returns.best - rule.return_drop * returns.range
    if since * (1 + rule.slower) > before or returns.now < lowest_return:
        return None
    laps = f"evaluated laps took {1 / before:.2f} s and have taken {1 / since:.2f} s or more since"
    lap_times = {"lap_time_s_before": 1 / before, "lap_time_s_since": 1 / since}
    return f"{laps}, while the return holds", lap_times | {"return": returns.now, "return_best": returns.best}
