"""What the log of a physical car says of a drive: pace, hesitation, and what another policy would have done."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.aws.logs.car_log import CarLog
from deepracer_exp.errors import count

from .log_tables import Table

Floats = NDArray[np.float64]

UNSURE = 0.1
"""Lead of the likeliest action over the second, as a probability, below which the policy hesitates."""
AGAINST = 0.5
"""Share of full lock by which another policy must steer differently to decide against the car."""
CENTRED = 0.07
"""Share of full lock below which the wheels count as straight: `zigzag.CENTRED_DEG` of 30 degrees."""
_JOINED_S = 0.2
"""Pictures of one spell are not further apart."""
_GAP = 2.5
"""Times the median between two pictures, above which some are missing."""
MOST_SPELLS = 12
UNLOGGED_S = 0.034
"""Latency that no log has, as in `conf/evaluation/real_car.yaml`: 0.024 s of the camera, because a picture is stamped
when it has been handed over (camera_node.cpp), and 0.010 s, half a period of the servo's signal."""


@dataclass(frozen=True, eq=False)
class Decisions:
    """What another policy would have done on the n pictures of a drive."""

    name: str
    """Name of its run."""
    outputs: Floats
    """As `CarLog.outputs`, (n, k)."""
    steering: Floats
    """As a car would command it: a share of full lock, -1 to 1, (n,)."""
    throttle: Floats
    """As a car would command it at 100% of its maximum speed, 0 to 1, (n,)."""


@dataclass(frozen=True)
class Spell:
    """Consecutive pictures on which a policy hesitates."""

    first: int
    last: int
    """Included."""


def lead(log: CarLog) -> Floats:
    """Return how far the likeliest action leads the second, as a probability, (n,); NaN for means."""
    if not log.is_discrete or log.outputs.shape[1] < 2:
        return np.full(len(log), np.nan)
    two = np.sort(log.outputs, axis=1)[:, -2:]
    leads: Floats = two[:, 1] - two[:, 0]
    return leads


def spells(log: CarLog) -> list[Spell]:
    """Return where the policy hesitates, the longest spell first."""
    unsure = np.flatnonzero(lead(log) < UNSURE)
    if not len(unsure):
        return []
    starts = np.flatnonzero(np.diff(log.time_s[unsure]) > _JOINED_S) + 1
    parts = [Spell(int(part[0]), int(part[-1])) for part in np.split(unsure, starts)]
    return sorted(parts, key=lambda spell: log.time_s[spell.first] - log.time_s[spell.last])


def action_names(log: CarLog) -> list[str]:
    """Return a name for each output: its number, and what the car made of it where it took it."""
    if not log.is_discrete:
        return [f"output {number}" for number in range(log.outputs.shape[1])]
    names, chosen = [], log.outputs.argmax(axis=1)
    for number in range(log.outputs.shape[1]):
        taken = (chosen == number) & np.isfinite(log.steering)
        what = f": {side(float(np.median(log.steering[taken])))}" if taken.any() else ""
        names.append(f"{number}{what}")
    return names


def side(steering: float) -> str:
    """Return steering, a share of full lock, in words: ``left 67%``."""
    return (
        "straight" if abs(steering) < 0.005 else f"{'left' if steering > 0 else 'right'} {abs(steering):.0%}"
    )


def in_order(log: CarLog) -> NDArray[np.intp]:
    """Return the actions from left to right as the car steered them; those that it never took come last."""
    chosen, logged = log.outputs.argmax(axis=1), np.isfinite(log.steering)
    steering = np.full(log.outputs.shape[1], -np.inf)
    for number in np.unique(chosen[logged]):
        steering[number] = np.median(log.steering[logged & (chosen == number)])
    return np.argsort(-steering, kind="stable")


def headline(log: CarLog) -> str:
    """Return how long the drive was: ``1,840 pictures in 61.3 s, 30.0 a second``."""
    return f"{count(len(log), 'picture')} in {log.time_s[-1]:.1f} s, {_frames_per_s(log):.1f} a second"


def sentences(log: CarLog, policy: Decisions | None = None) -> list[str]:
    """Return what the drive shows, the most important first."""
    return [
        *_hesitation(log),
        *([] if policy is None else _against(log, policy)),
        *_steering(log),
        *_pace(log),
        *_status(log),
    ]


