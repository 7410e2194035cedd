"""The command `evaluate`: race a stored policy, in the simulator or as the physical car; print and record results."""

import datetime
import json
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from tensordict import TensorDict

from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.named import tracks_of
from deepracer_exp.config.running import MLflowTracking
from deepracer_exp.env.others.head_to_head import HeadToHead
from deepracer_exp.env.race import Race
from deepracer_exp.errors import RunFailed, count, writing
from deepracer_exp.files import atomic_write
from deepracer_exp.runs.checkpoint_files import checkpoint_words
from deepracer_exp.runs.checkpoints import StoredPolicy
from deepracer_exp.runs.run_files import EVALUATIONS, FILMS
from deepracer_exp.tracking.delivery import deliver_evaluation
from deepracer_exp.tracking.mlflow_metrics import evaluate_metric, track_labels
from deepracer_exp.tracks.boards import Standing, standings, what_it_sees

from .evaluator import Evaluator
from .film import LapRecorder, best_attempt
from .plan import EvaluatePlan
from .race_protocol import RaceProtocol
from .results import CONFIDENCE, NOTHING, USUAL, Evaluation, number, zigzag_columns
from .trace_recorder import TraceRecorder

_TIMES = ("lap s", "median", "best", "std", "score s")
_MINOR = ("median", "std", "score s", "zig-zag /m")


def results_table(
    evaluation: Evaluation, config: EvaluationConfig, trained_on: Container[str], console: Console
) -> Table:
    """Return the results as a table, one row per track and condition, with as many columns as the console fits."""
    unseen = [track for track in evaluation.tracks if track not in trained_on]
    groups = [(f"{group.track}{' *' * (group.track in unseen)}", group) for group in evaluation.groups]
    if len(evaluation.tracks) > 1:
        groups += [("all", evaluation.on(condition)) for condition in evaluation.conditions]
    lines = [(label, group.condition.replace("_", " "), group.statistics()) for label, group in groups]
    penalties = any(vars(config.penalty_s).values())
    hidden = (() if config.resets_per_lap else ("resets",)) + (() if penalties else ("penalty s",))
    hidden += () if evaluation.among_others else ("crash-free %", "crashes")
    hidden += () if any(group.won for group in evaluation.groups) else ("won %",)

    def lay_out(intervals: bool, left_out: Sequence[str]) -> Table:
        rows = [(label, condition, _cells(numbers, intervals)) for label, condition, numbers in lines]
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
    car: Mapping[str, Any] | None = None,
    places: Mapping[str, Sequence[Standing]] | None = None,
    rival: tuple[str, str] | None = None,
) -> Path:
    """Write `evaluations/<time>.json` into a run's folder and return it.

    `car` are the figures of a check for the car, `places` the results of `official_places`; `rival` names the run and
    checkpoint that drove the other car, None: there was none, or the policy itself.

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
    if rival is not None:
        content["rival"] = dict(zip(("run", "checkpoint"), rival, strict=True))
    if car is not None:
        content["real_car"] = car
    if places:
        content["boards"] = {
            track: [place.as_dict() for place in on_track] for track, on_track in places.items()
        }
    target = folder / EVALUATIONS
    with writing(target, failure=RunFailed):
        target.mkdir(exist_ok=True)
        # Microseconds, so that two within a second do not overwrite each other.
        name = now.strftime("%Y%m%d-%H%M%S-%f")
        return atomic_write(target / f"{name}.json", json.dumps(content, indent=2) + "\n")


def _cells(statistics: Mapping[str, Any], intervals: bool) -> dict[str, str]:
    """Return a group's cells by column."""
    times = statistics["lap_time_s"]
    return {
        "won %": _mean(statistics["won"], 0, intervals, 100.0) if "won" in statistics else NOTHING,
        "laps": f"{statistics['laps']} of {statistics['laps_tried']}",
        "crash-free %": _mean(statistics["crash_free"], 0, intervals, 100.0),
        "done %": _mean(statistics["completion"], 1, intervals),
        "lap s": _mean(times, 2, intervals),
        "median": number(times["median"], 2),
        "best": number(times["best"], 2),
        "std": number(times["std"], 2),
        "resets": _mean(statistics["resets"], 1, intervals),
        "penalty s": _mean(statistics["penalty_s"], 1, intervals),
        "crashes": _mean(statistics["crashes"], 1, intervals),
        "score s": number(statistics["race_score_s"], 2),
        "zig-zag /m": _mean(statistics["zigzag"]["changes_per_m"], 2, intervals),
    }


def _mean(statistics: Mapping[str, Any], digits: int, intervals: bool, factor: float = 1.0) -> str:
    mean = number(None if statistics["mean"] is None else factor * statistics["mean"], digits)
    if statistics["interval"] is None or not intervals:
        return mean
    low, high = (number(factor * bound, digits) for bound in statistics["interval"])
    return mean if low == high else f"{mean} ({low}\N{EN DASH}{high})"


