"""Findings of a log in words: rules over its tables, each with its figure (docs/findings.md)."""

import math
from collections.abc import Mapping, Sequence
from statistics import NormalDist

import numpy as np

from deepracer_exp.errors import count
from deepracer_exp.evaluation.zigzag import CONSOLE_CURE, CURE, ZIGZAG_DEG, ZIGZAG_PER_M, zigzag_in_words
from deepracer_exp.reports.tables.log_tables import raced_beside
from deepracer_exp.reports.tables.log_view import LEAST_LAPS, LogView, thirds
from deepracer_exp.reports.tables.off_track import JUDGEMENTS, OffTrackPlace, off_track_places
from deepracer_exp.reports.tables.others_on_road import costliest
from deepracer_exp.reports.tables.sector_times import sectors_now, zigzag_now
from deepracer_exp.reports.tables.statistics import wilson
from deepracer_exp.reports.tables.step_columns import begins_of, first_rows
from deepracer_exp.reports.tables.tables import CANDIDATE_LAPS, DENSE
from deepracer_exp.runs.run_result import RunResult
from deepracer_exp.tracks.sectors import Sector, sector_at, sectors_of

from .finding import LEAST_LOSS_PERCENT, LEAST_LOSS_S, Finding, Numbers, in_order
from .tables import off_track
from .training_findings import training_findings

CRASH_PLACE_M = 1.0
"""Crashes no further than this from one place are at one object."""
MOST_LOST = 3


def findings(view: LogView, target_s: float | None = None) -> list[Finding]:
    """Apply all rules to a log; advice comes first, then the costliest finding (`finding.in_order`).

    `target_s` is the desired lap time, if there is one.
    """
    of_training = training_findings(view, _submit(view)) if view.trained else []
    of_driving = [_time_lost(view)]
    if not view.laps_only:
        of_driving += [_crashes(view), _costliest(view), *_runs_off(view)]
    of_driving += [_zigzag(view), _chance(view, target_s)]
    return in_order(of_training, [finding for finding in of_driving if finding is not None])


def _race_with(best: RunResult) -> Finding:
    """Name the best checkpoint of a run of ours, as its summary does."""
    if best.iteration is None:
        sentence = (
            "No checkpoint was evaluated: `deepracer-exp checkpoints RUN` races the ones that were kept."
        )
        return Finding("submit", sentence, to_do=sentence)
    values: Numbers = {"iteration": best.iteration, "by": best.criterion}
    sentence = f"The best checkpoint by {best.criterion} is checkpoint {best.iteration}: {best.words()}."
    to_do = f"Race with checkpoint {best.iteration}, the best by {best.criterion}: {best.words()}."
    return Finding("submit", sentence, values, to_do=to_do)


def _submit(view: LogView) -> Finding:
    if view.run is not None:
        return _race_with(view.run.best)
    best = view.candidates
    thresholds = {"least_laps": CANDIDATE_LAPS, "dense": DENSE}
    if not len(best):
        return _nothing_to_submit(view, thresholds)
    first = best.iloc[0]
    complete, episodes = int(first["complete"]), int(first["episodes"])
    values: Numbers = {
        "iteration": int(first["iteration"]),
        "laps": complete,
        "lap_share": first["lap_share"],
    }
    if first["evaluated"]:
        completed = f"{complete} of {episodes} laps"
        if complete == episodes:
            completed = {1: "its lap", 2: "both laps"}.get(episodes, f"all {episodes} laps")
        average = "" if complete == 1 else " on average"
        which = (
            f"{_checkpoint(view, first['checkpoint'])} iteration {first['iteration']}: its evaluation completed "
            f"{completed}, in {first['lap_time_mean_s']:.2f} s{average}. The evaluations of the log decide: they race "
            "without exploring."
        )
        values |= {"lap_time_s": float(first["lap_time_mean_s"])}
        time_of = "lap_time_mean_s"
    else:
        low, high = map(float, wilson(complete, episodes))
        whose = "their" if view.in_blocks else "its"
        which = (
            f"{_checkpoint(view, first['checkpoint'])} {_iterations(view, first['iteration'])}: a quarter of "
            f"{whose} exploring laps are below {first['lap_time_p25_s']:.2f} s, and {complete} of {whose} {episodes} "
            f"episodes are complete laps ({_share(low)} to {_share(high)} with 95% confidence)."
        )
        values |= {"p25_s": float(first["lap_time_p25_s"])}
        time_of = "lap_time_p25_s"
    others = [
        f"{row['checkpoint'] or 'that of iteration ' + str(row['iteration'])} ({row[time_of]:.2f} s, "
        f"{row['lap_share']:.0%})"
        for row in best.iloc[1:].to_dict("records")
    ]
    if others:
        which += f" After it: {' and '.join(others)}."
    return Finding("submit", f"The best so far is {which}", values, thresholds, to_do=f"Submit {which}")


