"""Findings of a log in words: rules over its tables, each with its figure (docs/findings.md)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from deepracer_exp.runs.convergence import (
    EVALUATION_DROP,
    LOG_RULE,
    POOR,
    convergence,
    convergence_rule,
    overfitting,
)
from deepracer_exp.runs.result import RunResult

from . import candidates as chosen
from . import off_track
from .candidates import candidates, evaluated_candidates, lap_chance
from .log_view import LogView
from .off_track import JUDGEMENTS, OffTrackPlace, off_track_places
from .sectors import Sectors, sectors_of, theoretical_best_s, times_by_sector
from .statistics import wilson

LATE_SHARE = 1 / 3
"""Share of the iterations, the last ones, that show how the car drives now."""
LEAST_LAPS = 5
"""Complete laps in them below which all laps of the log are used, and below which no chances are given."""
CRASH_PLACE_M = 1.0
"""Crashes no further than this from one place are at one object."""
MOST_LOST = 3
WORTH_S = 0.02
"""Time lost in a sector from which on it is mentioned."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A finding of a log."""

    rule: str
    sentence: str
    """In plain words, one to three sentences."""
    figure: str
    """Name of the chart that shows it."""
    values: Mapping[str, float | int | str] = field(default_factory=dict)
    """The numbers that were compared."""
    thresholds: Mapping[str, float | int] = field(default_factory=dict)


def findings(view: LogView, target_s: float | None = None) -> list[Finding]:
    """Apply all rules to a log; the most important findings are first.

    Args:
        view: the log.
        target_s: lap time wanted; None: the fastest lap driven.
    """
    found: list[Finding | None] = []
    if view.trained:
        found += [_converged(view), _submit(view)]
    laps = _Laps.of(view)
    found += [
        _chance(laps, target_s),
        _time_lost(view, laps),
        _crashes(view),
        *_runs_off(view),
        _overfits(view),
    ]
    return [one for one in found if one is not None]


@dataclass(frozen=True, eq=False)
class _Laps:
    """The steps of the car as it drives now; without a training, those of the evaluations."""

    steps: pd.DataFrame
    lap_times_s: np.ndarray
    whose: str

    @classmethod
    def of(cls, view: LogView) -> "_Laps":
        if not view.trained:
            return cls(view.steps, view.episodes["lap_time_s"].to_numpy(), "of the evaluations")
        late = _late(view)
        times = late["lap_time_s"].to_numpy()
        if np.isfinite(times).sum() >= LEAST_LAPS:
            steps = view.steps[view.steps["episode"].isin(late["episode"])]
            return cls(steps, times, f"since iteration {late['iteration'].min()}")
        return cls(view.steps, view.episodes["lap_time_s"].to_numpy(), "of the training")


def _now(view: LogView) -> tuple[pd.DataFrame, str]:
    """Return the episodes that show how the car drives now, and which they are."""
    if not view.trained:
        return view.episodes, "in the evaluations"
    late = _late(view)
    return late, f"since iteration {late['iteration'].min()}"


def _late(view: LogView) -> pd.DataFrame:
    """Return the episodes of the last iterations."""
    iterations = np.unique(view.episodes["iteration"])
    begin = iterations[-math.ceil(LATE_SHARE * len(iterations))]
    return view.episodes[view.episodes["iteration"] >= begin]


def _converged(view: LogView) -> Finding:
    decision = view.recording.decision
    if decision is not None:
        return _decided(decision)
    found = convergence(view.iterations, view.action_count, view.recording.stopping)
    rule = convergence_rule(view.recording.stopping)
    thresholds = {
        "completion_gain": rule.completion_gain,
        "reward_gain": rule.return_gain,
        "laps_gain": rule.laps_gain,
        "completion_near": rule.completion_near,
        "entropy_change": rule.entropy_change,
    }
    if found is None:
        driven = int((view.iterations["episodes"] > 0).sum())
        sentence = (
            f"Too short to say whether the training has converged: {_count(driven, 'iteration')}, and at least "
            f"{rule.patience + 1} are needed."
        )
        return Finding(
            rule="converged", sentence=sentence, figure="training_progress", values={"iterations": driven}
        )
    values: dict[str, float | int | str] = {
        "completion": found.completion,
        "completion_before": found.completion_before,
        "completion_best": found.completion_best,
        "patience": found.patience,
    }
    if math.isfinite(found.entropy_change):
        values["entropy_change"] = found.entropy_change
    if found.iteration is not None:
        values["iteration"] = found.iteration
        sentence = (
            f"Converged at iteration {found.iteration}: since then completion ({found.completion:.0f} %), reward and "
            "complete laps have not grown."
        )
        if found.completion < POOR:
            sentence += (
                " That is far from a lap: change reward, action space or learning rate, do not train longer."
            )
    elif found.completion < found.completion_best - rule.completion_near:
        sentence = (
            f"Not converged: completion fell back from {found.completion_best:.0f} to {found.completion:.0f} %. "
            "A lower learning rate or an earlier checkpoint may hold it."
        )
    elif found.completion > found.completion_before + rule.completion_gain:
        sentence = (
            f"Not converged yet: completion grew from {found.completion_before:.0f} to {found.completion:.0f} % in "
            f"the last {found.patience} iterations. Train on."
        )
    else:
        what = "reward or complete laps still grow" if found.entropy_flat else "the entropy still changes"
        sentence = f"Not converged yet: completion is {found.completion:.0f} %, but {what}. Train on."
    return Finding(
        rule="converged", sentence=sentence, figure="training_progress", values=values, thresholds=thresholds
    )


