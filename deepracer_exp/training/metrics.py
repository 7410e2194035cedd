"""Training metrics: episodes counted from the trace, and the figures of an iteration and of a run."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from deepracer_exp.config.stopping import ReliableStopping, StoppingConfig
from deepracer_exp.env.rules import lap_clock_s
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.env.trace_columns import PACKED, STATUS_CODE
from deepracer_exp.runs.fingerprint import REMEMBERED_EPISODES
from deepracer_exp.tracking.mlflow_metrics import track_labels

TIMES = ("wall_clock_s", "collect_s", "update_s", "env_steps_per_s")
"""Columns of metrics.jsonl that differ between two runs of the same seed."""
_FEWEST_EPISODES = 10  # with fewer, the mean completion says little about the policy


def track_names(setup: RaceSetup) -> list[str]:
    """Return the names of the courses."""
    return [course.name for course in setup.courses]


@dataclass(frozen=True)
class Finished:
    """Episodes that ended, in the order of their ends; arrays of one length."""

    track: np.ndarray
    """Number of the track, int64."""
    returns: np.ndarray
    """Sum of rewards."""
    progress: np.ndarray
    """Per cent of the lap at the end."""
    lap: np.ndarray
    """Whether the lap was completed."""
    time_s: np.ndarray
    """Seconds since the reset (`rules.lap_clock_s`): the lap time where the lap was completed."""
    on_usual: np.ndarray
    """Whether the car drives on usual conditions (`usual_cars`)."""

    def on(self, track: int) -> "Finished":
        """Return the episodes of one track."""
        here = self.track == track
        return Finished(*(values[here] for values in vars(self).values()))


class Record:
    """Counts of finished episodes and laps, the fastest lap on usual conditions, and the last episodes."""

    def __init__(self, remembered: int):
        """Start at zero.

        `remembered` is the number of last finished episodes in `lap_share`.
        """
        self._laps_of_last: deque[bool] = deque(maxlen=remembered)
        self.finished = 0
        self.laps = 0
        self.best_lap_s: float | None = None

    @property
    def lap_share(self) -> float | None:
        """Share of complete laps among the `remembered` last episodes, None before so many have ended."""
        last = self._laps_of_last
        return sum(last) / len(last) if len(last) == last.maxlen else None

    def add(self, finished: Finished) -> None:
        """Add episodes."""
        self.finished += len(finished.lap)
        self.laps += int(finished.lap.sum())
        self._laps_of_last.extend(finished.lap.tolist())
        laps_s = finished.time_s[finished.lap & finished.on_usual]
        if len(laps_s):
            fastest = float(laps_s.min())
            self.best_lap_s = fastest if self.best_lap_s is None else min(self.best_lap_s, fastest)

    def state_dict(self) -> dict[str, Any]:
        """Return everything, JSON types."""
        return {
            "laps_of_last": list(self._laps_of_last),
            "finished": self.finished,
            "laps": self.laps,
            "best_lap_s": self.best_lap_s,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over a `state_dict`."""
        self._laps_of_last.clear()
        self._laps_of_last.extend(state["laps_of_last"])
        self.finished, self.laps, self.best_lap_s = state["finished"], state["laps"], state["best_lap_s"]


