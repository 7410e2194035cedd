"""The rules by which a run stops: a `StoppingRule` decides after each row of metrics.jsonl."""

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

from deepracer_exp.config.own_class import OwnClass, build_own
from deepracer_exp.config.stopping import (
    ConvergedRule,
    EntropyStopping,
    LapsSlowerRule,
    OverfittingRule,
    PlateauStopping,
    ReliableStopping,
    StoppingConfig,
)
from deepracer_exp.errors import count
from deepracer_exp.runs.run_result import FINISHED, STOPPED_EARLY, Ending, reliable_lap_s

from . import trends
from .trends import Average, Reason

Row = Mapping[str, Any]
"""One line of metrics.jsonl."""

EVALUATED = ("eval_completion", "held_out_completion")
"""Columns that only the rows of evaluated iterations have."""
_GROWTH = ("completion", "mean_return", "laps_per_1000_steps")
_LAP_SPEED = "evaluated_laps_per_s"
_STEPS = 1000  # control steps per which laps are counted, because iterations differ in length
UNDECIDED = {"stopping.rule": "none", "stopping.stopped_early": "false"}
"""Tags of a run that is resumed after a rule had ended it; those with the rule's values stay."""


@dataclass(frozen=True, kw_only=True)
class Decision:
    """Why a run should end."""

    rule: str
    """`reliable`, `plateau`, a rule of `stopping=entropy` (`converged`, `overfitting`, `laps_slower`, `collapsed`,
    `not_learning`), or the name of another rule."""
    why: str
    """The rule's reason in words."""
    values: dict[str, float] = field(default_factory=dict)
    """Values that were compared; entropy as a share, see `entropy_share`."""
    thresholds: dict[str, Any] = field(default_factory=dict)
    """The keys of the rule."""
    stopped_early: bool = False
    """Whether more training would not have helped, and the result is of no use."""

    def __str__(self) -> str:
        """Return rule and reason, e.g. ``reliable: 94% of the last 50 episodes completed the lap``."""
        return self.ending.reason

    @property
    def ending(self) -> Ending:
        """The run's ending under this decision."""
        return Ending.by_rule(self.rule, self.why, STOPPED_EARLY if self.stopped_early else FINISHED)

    def as_dict(self) -> dict[str, Any]:
        """Return the decision for summary.json."""
        return asdict(self)

    def tags(self) -> dict[str, str]:
        """Return the decision as tags of a run."""
        numbers = [("value", self.values), ("threshold", self.thresholds)]
        return {
            "stopping.rule": self.rule,
            "stopping.stopped_early": str(self.stopped_early).lower(),
            **{
                f"stopping.{kind}.{key}": f"{value:.4g}" if isinstance(value, float) else str(value)
                for kind, items in numbers
                for key, value in items.items()
            },
        }


def entropy_share(entropy: float, at_start: float, action_count: int | None) -> float:
    """Return a policy's entropy as a share.

    Entropies are in nats; the one at the start is used only for a continuous policy, whose `action_count` is None.

    Returns:
        For a discrete policy its entropy over that of a uniform choice, log(n): 0 to 1. A continuous policy's entropy
        may be negative, so a ratio has no meaning; exp((entropy - start) / 2), for two normal distributions, is the
        ratio of their spread (geometric mean of the standard deviations): 1 at the start.
    """
    if action_count is None:
        return math.exp(min((entropy - at_start) / 2, 700.0))
    return entropy / math.log(action_count) if action_count > 1 else 0.0


def entropy_over_target(entropy: float, target: float, action_count: int | None) -> float:
    """Return entropy as a share of its target, for a policy such as SAC's whose temperature steers it there.

    Both are in nats.

    Returns:
        1 at the target; for a continuous policy the ratio of spreads, as in `entropy_share`.
    """
    if action_count is None:
        return entropy_share(entropy, target, None)
    return entropy / target if target > 0 else 1.0


class StoppingRule:
    """Never ends a run (`stopping=none`); base class of all rules, yours included.

    The same rows must give the same decisions: a resumed run passes its rows again.
    """

    def observe(self, row: Row) -> Decision | None:
        """Return why the run should end after this row of metrics.jsonl, None to continue."""
        return None


