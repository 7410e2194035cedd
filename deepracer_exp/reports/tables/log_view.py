"""A recording on one course, prepared for figures and findings."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from deepracer_exp.aws.logs.recorded import TRAINING, LogProblem, Recording
from deepracer_exp.aws.models.hyperparameters import Hyperparameters
from deepracer_exp.env.others.placement import PlacedOthers, box_corners_of, rebuild_poses
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.recording import EvaluationRecording, RunRecording
from deepracer_exp.runs.run_files import METRICS
from deepracer_exp.tracks.track import Track
from deepracer_exp.training.stopping.judge import Convergence, convergence

from .log_course import (
    catalogue_track,
    directed,
    driven_against,
    estimated_course,
    find_courses,
    numbered_as_logged,
    was_driven_on,
)
from .others_on_road import OthersOnRoad, others_on_road, placed_in_log
from .step_columns import add_derived, first_rows, timed_by_service
from .tables import candidates, episode_table, iteration_table

DISCOUNT = Hyperparameters().discount_factor
"""Discount of logs without hyperparameters: the service's default."""
ONE_WAY = "driven in both directions: the episodes against that of the first ones are left out"
_ALTERNATES = 0.1
"""Share of rows driven against the course beyond which a training alternates: no car drives back that often."""
PREPARE = "prepare"
"""Status of the row in which an episode starts, before the first action."""
LEAST_LAPS = 5
"""Complete laps in the last third of the iterations below which those of the whole log are used instead."""
LEAST_EPISODES = 5
"""Fewest episodes of a meaningful iteration: SAC updates its policy after each one."""
FINISHED = 0.75
"""Share of the usual number of episodes below which the job ended in the last iteration: its few starting places make
it easier or harder than the others."""
STARTING_STEPS = 10
"""First control steps of an episode, in which the car pulls away from standing."""

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


