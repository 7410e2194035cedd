"""Finished episodes, counted from the trace."""

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from deepracer_exp.formats.trace import PACKED, STATUS_CODE


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
    """Seconds of driving, the prepare step not counted: the lap time where the lap was completed."""

    def on(self, track: int) -> "Finished":
        """Return the episodes of one track."""
        here = self.track == track
        return Finished(*(values[here] for values in vars(self).values()))


class Record:
    """How episodes ended: how many, how many laps, the fastest, and the last ones."""

    def __init__(self, remembered: int):
        """Begin with nothing.

        Args:
            remembered: how many of the last finished episodes `lap_share` looks at.
        """
        self._laps_of_last: deque[bool] = deque(maxlen=remembered)
        self.finished = 0
        self.laps = 0
        self.best_lap_s: float | None = None

    @property
    def lap_share(self) -> float | None:
        """Share of complete laps among the last episodes, None before as many as are remembered have ended."""
        last = self._laps_of_last
        return sum(last) / len(last) if len(last) == last.maxlen else None

    def add(self, finished: Finished) -> None:
        """Note episodes."""
        self.finished += len(finished.lap)
        self.laps += int(finished.lap.sum())
        self._laps_of_last.extend(finished.lap.tolist())
        if finished.lap.any():
            fastest = float(finished.time_s[finished.lap].min())
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


class EpisodeBook:
    """Numbers the episodes of a run and remembers how they ended.

    Attributes:
        all: the episodes of all tracks.
        tracks: those of each track.
    """

    def __init__(self, n_cars: int, n_tracks: int, remembered: int, step_s: float):
        """Open the book.

        Args:
            n_cars: cars over all processes.
            n_tracks: tracks the cars drive on.
            remembered: how many of the last finished episodes `Record.lap_share` looks at.
            step_s: simulated seconds of a control step.
        """
        self._number = np.full(n_cars, -1)
        self._next_number = 0
        self._step_s = step_s
        self.all = Record(remembered)
        self.tracks = tuple(Record(remembered) for _ in range(n_tracks))

    def enter(self, trace: np.ndarray) -> tuple[np.ndarray, Finished]:
        """Note a batch of driving.

        Args:
            trace: rows of `formats.trace.PACKED_COLUMNS`, shape (cars, T, C), time running along T. A car that
                stands there twice (of asynchronous collection, where one process was faster than the others)
                drove the lower row later.

        Returns:
            The rows in the order of episode and step, with the run's own episode numbers, shape (cars * T, C); and
            the episodes that ended in them.
        """
        trace = trace.copy()
        cars = trace[:, 0, PACKED["car"]].astype(np.int64)
        for part in _each_car_once(cars):
            begins = trace[part, :, PACKED["steps"]] == 1
            trace[part, :, PACKED["episode"]] = self._numbers(cars[part], begins)
        finished = self._close(trace)
        rows = trace.reshape(-1, trace.shape[-1])
        return rows[np.lexsort((rows[:, PACKED["steps"]], rows[:, PACKED["episode"]]))], finished

    def state_dict(self) -> dict[str, Any]:
        """Return the numbers of the episodes under way and the records."""
        return {
            "number": self._number,
            "next_number": self._next_number,
            "records": [record.state_dict() for record in (self.all, *self.tracks)],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over a `state_dict`."""
        self._number, self._next_number = state["number"].copy(), state["next_number"]
        for record, own in zip((self.all, *self.tracks), state["records"], strict=True):
            record.load_state_dict(own)

    def _numbers(self, cars: np.ndarray, begins: np.ndarray) -> np.ndarray:
        """Return the number of each step's episode, (cars, T), from where episodes begin."""
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
            time_s=(ends[:, PACKED["steps"]] - 1) * self._step_s,
        )
        self.all.add(finished)
        for number, record in enumerate(self.tracks):
            record.add(finished.on(number))
        return finished


def _each_car_once(cars: np.ndarray) -> list[np.ndarray]:
    """Return the rows at which each car stands for the first time, for the second time, and so on."""
    order = np.argsort(cars, kind="stable")
    _, first, counts = np.unique(cars[order], return_index=True, return_counts=True)
    turn = np.empty(len(cars), np.int64)
    turn[order] = np.arange(len(cars)) - np.repeat(first, counts)
    return [np.flatnonzero(turn == nth) for nth in range(turn.max() + 1)]
