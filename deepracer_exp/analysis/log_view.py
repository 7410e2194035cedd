"""One course of a recording, prepared for figures and findings."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from deepracer_exp.errors import BadInput
from deepracer_exp.formats.recording import TRAINING, LogProblem, Recording
from deepracer_exp.tracks.track import Track

from .episode_table import episode_table, first_rows
from .iteration_table import iteration_table
from .log_course import catalogue_track, directed, estimated_course, find_courses, numbered_as_logged
from .step_columns import add_derived

DISCOUNT = 0.99
"""Where the hyperparameters tell none: the service's default."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LogView:
    """A recording on one course; made by `prepare`."""

    name: str
    recording: Recording
    course: Track | None
    """None: not known; what needs its shape is then left out."""
    track_name: str
    """Name of the course as logged, "" where it is neither told nor found."""
    trained: bool
    """Whether a training is recorded; else `steps` and `episodes` are those of the evaluations and races, numbered
    through."""
    steps: pd.DataFrame
    """Training steps on the course, ordered by episode and time, prepare rows among them; columns
    `recording.STEP_COLUMNS` and `step_columns.DERIVED_COLUMNS`."""
    episodes: pd.DataFrame
    """Their episodes, `episode_table.EPISODE_COLUMNS`."""
    iterations: pd.DataFrame
    """Their iterations, `iteration_table.ITERATION_COLUMNS`."""
    evaluations: pd.DataFrame
    """Steps on the course of all other streams, ordered by stream, episode and time, with the same columns."""
    evaluation_episodes: pd.DataFrame
    """Their episodes, with `stream`."""
    problems: tuple[LogProblem, ...]
    """Those of the recording and of its courses."""
    discount: float
    """Factor on the reward of the next step, in `discounted_future_reward`."""

    @property
    def action_count(self) -> int | None:
        """Return how many actions a discrete policy has, None of a continuous one."""
        if not self.steps["action"].notna().any():
            return None
        metadata = self.recording.metadata
        return len(metadata.actions if metadata is not None else ()) or int(self.steps["action"].max()) + 1


def prepare(recording: Recording, track: str | None = None) -> LogView:
    """Prepare one course of a recording.

    Args:
        recording: what was recorded.
        track: a course of its steps; None: the one with the most training steps. A name of the catalogue or a file
            (.npy route, .yaml knots) says which course it is where the log's own name does not.

    Raises:
        BadInput: the recording has no steps on the course.
    """
    steps = recording.steps
    if not len(steps):
        raise BadInput(f"{recording.name}: no control steps; accepted: a training or a race with its trace")
    names = steps["track"].astype("category")
    training = (steps["stream"] == TRAINING).to_numpy()
    counts = names[training if training.any() else slice(None)].value_counts()
    logged = [str(name) for name in counts.index if counts[name] > 0]
    name = track if track in logged else logged[0]
    if track is not None and track not in logged and len(logged) > 1:
        raise BadInput(f"{recording.name}: track={track} was not driven on; accepted: {', '.join(logged)}")
    courses = find_courses(recording)
    here = (names == name).to_numpy()
    course, problems = courses.tracks.get(name), courses.problems
    if track is not None and track not in logged:
        course, problems = directed(catalogue_track(track), catalogue_track(track, True), steps[here]), ()
    driven_on = steps[here]
    course = estimated_course(name, driven_on) if course is None else numbered_as_logged(course, driven_on)
    discount = float((recording.hyperparameters or {}).get("discount_factor", DISCOUNT))
    trained, first = _ordered(steps, here & training)
    driven, evaluation_first = _ordered(steps, here & ~training)
    trained = add_derived(trained, first, course, discount)
    driven = add_derived(driven, evaluation_first, course, discount)
    episodes = episode_table(trained, first)
    evaluation_episodes = episode_table(driven, evaluation_first)
    streams = driven["stream"].to_numpy()[np.flatnonzero(evaluation_first)]
    evaluation_episodes = evaluation_episodes.assign(stream=streams)
    iterations = iteration_table(recording, trained, episodes)
    if not training.any():
        number = np.cumsum(evaluation_first) - 1
        trained = driven.assign(episode=number)
        episodes = evaluation_episodes.assign(episode=np.arange(len(evaluation_episodes)))
    return LogView(
        name=recording.name,
        trained=bool(training.any()),
        recording=recording,
        course=course,
        track_name=name or (course.name if course is not None else ""),
        steps=trained,
        episodes=episodes,
        iterations=iterations,
        evaluations=driven,
        evaluation_episodes=evaluation_episodes,
        problems=(*recording.problems, *problems),
        discount=discount,
    )


def _ordered(steps: pd.DataFrame, wanted: NDArray[np.bool_]) -> tuple[pd.DataFrame, NDArray[np.bool_]]:
    """Return the wanted rows, episode by episode, and whether each is its episode's first one."""
    rows = steps if wanted.all() else steps[wanted]
    streams, episodes = rows["stream"].astype("category").cat.codes.to_numpy(), rows["episode"].to_numpy()
    key = streams.astype(np.int64) * (int(episodes.max(initial=0)) + 1) + episodes
    if (np.diff(key) < 0).any():
        rows = rows.iloc[np.argsort(key, kind="stable")]
    return rows.reset_index(drop=True), first_rows(rows)