@dataclass(frozen=True, kw_only=True, eq=False)
class LogView:
    """A recording on one course, as `prepare` returns it."""

    name: str
    recording: Recording
    course: Track | None
    """The track; None if it is unknown, and figures that need its shape are left out."""
    track_name: str
    """Name of the course as logged, "" if it was neither logged nor recognised."""
    trained: bool
    """Whether a training is recorded; else `steps` and `episodes` are those of the evaluations and races, with
    consecutive numbers."""
    steps: pd.DataFrame
    """Training steps on the course, ordered by episode and time, prepare rows among them; columns
    `recording.STEP_COLUMNS` and `tables.DERIVED_COLUMNS`."""
    episodes: pd.DataFrame
    """Their episodes, `tables.EPISODE_COLUMNS`."""
    iterations: pd.DataFrame
    """Their iterations, `tables.ITERATION_COLUMNS`."""
    judged: pd.DataFrame
    """Rows that judge a training: its iterations, or blocks of them where they have fewer than `LEAST_EPISODES`; logs
    of the service leave out the one in which the job ended."""
    in_blocks: bool
    """Whether several iterations are judged together."""
    evaluation_episodes: pd.DataFrame
    """Episodes on the course of all other streams, with `stream`."""
    evaluation_steps: pd.DataFrame
    """Their steps, with the columns of `steps`."""
    laps_timed: int
    """Number of complete laps whose time is from a metrics file; other times are counted from the rows."""
    problems: tuple[LogProblem, ...]
    """Problems of the recording and of its courses."""
    discount: float
    """Factor on the reward of the next step, in `discounted_future_reward`."""
    others: OthersOnRoad | None = None
    """The others around the cars of `steps`; None where the car was alone, or their places are not known."""
    placed: PlacedOthers | None = None
    """Their placements in each episode."""
    run: RunRecording | None = None
    """The records that only a run of ours has; None for a log of the service."""

    def boxes_of(self, episode: int) -> NDArray[np.float64]:
        """Return the corners of the boxes of an episode of `steps`, (k, 4, 2); none where these are not known."""
        placed, course = self.placed, self.course
        drawn = None if placed is None or course is None else placed.on(course).get(episode)
        if placed is None or course is None or drawn is None:
            return np.zeros((0, 4, 2))
        return box_corners_of(placed.race, course, drawn)

    def others_at(self, rows: pd.DataFrame) -> NDArray[np.float64] | None:
        """Return x and y of the others at rows of one episode of `steps`, (n, K, 2); None where they are not known."""
        placed, course = self.placed, self.course
        if placed is None or course is None:
            return None
        drawn = placed.on(course).get(int(rows["episode"].iloc[0]))
        if drawn is None:
            return None
        step = rows["steps"].to_numpy(np.int64)
        same = np.zeros(len(rows), np.intp)
        poses, _ = rebuild_poses(placed.race, course, [drawn], placed.period_s, same, step)
        return poses[..., :2]

    @property
    def laps_only(self) -> bool:
        """Whether the steps are those of complete laps only, so that the ends of other episodes are not known."""
        return self.run is not None and self.run.laps_only

    @property
    def run_folder(self) -> Path | None:
        """The folder of a run of ours, None of other recordings."""
        return next((file.parent for file in self.recording.files if file.name == METRICS), None)

    @property
    def stopping(self) -> Mapping[str, Any] | None:
        """The group `stopping` of a run of ours."""
        return None if self.run is None else self.run.stopping

    @property
    def decision(self) -> Mapping[str, Any] | None:
        """The decision of the stopping rule that ended a run of ours."""
        return None if self.run is None else self.run.decision

    @property
    def action_count(self) -> int | None:
        """Number of actions of a discrete policy, None of a continuous one."""
        if not self.steps["action"].notna().any():
            return None
        metadata = self.recording.metadata
        return len(metadata.actions if metadata is not None else ()) or int(self.steps["action"].max()) + 1

    @property
    def lap_word(self) -> str:
        """Return the name of a lap of `episodes`: a training's is an exploring one."""
        return "exploring lap" if self.trained else "lap"

    @property
    def untraced(self) -> int:
        """Number of finished episodes of the training that are known from metrics files only."""
        more = int(self.iterations["episodes"].sum() - self.episodes["ended"].sum())
        return max(0, more) if self.trained else 0

    @property
    def traced(self) -> str:
        """Return the words after a number of episodes that are counted in the traces."""
        return " with a trace" if self.untraced else ""

    @cached_property
    def candidates(self) -> pd.DataFrame:
        """Checkpoints worth submitting, the best first, `tables.CANDIDATE_COLUMNS`.

        Findings, tables and figures quote this choice. There are none of our own runs, which keep few checkpoints and
        have evaluated them.
        """
        return candidates(self.recording, self.judged).iloc[: None if self.run is None else 0]

    @cached_property
    def convergence(self) -> Convergence | None:
        """Where the training converged; None where it is too short to say, or a stopping rule has decided.

        Findings and figures quote this.
        """
        if self.decision is not None:
            return None
        return convergence(self.judged, self.action_count, self.stopping)

    @property
    def waypoint_count(self) -> int:
        """Number of waypoints of the course, or where it is unknown of those in the log."""
        logged = int(self.steps["closest_waypoint"].max()) + 1 if len(self.steps) else 0
        return logged if self.course is None else max(len(self.course.waypoints), logged)

    @cached_property
    def is_driven(self) -> NDArray[np.bool_]:
        """Whether each row of `steps` follows an action; prepare rows do not, and have no reward."""
        return (self.steps["episode_status"] != PREPARE).to_numpy()

    @cached_property
    def episode_index(self) -> NDArray[np.intp]:
        """Position in `episodes` of the episode of each row of `steps`."""
        episode = self.steps["episode"].to_numpy()
        return np.cumsum(np.diff(episode, prepend=episode[:1]) != 0)

    def driven(self, *columns: str) -> pd.DataFrame:
        """Return columns of the training's driven rows."""
        kept = self._driven_columns
        for name in columns:
            if name not in kept:
                kept[name] = self.steps[name].to_numpy()[self._driven_rows]
        return pd.DataFrame({name: kept[name] for name in columns}, copy=False)

    @cached_property
    def _driven_rows(self) -> NDArray[np.intp]:
        return np.flatnonzero(self.is_driven)

    @cached_property
    def _driven_columns(self) -> dict[str, NDArray[Any]]:
        """Columns of the driven rows that a figure has asked for; many figures need the same ones."""
        return {}

    def recent(self, *columns: str) -> pd.DataFrame:
        """Return columns of the driven rows of the last third of the iterations: of the policy as it is now."""
        return self._select(self._is_recent, columns)

    @cached_property
    def _is_recent(self) -> NDArray[np.bool_]:
        return self.is_driven & (thirds(self.steps["iteration"].to_numpy()) == 2)

    def now(self, least_laps: int = 0) -> tuple[pd.DataFrame, str]:
        """Return the finished episodes that represent the present policy, and their description.

        They are those of the last third of the iterations, or of all if that has fewer than `least_laps` complete laps;
        with `least_laps` those `on_usual` conditions alone, because lap times of cars that differ do not compare.
        """
        ended = self.episodes["ended"].to_numpy(bool)
        if not self.trained:
            return self.episodes[ended], "in the evaluations"
        alike = ""
        if least_laps and not self.on_usual.all():
            ended, alike = ended & self.on_usual, " on usual conditions"
        third = thirds(self.episodes["iteration"].to_numpy()) == 2
        late = self.episodes[ended & third]
        if late["lap_time_s"].notna().sum() < least_laps:
            return self.episodes[ended], f"in the {'traces' if self.untraced else 'training'}{alike}"
        begin = self.episodes["iteration"][third].min()
        return late, f"since iteration {begin}{' of the traces' * bool(self.untraced)}{alike}"

    @cached_property
    def on_usual(self) -> NDArray[np.bool_]:
        """Whether each of `episodes` was driven on usual conditions; all where no car differs, or all do."""
        return _on_usual(self.episodes, self.run if self.trained else None)

    @cached_property
    def comparable(self) -> pd.DataFrame:
        """Episodes whose laps compare: those `on_usual`, or all where none of these is a lap."""
        return self.episodes[_comparable(self.episodes, self.on_usual)]

    def of_episodes(self, wanted: NDArray[np.bool_], *columns: str) -> pd.DataFrame:
        """Return columns of the driven rows of the wanted episodes, (n,) in the order of `episodes`."""
        rows = self.rows_of(wanted)
        return self._taken(rows[self.is_driven[rows]], columns)

    def rows_of(self, wanted: NDArray[np.bool_]) -> NDArray[np.intp]:
        """Return the numbers of the rows in `steps` of the wanted episodes, (n,) in the order of `episodes`."""
        begin = self.begins[:-1][wanted]
        counts = self.begins[1:][wanted] - begin
        ends = np.cumsum(counts)
        return np.arange(counts.sum()) + np.repeat(begin - ends + counts, counts)

    @cached_property
    def begins(self) -> NDArray[np.intp]:
        """First row of each episode, and the number of all rows."""
        return np.append(np.flatnonzero(np.diff(self.episode_index, prepend=-1)), len(self.steps))

    def fastest_lap(self, *columns: str) -> pd.DataFrame | None:
        """Return columns of the driven rows of the fastest `comparable` lap, None without a lap."""
        laps_s = self.comparable["lap_time_s"].dropna()
        if laps_s.empty:
            return None
        return self.of_episodes(self.episodes.index == laps_s.idxmin(), *columns)

    def _select(self, wanted: NDArray[np.bool_], columns: Sequence[str]) -> pd.DataFrame:
        return self._taken(np.flatnonzero(wanted), columns)

    def _taken(self, rows: NDArray[np.intp], columns: Sequence[str]) -> pd.DataFrame:
        # Column by column: a frame of all columns would take seconds on millions of rows.
        return pd.DataFrame({name: self.steps[name].to_numpy()[rows] for name in columns}, copy=False)


