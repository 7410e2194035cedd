"""The page that compares several of a kind, runs or checkpoints: a title, sentences, tables and figures."""

from collections.abc import Sequence
from pathlib import Path

from deepracer_exp.files import atomic_write
from deepracer_exp.reports.charts.figure import Chart
from deepracer_exp.reports.tables.log_tables import Table

from .page import plot_of, render


def write_comparison(
    path: Path,
    title: str,
    sentences: Sequence[str],
    tables: Sequence[tuple[str, Table, str]],
    charts: Sequence[Chart],
) -> Path:
    """Write the page atomically; each table has a title before it and a note after it, which may be empty.

    Raises:
        OSError: it cannot be written.
    """
    page = render(
        __package__,
        "comparison.html.j2",
        [plot_of(chart) for chart in charts],
        title=title,
        sentences=sentences,
        tables=tables,
        captions={chart.name: chart.caption for chart in charts},
    )
    return atomic_write(path, page)