def _decided(decision: Mapping[str, Any]) -> Finding:
    """Report the decision of the run's own stopping rule: whatever else the log shows, that is why it ended."""
    rule = str(decision["rule"]).replace("_", " ")
    return Finding(
        rule="converged",
        sentence=f"The run's stopping rule ended it ({rule}): {decision['why']}.",
        figure="training_progress",
        values=decision["values"],
        thresholds={
            key: value for key, value in decision["thresholds"].items() if isinstance(value, int | float)
        },
    )


def _race_with(best: RunResult) -> Finding:
    """Name the best checkpoint of a run of ours, as its summary does."""
    sentence = "No checkpoint was evaluated: `deepracer-exp checkpoints RUN` races the ones that were kept."
    values: dict[str, float | int | str] = {}
    if best.iteration is not None:
        sentence = f"Race with checkpoint {best.iteration:06d}, the best by {best.criterion}: {best.words()}."
        values = {"iteration": best.iteration, "by": best.criterion}
    return Finding(rule="submit", sentence=sentence, figure="training_progress", values=values)


def _submit(view: LogView) -> Finding:
    if view.recording.best is not None:
        return _race_with(view.recording.best)
    best = candidates(view.iterations)
    thresholds = {"least_laps": chosen.LEAST_LAPS, "dense": chosen.DENSE}
    if not len(best):
        farthest = view.episodes.loc[view.episodes["progress"].idxmax()]
        laps = int(view.iterations["complete"].sum())
        evaluated = evaluated_candidates(view.recording)
        if len(evaluated):
            return _submit_evaluated(evaluated, laps, thresholds)
        sentence = (
            f"Nothing to submit yet: no iteration has {chosen.LEAST_LAPS} complete laps ({_count(laps, 'lap')} in "
            f"all); the farthest episode drove {farthest['progress']:.0f} % of the lap in iteration "
            f"{farthest['iteration']}."
        )
        values = {"laps": laps, "progress": float(farthest["progress"])}
        return Finding(
            rule="submit",
            sentence=sentence,
            figure="lap_time_percentile",
            values=values,
            thresholds=thresholds,
        )
    first = best.iloc[0]
    low, high = map(float, wilson(first["complete"], first["episodes"]))
    which = f"the checkpoint {first['checkpoint']}, which" if first["checkpoint"] else "the checkpoint that"
    sentence = (
        f"Submit {which} drove iteration {first['iteration']:.0f}: a quarter of its laps are below "
        f"{first['lap_time_p25_s']:.2f} s, and {first['complete']:.0f} of its {first['episodes']:.0f} episodes are "
        f"complete laps ({_share(low)} to {_share(high)} with 95 % confidence)."
    )
    others = [
        f"{row.checkpoint or row.iteration} ({row.lap_time_p25_s:.2f} s, {row.lap_share:.0%})"
        for row in best.iloc[1:].itertuples()
    ]
    if others:
        sentence += f" After it: {' and '.join(others)}."
    values = {"iteration": int(first["iteration"]), "p25_s": float(first["lap_time_p25_s"])}
    values |= {"lap_share": float(first["lap_share"]), "laps": int(first["complete"])}
    return Finding(
        rule="submit", sentence=sentence, figure="lap_time_percentile", values=values, thresholds=thresholds
    )


def _submit_evaluated(evaluated: pd.DataFrame, laps: int, thresholds: Mapping[str, float]) -> Finding:
    first = evaluated.iloc[0]
    count = int(first["laps"])
    did = {1: "completed its lap", 2: "completed both laps"}.get(count, f"completed all {count} laps")
    sentence = (
        f"Submit the checkpoint saved after iteration {evaluated.index[0]}: its evaluation {did}, in "
        f"{first['lap_time_s']:.2f} s{'' if count == 1 else ' on average'}. The training itself has too few complete "
        f"laps to judge by ({laps})."
    )
    return Finding(
        rule="submit",
        sentence=sentence,
        figure="training_progress",
        values={"iteration": int(evaluated.index[0]), "lap_time_s": float(first["lap_time_s"]), "laps": laps},
        thresholds=thresholds,
    )


