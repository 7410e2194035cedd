"""One HTML page that tells all of a log, findings first, and needs nothing beside it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from deepracer_exp.errors import BadInput
from deepracer_exp.formats.recording import Recording, readable
from deepracer_exp.formats.run_files import read_head
from deepracer_exp.formats.whole_file import write_whole

from .chart import Chart
from .chart_plotly import draw
from .chart_plotly_panel import NARROW_WIDTH
from .charts import Section, draw_sections
from .findings import Finding, findings
from .log_tables import (
    MOST_FILES,
    best_laps,
    candidate_rows,
    count,
    facts,
    headline,
    iteration_rows,
    problem_rows,
    settings,
)
from .log_view import LogView, prepare
from .next_steps import next_steps, outcome
from .page import Plot, plot, render
from .reward_comparison import RewardComparison
from .run_folders import run_folder


def write_report(
    recording: Recording,
    path: Path,
    compare: Sequence[Recording] = (),
    target_s: float | None = None,
    replay: RewardComparison | None = None,
) -> Path:
    """Write the page of a recording, whole or not at all.

    Args:
        recording: what was recorded.
        path: of the page.
        compare: other recordings to stand beside it.
        target_s: lap time whose chance is told.
        replay: of another reward function.

    Raises:
        BadInput: a recording has no steps.
        OSError: the page cannot be written.
    """
    view = prepare(recording)
    others = [prepare(other) for other in compare]
    return write_page(path, LogPage(view, findings(view, target_s), others, replay))


@dataclass(frozen=True)
class LogPage:
    """What a page tells."""

    view: LogView
    findings: Sequence[Finding]
    """The most important first."""
    others: Sequence[LogView] = ()
    """Views of the recordings beside it."""
    replay: RewardComparison | None = None
    """What another reward function makes of it."""
    terms: pd.DataFrame | None = None
    """What each term of its reward function contributed, as `charts_of_rewards.reward_terms` takes it."""


def write_page(path: Path, page: LogPage) -> Path:
    """Write the page of a prepared recording, whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    return write_whole(path, html(page))


def html(page: LogPage) -> str:
    """Return the page of a prepared recording."""
    view, recording = page.view, page.view.recording
    sections = draw_sections(view, page.others, page.terms)
    if page.replay is not None and page.replay.charts:
        sections = [Section("Another reward function", page.replay.charts), *sections]
    drawn = [(section.title, [_Figure.of(chart) for chart in section.charts]) for section in sections]
    figures = {figure.name: figure for _, some in drawn for figure in some}
    came_of_it, steps = _first_screen(page)
    files = [readable(str(file)) for file in recording.files]
    return render(
        __package__,
        "log_report.html.j2",
        [figure.plot for figure in figures.values()],
        name=view.name,
        headline=headline(view),
        outcome=came_of_it,
        steps=steps,
        picture=figures["lap_line"].plot if "lap_line" in figures else None,
        findings=[_finding(one, figures) for one in page.findings],
        problem_count=count(len(view.problems), "problem") if view.problems else "",
        names=set(figures),
        replay=page.replay,
        candidates=candidate_rows(view),
        laps=best_laps(view),
        sections=[{"title": title, "figures": some} for title, some in drawn],
        iterations=iteration_rows(view),
        facts=facts(view),
        settings=settings(recording.hyperparameters),
        reward=recording.reward_source,
        file_count=count(len(files), "file"),
        files=files[:MOST_FILES],
        files_left_out=max(0, len(files) - MOST_FILES),
        problems=problem_rows(view),
    )


def _first_screen(page: LogPage) -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """Return what came of a training, in names and values, and what to do next: commands, each with what it does.

    No command of ours takes a checkpoint of the service: what to do with those is to submit one of them.
    """
    folder = run_folder(page.view)
    try:
        run = read_head(folder) if folder is not None else None
        if run is not None:
            return outcome(run), next_steps(run.path, run.summary) if run.summary else []
    except BadInput:
        pass  # the page lists which files could not be read
    return facts(page.view), [("", one.sentence) for one in page.findings if one.rule == "submit"]


@dataclass(frozen=True)
class _Figure:
    """A figure as the template takes it."""

    name: str
    title: str
    caption: str
    plot: Plot

    @classmethod
    def of(cls, chart: Chart) -> "_Figure":
        packed = plot(draw(chart), chart.name, chart.title, draw(chart, NARROW_WIDTH))
        return cls(chart.name, chart.title, chart.caption, packed)


def _finding(one: Finding, figures: Mapping[str, _Figure]) -> dict[str, Any]:
    numbers = [*one.values.items(), *((f"{key} (threshold)", value) for key, value in one.thresholds.items())]
    return {
        "sentence": one.sentence,
        "figure": one.figure if one.figure in figures else None,
        "numbers": [(key.replace("_", " "), _shown(value)) for key, value in numbers],
    }


def _shown(value: object) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)
