"""How good the policy is, by what its cars did last."""

from collections.abc import Sequence

import numpy as np

from .episodes import Finished

_FEWEST_EPISODES = 10  # with fewer, the mean completion says little about the policy


class Ranking:
    """Ranks a policy by the episodes that ended last on each track.

    Where a lap takes longer than an iteration, or few cars drive on a track, not every iteration ends an episode on
    each: a track counts with the last iteration that did.
    """

    def __init__(self, lengths_m: Sequence[float]):
        """Begin without a result.

        Args:
            lengths_m: length of each track.
        """
        self._lengths_m = lengths_m
        self._completion = np.full(len(lengths_m), np.nan)
        self._speed_mps = np.full(len(lengths_m), np.nan)
        self._episodes = np.zeros(len(lengths_m), np.int64)

    def rank(self, finished: Finished) -> tuple[float, float] | None:
        """Return completion (per cent) and speed along the lap (m/s), means over tracks; higher is better.

        Completion is the mean over a track's episodes, speed the track's length over the mean time of complete laps,
        0 where there is none.

        Args:
            finished: what ended in this iteration.

        Returns:
            None as long as too few episodes have ended to tell, or if none did in this iteration.
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
        """Return what is known of each track."""
        return {"completion": self._completion, "speed_mps": self._speed_mps, "episodes": self._episodes}

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        """Take over a `state_dict`."""
        self._completion, self._speed_mps = state["completion"].copy(), state["speed_mps"].copy()
        self._episodes = state["episodes"].copy()
