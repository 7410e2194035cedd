"""Findings on a training as a whole: convergence, overfitting, slower laps, and advice.

Advice on a log of the service uses the console's terms, advice on a run of ours its keys.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from deepracer_exp.errors import count
from deepracer_exp.reports.tables.log_view import LEAST_EPISODES, LogView, once_per_view
from deepracer_exp.reports.tables.slower_laps import CHANCE, LEAST_TIMES, SLOWER, SlowerLaps, slower_laps
from deepracer_exp.reports.tables.statistics import Values, chance_of_rise, moving_average
from deepracer_exp.runs.checkpoint_files import kept_checkpoints
from deepracer_exp.runs.run_files import CHECKPOINTS
from deepracer_exp.training.stopping.judge import (
    POOR,
    Convergence,
    Overfitting,
    convergence_rule,
    iterations_needed,
    overfitting,
)
from deepracer_exp.training.stopping.stopping_rules import entropy_share

from .finding import LEAST_LOSS_S, Finding, Numbers

_RANDOM = 0.95
"""Share of the highest entropy above which a policy decides almost at random."""

_ENTROPY_COST_PERCENT = 5.0
"""Loss of completion from which a rising entropy is to blame: completion scatters by less."""


def training_findings(view: LogView, submit: Finding) -> list[Finding]:
    """Return the findings on a training, of equally costly ones the more urgent first; `submit` is one of them."""
    of_training = [_entropy_rises(view), _laps_slower(view), _overfits(view), _progress(view), submit]
    return [finding for finding in of_training if finding is not None]


def _progress(view: LogView) -> Finding:
    """Report whether the training has converged, or the decision of its stopping rule."""
    if view.decision is not None:
        return _decided(view, view.decision)
    converged = view.convergence
    if converged is None:
        return _too_short(view)
    missing, rule = 100 - converged.completion, convergence_rule(view.stopping)
    cost, advice = 0.0, ""
    if converged.iteration is not None:
        sentence = (
            f"Converged at iteration {converged.iteration}: since then completion ({converged.completion:.0f}%), "
            "reward and complete laps have not grown."
        )
        if converged.completion < POOR:
            cost, advice = (
                missing,
                f"That is far from a lap, and training longer will not help: {_cures(view)}",
            )
    elif converged.completion < converged.completion_best - rule.completion_near:
        cost = converged.completion_best - converged.completion
        fallen = f"from {converged.completion_best:.0f} to {converged.completion:.0f}%"
        sentence = f"Not converged: completion fell back {fallen}."
        advice = f"Lower the learning rate, or take {_instead(view)}."
    elif converged.completion < POOR:
        cost, sentence, advice = missing, f"Not converged yet: {_pace(view, converged)}.", _cures(view)
        advice = f"Before you train longer: {advice}"
    else:
        cost, sentence, advice = missing, f"Not converged yet: {_growth(view, converged)}.", _continue(view)
    values: Numbers = {
        "completion": converged.completion,
        "completion_before": converged.completion_before,
        "completion_best": converged.completion_best,
        "patience": converged.patience,
    }
    if converged.entropy_change is not None:
        values["entropy_change"] = converged.entropy_change
    if converged.iteration is not None:
        values["iteration"] = converged.iteration
    thresholds = {
        "completion_gain": rule.completion_gain,
        "reward_gain": rule.return_gain,
        "laps_gain": rule.laps_gain,
        "completion_near": rule.completion_near,
        "entropy_change": rule.entropy_change,
    }
    return Finding("converged", sentence, values, thresholds, cost, advice and f"{sentence} {advice}")


def _too_short(view: LogView) -> Finding:
    driven = view.judged[view.judged["episodes"] > 0]
    needed = iterations_needed(view.judged, view.stopping)
    sentence = (
        f"Too short to say whether the training has converged: {_rows(len(driven), view)}, and at least {needed} are "
        "needed."
    )
    values: Numbers = {"iterations": len(driven), "needed": needed}
    if view.run is not None or len(view.candidates):
        return Finding("converged", sentence, values)
    missing = 100 - float(driven["completion_mean"].iloc[-1]) if len(driven) else 100.0
    return Finding("converged", sentence, values, cost_percent=missing, to_do=f"{sentence} {_continue(view)}")


def _growth(view: LogView, converged: Convergence) -> str:
    """Return the figures that still change in a training that has not converged."""
    rule = convergence_rule(view.stopping)
    if converged.completion > converged.completion_before + rule.completion_gain:
        return (
            f"completion grew from {converged.completion_before:.0f} to {converged.completion:.0f}% in the last "
            f"{_rows(converged.patience, view)}"
        )
    what = (
        "reward, complete laps or lap times still improve"
        if converged.entropy_flat
        else "the entropy still changes"
    )
    return f"completion is {converged.completion:.0f}%, but {what}"


def _pace(view: LogView, converged: Convergence) -> str:
    """Return a training's completion, and the time to a whole lap at its present pace."""
    gained = converged.completion - converged.completion_before
    driven = int((view.judged["episodes"] > 0).sum())
    words = f"completion is {converged.completion:.0f}% after {_rows(driven, view)}"
    if gained <= 0:
        return f"{words} and has not grown in the last {_rows(converged.patience, view)}"
    left = round((100 - converged.completion) * converged.patience / gained)
    return (
        f"{words}, {gained:.0f} points more than {_rows(converged.patience, view)} ago; at this pace a whole lap is "
        f"{left:,} more away"
    )


