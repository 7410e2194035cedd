"""The policies that a run races against: snapshots of itself, or one of another run."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.race import NEWEST, RivalsConfig
from deepracer_exp.env.head_to_head import Rivals, Weights, rival_setup, weights_of
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.lookup.resolve import StoredRun
from deepracer_exp.runs.files import RIVAL

from .kept_policy import read_kept_policy

_STATE = "rivals"
"""Key of the snapshots in a checkpoint."""


def kept_rival(experiment: Experiment, run_dir: Path) -> StoredRun | None:
    """Return the other run whose policy is kept in a run's folder as its rival; None: it has none."""
    config = experiment.race.rivals
    return None if config is None or config.is_own else StoredRun(run_dir / RIVAL)


class RivalPool:
    """The policies that drive a run's rivals.

    Attributes:
        weights: of the kept snapshots, the oldest first, or of the other run's policy alone.
    """

    def __init__(
        self, config: RivalsConfig, setup: RaceSetup, policy: torch.nn.Module, kept: StoredRun | None
    ):
        """Set up.

        Args:
            config: the group's `rivals`.
            setup: of the learner's race.
            policy: the learner's; `take` keeps its weights.
            kept: the other run, of `kept_rival`.

        Raises:
            BadInput: the other run's policy is missing or corrupt.
        """
        self._config, self._learner = config, policy
        self.weights: dict[int, Weights] = {}
        sees = setup.observation
        if kept is not None:
            policy, sees = read_kept_policy(kept.path).networks.policy, kept.experiment.observation
            self.weights[0] = weights_of(policy)
        self._rivals = Rivals(setup=rival_setup(setup, sees), policy=policy, weights=())

    @property
    def driving(self) -> tuple[Weights, ...]:
        """Return the weights among which each episode draws its rival's."""
        weights = list(self.weights.values())
        return tuple(weights[-1:] if self._config.policy == NEWEST else weights)

    @property
    def rivals(self) -> Rivals:
        """Return what the cars need to race against them."""
        return replace(self._rivals, weights=self.driving)

    def newest_policy(self) -> torch.nn.Module:
        """Return the newest rival."""
        (policy,) = self._rivals.policies(self.driving[-1:])
        return policy

    def take(self, iteration: int) -> bool:
        """Keep a snapshot of the learner where one is due after an iteration; return whether the rivals change."""
        config = self._config
        if not config.is_own or (self.weights and iteration % config.snapshot_every):
            return False
        self.weights[iteration] = weights_of(self._learner)
        while len(self.weights) > config.pool_size:
            del self.weights[min(self.weights)]
        return True

    def state_dict(self) -> dict[str, Any]:
        """Return the snapshots; a policy of another run is in a folder of its own."""
        if not self._config.is_own:
            return {}
        return {_STATE: {str(number): dict(weights) for number, weights in self.weights.items()}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the snapshots."""
        if self._config.is_own:
            kept = state[_STATE]
            self.weights = {number: kept[str(number)] for number in sorted(map(int, kept))}
