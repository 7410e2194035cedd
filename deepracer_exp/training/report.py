"""The pictures and the page at the end of a run."""

import logging
from collections.abc import Sequence
from pathlib import Path

from deepracer_exp.deepracer.trace import read_trace
from deepracer_exp.env.setup import Course
from deepracer_exp.runs.files import BEST_LAP, LEARNING, METRICS, TRACE

logger = logging.getLogger("deepracer_exp")

PAGE = "report.html"


def write_pictures(run_dir: Path, courses: Sequence[Course]) -> None:
    """Draw `best_lap.png` and `learning.png` from the run's trace and metrics."""
    # Half a second of import that no training waits for.
    import pandas as pd

    from deepracer_exp.analysis.charts.run_pictures import LINE_COLUMNS, driven_lines, learning_curves

    metrics_file = run_dir / METRICS
    if not metrics_file.is_file() or not metrics_file.stat().st_size:
        return
    trace = read_trace(run_dir / TRACE, LINE_COLUMNS)
    figure = driven_lines(trace, {course.name: course.tracks[0] for course in courses})
    figure.savefig(run_dir / BEST_LAP, dpi=120)
    learning_curves(pd.read_json(metrics_file, lines=True)).savefig(run_dir / LEARNING, dpi=120)


def write_run_page(run_dir: Path) -> str | None:
    """Write `report.html`, the page of the whole training; return a line where there is none.

    The training is over, and nothing that happens here spoils it: what went wrong is told, and stands in the log.
    """
    again = f"`deepracer-exp analyze {run_dir.name}` writes it"
    try:
        from deepracer_exp.analysis.findings import findings
        from deepracer_exp.analysis.log_report import LogPage, write_page
        from deepracer_exp.analysis.log_view import prepare
        from deepracer_exp.evaluation.reward_terms import run_terms
        from deepracer_exp.runs.own_recording import read_own_recording

        view, terms = run_terms(prepare(read_own_recording(run_dir)), just_trained=True)
        write_page(run_dir / PAGE, LogPage(view, findings(view), terms=terms))
    except KeyboardInterrupt:
        return f"{PAGE} was left off; {again}"
    except Exception as error:
        note = f"{PAGE} could not be written: {' '.join(f'{type(error).__name__}: {error}'.split())}"
        # Its level is below that of warnings, which commands show: they tell the line.
        logger.info(note, exc_info=True)
        return f"{note}; log.txt has the traceback"
    return None