def _nothing_to_submit(view: LogView, thresholds: Mapping[str, float]) -> Finding:
    laps, at_first = int(view.iterations["complete"].sum()), view.iterations["iteration"] == 0
    before = int(view.iterations["complete"][at_first].sum())
    farthest = view.episodes.loc[view.episodes["progress"].idxmax()]
    raced = raced_beside(view)
    lead = "The training names no checkpoint to submit" if raced else "Nothing to submit yet"
    sentence = (
        f"{lead}: no iteration has {CANDIDATE_LAPS} complete laps ({count(laps, 'lap')} in "
        f"all); the farthest episode drove {math.floor(farthest['progress'])}% of the lap in iteration "
        f"{farthest['iteration']}."
    )
    if before >= CANDIDATE_LAPS:
        sentence = (
            f"{lead}: {before} of {count(laps, 'complete lap')} are those of iteration 0, driven by the "
            f"policy that the training began with; no later one has {CANDIDATE_LAPS}."
        )
    if raced:
        sentence += f" What was raced beside it: {raced}."
    return Finding("submit", sentence, {"laps": laps, "progress": float(farthest["progress"])}, thresholds)


def _iterations(view: LogView, last: int) -> str:
    """Return the iterations of a row of `view.judged` in words."""
    if not view.in_blocks:
        return f"iteration {last}"
    before = view.judged["iteration"][view.judged["iteration"] < last].max()
    first = 0 if math.isnan(before) else int(before) + 1
    return f"iteration {last}" if first == last else f"the last of iterations {first} to {last}"


def _checkpoint(view: LogView, name: str) -> str:
    if not name:
        return (
            "the checkpoint (its name is not logged, nor can it be counted, since steps before it are not recorded) "
            "that drove"
        )
    if view.recording.checkpoints_counted:
        return (
            f"the checkpoint {name} (no file names it: counted as if the training were no clone), which drove"
        )
    cloned = ", the model that was cloned," if name.endswith("_Step-0") else ","
    return f"the checkpoint {name}{cloned} which drove"


def _chance(view: LogView, target_s: float | None) -> Finding | None:
    """Report the speed of laps, and with a target its probability, measured and by a normal distribution."""
    episodes, when = view.now(LEAST_LAPS)
    laps_s = episodes["lap_time_s"].dropna().to_numpy(np.float64)
    laps = len(laps_s)
    if not laps:
        return None
    best_s, mean_s = float(laps_s.min()), float(laps_s.mean())
    if laps < LEAST_LAPS:
        are = f"is a complete {view.lap_word}" if laps == 1 else f"are complete {view.lap_word}s"
        of = "" if view.laps_only else f" of {count(len(episodes), 'episode')}"
        sentence = f"{laps}{of} {when} {are}, the fastest in {best_s:.2f} s: too few to say how likely the next one is."
        return Finding("chance", sentence, {"laps": laps, "best_s": best_s}, {"least_laps": LEAST_LAPS})
    complete, sd_s = laps / len(episodes), float(laps_s.std(ddof=1))
    share = f"{complete:.0%} of these episodes were complete laps."
    if view.laps_only:
        share = "Other episodes are not in the trace (trace=laps)."
    driven = count(laps, f"complete {view.lap_word}")
    values: Numbers = {"laps": laps, "best_s": best_s, "mean_s": mean_s, "complete": complete, "sd_s": sd_s}
    if target_s is None:
        p25_s, median_s = (float(quantile) for quantile in np.quantile(laps_s, [0.25, 0.5]))
        sentence = (
            f"Half of the {driven} {when} took at most {median_s:.2f} s, a quarter at most "
            f"{p25_s:.2f} s; the fastest took {best_s:.2f} s. {share}"
        )
        return Finding("chance", sentence, values | {"p25_s": p25_s, "median_s": median_s})
    faster = int((laps_s <= target_s).sum())
    low, high = map(float, wilson(faster, laps))
    sentence = (
        f"{faster:,} of {driven} {when} took at most {target_s:.2f} s: the chance of such a lap "
        f"is {_share(low)} to {_share(high)}"
    )
    values |= {"target_s": target_s, "faster": faster, "low": low, "high": high}
    if sd_s > 0:
        normal = NormalDist(mean_s, sd_s).cdf(target_s)
        sentence += f"; a normal fit (mean {mean_s:.2f} s, deviation {sd_s:.2f} s) says {_share(normal)}"
        values["normal"] = normal
    return Finding("chance", f"{sentence}. {share}", values)


