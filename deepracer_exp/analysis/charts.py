"""All charts of a log in the order of its page."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import pandas as pd

from .chart import Chart
from .charts_of_actions import action_use_by_section, entropy_along_track, zero_steering_top_speed
from .charts_of_correlations import correlations
from .charts_of_episodes import (
    common_rewards,
    discount_factors,
    reward_distribution,
    scatter_time_reward,
    start_position,
)
from .charts_of_laps import lap_delta, lap_time_histogram, lap_time_percentile
from .charts_of_rewards import reward_by_waypoint, reward_map, reward_terms, value_map
from .charts_of_runs import generalisation_matrix, generations, runs_compared
from .charts_of_stability import stability
from .charts_of_track import episode_ends_map, off_track_risk, visits_map, waypoint_map
from .charts_of_track_line import racing_line, sector_times, speed_steering_by_waypoint
from .charts_of_track_motion import acceleration_map, lap_line, slide_map
from .charts_of_training import evaluations, learning_vs_lap_time, quarters, training_progress
from .log_view import LogView
from .run_folders import clone_chain, evaluation_results

_BESIDE, _PAID = "Generations, runs and tracks", "What it is paid for"
SECTIONS: Mapping[str, Sequence[Callable[[LogView], Chart | None]]] = {
    "How it learned": (training_progress, learning_vs_lap_time, evaluations, quarters, stability),
    _BESIDE: (),
    "Lap times": (lap_time_percentile, lap_time_histogram, lap_delta, correlations, start_position),
    "The line it drives": (
        *(lap_line, sector_times, speed_steering_by_waypoint, racing_line, acceleration_map, slide_map),
    ),
    "Where it goes wrong": (off_track_risk, episode_ends_map, visits_map),
    "What it does": (action_use_by_section, zero_steering_top_speed, entropy_along_track),
    _PAID: (
        *(reward_map, reward_by_waypoint, value_map, reward_distribution, common_rewards),
        *(scatter_time_reward, discount_factors),
    ),
    "The course": (waypoint_map,),
}
"""Charts of one recording."""


RACES: Mapping[str, Sequence[Callable[[LogView], Chart | None]]] = {
    "How it raced": (evaluations,),
    _BESIDE: (),
    "Lap times": (lap_time_histogram, lap_delta),
    "The line it drives": (lap_line, sector_times, speed_steering_by_waypoint, racing_line),
    "Where it goes wrong": (episode_ends_map,),
    _PAID: (),
    "The course": (waypoint_map,),
}
"""Charts of a recording without a training: nothing of iterations."""


@dataclass(frozen=True)
class Section:
    """Charts that belong together."""

    title: str
    charts: Sequence[Chart]


def draw_sections(
    view: LogView, others: Sequence[LogView] = (), terms: pd.DataFrame | None = None
) -> list[Section]:
    """Return all charts that there is something to draw of, in the order of the page.

    Args:
        view: the recording.
        others: what stands beside it.
        terms: of its reward function, as `reward_terms` takes them.
    """
    sections = SECTIONS if view.trained else RACES
    drawn = {title: _drawn(one(view) for one in some) for title, some in sections.items()}
    if terms is not None:
        drawn[_PAID] += _drawn([reward_terms(view, terms)])
    views = [view, *others]
    beside = (
        runs_compared(views),
        generations(clone_chain(views) or [view]),
        generalisation_matrix(views, [evaluation_results(one) for one in views]),
    )
    drawn[_BESIDE] += _drawn(beside)
    return [Section(title, charts) for title, charts in drawn.items() if charts]


def _drawn(charts: Iterable[Chart | None]) -> list[Chart]:
    return [chart for chart in charts if chart is not None]