def _chance(laps: _Laps, target_s: float | None) -> Finding | None:
    known = laps.lap_times_s[np.isfinite(laps.lap_times_s)]
    if not len(known):
        return None
    if len(known) < LEAST_LAPS:
        driven = f"{len(known)} of {_count(len(laps.lap_times_s), 'episode')} {laps.whose}"
        sentence = (
            f"{driven} {'is a complete lap' if len(known) == 1 else 'are complete laps'}, the fastest in "
            f"{known.min():.2f} s: too few to say how likely the next one is."
        )
        return Finding(
            rule="chance",
            sentence=sentence,
            figure="lap_time_histogram",
            values={"laps": len(known), "best_s": float(known.min())},
            thresholds={"least_laps": LEAST_LAPS},
        )
    target = float(known.min()) if target_s is None else target_s
    found = lap_chance(known, target)
    assert found is not None
    complete = len(known) / len(laps.lap_times_s)
    what = f"took at most {target:.2f} s" + (", the fastest of them" if target_s is None else "")
    sentence = (
        f"{found.faster} of {_count(found.laps, 'complete lap')} {laps.whose} {what}: the chance of such a lap is "
        f"{_share(found.low)} to {_share(found.high)}"
    )
    values: dict[str, float | int | str] = {"target_s": target, "laps": found.laps, "faster": found.faster}
    values |= {"low": found.low, "high": found.high, "mean_s": found.mean_s, "complete": complete}
    if math.isfinite(found.normal):
        fit = f"mean {found.mean_s:.2f} s, deviation {found.sd_s:.2f} s"
        sentence += f"; a normal fit ({fit}) says {_share(found.normal)}"
        values |= {"sd_s": found.sd_s, "normal": found.normal}
    sentence += f". {complete:.0%} of the episodes were complete laps."
    return Finding(rule="chance", sentence=sentence, figure="lap_time_histogram", values=values)


def _time_lost(view: LogView, laps: _Laps) -> Finding | None:
    if view.course is None:
        return None
    sectors = sectors_of(view.course)
    times = times_by_sector(laps.steps, sectors)
    if len(times) < 2 or len(sectors.parts) < 2:
        return None
    lost = (times.median() - times.min()).sort_values(ascending=False, kind="stable").head(MOST_LOST)
    lost = lost[lost >= WORTH_S]
    best_s, possible_s = float(times.sum(axis=1).min()), theoretical_best_s(times)
    places = [f"{_place(sectors, name)}: {seconds:.2f} s" for name, seconds in lost.items()]
    sentence = f"The best sectors of {_count(len(times), 'lap')} {laps.whose} add up to {possible_s:.2f} s; "
    sentence += f"the fastest lap took {best_s:.2f} s. "
    sentence += (
        f"An ordinary lap loses most in {'; '.join(places)}."
        if places
        else "No sector loses time to its best."
    )
    if len(times) < LEAST_LAPS:
        sentence += f" From {len(times)} laps this is a hint at most."
    return Finding(
        rule="time_lost",
        sentence=sentence,
        figure="sector_times",
        values={"best_lap_s": best_s, "theoretical_best_s": possible_s}
        | {f"lost_s, {name}": float(seconds) for name, seconds in lost.items()},
        thresholds={"worth_s": WORTH_S},
    )


def _place(sectors: Sectors, name: str) -> str:
    part = sectors.parts[sectors.names.index(name)]
    return f"{name} (waypoints {part.first_waypoint} to {part.last_waypoint})"


def _crashes(view: LogView) -> Finding | None:
    """Say how many episodes of the whole log ended in a crash, and how many of them at one object."""
    status = view.steps["episode_status"].astype(str).to_numpy()
    begins = (status == "crashed") & (np.append([""], status[:-1]) != "crashed")
    rows = view.steps[begins]
    if not len(rows):
        return None
    places = rows[["X", "Y"]].to_numpy(np.float64)
    near = np.linalg.norm(places[:, None] - places[None], axis=2) <= CRASH_PLACE_M
    centre = int(near.sum(axis=1).argmax())
    here = rows[near[centre]]
    crashed, episodes = rows["episode"].nunique(), len(view.episodes)
    waypoint = int(here["closest_waypoint"].median())
    x_m, y_m = here[["X", "Y"]].median()
    sentence = f"The car crashed in {crashed} of {_count(episodes, 'episode')}"
    if len(here) >= off_track.LEAST:
        sentence += (
            f", {len(here)} times at one place: waypoint {waypoint} (x {x_m:.2f} m, y {y_m:.2f} m), where an "
            "object is."
        )
    else:
        sentence += ", at no place often."
    return Finding(
        rule="crashes",
        sentence=sentence,
        figure="episode_ends_map",
        values={"crashed": crashed, "episodes": episodes, "here": len(here), "waypoint": waypoint},
        thresholds={"place_m": CRASH_PLACE_M, "least": off_track.LEAST},
    )


