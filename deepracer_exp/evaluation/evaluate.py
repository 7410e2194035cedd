"""The command `evaluate`: race a stored policy, print the results and record them."""

import datetime
import json
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from rich.console import Console
from rich.table import Table

from deepracer_exp.config.evaluation import EvaluateConfig, EvaluationConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.running import MLflowTracking
from deepracer_exp.errors import RunFailed, count, writing
from deepracer_exp.files import atomic_write
from deepracer_exp.runs.checkpoints import StoredPolicy, read_checkpoint
from deepracer_exp.runs.files import EVALUATIONS, FILMS
from deepracer_exp.runs.resolve import resolve
from deepracer_exp.tracking.delivery import deliver_evaluation
from deepracer_exp.tracking.metrics import evaluate_metric, track_labels

from .evaluator import Evaluator
from .film import LapRecorder, best_attempt
from .real_car import compare, explain_controls, key_figures, losses_table
from .result import CONFIDENCE, NOTHING, USUAL, Evaluation, number

if TYPE_CHECKING:
    from .video import View

_TIMES = ("lap s", "median", "best", "std", "score s")
_MINOR = ("median", "std", "score s")


def results_table(
    evaluation: Evaluation, config: EvaluationConfig, trained_on: Container[str], console: Console
) -> Table:
    """Return the results as a table, one row per track and condition, with as many columns as the console fits."""
    unseen = [track for track in evaluation.tracks if track not in trained_on]
    groups = [(f"{group.track}{' *' * (group.track in unseen)}", group) for group in evaluation.groups]
    if len(evaluation.tracks) > 1:
        groups += [("all", evaluation.on(condition)) for condition in evaluation.conditions]
    found = [(label, group.condition.replace("_", " "), group.statistics()) for label, group in groups]
    penalties = any(vars(config.penalty_s).values())
    hidden = (() if config.resets_per_lap else ("resets",)) + (() if penalties else ("penalty s",))

    def lay_out(intervals: bool, left_out: Sequence[str]) -> Table:
        rows = [(label, condition, _cells(numbers, intervals)) for label, condition, numbers in found]
        names = [name for name in rows[0][2] if name not in left_out]
        notes = [
            f"in brackets: {CONFIDENCE:.0%} interval of the mean, by bootstrap over the trials"
        ] * intervals
        notes += ["*: not trained on"] * bool(unseen)
        shown = Table(box=None, pad_edge=False, caption="; ".join(notes), caption_justify="left")
        for name in ("track", "on", *names):
            shown.add_column(name, no_wrap=True, justify="right" if name in names else "left")
        for label, condition, cells in rows:
            whole = label == "all"
            # Lap times of tracks of different lengths have no mean.
            texts = [NOTHING if whole and name in _TIMES else cells[name] for name in names]
            shown.add_row(label, condition, *texts, style="bold" * whole)
        return shown

    return fit(console, lay_out, hidden, _MINOR)


def fit(
    console: Console,
    lay_out: Callable[[bool, Sequence[str]], Table],
    hidden: tuple[str, ...],
    minor: tuple[str, ...],
) -> Table:
    """Return the fullest table that fits a console: with intervals or without, first without the minor columns."""
    endless = console.options.update(max_width=10_000)
    for intervals, left_out in ((True, hidden), (True, hidden + minor), (False, hidden + minor)):
        shown = lay_out(intervals, left_out)
        if console.measure(shown, options=endless).maximum <= console.width:
            break
    return shown


def write_evaluation(
    folder: Path,
    evaluation: Evaluation,
    config: EvaluationConfig,
    stored: StoredPolicy,
    car: Mapping[str, Evaluation] | None = None,
) -> Path:
    """Write `evaluations/<time>.json` into a run's folder and return it; `car`: what `real_car.compare` returns.

    Raises:
        RunFailed: the file cannot be written.
    """
    now = datetime.datetime.now()
    content: dict[str, Any] = {
        "time": now.isoformat(timespec="seconds"),
        "checkpoint": {"name": stored.path.name, **stored.counters},
        "evaluation": asdict(config),
        **evaluation.as_dict(),
    }
    if car is not None:
        content["real_car"] = key_figures(car)
    target = folder / EVALUATIONS
    with writing(target, failure=RunFailed):
        target.mkdir(exist_ok=True)
        # Microseconds, so that two within a second do not overwrite each other.
        name = now.strftime("%Y%m%d-%H%M%S-%f")
        return atomic_write(target / f"{name}.json", json.dumps(content, indent=2) + "\n")