def _time_lost(view: LogView) -> Finding | None:
    if view.course is None:
        return None
    parts, times, when = sectors_now(view, view.course)
    if len(times) < 2 or len(parts) < 2:
        return None
    sectors = {part.name: part for part in parts}
    lost = (times.median() - times.min()).sort_values(ascending=False, kind="stable").head(MOST_LOST)
    lost = lost[lost >= LEAST_LOSS_S]
    if not len(lost):
        return None
    best_s, possible_s = float(times.sum(axis=1).min()), float(times.min().sum())
    places = [
        f"{name} (waypoints {sectors[name].first_waypoint} to {sectors[name].last_waypoint}): {seconds:.2f} s"
        for name, seconds in lost.items()
    ]
    starts = view.episodes.loc[times.index, "start_at"]
    begun = np.searchsorted([part.first_waypoint for part in parts], starts, side="right")
    # Where laps begin in different sectors, the best time of each is that of a car at speed.
    standing = " without a standing start" if len(set(begun)) > 1 else ""
    sentence = (
        f"The best sectors of {count(len(times), view.lap_word)} {when} add up to {possible_s:.2f} s{standing}; the "
        f"fastest of them took {best_s:.2f} s. Compared with the best time of each sector, the median loses most in "
        f"{'; '.join(places)}."
    )
    if len(times) < LEAST_LAPS:
        sentence += f" From {len(times)} laps this is a hint at most."
    values = {"best_lap_s": best_s, "theoretical_best_s": possible_s}
    values |= {f"lost_s, {name}": float(seconds) for name, seconds in lost.items()}
    cost = 100 * float(lost.sum()) / float(times.sum(axis=1).median())
    return Finding("time_lost", sentence, values, {"least_s": LEAST_LOSS_S}, cost)


def _costliest(view: LogView) -> Finding | None:
    """Name the object with most crashes in the last third of the iterations, or in an evaluation."""
    if view.others is None:
        return None
    late = thirds(view.steps["iteration"].to_numpy()) == 2
    costs_most = costliest(view.others, late)
    if costs_most is None:
        return None
    sentence, values = costs_most
    when = "last third of the iterations" if view.trained else "evaluations"
    driven = view.steps["episode"][late].nunique()
    return Finding(
        "costs_most", f"In the {when}: {sentence}", values, cost_percent=100 * int(values["crashes"]) / driven
    )


def _crashes(view: LogView) -> Finding | None:
    """Count the finished episodes of the whole log with a crash, and the crashes at one object."""
    episodes = view.episodes.loc[view.episodes["ended"], "episode"]
    crashed_now = (view.steps["episode_status"] == "crashed").to_numpy()
    rows = view.steps[begins_of(crashed_now, first_rows(view.steps))]
    rows = rows[rows["episode"].isin(episodes)].dropna(subset=["X", "Y"])
    if not len(rows):
        return None
    from scipy.spatial import KDTree  # takes a quarter of a second, and few cars crash

    places = rows[["X", "Y"]].to_numpy(np.float64)
    tree = KDTree(places)
    densest = places[tree.query_ball_point(places, CRASH_PLACE_M, return_length=True).argmax()]
    here = rows.iloc[tree.query_ball_point(densest, CRASH_PLACE_M)]
    crashed = rows["episode"].nunique()
    x_m, y_m = here[["X", "Y"]].median()
    nearest = np.hypot(here["X"] - x_m, here["Y"] - y_m).to_numpy().argmin()
    waypoint = int(here["closest_waypoint"].iloc[nearest])
    where = ", at no place often."
    if len(here) >= off_track.LEAST:
        where = f", {len(here)} times at one place: waypoint {waypoint} (x {x_m:.2f} m, y {y_m:.2f} m)."
    return Finding(
        "crashes",
        f"The car crashed in {crashed} of {count(len(episodes), 'episode')}{view.traced}{where}",
        {"crashed": crashed, "episodes": len(episodes), "here": len(here), "waypoint": waypoint},
        {"place_m": CRASH_PLACE_M, "least": off_track.LEAST},
        100 * crashed / len(episodes),
    )


