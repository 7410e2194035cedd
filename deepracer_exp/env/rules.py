"""What ends an episode, as the service's simulator decides it."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from deepracer_exp.config.driving import EpisodeConfig
from deepracer_exp.formats.trace import STATUS_CODE

from .state import fitting

PENALTY_S = {"off_track": 2.0, "crashed": 5.0, "reversed": 2.0, "immobilized": 0.0}
"""Seconds a car waits where an evaluation resets it; in training each of these ends the episode instead.

The service's own figures (deepracer-simapp, rollout_agent_ctrl.py): OFF_TRACK_PENALTY 2 s and COLLISION_PENALTY 5 s;
REVERSE_PENALTY is that of leaving the track and IMMOBILIZED_PENALTY nothing where a job does not set them.
"""


class EpisodeRules:
    """Counters and verdicts of N cars (deepracer-simapp, markov/reset/rules and rollout_agent_ctrl.py).

    A car's first step is the prepare step: it stands at its start pose and no rule is applied.
    """

    def __init__(self, config: EpisodeConfig, n_cars: int):
        self._config = config
        self._still = np.zeros(n_cars, np.int64)
        self._falling = np.zeros(n_cars, np.int64)

    def reset(self, ids: np.ndarray) -> None:
        """Forget what the cars `ids` did before."""
        self._still[ids] = 0
        self._falling[ids] = 0

    def state_dict(self) -> dict[str, Any]:
        """Return copies of the counters."""
        return {"still": self._still.copy(), "falling": self._falling.copy()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on counting from a `state_dict`.

        Raises:
            BadInput: it is of another number of cars.
        """
        self._still = fitting(state, "still", self._still.shape)
        self._falling = fitting(state, "falling", self._falling.shape)

    def judge(
        self,
        steps: np.ndarray,
        progress: np.ndarray,
        last_progress: np.ndarray,
        moved_m: np.ndarray,
        off_track: np.ndarray,
    ) -> np.ndarray:
        """Return each car's episode status.

        Args:
            steps: control steps of the episode, the prepare step being 1, shape (N,).
            progress: progress now, per cent, shape (N,).
            last_progress: progress one step before, shape (N,).
            moved_m: distance since one step before, in metres, shape (N,).
            off_track: no wheel on the road, shape (N,).

        Returns:
            Status codes, shape (N,), int64. Where several rules hold the service's priority decides: time_up,
            lap_complete, then the others.
        """
        config = self._config
        running = steps > 1
        self._still = np.where(running & (moved_m <= config.immobilized_m), self._still + 1, 0)
        self._falling = np.where(running & (progress < last_progress), self._falling + 1, 0)
        status = np.full(len(steps), STATUS_CODE["in_progress"])
        if config.reversed_steps:
            status[self._falling >= config.reversed_steps] = STATUS_CODE["reversed"]
        if config.immobilized_steps:
            status[self._still >= config.immobilized_steps] = STATUS_CODE["immobilized"]
        status[off_track] = STATUS_CODE["off_track"]
        status[progress >= 100.0] = STATUS_CODE["lap_complete"]
        if config.max_steps:
            status[steps >= config.max_steps] = STATUS_CODE["time_up"]
        status[~running] = STATUS_CODE["prepare"]
        return status