def _cures(view: LogView) -> str:
    """Return remedies for a training that drives little of the lap."""
    by_entropy = _entropy_cure(view)
    reward = "`deepracer-exp validate` shows what the reward function rewards, on a lap and off the road"
    if view.run is None:
        speed = "lower the top speed of the action space"
        reward = reward.replace("validate`", "validate reward.file=FILE`")
    else:
        speed = "lower the top speed (action_space.speed.high, or the largest of action_space.actions)"
    return f"{by_entropy}{speed} until the car completes laps; {reward}."


def _entropy_cure(view: LogView) -> str:
    """Return remedies for a policy that decides almost at random; "" for any other, or if that is not known."""
    entropy = view.judged["entropy"].dropna().to_numpy(np.float64)
    if not len(entropy):
        return ""
    now = entropy_share(float(moving_average(entropy)[-1]), float(entropy[0]), view.action_count)
    if now < _RANDOM:
        return ""
    highest = "highest" if view.action_count is not None else "spread at the start"
    key = "" if view.run is None else " (algorithm.lr)"
    return f"it decides almost at random ({now:.0%} of the {highest}), so raise the learning rate{key}; "


def _continue(view: LogView) -> str:
    return "Keep training." if view.run is not None else "Keep training: clone the model as it is."


def _rows(number: int, view: LogView) -> str:
    """Return so many rows of `view.judged` in words."""
    if not view.in_blocks:
        return count(number, "iteration")
    return f"{count(number, 'block')} of {LEAST_EPISODES} or more episodes"


def _decided(view: LogView, decision: Mapping[str, Any]) -> Finding:
    """Report the decision of the run's own stopping rule: whatever else the log shows, that is why it ended."""
    rule, values = str(decision["rule"]), decision["values"]
    sentence = f"The run's stopping rule ended it ({rule.replace('_', ' ')}): {decision['why']}."
    cost, advice = 0.0, ""
    if rule == "reliable":
        advice = "Train longer: this rule ends a training when the car is reliable, not when it is fast."
    elif rule == "overfitting":
        judged = overfitting(view.judged, view.stopping)
        sentence += _faster_laps(view, judged)
        cost = values.get("held_out_completion_before", 0.0) - values.get("held_out_completion_since", 0.0)
        advice = _overfitting_cures(view, judged)
    elif rule == "laps_slower":
        before_s, since_s = values.get("lap_time_s_before", 1.0), values.get("lap_time_s_since", 1.0)
        cost = 100 * (since_s / before_s - 1)
        advice = (
            "The reward function rewards slower laps: `deepracer-exp validate` shows what slow and fast laps return. "
            f"Take {_instead(view)}."
        )
    elif rule in ("collapsed", "not_learning"):
        cost = 100 - values.get("completion", 0.0)
        advice = f"Training longer will not help: {_cures(view)}"
        if rule == "collapsed":
            is_sac = "sac_alpha" in (view.recording.hyperparameters or {})
            bonus = (
                "entropy that the temperature aims at (algorithm.target_entropy, for a list of actions "
                "algorithm.target_entropy_share; without learn_alpha the temperature, algorithm.alpha)"
                if is_sac
                else "entropy coefficient (algorithm.entropy_coeff)"
            )
            advice = (
                f"Raise the {bonus} or lower the learning rate (algorithm.lr): "
                "the policy has settled before it could drive."
            )
    limits = {key: limit for key, limit in decision["thresholds"].items() if isinstance(limit, int | float)}
    return Finding("converged", sentence, values, limits, cost, advice and f"{sentence} {advice}")