class ReliableRule(StoppingRule):
    """Ends a run once the policy completes a share of its laps: of the last episodes, or of the last evaluations."""

    def __init__(self, config: ReliableStopping):
        self._config = config
        self._evaluated: deque[tuple[int, int, float]] = deque(maxlen=config.evaluations)
        """Complete and attempted laps of the last evaluations under the usual conditions, and completion under held-out
        ones."""

    def observe(self, row: Row) -> Decision | None:
        """Compare the share of complete laps."""
        return self._explored(row) if self._config.evaluations is None else self._raced(row)

    def _explored(self, row: Row) -> Decision | None:
        share = row["lap_share"]
        if share is None or share < self._config.lap_share:
            return None
        tracks = sum(key.startswith("lap_share/") for key in row)
        more, where = (" or more", f" on each of {tracks} tracks") if tracks else ("", "")
        why = f"{share:.0%}{more} of the last {self._config.episodes} episodes completed the lap{where}"
        return _decision("reliable", why, {"lap_share": share}, self._config)

    def _raced(self, row: Row) -> Decision | None:
        config, tried = self._config, row.get("eval_laps_tried")
        if not tried:
            return None
        self._evaluated.append((row["eval_laps"], tried, row.get("held_out_completion") or 0.0))
        laps, tried, held_out = (sum(column) for column in zip(*self._evaluated, strict=True))
        if len(self._evaluated) != config.evaluations or laps < config.lap_share * tried:
            return None
        why = f"{laps} of {tried} laps of the last {count(len(self._evaluated), 'evaluation')} were complete"
        values = {"lap_share": laps / tried}
        if config.held_out_completion is not None:
            completion = held_out / len(self._evaluated)
            if completion < config.held_out_completion:
                return None
            why += f", and {completion:.0f}% of the way on held-out conditions"
            values["held_out_completion"] = completion
        return _decision("reliable", why, values, config)