def spell_table(log: CarLog, policy: Decisions | None = None) -> Table:
    """Return the longest spells of hesitation: when, how long, between which actions, and what a policy would do."""
    names, rows = action_names(log), []
    longest = spells(log)
    for spell in longest[:MOST_SPELLS]:
        part = slice(spell.first, spell.last + 1)
        mean = log.outputs[part].mean(axis=0)
        between = np.argsort(-mean, kind="stable")[:2]
        cells = [
            f"{log.time_s[spell.first]:.1f}",
            f"{log.time_s[spell.last] - log.time_s[spell.first]:.2f}",
            *(f"{names[number]} ({mean[number]:.0%})" for number in between),
        ]
        if policy is not None:
            cells.append(side(float(np.median(policy.steering[part]))))
        rows.append(tuple(cells))
    heads = ("at s", "for s", "between", "and", *([policy.name] if policy else []))
    return Table(heads, tuple(rows), left_out=max(0, len(longest) - MOST_SPELLS))


def differences(log: CarLog, policy: Decisions) -> Floats:
    """Return by how much a policy would steer further to the left than the car did, shares of full lock, (n,)."""
    return policy.steering - log.steering


def _frames_per_s(log: CarLog) -> float:
    apart_s = np.diff(log.time_s)
    usual_s = float(np.median(apart_s)) if len(apart_s) else 0.0
    return 1 / usual_s if usual_s > 0 else 0.0


def _hesitation(log: CarLog) -> list[str]:
    if not log.is_discrete:
        return [
            "The model has continuous actions: it returns no probabilities, so no hesitation can be seen."
        ]
    doubts = spells(log)
    share = float((lead(log) < UNSURE).mean())
    if not doubts:
        return [f"It never hesitates: the likeliest action leads by at least {UNSURE:.0%} on every picture."]
    longest = doubts[0]
    return [
        f"It hesitates on {share:.0%} of the pictures (the likeliest action leads by less than {UNSURE:.0%}), in "
        f"{count(len(doubts), 'spell')}; the longest from {log.time_s[longest.first]:.1f} to "
        f"{log.time_s[longest.last]:.1f} s."
    ]


def _against(log: CarLog, policy: Decisions) -> list[str]:
    lines = []
    if log.is_discrete and policy.outputs.shape == log.outputs.shape:
        same = (log.outputs.argmax(axis=1) == policy.outputs.argmax(axis=1)).mean()
        most = np.abs(log.outputs - policy.outputs).max()
        lines.append(
            f"{policy.name} would have taken the same action on {same:.1%} of the pictures; its probabilities differ "
            f"by {most:.2g} at most."
        )
    apart = np.abs(differences(log, policy))
    logged = np.isfinite(apart)
    if logged.any():
        worst = int(np.nanargmax(apart))
        lines.append(
            f"{policy.name} would have steered by more than half of full lock otherwise on "
            f"{(apart[logged] > AGAINST).mean():.1%} of the pictures, by {np.nanmean(apart):.1%} on average, and by "
            f"most, {side(float(policy.steering[worst]))} instead of {side(float(log.steering[worst]))}, at "
            f"{log.time_s[worst]:.1f} s."
        )
    return lines


def _steering(log: CarLog) -> list[str]:
    steers = log.steering[np.isfinite(log.steering)]
    if not len(steers) or log.time_s[-1] <= 0:
        return []
    sides = np.sign(steers[np.abs(steers) > CENTRED])
    changes = int((np.diff(sides) != 0).sum())
    throttle = log.throttle[np.isfinite(log.throttle)]
    return [
        f"The steering changes from one side to the other {changes / log.time_s[-1]:.1f} times a second; full lock on "
        f"{(np.abs(steers) > 0.99).mean():.0%} of the pictures.",
        f"Throttle: {throttle.mean():.0%} on average, {throttle.max():.0%} at most, with the maximum speed of the "
        "car's console.",
    ]


def _pace(log: CarLog) -> list[str]:
    apart_s = np.diff(log.time_s)
    lines = []
    if len(apart_s):
        usual_s = float(np.median(apart_s))
        gaps = apart_s > _GAP * usual_s
        if gaps.any():
            lines.append(
                f"Pictures are missing in {count(int(gaps.sum()), 'place')}: the longest gap is {apart_s.max():.2f} s, "
                f"at {log.time_s[int(apart_s.argmax())]:.1f} s."
            )
    latency_s = log.latency_s[np.isfinite(log.latency_s)]
    if len(latency_s):
        lines.append(
            f"A command follows its picture after {1000 * np.median(latency_s):.0f} ms (median; 95% within "
            f"{1000 * np.percentile(latency_s, 95):.0f} ms). With the camera before it and the servo after it, "
            f"evaluate with evaluation.real_car.timing.frames_per_s={min(max(_frames_per_s(log), 5), 60):.0f} "
            f"evaluation.real_car.timing.latency_s={np.median(latency_s) + UNLOGGED_S:.3f}."
        )
    return lines


def _status(log: CarLog) -> list[str]:
    if not log.status:
        return []
    busy, hot = log.status["cpu_percent"], log.status["cpu_temp"]
    return [f"The car's processor: {busy.mean():.0f}% busy, at most {hot.max():.0f} degrees Celsius."]