class RunMetrics:
    """Numbers the episodes of a run and counts their endings, by track.

    Attributes:
        track_names: in the order of their numbers in the trace.
        labels: names of the tracks in metrics; empty with one track.
        remembered: number of last finished episodes in `lap_share`.
        all: the episodes of all tracks.
        tracks: those of each track.
        on_usual: whether each car drives on usual conditions, (n_cars,); lap times compare among these.
    """

    def __init__(
        self,
        names: Sequence[str],
        n_cars: int,
        step_s: float,
        stopping: StoppingConfig,
        on_usual: np.ndarray | None = None,
    ):
        """Start without episodes.

        Args:
            names: of the tracks, in the order of their numbers in the trace.
            n_cars: cars over all processes.
            step_s: simulated seconds of a control step.
            stopping: its rule decides over how many episodes `lap_share` is taken.
            on_usual: whether each car drives on usual conditions (`usual_cars`), (n_cars,); None: all do.
        """
        self.track_names = names
        self.labels = track_labels(names) if len(names) > 1 else []
        self.remembered = stopping.episodes if isinstance(stopping, ReliableStopping) else REMEMBERED_EPISODES
        self.all = Record(self.remembered)
        self.tracks = tuple(Record(self.remembered) for _ in names)
        self._last: list[dict[str, float | None]] = [{} for _ in self.labels]
        self.on_usual = np.ones(n_cars, bool) if on_usual is None else on_usual
        self._number = np.full(n_cars, -1)
        self._next_number = 0
        self._step_s = step_s

    def enter(self, trace: np.ndarray) -> tuple[np.ndarray, Finished]:
        """Number and count the episodes of a batch.

        `trace` has rows of `env.trace_columns.PACKED_COLUMNS`, shape (cars, T, C), time running along T.

        Returns:
            The rows in the order of episode and step, with the run's own episode numbers, shape (cars * T, C); and
            the episodes that ended in them.
        """
        trace = trace.copy()
        cars = trace[:, 0, PACKED["car"]].astype(np.int64)
        trace[..., PACKED["episode"]] = self._numbers(cars, trace[..., PACKED["steps"]] == 1)
        finished = self._close(trace)
        rows = trace.reshape(-1, trace.shape[-1])
        return rows[np.lexsort((rows[:, PACKED["steps"]], rows[:, PACKED["episode"]]))], finished

    @property
    def lap_share(self) -> float | None:
        """Share of complete laps among the last episodes on the track where it is lowest.

        None before as many episodes as are remembered have ended on every track.
        """
        shares = [record.lap_share for record in self.tracks]
        measured = [share for share in shares if share is not None]
        return min(measured) if len(measured) == len(shares) else None

    def row(self, finished: Finished) -> dict[str, float | None]:
        """Return the figures of the episodes of an iteration, means over episodes.

        Lap times of different tracks do not compare: with several tracks there are only those of each.
        """
        figures = _figures(finished, self.all)
        if self.labels:
            figures |= {"lap_share": self.lap_share, "best_lap_time_s": None, "mean_lap_time_s": None}
        return {"mean_return": _mean(finished.returns), **figures}

    def row_of_tracks(self, finished: Finished) -> dict[str, float | None]:
        """Return the figures of each track, empty with one track; None where none is known."""
        row: dict[str, float | None] = {}
        for number, label in enumerate(self.labels):
            figures = _figures(finished.on(number), self.tracks[number])
            self._last[number] |= {key: value for key, value in figures.items() if value is not None}
            row |= {f"{metric}/{label}": value for metric, value in figures.items()}
        return row

    def state_dict(self) -> dict[str, Any]:
        """Return the numbers of the episodes under way, the records, and the last figures of each track."""
        records = [record.state_dict() for record in (self.all, *self.tracks)]
        book = {"number": self._number, "next_number": self._next_number, "records": records}
        return {"book": book, "last": self._last}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over a `state_dict`."""
        book = state["book"]
        self._number, self._next_number = book["number"].copy(), book["next_number"]
        for record, stored in zip((self.all, *self.tracks), book["records"], strict=True):
            record.load_state_dict(stored)
        self._last = [dict(last) for last in state["last"]]

    def summary(self) -> dict[str, Any]:
        """Return the figures at the end; with several tracks, `tracks` has those of each by its name."""
        best_s = None if self.labels else self.all.best_lap_s
        whole = {"lap_share": self.lap_share, "best_lap_time_s": best_s}
        if not self.labels:
            return whole
        tracks = {
            name: {
                "episodes": record.finished,
                "laps": record.laps,
                "completion": last.get("completion"),
                "lap_share": record.lap_share,
                "best_lap_time_s": record.best_lap_s,
                "mean_lap_time_s": last.get("mean_lap_time_s"),
            }
            for name, record, last in zip(self.track_names, self.tracks, self._last, strict=True)
        }
        return {**whole, "tracks": tracks}

    def _numbers(self, cars: np.ndarray, begins: np.ndarray) -> np.ndarray:
        """Return the number of each step's episode, (cars, T), from the flags of their first steps."""
        # Episodes are numbered in the order in which they begin, cars that begin together by their number.
        order = np.argwhere(begins.T)
        numbers = np.full(begins.shape, -1)
        numbers[order[:, 1], order[:, 0]] = self._next_number + np.arange(len(order))
        self._next_number += len(order)
        numbers[:, 0] = np.maximum(numbers[:, 0], self._number[cars])
        numbers = np.maximum.accumulate(numbers, axis=1)
        self._number[cars] = numbers[:, -1]
        return numbers

    def _close(self, trace: np.ndarray) -> Finished:
        in_time = trace.transpose(1, 0, 2)
        ends = in_time[in_time[:, :, PACKED["done"]] == 1]
        finished = Finished(
            track=ends[:, PACKED["track"]].astype(np.int64),
            returns=ends[:, PACKED["episode_return"]],
            progress=ends[:, PACKED["progress"]],
            lap=ends[:, PACKED["episode_status"]] == STATUS_CODE["lap_complete"],
            time_s=lap_clock_s(ends[:, PACKED["steps"]], self._step_s),
            on_usual=self.on_usual[ends[:, PACKED["car"]].astype(np.int64)],
        )
        self.all.add(finished)
        for number, record in enumerate(self.tracks):
            record.add(finished.on(number))
        return finished