class TrendRule(StoppingRule):
    """The rules `plateau` and `entropy`, which read moving averages."""

    def __init__(self, config: PlateauStopping | EntropyStopping, action_count: int | None):
        """Set up the rule.

        `action_count` is the number of discrete actions, None for a continuous action space.
        """
        self._config = config
        self._action_count = action_count
        self._entropy_at_start: float | None = None
        self._is_led = False
        self._before = (0, 0)
        self.averages = {
            name: Average(config.window) for name in (*_GROWTH, "entropy", *EVALUATED, _LAP_SPEED)
        }
        self._race_scores_s: list[float] = []  # infinite where none is known
        self._rows = 0

    def observe(self, row: Row) -> Decision | None:
        """Add the row to the averages and apply the rule."""
        config = self._config
        self._rows += 1
        for name, value in self._watched(row).items():
            self.averages[name].add(value)
        score_s = row.get("eval_race_score_s")
        self._race_scores_s.append(math.inf if score_s is None else score_s)
        return self._plateau(config) if isinstance(config, PlateauStopping) else self._entropy(config)

    def _watched(self, row: Row) -> dict[str, float | None]:
        entropy = row.get("entropy")
        if self._entropy_at_start is None:
            self._entropy_at_start = entropy
        (laps, steps), self._before = self._before, (row["laps"], row["env_steps"])
        share = None
        if entropy is not None and self._entropy_at_start is not None:
            share = entropy_share(entropy, self._entropy_at_start, self._action_count)
            target = row.get("target_entropy")
            if target is not None:
                self._is_led = True
                share = entropy_over_target(entropy, target, self._action_count)
        return {
            "entropy": share,
            _LAP_SPEED: 1 / lap_s if (lap_s := reliable_lap_s(row)) else None,
            "laps_per_1000_steps": _STEPS * (row["laps"] - laps) / max(row["env_steps"] - steps, 1),
            **{name: row.get(name) for name in ("completion", "mean_return", *EVALUATED)},
        }

    def _plateau(self, config: PlateauStopping) -> Decision | None:
        series = self.averages[config.metric]
        if self._rows <= max(config.warmup, config.patience) or not series.reaches_back(config.patience):
            return None
        before, since = series.bests(config.patience)
        if since > before + config.gain * series.range:
            return None
        why = f"{config.metric} has not grown for {count(config.patience, 'iteration')}"
        values = {f"{config.metric}_before": before, f"{config.metric}_since": since}
        return _decision("plateau", why, values, config)

    def _entropy(self, config: EntropyStopping) -> Decision | None:
        not_learning = partial(trends.not_learning, is_led=self._is_led)
        rules: tuple[tuple[str, Any, tuple[str, ...], Callable[..., Reason | None]], ...] = (
            ("collapsed", config.collapsed, ("entropy", "completion"), trends.collapsed),
            ("not_learning", config.not_learning, ("entropy", "completion"), not_learning),
            ("overfitting", config.overfitting, ("held_out_completion", "mean_return"), self._overfits),
            ("laps_slower", config.laps_slower, (_LAP_SPEED, "mean_return"), self._laps_slower),
            ("converged", config.converged, _GROWTH, self._converged),
        )
        for name, rule, columns, judge in rules:
            # Patience begins with the first average, so that there is something before it to compare with.
            if rule is None or self._rows <= max(rule.warmup, rule.patience):
                continue
            averages = [self.averages[column] for column in columns]
            if all(average.reaches_back(rule.patience) for average in averages) and (
                reason := judge(rule, *averages)
            ):
                return _decision(name, *reason, rule)
        return None

    def _overfits(self, rule: OverfittingRule, held_out: Average, returns: Average) -> Reason | None:
        return trends.overfits(rule, held_out, returns, self.averages[_LAP_SPEED])

    def _laps_slower(self, rule: LapsSlowerRule, speed: Average, returns: Average) -> Reason | None:
        scores_s = self._race_scores_s
        # A policy that gives up some speed for laps on held-out conditions may still become the best one.
        improves = min(scores_s[-rule.patience :]) < min(scores_s[: -rule.patience], default=math.inf)
        return (
            None
            if improves or not speed.is_fresh(rule.patience)
            else trends.laps_slower(rule, speed, returns)
        )

    def _converged(self, rule: ConvergedRule, *averages: Average) -> Reason | None:
        completion, returns, laps = averages
        values = {"completion": completion.now, "completion_best": completion.best}
        entropy, at_entropy = self.averages["entropy"], ""
        change = entropy.change(rule.patience)
        if change is not None:  # the logs of others may have no entropy
            values |= {"entropy": entropy.now, "entropy_change": change}
            at_entropy = f", entropy {entropy.now:.1%}"
        grew = False
        gains = (rule.completion_gain, rule.return_gain * returns.range, rule.laps_gain * laps.best)
        for name, series, enough in zip(_GROWTH, averages, gains, strict=True):
            before, since = series.bests(rule.patience)
            values |= {f"{name}_before": before, f"{name}_since": since}
            grew = grew or since > before + enough
        scores_s = self._race_scores_s
        before_s = min(scores_s[: -rule.best_patience], default=math.inf)
        since_s = min(scores_s[-rule.best_patience :])
        if math.isfinite(before_s) and math.isfinite(since_s):
            values |= {"race_score_s_before": before_s, "race_score_s_since": since_s}
        if (
            grew
            or since_s < before_s * (1 - rule.best_gain)
            or completion.now < completion.best - rule.completion_near
            or (change or 0.0) > rule.entropy_change
        ):
            return None
        idle = count(rule.patience, "iteration")
        return f"{completion.now:.1f}% completion{at_entropy}, no growth for {idle}", values


def build_rule(config: StoppingConfig, action_count: int | None) -> StoppingRule:
    """Return the rule of the group `stopping`.

    `action_count` is the number of discrete actions, None for a continuous action space.

    Raises:
        BadInput: a class of the user's own cannot be used.
    """
    match config:
        case OwnClass():
            return build_own(config, "stopping.target", StoppingRule)
        case ReliableStopping():
            return ReliableRule(config)
        case PlateauStopping() | EntropyStopping():
            return TrendRule(config, action_count)
    return StoppingRule()


def _decision(rule: str, why: str, values: dict[str, float], config: Any) -> Decision:
    thresholds = {key: value for key, value in asdict(config).items() if key != "kind"}
    return Decision(
        rule=rule,
        why=why,
        values={key: round(value, 6) for key, value in values.items()},
        thresholds=thresholds,
        stopped_early=rule in ("collapsed", "not_learning"),
    )
