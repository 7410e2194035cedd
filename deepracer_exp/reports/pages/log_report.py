"""The report of a log: one HTML page with findings, figures and tables that needs no other file."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from deepracer_exp.aws.logs.recorded import readable
from deepracer_exp.errors import BadInput, count
from deepracer_exp.files import atomic_write
from deepracer_exp.reports.charts import (
    action_charts,
    driving_line,
    lap_charts,
    mistakes,
    others_charts,
    reward_charts,
    training_charts,
)
from deepracer_exp.reports.charts.figure import Chart
from deepracer_exp.reports.charts.run_charts import generalisation_matrix, generations, policy_of
from deepracer_exp.reports.findings import Finding
from deepracer_exp.reports.tables.against_fastest import fastest_in_words
from deepracer_exp.reports.tables.log_tables import (
    best_laps,
    candidate_rows,
    facts,
    headline,
    iteration_rows,
    problem_rows,
    result_in_words,
)
from deepracer_exp.reports.tables.log_view import LogView
from deepracer_exp.reports.tables.reward_replay import ReplayedRewards
from deepracer_exp.runs.next_steps import next_steps, official_place, outcome
from deepracer_exp.runs.run_files import read_head

from .page import Plot, plot_of, render

if TYPE_CHECKING:
    from .best_drive import BestDrive

MOST_FILES = 400
_BESIDE, _REWARDED = "Generations and tracks", "What the reward function rewards"
_EVALUATED = "The evaluated lap"
_OF_FAILURES = ("What is on the road", "Where it goes wrong")
"""Sections on episodes that were no complete lap."""
_PICTURES = ("evaluated_lap", "lap_line")
"""Figures beside the outcome, of which the first available one is shown."""
SECTIONS: Mapping[str, Sequence[Callable[[LogView], Chart | None]]] = {
    "How it learned": (
        *(
            training_charts.training_progress,
            training_charts.learning_vs_lap_time,
            training_charts.evaluations,
        ),
        *(training_charts.quarters, training_charts.stability),
    ),
    _BESIDE: (),
    "Lap times": (
        *(lap_charts.lap_time_percentile, lap_charts.lap_time_histogram, lap_charts.lap_delta),
        driving_line.against_fastest,
        *(lap_charts.correlations, lap_charts.start_position),
    ),
    "The line it drives": (
        *(driving_line.lap_line, driving_line.sector_times, driving_line.speed_steering_by_waypoint),
        driving_line.zigzag,
        *(driving_line.racing_line, driving_line.acceleration_map, driving_line.slide_map),
    ),
    "What is on the road": (
        *(others_charts.crash_free, others_charts.crashes_by_object, others_charts.crash_places),
        others_charts.overtakes,
    ),
    "Where it goes wrong": (mistakes.off_track_risk, mistakes.episode_ends_map, mistakes.visits_map),
    "What it does": (
        *(
            action_charts.action_use_by_section,
            action_charts.zero_steering_top_speed,
            action_charts.entropy_along_track,
        ),
    ),
    _REWARDED: (
        *(
            reward_charts.reward_map,
            reward_charts.reward_by_waypoint,
            reward_charts.value_map,
            reward_charts.reward_distribution,
        ),
        *(reward_charts.common_rewards, reward_charts.scatter_time_reward, reward_charts.discount_factors),
    ),
    "The track": (driving_line.waypoint_map,),
}
"""The figures of a training, in the order of the page; a new one is added here."""
RACES: Mapping[str, Sequence[Callable[[LogView], Chart | None]]] = {
    "How it raced": (training_charts.evaluations,),
    _BESIDE: (),
    "Lap times": (lap_charts.lap_time_histogram, lap_charts.lap_delta),
    "The line it drives": SECTIONS["The line it drives"][:5],
    "What is on the road": (
        others_charts.crashes_by_object,
        others_charts.crash_places,
        others_charts.overtakes,
    ),
    "Where it goes wrong": (mistakes.episode_ends_map,),
    _REWARDED: (),
    "The track": (driving_line.waypoint_map,),
}
"""The figures of a recording without a training."""
FIRST = (
    *(
        "replayed_laps",
        "evaluated_lap",
        "lap_line",
        "crash_free",
        "crashes_by_object",
        "training_progress",
        "evaluations",
        "lap_time_histogram",
    ),
    *("sector_times", "speed_steering_by_waypoint", "off_track_risk", "racing_line", "reward_by_waypoint"),
)
"""Names of the most important figures: the requested ones, then the result, then the loss of time."""
MOST_FIRST = 6
"""Figures that are open when the page is opened; the others are folded."""


@dataclass(frozen=True)
class LogPage:
    """The contents of a page."""

    view: LogView
    findings: Sequence[Finding]
    """The most important first."""
    replay: ReplayedRewards | None = None
    """The rewards of another function for the same driving."""
    terms: pd.DataFrame | None = None
    """Contribution of each term of the reward function, as `contributed_terms` returns it."""
    best: "BestDrive | None" = None
    """The driving and views of a run's best policy."""