def _entropy_rises(view: LogView) -> Finding | None:
    settings = view.recording.hyperparameters or {}
    if "sac_alpha" in settings:  # it steers the entropy to a target
        return None
    rising = rising_entropy(view.judged, view.action_count)
    if rising is None:
        return None
    slower, completion = _slower(view), moving_average(view.judged["completion_mean"].dropna().to_numpy())
    cost = max(
        float(completion.max() - completion[-1]) if len(completion) else 0.0,
        100 * (slower.now_s / slower.fastest_s - 1) if slower is not None else 0.0,
        100 - float(completion[-1]) if len(completion) and completion[-1] < POOR else 0.0,
    )
    if cost < _ENTROPY_COST_PERCENT:  # it may rise where there is nothing to lose by it
        return None
    by_chance = f", {rising.rise:.0%} of the highest" if view.action_count is not None else ""
    if view.action_count is None:
        by_chance = f": its actions scatter {1 + rising.rise:.1f} times as much"
    sentence = (
        f"The entropy of the policy rises, from {rising.lowest:.2f} nats at iteration {rising.since} to "
        f"{rising.now:.2f}{by_chance}. It learns to decide by chance, not how to drive."
    )
    entropy, lr = (_now(settings, key) for key in ("beta_entropy", "lr"))
    keys = f"entropy{entropy} or learning rate{lr}"
    if view.run is not None:
        keys = f"algorithm.entropy_coeff{entropy} or algorithm.lr{lr}"
    advice = f"Clone {_instead(view)} with a lower {keys}."
    values: Numbers = {"iteration": rising.since, "lowest": rising.lowest, "now": rising.now}
    thresholds = {"rise": RISE, "chance": ENTROPY_CHANCE, "cost_percent": _ENTROPY_COST_PERCENT}
    return Finding("entropy_rises", sentence, values, thresholds, cost, f"{sentence} {advice}")


def _now(settings: Mapping[str, Any], key: str) -> str:
    value = settings.get(key)
    return f" (now {value:g})" if isinstance(value, int | float) else ""


def _overfits(view: LogView) -> Finding | None:
    """Report that evaluations complete less of the lap than before, though the training does not."""
    decision, judged = view.decision, overfitting(view.judged, view.stopping)
    if judged is None or (decision is not None and decision["rule"] == "overfitting"):  # reported already
        return None
    completion = moving_average(view.judged["completion_mean"].dropna().to_numpy())
    drop = judged.rule.held_out_drop
    fallen = judged.best - judged.now
    if fallen < drop or completion.max() - completion[-1] >= drop:
        return None
    values: Numbers = {"best": judged.best, "now": judged.now, "best_iteration": judged.best_iteration}
    thresholds: dict[str, float | int] = {"held_out_drop": drop}
    sentence = (
        f"It became less sure: the mean completion of three {judged.evaluated}s in a row fell from {judged.best:.0f}% "
        f"around iteration {judged.best_iteration} to {judged.now:.0f}%"
    )
    if judged.decision is not None:
        sentence += " while the reward of the training holds: it overfits"
        values |= judged.decision.values
        thresholds |= {"return_drop": judged.rule.return_drop, "patience": judged.rule.patience}
    sentence += f".{_faster_laps(view, judged)}"
    return Finding(
        "overfits", sentence, values, thresholds, fallen, f"{sentence} {_overfitting_cures(view, judged)}"
    )


def _faster_laps(view: LogView, judged: Overfitting | None) -> str:
    """Return a sentence if the evaluated laps became faster since completion was best, else ""."""
    evaluated = view.judged.dropna(subset="eval_lap_time_s")
    laps_s: Values = evaluated["eval_lap_time_s"].to_numpy(np.float64)
    best = 0 if judged is None else judged.best_iteration
    before_s = laps_s[evaluated["iteration"].to_numpy() <= best][-3:]
    if not len(before_s):
        return ""
    first_s, now_s = float(before_s.mean()), float(laps_s[-3:].mean())
    if first_s - now_s < LEAST_LOSS_S:
        return ""
    return (
        f" Its laps became faster meanwhile, from {first_s:.2f} to {now_s:.2f} s: it is faster and less sure."
    )


def _overfitting_cures(view: LogView, judged: Overfitting | None) -> str:
    """Return remedies for a policy that became less reliable."""
    if view.run is None:
        return f"Take {_instead(view)}, and clone it at a lower learning rate."
    words = "Clone it at a tenth of the learning rate"
    if not view.run.randomized:
        words = f"{words}, with randomization=sim2real, so that all its cars meet such conditions"
    earlier = None if judged is None else _reliable_checkpoint(view, judged)
    return f"{words}; or take {earlier}." if earlier is not None else f"{words}."