def _figures(finished: Finished, record: Record) -> dict[str, float | None]:
    return {
        "completion": _mean(finished.progress),
        "lap_share": record.lap_share,
        "best_lap_time_s": record.best_lap_s,
        "mean_lap_time_s": _mean(finished.time_s[finished.lap & finished.on_usual]),
    }


def _mean(values: np.ndarray) -> float | None:
    return float(values.mean()) if len(values) else None


class Ranking:
    """Ranks a policy by the episodes that ended last on each track.

    Where a lap takes longer than an iteration, or few cars drive on a track, not every iteration ends an episode on
    each: a track counts with the last iteration in which one ended.
    """

    def __init__(self, lengths_m: Sequence[float]):
        """Start without results."""
        self._lengths_m = lengths_m
        self._completion = np.full(len(lengths_m), np.nan)
        self._speed_mps = np.full(len(lengths_m), np.nan)
        self._episodes = np.zeros(len(lengths_m), np.int64)

    def rank(self, finished: Finished) -> tuple[float, float] | None:
        """Return completion (per cent) and speed along the lap (m/s), means over tracks; None: too few episodes.

        Completion is the mean over a track's episodes, speed the track's length over the mean time of complete laps,
        0 where there is none.
        """
        for track in np.unique(finished.track):
            here = finished.track == track
            times_s = finished.time_s[here & finished.lap]
            self._completion[track] = finished.progress[here].mean()
            self._speed_mps[track] = self._lengths_m[track] / times_s.mean() if len(times_s) else 0.0
            self._episodes[track] = here.sum()
        if not len(finished.track) or not self._episodes.all() or self._episodes.sum() < _FEWEST_EPISODES:
            return None
        return float(self._completion.mean()), float(self._speed_mps.mean())

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return the last result of each track."""
        return {"completion": self._completion, "speed_mps": self._speed_mps, "episodes": self._episodes}

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        """Take over a `state_dict`."""
        self._completion, self._speed_mps = state["completion"].copy(), state["speed_mps"].copy()
        self._episodes = state["episodes"].copy()