def evaluate_run(
    plan: EvaluatePlan, video: Path | None, out: Console, err: Console, trace: Path | None = None
) -> Evaluation:
    """Race a run's checkpoint under a protocol, print the table, write the JSON file, record both in MLflow.

    Args:
        plan: of the evaluation.
        video: file for the film of a lap; None: no film.
        out: where results are printed.
        err: where progress is printed.
        trace: folder for the control steps; None: they are not written.

    Raises:
        BadInput: the checkpoint, a track or a condition cannot be used, or the machine cannot render.
        RunFailed: a car's state became NaN, or a file cannot be written.
    """
    run, config = plan.run, plan.config.evaluation
    stored = run.read_policy()
    torch.set_num_threads(1)
    rival = None if plan.rival is None else plan.rival.read_policy()
    evaluator = Evaluator(
        run.experiment, config, rival_sees=plan.rival.experiment.observation if plan.rival else None
    )
    recorder = LapRecorder(evaluator)
    traced = TraceRecorder(config)
    recorders = [recorder] * (video is not None) + [traced] * (trace is not None)

    def record(race: Race, protocol: RaceProtocol, acted: TensorDict) -> None:
        for on_step in recorders:
            on_step(race, protocol, acted)

    err.print(
        f"{run.path.name}, {checkpoint_words(stored.path.name)}: {count(len(evaluator.trials), 'trial')}"
        + _against(plan, rival, evaluator),
        soft_wrap=True,
    )
    evaluation = evaluator(
        stored.networks.policy,
        record if recorders else None,
        None if rival is None else rival.networks.policy,
    )
    places = official_places(run.experiment, config, evaluation)
    against = None if plan.rival is None or rival is None else (plan.rival.path.name, rival.path.name)
    file = write_evaluation(run.path, evaluation, config, stored, places=places, rival=against)
    trained = trained_on(run.experiment, config, evaluation)
    out.print(results_table(evaluation, config, trained, out))
    for track, on_track in places.items():
        laps = next(group for group in evaluation.groups if group.track == track and group.condition == USUAL)
        part = f"; {len(laps.lap_times_s)} of {len(laps.decided)} laps were complete" * (laps.lap_share < 1)
        out.print(f"\n{on_track[0].words}{part}", soft_wrap=not out.is_terminal)
    out.print(f"\n  zig-zag  {evaluation.on(USUAL).zigzag.words()}, on straights", soft_wrap=True)
    out.print(f"  results  {file}", soft_wrap=True)
    if trace is not None:
        for written in traced.write(trace, evaluator):
            out.print(f"  trace    {written}", soft_wrap=True)
    files = {file: EVALUATIONS}
    if video is not None:
        from .video import write_video  # imports MuJoCo's renderer

        write_video(video, recorder.lap(best_attempt(evaluation)), evaluator.race.setup.car, err)
        out.print(f"  video    {video}", soft_wrap=True)
        files[video] = FILMS
    tracking = run.experiment.tracking
    uri = plan.config.tracking.uri or (tracking.uri if isinstance(tracking, MLflowTracking) else None)
    metrics = _metrics(evaluation, trained)
    runs_dir = run.path.resolve().parent.parent
    deliver_evaluation(run.path, uri, runs_dir, stored.counters["env_steps"], metrics, files)
    return evaluation


def _against(plan: EvaluatePlan, rival: StoredPolicy | None, evaluator: Evaluator) -> str:
    """Name the policy's rival."""
    if plan.rival is not None and rival is not None:
        return f" against {plan.rival.path.name}, {checkpoint_words(rival.path.name)}"
    return " against itself" * isinstance(evaluator.race, HeadToHead)


def official_places(
    experiment: Experiment, config: EvaluationConfig, evaluation: Evaluation
) -> dict[str, list[Standing]]:
    """Return the places of the usual laps on the official boards of each track that has any, the best known first.

    The boards are those of time trials in the simulator: laps among boxes or bots have no place there, nor have those
    driven as the physical car does.
    """
    if config.real_car is not None or evaluation.among_others:
        return {}
    courses, observation = tracks_of(experiment, config), experiment.observation
    by_track = {}
    for group in evaluation.groups:
        course, mean_s = courses.get(group.track), group.mean_lap_time_s
        if group.condition != USUAL or course is None or mean_s is None:
            continue
        if course.file is not None or course.knots is not None or course.direction == "reversed":
            continue
        places = standings(
            course.name,
            mean_lap_s=mean_s,
            best_lap_s=float(group.lap_times_s.min()),
            car=experiment.car.name,
            sees=what_it_sees(observation.camera, observation.lidar),
            off_track_penalty_s=config.penalty_s.off_track if config.resets_per_lap else None,
        )
        if places:
            by_track[group.track] = places
    return by_track


def trained_on(experiment: Experiment, config: EvaluationConfig, evaluation: Evaluation) -> list[str]:
    """Return the names of the tracks that the policy of an evaluation was trained on."""
    if config.tracks is None:
        return evaluation.tracks
    # Among several, a track of a file keeps the name of an option, so it is not the track of that name.
    return [name for name, track in experiment.tracks.items() if track.file is None]


def _metrics(evaluation: Evaluation, trained_on: Sequence[str]) -> dict[str, float | None]:
    """Return the results as metrics of the run, suffixed with the track unless it is the run's only one."""
    names = evaluation.tracks
    labels = [None] if names == list(trained_on) and len(names) == 1 else track_labels(names)
    metrics: dict[str, float | None] = {evaluate_metric("eval_race_score_s", None): evaluation.race_score_s}
    for group in evaluation.groups:
        label = labels[names.index(group.track)]
        if group.condition == USUAL:
            if group.won:
                metrics[evaluate_metric("eval_won", label)] = group.won_share
            metrics[evaluate_metric("eval_lap_time_s", label)] = group.mean_lap_time_s
            metrics[evaluate_metric("eval_completion", label)] = group.completion
            metrics |= {
                evaluate_metric(column, label): value for column, value in zigzag_columns(group).items()
            }
        else:
            metrics[evaluate_metric("held_out_completion", label)] = group.completion
    return metrics
