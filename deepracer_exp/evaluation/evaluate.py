"""The command that puts a stored policy to the test."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from rich.console import Console

from deepracer_exp.config.evaluation import EvaluateConfig
from deepracer_exp.config.running import TrackingOff
from deepracer_exp.tracking.delivery import deliver_evaluation
from deepracer_exp.tracking.names import evaluate_metric, track_labels

from .checkpoint import read_checkpoint
from .evaluator import Evaluator
from .report import table, write_json
from .result import USUAL, Evaluation
from .run import read_run

if TYPE_CHECKING:
    from .film import Film
    from .scene import View


def evaluate(
    config: EvaluateConfig, video: "tuple[Path, View] | None", out: Console, told: Console
) -> Evaluation:
    """Drive a run's checkpoint under a protocol, print the table and write the JSON file.

    Args:
        config: validated.
        video: file and view of a film of the best lap; None: no film.
        out: for the results.
        told: for what is going on.

    Raises:
        BadInput: the run, the checkpoint, a track or a condition cannot be used, or the machine cannot film.
        RunFailed: a car's state became NaN, or a file cannot be written.
    """
    run = read_run(config.run, Path(config.runs_dir), config.tracking_uri)
    stored = read_checkpoint(run.experiment, run.checkpoints, run.meant(config.checkpoint))
    torch.set_num_threads(1)
    evaluator = Evaluator(run.experiment, config.evaluation)
    film = _film(evaluator, *video) if video is not None else None
    told.print(
        f"{run.path.name}, checkpoint {stored.path.name}: {len(evaluator.trials)} trials", highlight=False
    )
    evaluation = evaluator(stored.networks.policy, film.record if film is not None else None)
    file = write_json(run.path, evaluation, config.evaluation, stored)
    # A file has the name of the option whose place it took.
    own = [name for name, track in run.experiment.tracks.items() if track.file is None]
    trained_on = evaluation.tracks if config.evaluation.tracks is None else own
    out.print(table(evaluation, config.evaluation, trained_on, out))
    out.print(f"\n  results  {file}", soft_wrap=True, highlight=False)
    if film is not None:
        film.write(evaluation, told)
        out.print(f"  video    {film.file}", soft_wrap=True, highlight=False)
    tracking = run.experiment.tracking
    uri = config.tracking_uri or (None if isinstance(tracking, TrackingOff) else tracking.uri)
    files = {file: "evaluations"} | ({} if film is None else {film.file: "films"})
    metrics = _metrics(evaluation, trained_on)
    runs_dir = run.path.resolve().parents[1]
    deliver_evaluation(run.path, uri, runs_dir, stored.counters["env_steps"], metrics, files)
    return evaluation


def _metrics(evaluation: Evaluation, trained_on: Sequence[str]) -> dict[str, float | None]:
    """Return the results as metrics of the run, each track's under its name unless it is the run's only one."""
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


def _film(evaluator: Evaluator, file: Path, view: "View") -> "Film":
    # Only films need a video encoder.
    from .film import Film

    return Film(evaluator, file, view)