def _cells(found: Mapping[str, Any], intervals: bool) -> dict[str, str]:
    """Return a group's cells by column."""
    times = found["lap_time_s"]
    return {
        "laps": f"{found['laps']} of {found['laps_tried']}",
        "done %": _mean(found["completion"], 1, intervals),
        "lap s": _mean(times, 2, intervals),
        "median": number(times["median"], 2),
        "best": number(times["best"], 2),
        "std": number(times["std"], 2),
        "resets": _mean(found["resets"], 1, intervals),
        "penalty s": _mean(found["penalty_s"], 1, intervals),
        "score s": number(found["race_score_s"], 2),
    }


def _mean(found: Mapping[str, Any], digits: int, intervals: bool) -> str:
    mean = number(found["mean"], digits)
    if found["interval"] is None or not intervals:
        return mean
    low, high = (number(bound, digits) for bound in found["interval"])
    return mean if low == high else f"{mean} ({low}\N{EN DASH}{high})"


def evaluate_run(
    config: EvaluateConfig, video: "tuple[Path, View] | None", out: Console, err: Console
) -> Evaluation:
    """Race a run's checkpoint under a protocol, print the table, write the JSON file, record both in MLflow.

    Raises:
        BadInput: the run, the checkpoint, a track or a condition cannot be used, or the machine cannot render.
        RunFailed: a car's state became NaN, or a file cannot be written.
    """
    run = resolve(config.run, Path(config.runs_dir), config.tracking.uri)
    stored = read_checkpoint(run.experiment, run.checkpoints, run.choose_checkpoint(config.checkpoint))
    torch.set_num_threads(1)
    evaluator = Evaluator(run.experiment, config.evaluation)
    recorder = LapRecorder(evaluator)
    err.print(
        f"{run.path.name}, checkpoint {stored.path.name}: {count(len(evaluator.trials), 'trial')}",
        highlight=False,
    )
    evaluation = evaluator(stored.networks.policy, recorder if video is not None else None)
    car = None
    if config.evaluation.real_car is not None:
        car = compare(run.experiment, config.evaluation, stored.networks.policy, evaluation)
    file = write_evaluation(run.path, evaluation, config.evaluation, stored, car)
    known = trained_on(run.experiment, config.evaluation, evaluation)
    out.print(results_table(evaluation, config.evaluation, known, out))
    if car is not None:
        out.print()
        out.print(losses_table(car))
        for line in explain_controls(run.experiment, config.evaluation):
            out.print(f"  {line}", soft_wrap=True, highlight=False)
    out.print(f"\n  results  {file}", soft_wrap=True, highlight=False)
    files = {file: EVALUATIONS}
    if video is not None:
        from .video import write_video  # imports MuJoCo's renderer

        write_video(*video, recorder.lap(best_attempt(evaluation)), run.experiment.car, err)
        out.print(f"  video    {video[0]}", soft_wrap=True, highlight=False)
        files[video[0]] = FILMS
    tracking = run.experiment.tracking
    uri = config.tracking.uri or (tracking.uri if isinstance(tracking, MLflowTracking) else None)
    metrics = _metrics(evaluation, known)
    runs_dir = run.path.resolve().parents[1]
    deliver_evaluation(run.path, uri, runs_dir, stored.counters["env_steps"], metrics, files)
    return evaluation


def trained_on(experiment: Experiment, config: EvaluationConfig, evaluation: Evaluation) -> list[str]:
    """Return the names of the tracks that the policy of an evaluation was trained on."""
    if config.tracks is None:
        return evaluation.tracks
    # A track file replaces an option and keeps its name, so it is not the track of that name.
    return [name for name, track in experiment.tracks.items() if track.file is None]


def _metrics(evaluation: Evaluation, trained_on: Sequence[str]) -> dict[str, float | None]:
    """Return the results as metrics of the run, suffixed with the track unless it is the run's only one."""
    names = evaluation.tracks
    labels = [None] if names == list(trained_on) and len(names) == 1 else track_labels(names)
    found: dict[str, float | None] = {evaluate_metric("eval_race_score_s", None): evaluation.race_score_s}
    for group in evaluation.groups:
        label = labels[names.index(group.track)]
        if group.condition == USUAL:
            found[evaluate_metric("eval_lap_time_s", label)] = group.mean_lap_time_s
            found[evaluate_metric("eval_completion", label)] = group.completion
        else:
            found[evaluate_metric("held_out_completion", label)] = group.completion
    return found