def _on_usual(episodes: pd.DataFrame, run: RunRecording | None) -> NDArray[np.bool_]:
    """Return whether each episode was driven on usual conditions; all where no car differs, or all do."""
    everywhere = np.ones(len(episodes), bool)
    if run is None or run.usual_episodes is None:
        return everywhere
    on_usual = np.isin(episodes["episode"].to_numpy(), run.usual_episodes)
    return on_usual if on_usual.any() else everywhere


def _comparable(episodes: pd.DataFrame, on_usual: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return whether each episode's lap compares: those on usual conditions, or all where none of these is a lap."""
    has_lap = episodes["lap_time_s"].notna().to_numpy()
    return on_usual if (has_lap & on_usual).any() else np.ones(len(episodes), bool)


def thirds(iteration: NDArray[np.integer]) -> NDArray[np.intp]:
    """Return the third of the training, 0 to 2, that each iteration belongs to."""
    first, last = (int(iteration.min()), int(iteration.max())) if len(iteration) else (0, 0)
    # Counted from the end, so that with one or two iterations the last one is in the last third.
    third = 2 - 3 * np.arange(last - first, -1, -1) // (last - first + 1)
    # Looked up, because dividing millions of rows takes ten times as long.
    return third[iteration - first]


def closest_waypoints(steps: pd.DataFrame) -> NDArray[np.intp]:
    """Return the closest waypoint of each row; -1 where none is logged."""
    return np.maximum(steps["closest_waypoint"].to_numpy(np.intp), -1)


def prepare(log: Recording | RunRecording | EvaluationRecording, track: str | None = None) -> LogView:
    """Prepare one course of a recording.

    Args:
        log: the recording, of any format.
        track: a course of its steps; None: the one with the most training steps (of races: with the most steps). If
            the log's own name of the course is unknown, a name of the catalogue or a file (.npy route, .yaml knots)
            replaces it.

    Raises:
        BadInput: the recording has no steps on the course.
    """
    run = log if isinstance(log, RunRecording) else None
    recording = log if isinstance(log, Recording) else log.recording
    steps = recording.steps
    if not len(steps):
        raise BadInput(recording.name, "no control steps", "a training or a race with its trace")
    names = steps["track"].astype("category")
    training = (steps["stream"] == TRAINING).to_numpy()
    rows, of_training = names.value_counts(), names[training].value_counts()
    logged = sorted(
        map(str, names.cat.categories), key=lambda stream: (of_training[stream], rows[stream]), reverse=True
    )
    name = track if track in logged else logged[0]
    if track is not None and track not in logged and len(logged) > 1:
        raise BadInput(recording.name, f"track={track} was not driven on", ", ".join(logged))
    tracks, problems = find_courses(recording)
    here = (names == name).to_numpy()
    driven_on = steps if here.all() else steps[here]
    course = tracks.get(name)
    if track is not None and track not in logged:
        course_now, problems = course, ()
        course = directed(catalogue_track(track), catalogue_track(track, True), driven_on)
        if course_now is not None and not was_driven_on(course, driven_on):
            raise BadInput(recording.name, f"track={track} was not driven on", course_now.name)
    if course is not None:
        against = driven_against(course, driven_on, np.cumsum(first_rows(driven_on)) - 1)
        if against.mean() > _ALTERNATES:
            kept, driven_on = np.flatnonzero(here)[~against], driven_on[~against]
            here = np.zeros(len(steps), bool)
            here[kept] = True
            problems = (*problems, LogProblem(recording.name, None, ONE_WAY))
    course = estimated_course(name, driven_on) if course is None else numbered_as_logged(course, driven_on)
    recording = _on_course(recording, here & training)
    discount = float((recording.hyperparameters or {}).get("discount_factor", DISCOUNT))
    trained, episodes, timed = _episodes(recording, here & training, course, discount)
    driven, raced, races_timed = _episodes(recording, here & ~training, course, discount)
    raced = raced.assign(stream=driven["stream"].to_numpy()[first_rows(driven)])
    evaluations = None if run is None else run.evaluations
    alike = _comparable(episodes, _on_usual(episodes, run))
    timed_alike = episodes.assign(lap_time_s=episodes["lap_time_s"].where(alike))
    iterations = judged = iteration_table(recording, trained, timed_alike, evaluations=evaluations)
    if run is not None and run.counted is not None:
        counted = run.counted.set_index("iteration").reindex(iterations["iteration"])
        iterations = judged = iterations.assign(**{name: counted[name].to_numpy() for name in counted})
    usual = iterations["episodes"][iterations["episodes"] > 0].median()
    in_blocks = run is None and usual < LEAST_EPISODES
    if in_blocks:
        judged = iteration_table(recording, trained, episodes, LEAST_EPISODES)
    elif run is None and len(iterations) > 1 and 0 < iterations["episodes"].iloc[-1] < FINISHED * usual:
        judged = iterations.iloc[:-1]
    if not (here & training).any():
        trained = driven.assign(episode=np.cumsum(first_rows(driven)) - 1)
        episodes = raced.assign(episode=np.arange(len(raced)))
    placed = placed_in_log(recording, trained, course) if isinstance(log, Recording) else log.others
    return LogView(
        name=recording.name,
        trained=bool((here & training).any()),
        recording=recording,
        course=course,
        track_name=name or (course.name if course is not None else ""),
        steps=trained,
        episodes=episodes,
        iterations=iterations,
        judged=judged,
        in_blocks=in_blocks,
        evaluation_episodes=raced,
        evaluation_steps=driven,
        laps_timed=timed + races_timed,
        problems=(*recording.problems, *problems),
        discount=discount,
        others=None if placed is None or course is None else others_on_road(placed, trained, course),
        placed=placed,
        run=run,
    )


def _on_course(recording: Recording, here: NDArray[np.bool_]) -> Recording:
    """Return a recording without updates and metrics of iterations, or workers, on other tracks only.

    `here` says of each row whether it is one of the training on the course. An iteration without a row belongs to the
    one before it.
    """
    training = (recording.steps["stream"] == TRAINING).to_numpy()
    number = recording.steps["iteration"].to_numpy()
    driven, worker = np.unique(number[training]), recording.steps["worker"].to_numpy()
    is_here, elsewhere = np.isin(driven, number[here]), np.setdiff1d(worker[training & ~here], worker[here])
    if is_here.all() and not len(elsewhere):
        return recording

    def kept(rows: pd.DataFrame) -> NDArray[np.bool_]:
        before = np.searchsorted(driven, rows["iteration"], side="right") - 1
        return is_here[np.maximum(before, 0)]

    updates, metrics = recording.updates, recording.metrics
    of_training = (metrics["stream"] == TRAINING).to_numpy()
    kept_metrics = kept(metrics) & ~np.isin(metrics["worker"], elsewhere)
    return replace(recording, updates=updates[kept(updates)], metrics=metrics[~of_training | kept_metrics])


def _episodes(
    recording: Recording, wanted: NDArray[np.bool_], course: Track | None, discount: float
) -> tuple[pd.DataFrame, pd.DataFrame, int]:
    """Return the wanted rows with derived columns, the table of their episodes, and the number of timed laps."""
    rows = recording.steps if wanted.all() else recording.steps[wanted]
    streams, episodes = rows["stream"].astype("category").cat.codes.to_numpy(), rows["episode"].to_numpy()
    key = streams.astype(np.int64) * (int(episodes.max(initial=0)) + 1) + episodes
    if (np.diff(key) < 0).any():
        rows = rows.iloc[np.argsort(key, kind="stable")]
    rows = add_derived(rows.reset_index(drop=True), course, discount)
    rows, timed = timed_by_service(rows, recording.metrics)
    return rows, episode_table(rows), timed


def prepare_races(recording: Recording, track: str | None = None) -> LogView:
    """Prepare the evaluations and races of a log, or if there are none its training; raises as `prepare`."""
    raced = (recording.steps["stream"] != TRAINING).to_numpy()
    return prepare(replace(recording, steps=recording.steps[raced]) if raced.any() else recording, track)


def once_per_view(
    find: Callable[Concatenate[LogView, Arguments], Result],
) -> Callable[Concatenate[LogView, Arguments], Result]:
    """Memoise a function of a view and hashable arguments; the cache lives with the view."""
    results: WeakKeyDictionary[LogView, dict[Any, Result]] = WeakKeyDictionary()

    @wraps(find)
    def kept(view: LogView, *args: Arguments.args, **more: Arguments.kwargs) -> Result:
        of_view = results.setdefault(view, {})
        key = (args, tuple(more.items()))
        if key not in of_view:
            of_view[key] = find(view, *args, **more)
        return of_view[key]

    return kept
