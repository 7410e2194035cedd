"""The pictures at the end of a run."""

from collections.abc import Sequence
from pathlib import Path

from deepracer_exp.env.courses import Course
from deepracer_exp.formats.trace import read_trace


def write_report(run_dir: Path, courses: Sequence[Course]) -> None:
    """Draw `best_lap.png` and `learning.png` from the run's trace and metrics."""
    # Half a second of import that no training waits for.
    import pandas as pd

    from deepracer_exp.analysis.figures import LINE_COLUMNS, driven_line, driven_lines, learning_curves

    metrics_file = run_dir / "metrics.jsonl"
    if not metrics_file.is_file():
        return
    trace = read_trace(run_dir / "trace", LINE_COLUMNS)
    if len(courses) == 1:
        figure = driven_line(trace, courses[0].tracks[0])
    else:
        figure = driven_lines(trace, {course.name: course.tracks[0] for course in courses})
    figure.savefig(run_dir / "best_lap.png", dpi=120)
    learning_curves(pd.read_json(metrics_file, lines=True)).savefig(run_dir / "learning.png", dpi=120)