def _runs_off(view: LogView) -> list[Finding]:
    late, when = view.now()
    rows = view.rows_of(view.episodes.index.isin(late.index))
    steps = view.steps[list(off_track.COLUMNS)].iloc[rows]
    thresholds = {"least": off_track.LEAST, "place_m": off_track.PLACE_M}
    places = off_track_places(steps)
    if not places:
        times = len(off_track.off_track_rows(steps))
        if not times:
            return []
        words = {1: "once", 2: "twice"}.get(times, f"{times} times")
        sentence = f"The car runs off the road {words}, in no place often {when}."
        return [Finding("runs_off", sentence, {"times": times}, thresholds, 100 * times / len(late))]
    sectors = sectors_of(view.course) if view.course is not None else []
    where = [
        f"at waypoint {place.waypoint}{_in(sectors, place)} to the {place.side} "
        f"({place.count} of {place.passes} passes: a risk of {_share(place.low)} to {_share(place.high)})"
        for place in places
    ]
    sentence = f"The car runs off most often {', then '.join(where)}, counted {when}."
    values = {f"risk, waypoint {place.waypoint}": place.count / place.passes for place in places}
    values |= {f"times, waypoint {place.waypoint}": place.count for place in places}
    cost = 100 * sum(place.count for place in places) / len(late)
    return [Finding("runs_off", sentence, values, thresholds, cost), _steering(places, cost)]


def _steering(places: Sequence[OffTrackPlace], cost: float) -> Finding:
    # A mistake made at several places is mentioned once.
    waypoints: dict[str, list[str]] = {}
    for place in places:
        mistake = JUDGEMENTS[place.judgement] if place.judgement else "its mistakes vary"
        waypoints.setdefault(mistake, []).append(str(place.waypoint))
    words = []
    for mistake, some in waypoints.items():
        *first, last = some
        where = f"waypoints {', '.join(first)} and {last}" if first else f"waypoint {last}"
        words.append(f"at {where} {mistake}")
    values = {
        f"{name}, waypoint {place.waypoint}": times
        for place in places
        for name, times in place.judgements.items()
    }
    thresholds = {"unusual": off_track.UNUSUAL, "slide_deg": off_track.SLIDE_DEG}
    thresholds |= {"steers_deg": off_track.STEERS_DEG}
    return Finding("steering", f"Before it runs off, {'; '.join(words)}.", values, thresholds, cost)


def _zigzag(view: LogView) -> Finding | None:
    figures, where = zigzag_now(view)
    if (
        figures is None
        or figures[0] < ZIGZAG_PER_M
        or not figures[1] >= ZIGZAG_DEG
        or figures[2] < LEAST_LOSS_S
    ):
        return None
    cure = CONSOLE_CURE if view.run is None else CURE
    sentence = f"The car zig-zags on straights: {zigzag_in_words(*figures)} lost in the detour ({where}). Try {cure}."
    values = dict(zip(("changes_per_m", "amplitude_deg", "lost_s"), figures, strict=True))
    thresholds = {"changes_per_m": ZIGZAG_PER_M, "amplitude_deg": ZIGZAG_DEG, "lost_s": LEAST_LOSS_S}
    lap_s = float(view.now(LEAST_LAPS)[0]["lap_time_s"].median())
    # Without a lap there is nothing to compare with: it is mentioned after all that has a cost in per cent.
    cost = LEAST_LOSS_PERCENT if math.isnan(lap_s) else max(LEAST_LOSS_PERCENT, 100 * figures[2] / lap_s)
    return Finding("zigzag", sentence, values, thresholds, cost)


def _in(sectors: Sequence[Sector], place: OffTrackPlace) -> str:
    return f" ({sectors[sector_at(sectors, np.array([place.lap_position]))[0]].name})" if sectors else ""


def _share(share: float) -> str:
    """Return the share in per cent, with one more digit near 0 and 100%."""
    if 0.1 <= share <= 0.99 or share in (0, 1):
        return f"{share:.0%}"
    return f"{share:.1%}" if share >= 0.001 else "below 0.1%"