def write_log_page(path: Path, page: LogPage) -> Path:
    """Write the page of a prepared recording atomically.

    Raises:
        OSError: it cannot be written.
    """
    return atomic_write(path, html(page))


def draw_sections(page: LogPage) -> dict[str, list[Chart]]:
    """Return all figures for which there is data by their section, in the order of the page."""
    view = page.view
    drawn: dict[str, list[Chart | None]] = {}
    if page.replay is not None:
        drawn["Another reward function"] = [*reward_charts.replayed_charts(page.replay)]
    sections = SECTIONS if view.trained else RACES
    unknown = _OF_FAILURES if view.laps_only else ()
    lap = page.best.lap if page.best is not None else driving_line.raced_lap(view)
    if lap is not None:
        drawn[_EVALUATED] = [lap]
    drawn |= {
        title: [draw_one(view) for draw_one in some] if title not in unknown else []
        for title, some in sections.items()
    }
    drawn[_BESIDE] += [generations([view]), generalisation_matrix([policy_of(view)])]
    if page.terms is not None:
        drawn[_REWARDED].append(reward_charts.reward_terms(view, page.terms))
    drawable = {title: [chart for chart in some if chart is not None] for title, some in drawn.items()}
    return {title: some for title, some in drawable.items() if some}


def html(page: LogPage) -> str:
    """Return the page of a prepared recording."""
    view, recording = page.view, page.view.recording
    sections = draw_sections(page)
    plots = {chart.name: plot_of(chart) for some in sections.values() for chart in some}
    ranked = sorted(plots, key=lambda name: FIRST.index(name) if name in FIRST else len(FIRST))
    picture = next((name for name in _PICTURES if name in plots), None)
    if picture == "evaluated_lap" and "lap_line" in ranked:
        ranked.append(ranked.pop(ranked.index("lap_line")))
    first = ranked[:MOST_FIRST]
    shown = {"The most important figures": [name for name in first if name != picture]}
    for title, some in sections.items():
        shown[title] = [chart.name for chart in some if chart.name not in first]
    files = [readable(str(file)) for file in recording.files]
    settings = sorted((recording.hyperparameters or {}).items())
    return render(
        __package__,
        "log_report.html.j2",
        list(plots.values()),
        **_first_screen(page),
        name=view.name,
        result=result_in_words(view),
        headline=headline(view),
        picture=None if picture is None else plots[picture],
        findings=[_finding(finding, plots) for finding in page.findings],
        problem_count=count(len(view.problems), "problem") if view.problems else "",
        replay=page.replay,
        candidates=candidate_rows(view),
        trained=view.trained,
        evaluated=bool(view.candidates["evaluated"].any()),
        laps=best_laps(view),
        strip=() if page.best is None else page.best.strip,
        sections=[(title, [plots[name] for name in names]) for title, names in shown.items() if names],
        captions={chart.name: chart.caption for some in sections.values() for chart in some},
        iterations=iteration_rows(view),
        facts=facts(view),
        settings=[(key, value if isinstance(value, str) else json.dumps(value)) for key, value in settings],
        reward=recording.reward_source,
        file_count=count(len(files), "file"),
        files=files[:MOST_FILES],
        files_left_out=max(0, len(files) - MOST_FILES),
        problems=problem_rows(view),
    )


def _first_screen(page: LogPage) -> dict[str, Any]:
    """Return the title, the result in names and values, the place on the official board, and the next steps.

    The title is the experiment's name, of a log that of its file. The next step of a training is in its first finding;
    for a run of ours, commands with their effects follow. They take no checkpoints of the service.
    """
    to_do = [("", finding.sentence) for finding in page.findings[: int(page.view.trained)]]
    folder = page.view.run_folder
    try:
        run = read_head(folder) if folder is not None else None
        if run is not None:
            steps = next_steps(run.path, run.summary) if run.summary else []
            return {
                "title": str(run.config.get("name") or page.view.name),
                "outcome": outcome(run),
                "fastest": fastest_in_words(page.view, run.path),
                "official_place": official_place(run),
                "steps": [*to_do, *steps],
            }
    except BadInput:
        pass  # the page lists which files could not be read
    return {
        "title": page.view.name,
        "outcome": facts(page.view),
        "fastest": None,
        "official_place": None,
        "steps": to_do,
    }


def _finding(finding: Finding, plots: Mapping[str, Plot]) -> dict[str, Any]:
    numbers = dict(finding.values) | {
        f"{key} (threshold)": value for key, value in finding.thresholds.items()
    }
    return {
        "sentence": finding.sentence,
        "figure": finding.figure if finding.figure in plots else None,
        "numbers": [
            (key.replace("_", " "), f"{value:.5g}" if isinstance(value, float) else str(value))
            for key, value in numbers.items()
        ],
    }
