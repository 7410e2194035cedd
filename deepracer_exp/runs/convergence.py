"""Convergence and overfitting: the rules by which a run stops, and by which a report judges a training.

A `StoppingRule` decides row by row while a run is trained. `convergence` and `overfitting` judge a whole table of
iterations, for reports: of a run of ours with the values of its own rule, of other logs with `LOG_RULE`.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

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

from . import trends
from .result import reliable_lap_s
from .trends import Average, Found

if TYPE_CHECKING:
    import pandas as pd

Row = Mapping[str, Any]
"""One line of metrics.jsonl."""

EVALUATED = ("eval_completion", "held_out_completion")
"""Columns that only the rows of evaluated iterations have."""
_ALWAYS = ("completion", "mean_return", "laps_per_1000_steps", "entropy")
_LAP_SPEED = "evaluated_laps_per_s"
_STEPS = 1000  # control steps per which laps are counted, because iterations differ in length


LOG_RULE = ConvergedRule(
    warmup=0,
    patience=10,
    completion_near=5.0,
    completion_gain=2.0,
    return_gain=0.05,
    laps_gain=0.05,
    entropy_change=0.1,
    best_patience=60,
    best_gain=0.01,
)
"""The values of `conf/stopping/entropy.yaml`, with the warm-up and patience that suit the shorter logs of others."""
PATIENCE_SHARE = 0.2
"""Share of all iterations of such a log that must be without growth."""
POOR = 50.0
"""Completion below which a training that no longer grows has not learned to drive, per cent."""
LOG_OVERFITTING = OverfittingRule(warmup=0, patience=3, held_out_drop=10.0, return_drop=0.05)
"""Likewise; such a log has an evaluation after each iteration."""
UNDECIDED = {"stopping.rule": "none", "stopping.stopped_early": "false"}
"""Tags of a run that is resumed after a rule had ended it; the values by which it did stay beside them."""


@dataclass(frozen=True, kw_only=True)
class Decision:
    """Why a run should end."""

    rule: str
    """`reliable`, `plateau`, a rule of `stopping=entropy` (`converged`, `overfitting`, `laps_slower`, `collapsed`,
    `not_learning`), or the name of another rule."""
    why: str
    """The rule's reason in words."""
    values: dict[str, float] = field(default_factory=dict)
    """What was compared; entropy as a share, see `entropy_share`."""
    thresholds: dict[str, Any] = field(default_factory=dict)
    """The keys of the rule."""
    stopped_early: bool = False
    """Whether more training would have led nowhere, and the result is of no use."""

    def __str__(self) -> str:
        """Return rule and reason, e.g. ``reliable: 94% of the last 50 episodes completed the lap``."""
        return f"{self.rule.replace('_', ' ')}: {self.why}"

    def as_dict(self) -> dict[str, Any]:
        """Return it for summary.json."""
        return asdict(self)

    def tags(self) -> dict[str, str]:
        """Return it as tags of a run."""
        numbers = [("value", self.values), ("threshold", self.thresholds)]
        return {
            "stopping.rule": self.rule,
            "stopping.stopped_early": str(self.stopped_early).lower(),
            **{
                f"stopping.{kind}.{key}": f"{value:.4g}" if isinstance(value, float) else str(value)
                for kind, found in numbers
                for key, value in found.items()
            },
        }


def entropy_share(entropy: float, at_start: float, action_count: int | None) -> float:
    """Return a policy's entropy as a share.

    Args:
        entropy: in nats.
        at_start: the entropy at the start of the run; looked at for a continuous policy only.
        action_count: number of discrete actions, None for the two continuous ones.

    Returns:
        For a discrete policy its entropy over that of a uniform choice, log(n): 0 to 1. A continuous policy's entropy
        may be negative, so a ratio has no meaning; exp((entropy - start) / 2), for two normal distributions, is the
        ratio of their spread (geometric mean of the standard deviations): 1 at the start.
    """
    if action_count is None:
        return math.exp(min((entropy - at_start) / 2, 700.0))
    return entropy / math.log(action_count) if action_count > 1 else 0.0


class StoppingRule:
    """Never ends a run (`stopping=none`); base class of all rules, yours included.

    The same rows must give the same decisions: a resumed run passes its rows again.
    """

    def observe(self, row: Row) -> Decision | None:
        """Return why the run should end after this row of metrics.jsonl, None to continue."""
        return None


class ReliableRule(StoppingRule):
    """Ends a run once a share of the last episodes completed the lap, on every track."""

    def __init__(self, config: ReliableStopping):
        self._config = config

    def observe(self, row: Row) -> Decision | None:
        """Compare the share of complete laps."""
        share = row["lap_share"]
        if share is None or share < self._config.lap_share:
            return None
        tracks = sum(key.startswith("lap_share/") for key in row)
        more, where = (" or more", f" on each of {tracks} tracks") if tracks else ("", "")
        why = f"{share:.0%}{more} of the last {self._config.episodes} episodes completed the lap{where}"
        return _decision("reliable", why, {"lap_share": share}, self._config)


