"""The pictures and the page of a training."""

import logging
import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.racing import RaceConfig
from deepracer_exp.env.others.placement import box_corners_of, read_placements
from deepracer_exp.env.setup import Course
from deepracer_exp.runs.next_steps import COMMAND, own_word
from deepracer_exp.runs.run_files import BEST_LAP, LEARNING, METRICS, REPORT, TRACE, read_config
from deepracer_exp.runs.run_result import FINISHED, STOPPED_EARLY
from deepracer_exp.runs.trace import has_trace, missing_trace, read_others, read_trace
from deepracer_exp.tracks.track import Track
from deepracer_exp.training.train_result import TrainResult
from deepracer_exp.training.trainer import Callback, Trainer

logger = logging.getLogger("deepracer_exp")


class RunReport(Callback):
    """Draws the pictures of a run, and writes its report once it is over: a callback of the training."""

    def on_train_end(self, trainer: Trainer) -> None:
        """Draw best_lap.png and learning.png; no error here ends a training."""
        try:
            write_pictures(trainer.folder.path, trainer.setup.courses, trainer.metrics.on_usual)
        except Exception as error:
            logger.warning("%s and %s could not be drawn: %r", BEST_LAP, LEARNING, error, exc_info=True)

    def on_run_end(self, trainer: Trainer, result: TrainResult) -> None:
        """Write report.html if `report` is on and the run is over, with at least one iteration."""
        if trainer.experiment.report and trainer.iteration and result.status in (FINISHED, STOPPED_EARLY):
            result.note = write_run_page(trainer.folder.path, trainer.experiment.car)


def write_pictures(run_dir: Path, courses: Sequence[Course], on_usual: NDArray[np.bool_]) -> None:
    """Draw `best_lap.png` and `learning.png` from the run's trace and metrics, if it has an iteration.

    Without a trace (`trace=off`, or no lap yet with `trace=laps`) there is no best_lap.png. `on_usual` says of each
    car whether it drives on usual conditions.
    """
    # Imported here: it takes half a second, which the start of a training need not wait for.
    import pandas as pd
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from deepracer_exp.reports.charts.run_pictures import LINE_COLUMNS, driven_lines, learning_curves

    metrics_file = run_dir / METRICS
    if not metrics_file.is_file() or not metrics_file.stat().st_size:
        return
    trace = read_trace(run_dir / TRACE, LINE_COLUMNS) if has_trace(run_dir / TRACE) else None
    tracks = {course.name: course.tracks[0] for course in courses}
    others = read_others(run_dir / TRACE)
    boxes_of = None
    if others is not None:
        placed = read_placements(others)
        race = TypeAdapter(RaceConfig).validate_python(read_config(run_dir)["race"])

        def boxes_of(track: Track, episode: int) -> NDArray[np.float64]:
            drawn = placed[track.reversed].get(episode)
            return np.zeros((0, 4, 2)) if drawn is None else box_corners_of(race, track, drawn)

    figures = {LEARNING: learning_curves(pd.read_json(metrics_file, lines=True))}
    if trace is not None:
        figures[BEST_LAP] = driven_lines(trace, tracks, boxes_of, on_usual)
    for name, figure in figures.items():
        # `savefig` draws a figure twice, the first time for its layout alone.
        FigureCanvasAgg(figure).print_png(run_dir / name)


def write_run_page(run_dir: Path, car: CarConfig) -> str | None:
    """Write `report.html`; return a line if there is no trace or an error, since no error here ends a training."""
    if not has_trace(run_dir / TRACE):
        return f"no {REPORT}, no {BEST_LAP}: the run {missing_trace(run_dir)}"
    try:
        from deepracer_exp.reports.findings import findings
        from deepracer_exp.reports.tables.log_view import prepare
        from deepracer_exp.reports.tables.reward_terms import run_terms
        from deepracer_exp.runs.recording import read_run_recording

        from .best_drive import drive_best
        from .log_report import LogPage, write_log_page

        view, terms = run_terms(prepare(read_run_recording(run_dir)), car, just_trained=True)
        view, best = drive_best(view, run_dir, just_trained=True)
        write_log_page(run_dir / REPORT, LogPage(view, findings(view), terms=terms, best=best))
    except KeyboardInterrupt:
        return f"{REPORT} was left off; `{COMMAND} analyze {shlex.quote(own_word(run_dir))}` writes it"
    except Exception as error:
        note = f"{REPORT} could not be written: {' '.join(f'{type(error).__name__}: {error}'.split())}"
        # Commands print the line; warnings would be shown twice.
        logger.info(note, exc_info=True)
        return f"{note}; log.txt has the traceback"
    return None
