"""The command that puts all checkpoints of a run to the same test."""

import logging
from pathlib import Path

import torch
from rich.console import Console

from deepracer_exp.analysis.checkpoints_figure import Lap, Point, checkpoints_figure
from deepracer_exp.config.evaluation import EvaluateConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.formats.checkpoint_files import LINKS, kept_checkpoints

from .evaluator import Evaluator
from .run import read_run
from .standings import Figures, Recommendation, Standing, recommend, standings
from .standings_report import legend, notes, table, write_json

logger = logging.getLogger("deepracer_exp")


def show_checkpoints(
    config: EvaluateConfig,
    own_trials: bool,
    picture: str | None,
    file: str | None,
    out: Console,
    told: Console,
) -> Recommendation:
    """Drive a run's kept checkpoints under a protocol, show how they did and recommend one.

    Args:
        config: validated; its checkpoint says nothing.
        own_trials: drive the trials of the training and not those of `config`.
        picture: file of the picture; None: none is drawn.
        file: JSON file to write; None: none.
        out: for the results.
        told: for what is going on.

    Raises:
        BadInput: the run, all of its checkpoints, a track or a condition cannot be used, or a file cannot be written.
        RunFailed: a car's state became NaN.
    """
    run = read_run(config.run, Path(config.runs_dir), config.tracking_uri)
    kept = kept_checkpoints(run.checkpoints)
    if not kept:
        raise BadInput(f"{run.checkpoints}: holds no checkpoint")
    for link in (run.checkpoints / label for label in LINKS):
        if link.is_symlink() and not link.exists():
            logger.warning("%s leads nowhere", link)
    torch.set_num_threads(1)
    protocol = run.experiment.evaluation if own_trials else config.evaluation
    evaluator = Evaluator(run.experiment, protocol)
    told.print(
        f"{run.path.name}: {len(kept)} checkpoint{'s' * (len(kept) > 1)}, {len(evaluator.trials)} trials each",
        soft_wrap=True,
    )
    with told.status("") as status:
        found = list(standings(run, evaluator, lambda name: status.update(f"{name} drives")))
    chosen = recommend(found, run.experiment.checkpoints.metric)
    if chosen is None:
        raise BadInput(f"{found[-1].fault}; none in {run.checkpoints} can be used")
    out.print(table(found, chosen, out))
    out.print(legend(found), style="dim", soft_wrap=not out.is_terminal)
    out.print()
    for line in notes(found, chosen):
        # A terminal is read, a pipe is searched.
        out.print(line, soft_wrap=not out.is_terminal)
    out.print(f"  checkpoint={chosen.name} chooses it in evaluate, export and clone")
    try:
        if file is not None:
            write_json(Path(file), run.path, protocol, found, chosen)
        if picture is not None:
            points = [_point(one, one.figures) for one in found if one.figures is not None]
            checkpoints_figure(run.path.name, points, chosen.name).savefig(picture)
            out.print(f"\n{picture}: speed against stability", soft_wrap=True)
    except (OSError, ValueError) as error:
        raise BadInput(f"{picture if file is None else file}: cannot be written: {error}") from error
    return chosen


def _point(one: Standing, found: Figures) -> Point:
    low, high = found.lap_share_interval or (found.lap_share, found.lap_share)
    return Point(
        name=one.name,
        labels=", ".join([*one.labels, *["pinned"] * bool(one.pinned)]),
        usual=Lap(found.lap_time_p25_s, 100 * found.lap_share),
        interval=(100 * low, 100 * high),
        held_out=(
            None
            if found.held_out_lap_share is None
            else Lap(found.held_out_lap_time_p25_s, 100 * found.held_out_lap_share)
        ),
    )
