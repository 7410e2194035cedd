"""What the cars achieve: for metrics.jsonl after every iteration, for summary.json at the end."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from deepracer_exp.config.stopping import ReliableStopping, StoppingConfig
from deepracer_exp.tracking.names import track_labels, track_metric

from .episodes import EpisodeBook, Finished, Record

_REMEMBERED = 50  # of the last episodes, where no stopping rule says how many


class Results:
    """Results of a run on one track, or of each of its tracks.

    Attributes:
        book: the finished episodes.
        labels: what the tracks are called in metrics; empty with one track, whose metrics need no name.
    """

    def __init__(self, names: Sequence[str], n_cars: int, step_s: float, stopping: StoppingConfig):
        """Begin without a result.

        Args:
            names: of the tracks, in the order of their numbers in the trace.
            n_cars: cars over all processes.
            step_s: simulated seconds of a control step.
            stopping: its rule says of how many episodes `lap_share` is taken.
        """
        self._names = names
        self.remembered = stopping.episodes if isinstance(stopping, ReliableStopping) else _REMEMBERED
        self.book = EpisodeBook(n_cars, len(names), self.remembered, step_s)
        self.labels = track_labels(names) if len(names) > 1 else []
        self._last: list[dict[str, float | None]] = [{} for _ in self.labels]

    @property
    def lap_share(self) -> float | None:
        """Share of complete laps among the last episodes on the track where it is lowest.

        None before as many episodes as are remembered have ended on every track.
        """
        shares = [record.lap_share for record in self.book.tracks]
        known = [share for share in shares if share is not None]
        return min(known) if len(known) == len(shares) else None

    def metrics(self, finished: Finished) -> dict[str, float | None]:
        """Return the figures of the episodes of an iteration, means over episodes.

        Lap times of different tracks have no common measure: with several tracks they stand at each track only.
        """
        figures = _figures(finished, self.book.all)
        if self.labels:
            figures |= {"lap_share": self.lap_share, "best_lap_time_s": None, "mean_lap_time_s": None}
        return {"mean_return": _mean(finished.returns), **figures}

    def metrics_of_tracks(self, finished: Finished) -> dict[str, float | None]:
        """Return the figures of each track, empty with one track; None where an iteration has nothing to tell."""
        row: dict[str, float | None] = {}
        for number, label in enumerate(self.labels):
            figures = _figures(finished.on(number), self.book.tracks[number])
            self._last[number] |= {key: value for key, value in figures.items() if value is not None}
            row |= {track_metric(metric, label): value for metric, value in figures.items()}
        return row

    def state_dict(self) -> dict[str, Any]:
        """Return everything."""
        return {"book": self.book.state_dict(), "last": self._last}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over a `state_dict`."""
        self.book.load_state_dict(state["book"])
        self._last = [dict(last) for last in state["last"]]

    def summary(self) -> dict[str, Any]:
        """Return the figures at the end; with several tracks, `tracks` has those of each by its name."""
        book = self.book
        whole = {
            "lap_share": self.lap_share,
            "best_lap_time_s": None if self.labels else book.all.best_lap_s,
        }
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
            for name, record, last in zip(self._names, book.tracks, self._last, strict=True)
        }
        return {**whole, "tracks": tracks}


def _figures(finished: Finished, record: Record) -> dict[str, float | None]:
    return {
        "completion": _mean(finished.progress),
        "lap_share": record.lap_share,
        "best_lap_time_s": record.best_lap_s,
        "mean_lap_time_s": _mean(finished.time_s[finished.lap]),
    }


def _mean(values: np.ndarray) -> float | None:
    return float(values.mean()) if len(values) else None
