"""The pictures of a training are drawn once for each kind of run: they were a third of a tiny training's time."""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path

from deepracer_exp.env.setup import Course
from deepracer_exp.reports.run_page import write_pictures
from deepracer_exp.runs.files import METRICS, TRACE, read_metrics
from deepracer_exp.runs.trace import has_trace, read_others
from deepracer_exp.training import callbacks

_drawn: set[object] = set()


def _kind(run_dir: Path, courses: Sequence[Course]) -> object:
    """Return what decides how the pictures of a run look, apart from numbers."""
    rows = read_metrics(run_dir / METRICS) if (run_dir / METRICS).is_file() else []
    values = frozenset(name for row in rows for name, value in row.items() if value is not None)
    others = read_others(run_dir / TRACE)
    columns = None if others is None else tuple(others.column_names)
    return values, tuple(course.name for course in courses), has_trace(run_dir / TRACE), columns


def _draw_new_kinds(run_dir: Path, courses: Sequence[Course]) -> None:
    kind = _kind(run_dir, courses)
    if kind not in _drawn:
        write_pictures(run_dir, courses)
        _drawn.add(kind)


def draw_each_kind_once() -> None:
    """Let trainings in this process draw pictures only where no run like theirs has been drawn."""
    callbacks.write_pictures = _draw_new_kinds


@contextlib.contextmanager
def all_drawn() -> Iterator[None]:
    """Let trainings draw their pictures, as they do without tests."""
    before, callbacks.write_pictures = callbacks.write_pictures, write_pictures
    try:
        yield
    finally:
        callbacks.write_pictures = before