class TrendRule(StoppingRule):
    """The rules `plateau` and `entropy`, which look at moving averages."""

    def __init__(self, config: PlateauStopping | EntropyStopping, action_count: int | None):
        """Set up the rule.

        `action_count` is the number of discrete actions, None for a continuous action space.
        """
        self._config = config
        self._action_count = action_count
        self._entropy_at_start: float | None = None
        self._before = (0, 0)
        self._seen = {name: Average(config.window) for name in (*_ALWAYS, *EVALUATED, _LAP_SPEED)}
        self._race_scores_s: list[float] = []  # infinite where none is known
        self._rows = 0

    def observe(self, row: Row) -> Decision | None:
        """Add the row to the averages and apply the rule."""
        config = self._config
        self._rows += 1
        for name, value in self._watched(row).items():
            self._seen[name].add(value)
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
        return {
            "entropy": share,
            _LAP_SPEED: 1 / lap_s if (lap_s := reliable_lap_s(row)) else None,
            "laps_per_1000_steps": _STEPS * (row["laps"] - laps) / max(row["env_steps"] - steps, 1),
            **{name: row.get(name) for name in ("completion", "mean_return", *EVALUATED)},
        }

    def _plateau(self, config: PlateauStopping) -> Decision | None:
        series = self._seen[config.metric]
        if self._rows <= max(config.warmup, config.patience) or not series.known(config.patience):
            return None
        before, since = series.bests(config.patience)
        if since > before + config.gain * series.range:
            return None
        why = f"{config.metric} has not grown for {count(config.patience, 'iteration')}"
        values = {f"{config.metric}_before": before, f"{config.metric}_since": since}
        return _decision("plateau", why, values, config)

    def _entropy(self, config: EntropyStopping) -> Decision | None:
        rules: tuple[tuple[str, Any, tuple[str, ...], Callable[..., Found | None]], ...] = (
            ("collapsed", config.collapsed, ("entropy", "completion"), trends.collapsed),
            ("not_learning", config.not_learning, ("entropy", "completion"), trends.not_learning),
            ("overfitting", config.overfitting, ("held_out_completion", "mean_return"), trends.overfits),
            ("laps_slower", config.laps_slower, (_LAP_SPEED, "mean_return"), self._laps_slower),
            ("converged", config.converged, _ALWAYS, self._converged),
        )
        for name, rule, columns, judge in rules:
            # Patience begins with the first average, so that there is something before it to compare with.
            if rule is None or self._rows <= max(rule.warmup, rule.patience):
                continue
            averages = [self._seen[column] for column in columns]
            if all(one.known(rule.patience) for one in averages) and (found := judge(rule, *averages)):
                return _decision(name, *found, rule)
        return None

    def _laps_slower(self, rule: LapsSlowerRule, speed: Average, returns: Average) -> Found | None:
        scores_s = self._race_scores_s
        # A policy that gives up some speed for laps on held-out conditions may still become the best one.
        improves = min(scores_s[-rule.patience :]) < min(scores_s[: -rule.patience], default=math.inf)
        return (
            None
            if improves or not speed.is_fresh(rule.patience)
            else trends.laps_slower(rule, speed, returns)
        )

    def _converged(self, rule: ConvergedRule, *averages: Average) -> Found | None:
        completion, returns, laps, entropy = averages
        flat = entropy.last(rule.patience)
        values = {
            "completion": completion.now,
            "completion_best": completion.best,
            "entropy": entropy.now,
            "entropy_change": max(flat) - min(flat),
        }
        grew = False
        gains = (rule.completion_gain, rule.return_gain * returns.range, rule.laps_gain * laps.best)
        for name, series, enough in zip(_ALWAYS[:3], averages[:3], gains, strict=True):
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
            or values["entropy_change"] > rule.entropy_change
        ):
            return None
        idle = count(rule.patience, "iteration")
        return f"{completion.now:.1f}% completion, entropy {entropy.now:.1%}, no growth for {idle}", values


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


@dataclass(frozen=True, kw_only=True)
class Convergence:
    """Since when nothing has grown."""

    iteration: int | None
    """None: not converged."""
    completion: float
    """Moving average at the end, per cent."""
    completion_before: float
    """Highest one before the last `patience` iterations."""
    completion_best: float
    entropy_change: float
    """Over the last `patience` iterations; NaN where not logged."""
    patience: int
    iterations: int
    entropy_flat: bool