def _reliable_checkpoint(view: LogView, judged: Overfitting) -> str | None:
    """Return a reliable checkpoint that a run of ours still has, in words; None if there is none."""
    assert view.run is not None
    best, folder = view.run.best.iteration, view.run_folder
    kept = None if folder is None else {path.name for path in kept_checkpoints(folder / CHECKPOINTS)}
    column = "held_out_completion" if judged.evaluated.startswith("held-out") else "eval_completion"
    sure = view.judged[view.judged[column] > judged.best - judged.rule.held_out_drop]
    there = [int(k) for k in sure["iteration"] if kept is None or f"{k:06d}" in kept]
    if not there:
        return None
    chosen = best if best in there else max(there)
    completion = float(sure.set_index("iteration").loc[chosen, column])
    which = "the best" if chosen == best else "an earlier one"
    return f"checkpoint {chosen}, {which}, whose {judged.evaluated} completed {completion:.0f}%"


@once_per_view
def _slower(view: LogView) -> SlowerLaps | None:
    judged = view.judged
    if not view.on_usual.all():  # slower cars complete their first laps later
        laps_s = view.episodes[view.on_usual].groupby("iteration")["lap_time_s"].mean()
        judged = judged.assign(lap_time_mean_s=judged["iteration"].map(laps_s))
    return slower_laps(judged)


def _laps_slower(view: LogView) -> Finding | None:
    decision, slower = view.decision, _slower(view)
    if slower is None or (decision is not None and decision["rule"] == "laps_slower"):  # reported already
        return None
    values: Numbers = {"iteration": slower.since, "fastest_s": slower.fastest_s, "now_s": slower.now_s}
    values |= {"return_then": slower.return_then, "return_now": slower.return_now}
    thresholds = {"slower": SLOWER, "chance": CHANCE, "least_lap_times": LEAST_TIMES}
    cost = 100 * (slower.now_s / slower.fastest_s - 1)
    return Finding("laps_slower", str(slower), values, thresholds, cost, f"{slower} Take {_instead(view)}.")


def _instead(view: LogView) -> str:
    """Return the checkpoint to take instead of the last: the one that the finding `submit` names."""
    if view.run is not None:
        best = view.run.best
        if best.iteration is None:
            return "one of the kept checkpoints"
        return f"checkpoint {best.iteration} (the best by {best.criterion})"
    if not len(view.candidates):
        return "an earlier checkpoint"
    first = view.candidates.iloc[0]
    return (
        f"the checkpoint {first['checkpoint']}" if first["checkpoint"] else "the best checkpoint named below"
    )


LEAST_ITERATIONS = 12
"""Fewest iterations for a test."""
_BLOCKS = 12
"""More iterations are averaged to so many, because neighbours are not independent."""
RISE = 0.2
"""Rise that counts: of a list of actions as a share of the highest entropy, of a continuous space as the share by which
the actions scatter more."""
ENTROPY_CHANCE = 0.02
"""Significance level: the chance of a false alarm for an entropy that only scatters."""


@dataclass(frozen=True, kw_only=True)
class RisingEntropy:
    """A rise of the entropy; entropies are means of three iterations in nats."""

    since: int
    """The iteration at which it was lowest."""
    lowest: float
    now: float
    rise: float
    """The rise in the terms of `RISE`."""


def rising_entropy(iterations: pd.DataFrame, action_count: int | None) -> RisingEntropy | None:
    """Test whether entropy has risen since it was lowest; None: it has not, or there are too few iterations to say.

    Kendall's tau (one-sided) tests the entropies since then for a rising trend, at a significance level divided by the
    number of possible starts (Bonferroni), as in `slower_laps`.

    Args:
        iterations: a row each, with `iteration` and `entropy` in nats.
        action_count: of a discrete policy, None of a continuous one.
    """
    rows = iterations[iterations["entropy"].notna()]
    if len(rows) < LEAST_ITERATIONS:
        return None
    entropy = moving_average(rows["entropy"].to_numpy(np.float64))
    place = int(entropy.argmin())
    lowest, now = float(entropy[place]), float(entropy[-1])
    rise = entropy_share(now, lowest, action_count) - entropy_share(lowest, lowest, action_count)
    parts = np.array_split(rows["entropy"].to_numpy(np.float64), _BLOCKS)
    blocks = np.array([part.mean() for part in parts])
    if rise < RISE or not chance_of_rise(blocks[blocks.argmin() :]) < ENTROPY_CHANCE / _BLOCKS:
        return None
    return RisingEntropy(since=int(rows["iteration"].iloc[place]), lowest=lowest, now=now, rise=rise)