def _runs_off(view: LogView) -> list[Finding]:
    late, when = _now(view)
    steps = view.steps[view.steps["episode"].isin(late["episode"])]
    thresholds = {"least": off_track.LEAST, "place_m": off_track.PLACE_M}
    places = off_track_places(steps)
    if not places:
        times = len(off_track.off_track_rows(steps))
        often = (
            "does not run off the road"
            if not times
            else f"runs off the road {_times(times)}, in no place often"
        )
        sentence = f"The car {often} {when}."
        return [
            Finding(
                rule="runs_off",
                sentence=sentence,
                figure="off_track_risk",
                values={"times": times},
                thresholds=thresholds,
            )
        ]
    sectors = sectors_of(view.course) if view.course is not None else None
    where = [
        f"at waypoint {one.waypoint}{_in(sectors, one)} to the {one.side} "
        f"({one.count} of {one.passes} passes: a risk of {_share(one.low)} to {_share(one.high)})"
        for one in places
    ]
    found = Finding(
        rule="runs_off",
        sentence=f"The car runs off most often {', then '.join(where)}, counted {when}.",
        figure="off_track_risk",
        values={f"risk, waypoint {one.waypoint}": one.risk for one in places}
        | {f"times, waypoint {one.waypoint}": one.count for one in places},
        thresholds=thresholds,
    )
    return [found, _steering(places)]


def _steering(places: list[OffTrackPlace]) -> Finding:
    # A mistake made at several places is mentioned once.
    at: dict[str, list[str]] = {}
    for one in places:
        said = JUDGEMENTS[one.judgement] if one.judgement else "its mistakes vary"
        at.setdefault(said, []).append(str(one.waypoint))
    words = [f"at waypoint{'s' * (len(some) > 1)} {_and(some)} {said}" for said, some in at.items()]
    return Finding(
        rule="steering",
        sentence=f"Before it runs off, {'; '.join(words)}.",
        figure="slide_map",
        values={
            f"{name}, waypoint {one.waypoint}": times
            for one in places
            for name, times in one.judgements.items()
        },
        thresholds={
            "unusual": off_track.UNUSUAL,
            "slide_deg": off_track.SLIDE_DEG,
            "steers_deg": off_track.STEERS_DEG,
        },
    )


def _in(sectors: Sectors | None, place: OffTrackPlace) -> str:
    if sectors is None:
        return ""
    return f" ({sectors.names[int(sectors.of(np.array([place.lap_position]))[0])]})"


def _overfits(view: LogView) -> Finding | None:
    decision = view.recording.decision
    found = overfitting(view.iterations)
    if found is None or (decision is not None and decision["rule"] == "overfitting"):  # said already
        return None
    if found.overfits:
        sentence = (
            f"It overfits: completion in the {found.evaluated} fell from {found.best:.0f} % around iteration "
            f"{found.best_iteration} to {found.now:.0f} % while that of the training holds at "
            f"{found.training_now:.0f} %. Take a checkpoint from about iteration {found.best_iteration}."
        )
    else:
        sentence = (
            f"No sign of overfitting: completion in the {found.evaluated} is {found.now:.0f} % "
            f"(best {found.best:.0f} %), in the training at {found.training_now:.0f} %."
        )
    return Finding(
        rule="overfits",
        sentence=sentence,
        figure="training_progress",
        values={
            "best": found.best,
            "best_iteration": found.best_iteration,
            "now": found.now,
            "training_best": found.training_best,
            "training_now": found.training_now,
        },
        thresholds={
            "evaluation_drop": EVALUATION_DROP,
            "training_near": LOG_RULE.completion_near,
        },
    )


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _share(share: float) -> str:
    """Return it in per cent, with a digit more where it is small."""
    return (
        f"{share:.0%}" if share >= 0.1 or share == 0 else f"{share:.1%}" if share >= 0.001 else "below 0.1%"
    )


def _and(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def _times(number: int) -> str:
    return {1: "once", 2: "twice"}.get(number, f"{number} times")