def convergence(
    iterations: "pd.DataFrame", action_count: int | None, stopping: Mapping[str, Any] | None = None
) -> Convergence | None:
    """Find the iteration from which on a training no longer grew, None where it is too short to say.

    All series are moving averages of three iterations. Converged since the earliest iteration k, at least `patience`
    before the end, after which completion, reward and the share of complete laps stay within what counts as growth
    of their best up to k; completion ends near its best; entropy, where logged, is flat over the last `patience`.

    Args:
        iterations: a row each, with `episodes`, `completion_mean`, `reward_mean`, `lap_share` and `entropy`.
        action_count: of a discrete policy, None of a continuous one.
        stopping: of a run of ours, its group `stopping`, whose rule of convergence is applied if it has one; None:
            LOG_RULE.
    """
    table = iterations[iterations["episodes"] > 0]
    rows = len(table)
    rule = convergence_rule(stopping)
    patience = max(rule.patience, math.ceil(PATIENCE_SHARE * rows) if rule is LOG_RULE else 0)
    if rows <= patience:
        return None
    grown = ("completion_mean", "reward_mean", "lap_share")
    series = {name: moving_average(table[name].to_numpy(np.float64)) for name in grown}
    completion = series["completion_mean"]
    gains = {
        "completion_mean": rule.completion_gain,
        "reward_mean": rule.return_gain * float(np.ptp(series["reward_mean"])),
        "lap_share": rule.laps_gain,
    }
    still = np.ones(rows, bool)
    for name, gain in gains.items():
        best = np.maximum.accumulate(series[name])
        still &= best[-1] <= best + gain
    change = _entropy_change(table["entropy"].to_numpy(np.float64), action_count, patience)
    flat = not change > rule.entropy_change
    since = int(still.argmax())
    near = completion[-1] >= completion.max() - rule.completion_near
    converged = flat and near and since <= rows - 1 - patience
    return Convergence(
        iteration=int(table["iteration"].iloc[since]) if converged else None,
        completion=float(completion[-1]),
        completion_before=float(completion[:-patience].max()),
        completion_best=float(completion.max()),
        entropy_change=change,
        patience=patience,
        iterations=rows,
        entropy_flat=flat,
    )


def _entropy_change(entropy: NDArray[np.float64], action_count: int | None, patience: int) -> float:
    known = moving_average(entropy)
    known = known[np.isfinite(known)]
    if len(known) <= patience:
        return math.nan
    # Of a continuous policy exp((a - b) / 2) is the ratio of two spreads, as in `entropy_share`.
    scale = 2.0 if action_count is None else math.log(max(action_count, 2))
    return float(np.ptp(known[-patience:])) / scale


@dataclass(frozen=True, kw_only=True)
class Overfitting:
    """How the evaluations of a training went, and whether its rule calls that overfitting."""

    decision: Decision | None
    """Of the stopping rule after the last iteration; None: no sign of overfitting."""
    evaluated: str
    """`held-out evaluation` or `evaluation`."""
    best: float
    """Completion, per cent, mean of three evaluations."""
    best_iteration: int
    now: float
    rule: OverfittingRule


def overfitting(iterations: "pd.DataFrame", stopping: Mapping[str, Any] | None = None) -> Overfitting | None:
    """Apply the stopping rule of overfitting to a table of iterations; None with fewer than six evaluations.

    Evaluations on held-out conditions count; in logs without them the others do.

    Args:
        iterations: a row each, with `reward_mean`, `held_out_completion` and `eval_completion`.
        stopping: of a run of ours, its group `stopping`, whose rule is applied if it has one; None: LOG_OVERFITTING.
    """
    own = _entropy_stopping(stopping)
    rule = (own and own.overfitting) or LOG_OVERFITTING
    for column, name in (("held_out_completion", "held-out evaluation"), ("eval_completion", "evaluation")):
        known = iterations[iterations[column].notna()]
        if len(known) < 6:
            continue
        only = EntropyStopping(
            kind="entropy",
            window=3,
            converged=None,
            overfitting=rule,
            collapsed=None,
            not_learning=None,
            laps_slower=None,
        )
        judge, decision = TrendRule(only, None), None
        for returned, completion in zip(iterations["reward_mean"], iterations[column], strict=True):
            row = {"mean_return": returned, "held_out_completion": completion, "laps": 0, "env_steps": 0}
            decision = judge.observe(row)
        averages = moving_average(known[column].to_numpy(np.float64))
        best = 2 + int(averages[2:].argmax())  # the first two are of fewer than three
        return Overfitting(
            decision=decision,
            evaluated=name,
            best=float(averages[best]),
            best_iteration=int(known["iteration"].iloc[best]),
            now=float(averages[-1]),
            rule=rule,
        )
    return None


def convergence_rule(stopping: Mapping[str, Any] | None) -> ConvergedRule:
    """Return the rule of convergence of a group `stopping`, LOG_RULE if it has none."""
    own = _entropy_stopping(stopping)
    return (own and own.converged) or LOG_RULE


def _entropy_stopping(stopping: Mapping[str, Any] | None) -> EntropyStopping | None:
    adapter: TypeAdapter[StoppingConfig] = TypeAdapter(StoppingConfig)
    try:
        config = adapter.validate_python(stopping)
    except ValidationError:  # none, or of another version
        return None
    return config if isinstance(config, EntropyStopping) else None


def moving_average(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return for each value the mean of the known ones among the last three; NaN where the value itself is NaN."""
    import pandas as pd  # takes half a second, and only reports need it

    series = pd.Series(values, dtype=np.float64)
    return series.rolling(3, min_periods=1).mean().where(series.notna()).to_numpy()
