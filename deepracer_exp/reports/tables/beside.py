"""The evaluations, races and other tracks in the log of a training."""

import math

import numpy as np

from deepracer_exp.aws.logs.recorded import TRAINING
from deepracer_exp.errors import count

from .log_view import LogView


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
