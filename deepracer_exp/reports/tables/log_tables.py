"""The tables of a report: iterations, candidates, best laps, facts, evaluations, and problems while reading."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from deepracer_exp.aws.logs.recorded import TRAINING
from deepracer_exp.errors import count
from deepracer_exp.evaluation.zigzag import zigzag_in_words
from deepracer_exp.runs.run_result import RunResult

from .against_fastest import loss_in_words
from .log_view import LogView
from .sector_times import zigzag_now

NONE = "\N{EN DASH}"
MOST_ITERATIONS = 300
MOST_LAPS = 10
MOST_PROBLEMS = 200

_ITERATION_COLUMNS = {
    "iteration": ("Iteration", "d"),
    "episodes": ("Episodes", ",d"),
    "steps": ("Steps", ",.0f"),
    "complete": ("Exploring laps", ",d"),
    "completion_mean": ("Driven, %", ".1f"),
    "reward_mean": ("Reward", ".4g"),
    "lap_time_best_s": ("Fastest exploring, s", ".2f"),
    "lap_time_p25_s": ("25th percentile, s", ".2f"),
    "speed_mps": ("Speed, m/s", ".2f"),
    "entropy": ("Entropy, nats", ".3f"),
    "kl": ("KL, nats", ".2g"),
    "lr": ("Learning rate", ".2g"),
    "checkpoint": ("Checkpoint", ""),
    "eval_lap_time_s": ("Evaluated lap, s", ".2f"),
    "eval_completion": ("Evaluated, %", ".1f"),
    "held_out_completion": ("Held out, %", ".1f"),
    "eval_zigzag_per_m": ("Zig-zag, changes/m", ".2f"),
}
"""Columns with their heads and formats."""
_CANDIDATE_COLUMNS = {
    "checkpoint": ("Checkpoint", ""),
    "iteration": ("Drove iteration", "d"),
    "lap_time_p25_s": ("25th percentile, s", ".2f"),
    "lap_time_best_s": ("Fastest lap, s", ".2f"),
    "lap_time_mean_s": ("Mean lap, s", ".2f"),
    "lap_share": ("Complete", ".0%"),
    "complete": ("Laps", ",d"),
    "episodes": ("Episodes", ",d"),
}
_LAP_COLUMNS = {
    "lap_time_s": ("Lap time, s", ".2f"),
    "iteration": ("Iteration", "d"),
    "episode": ("Episode", "d"),
    "start_at": ("From waypoint", "d"),
    "steps": ("Steps", ",d"),
    "dist_m": ("Driven, m", ".2f"),
    "speed_mps": ("Speed commanded, m/s", ".2f"),
    "reward": ("Reward", ".4g"),
}


@dataclass(frozen=True)
class Table:
    """Texts in rows."""

    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    words: int = 0
    """The first columns that hold words; the others hold numbers."""
    left_out: int = 0
    """Number of rows that were left out to keep the page short."""


def table_of(rows: pd.DataFrame, columns: Mapping[str, tuple[str, str]], left_out: int = 0) -> Table:
    """Return columns of a table as texts, by their heads and formats; a dash where a number is not known."""
    texts = [
        tuple(
            NONE if isinstance(row[name], float) and not math.isfinite(row[name]) else format(row[name], form)
            for name, (_, form) in columns.items()
        )
        for row in rows.to_dict("records")
    ]
    return Table(tuple(head for head, _ in columns.values()), tuple(texts), left_out=left_out)


def iteration_rows(view: LogView) -> Table:
    """Return results and metrics of each iteration; of very many, every second, third, ... and the last."""
    table = view.iterations.replace({"steps": {0: math.nan}})  # those in metrics files only have no trace
    named = table.replace({"checkpoint": ""}, None).notna().any()
    every = math.ceil(len(table) / MOST_ITERATIONS) or 1
    shown = table.iloc[::-1].iloc[::every].iloc[::-1]
    columns = {name: column for name, column in _ITERATION_COLUMNS.items() if named[name]}
    return table_of(shown, columns, len(table) - len(shown))


def candidate_rows(view: LogView) -> Table:
    """Return the checkpoints worth submitting, the best first: `LogView.candidates`."""
    named = view.candidates.replace({"checkpoint": ""}, None).notna().any()
    return table_of(
        view.candidates, {name: label for name, label in _CANDIDATE_COLUMNS.items() if named[name]}
    )


def best_laps(view: LogView) -> Table:
    """Return the fastest `comparable` laps of the training, or of races without one; those with resets last."""
    columns, episodes = _LAP_COLUMNS, view.comparable
    if not view.trained:
        columns = {"stream": ("Race", "")} | {k: v for k, v in columns.items() if k != "iteration"}
        columns |= {"resets": ("Resets", "d")} if episodes["reset_lap_time_s"].notna().any() else {}
        episodes = episodes.assign(lap_time_s=episodes["lap_time_s"].fillna(episodes["reset_lap_time_s"]))
    laps = episodes.dropna(subset="lap_time_s").sort_values(["resets", "lap_time_s"], kind="stable")
    return table_of(laps.head(MOST_LAPS), columns, max(0, len(laps) - MOST_LAPS))


def problem_rows(view: LogView) -> Table:
    """Return the unreadable parts with their places and reasons."""
    rows = [
        (problem.file, NONE if problem.line is None else f"{problem.line:,}", problem.reason)
        for problem in view.problems[:MOST_PROBLEMS]
    ]
    return Table(("File", "Line", "Why"), tuple(rows), 3, max(0, len(view.problems) - MOST_PROBLEMS))


def facts(view: LogView) -> list[tuple[str, str]]:
    """Return course, action space and evaluations in names and values."""
    recording, course = view.recording, view.course
    lines: list[tuple[str, str]] = []
    if course is not None:
        way = ", reversed" if course.reversed else ""
        lines.append(("Course", f"{course.title}{way}: {course.length_m:.2f} m, {course.width_m:.2f} m wide"))
    if elsewhere := other_tracks(view):
        lines.append(("Other tracks in it", f"{elsewhere}; --track chooses one"))
    several = trainings(view)
    if several is not None:
        lines.append(("Trainings in it", several))
    if recording.model_checkpoints:
        which = {"best_checkpoint": "the best by the service's evaluations", "last_checkpoint": "the last"}
        names = [f"{name}, {which.get(key, key)}" for key, name in recording.model_checkpoints.items()]
        lines.append(("Checkpoints in the model's folder", "; ".join(names)))
    if recording.metadata is not None:
        actions = recording.metadata.actions
        space = "continuous" if not actions else f"{len(actions)} actions"
        if view.run is None:  # a run of ours has default sensors there, whatever its policy sees
            space += f"; sensors {', '.join(recording.metadata.sensor) or NONE}"
        lines.append(("Action space", space))
    races = view.evaluation_episodes.iloc[: None if view.trained else 0]
    laps = int(view.episodes["lap_time_s"].notna().sum() + races["lap_time_s"].notna().sum())
    if laps:
        counted = "counted from the reset, one control step before the first row, to the last row"
        timed = view.laps_timed
        words = f"{timed:,} of {count(laps, 'lap')} as in the service's metrics file, the others {counted}"
        words = counted if not timed else words if timed < laps else "as in the service's metrics file"
        lines.append(("Lap times", words))
    figures, where = zigzag_now(view)
    if figures is not None:
        lines.append(("Zig-zag on straights", f"{zigzag_in_words(*figures)} ({where})"))
    folder = view.run_folder
    if folder is not None and view.episodes["lap_time_s"].notna().any():
        lines.append(("Against the fastest lap", loss_in_words(view, folder)))
    if raced := raced_beside(view):
        lines.append(("Races and evaluations", raced))
    return lines


def trainings(view: LogView) -> str | None:
    """Name the trainings in a recording; None if there is only one."""
    rounds = view.recording.rounds
    if not rounds:
        return None
    listed = ", ".join(f"{part.name} from iteration {part.first_iteration}" for part in rounds)
    return f"{len(rounds)}, taken as clones one after the other: {listed}"


def result_in_words(view: LogView) -> str:
    """Return a sentence on the trained policy's races; for a log without evaluations, its `headline`.

    Of a run of ours it is the best checkpoint on the usual and the held-out conditions. Of a log of the service it is
    the evaluation of the checkpoint to submit, or the result of its evaluations and races.
    """
    best = view.candidates
    if view.run is not None and view.run.best.evaluated:
        return _result_of_run(view, view.run.best)
    if len(best) and best["evaluated"].iloc[0]:
        first = best.iloc[0]
        laps = f"{first['complete']} of {first['episodes']}"
        return f"Laps in {first['lap_time_mean_s']:.2f} s, {laps} in its evaluation."
    races = view.evaluation_episodes
    laps_s = races["lap_time_s"].dropna()
    if view.trained and len(laps_s):
        return f"Laps in {laps_s.mean():.2f} s, {len(laps_s)} of {len(races)} in its evaluations and races."
    return headline(view)


def _result_of_run(view: LogView, best: RunResult) -> str:
    laps = "" if best.laps_percent is None else f", {best.laps_percent:.0f}% of them complete"
    tried = None if view.run is None else view.run.evaluations
    if tried is not None and len(
        row := tried[tried["iteration"] == best.iteration].dropna(subset="laps_tried")
    ):
        laps = f", {row['laps'].iloc[0]:.0f} of {row['laps_tried'].iloc[0]:.0f}"
    words = (
        f"No complete lap: {best.completion:.0f}% of the way"
        if best.lap_time_s is None
        else f"Laps in {best.lap_time_s:.2f} s{laps}"
    )
    if best.held_out_completion is not None:
        words += f"; on other conditions {best.held_out_completion:.0f}% of the way"
    return f"{words}."


def headline(view: LogView) -> str:
    """Return one sentence on the amount and quality of driving, without episodes cut off by the end of the log."""
    finished, steps = (
        count(int(view.episodes["ended"].sum()), "finished episode"),
        count(int(view.iterations["steps"].sum()) if view.trained else len(view.steps), "control step"),
    )
    complete, put_back = view.episodes["complete"], view.episodes["resets"] > 0
    laps, best_s = int((complete & ~put_back).sum()), view.comparable["lap_time_s"].min()
    with_resets = int((complete & put_back).sum())
    if view.trained:
        sentence = f"{steps} of training in {finished} and {count(len(view.iterations), 'iteration')}"
        if view.untraced:
            sentence += f"; {count(view.untraced, 'more episode')} known from metrics files only"
            laps = int(view.iterations["complete"].sum())
            if view.run is None:  # all laps of a run of ours are in its trace
                best_s = view.iterations["lap_time_best_s"].min()
    else:
        races = count(view.episodes["stream"].nunique(), "race")
        sentence = f"No training; {steps} in {finished} of {races}"
    raced = raced_beside(view)
    beside = f" Beside it {raced}." if raced else ""
    if not laps:
        resets = f"no lap without a reset, {count(with_resets, 'complete lap')} with resets"
        none = f"no complete {view.lap_word if raced else 'lap'}"
        return f"{sentence}; {resets if with_resets else none}.{beside}"
    more = f"; {count(with_resets, 'more lap')} with resets" if with_resets else ""
    best = f", the fastest in {best_s:.2f} s" if math.isfinite(best_s) else ""
    return f"{sentence}; {count(laps, f'complete {view.lap_word}')}{best}{more}.{beside}"


def raced_beside(view: LogView) -> str:
    """Summarise the races and evaluations beside a training in words; "" without one."""
    raced = view.evaluation_episodes
    if not view.trained or not len(raced):
        return ""
    # An evaluation of the service is a race of its own.
    clean = raced["complete"] & (raced["resets"] == 0)
    laps, with_resets = int(clean.sum()), int((raced["complete"] & ~clean).sum())
    best_s = raced["lap_time_s"].min()
    words = f"{count(laps, 'complete lap') if laps else 'no complete lap'} in {count(len(raced), 'episode')}"
    words += f" of {count(raced['stream'].nunique(), 'race')}"
    words += f", the fastest in {best_s:.2f} s" if math.isfinite(best_s) else ""
    return words + (f"; {count(with_resets, 'more lap')} with resets" if with_resets else "")


def evaluated_in_training(view: LogView) -> str:
    """Return the evaluation of a training's best checkpoint in words; "" without one."""
    if view.run is not None:
        best = view.run.best
        return "" if best.iteration is None else f"checkpoint {best.iteration}: {best.words()}"
    completion = view.iterations["eval_completion"]
    if not completion.notna().any():
        return ""
    if not view.candidates["evaluated"].any():
        best_at = view.iterations.loc[completion.idxmax(), "iteration"]
        return f"no complete lap; {completion.max():.0f}% of the lap on average in iteration {best_at}"
    best = view.candidates.iloc[0]
    name = best["checkpoint"] or f"iteration {best['iteration']}"
    return f"{name}: {best['complete']} of {best['episodes']} laps, {best['lap_time_mean_s']:.2f} s"


def other_tracks(view: LogView) -> str:
    """Name the logs of a recording from other tracks, in words; "" if there are none."""
    steps = view.recording.steps
    starts = [part.first_iteration for part in view.recording.rounds]
    words = []
    for track in steps["track"].unique():
        if str(track) in ("", view.track_name):
            continue
        there = steps[(steps["track"] == track).to_numpy()]
        streams = [str(stream) for stream in there["stream"].unique()]
        if starts and TRAINING in streams:
            iterations = there["iteration"][(there["stream"] == TRAINING).to_numpy()].unique()
            rounds = np.unique(np.searchsorted(starts, iterations, side="right") - 1)
            names = [view.recording.rounds[number].name.rpartition("/")[2] for number in rounds]
            streams = [*names, *(stream for stream in streams if stream != TRAINING)]
        words.append(f"{track} ({', '.join(streams)}; {count(len(there), 'control step')})")
    return ", ".join(words)
