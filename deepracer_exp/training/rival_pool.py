"""The rivals of a run: snapshots of its own policy, or the policy of another run."""

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from deepracer_exp.config.racing import NEWEST, RivalsConfig
from deepracer_exp.env.others.head_to_head import Rivals, Weights, rival_setup, weights_of
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.runs.stored_run import StoredRun

_STATE = "rivals"
"""Key of the snapshots in a checkpoint."""


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
            kept: the other run, with its checkpoint; None: the rivals are snapshots.

        Raises:
            BadInput: the other run's policy is missing or corrupt.
        """
        self._config, self._learner = config, policy
        self.weights: dict[int, Weights] = {}
        sees = setup.observation
        if kept is not None:
            policy, sees = kept.read_policy().networks.policy, kept.experiment.observation
            self.weights[0] = weights_of(policy)
        # A copy: TorchRL takes the learner's weights away from its layers while it sends these to workers.
        self._rivals = Rivals(setup=rival_setup(setup, sees), policy=copy.deepcopy(policy), weights=())

    @property
    def driving(self) -> tuple[Weights, ...]:
        """Return the weights from which each episode draws its rival."""
        weights = list(self.weights.values())
        return tuple(weights[-1:] if self._config.policy == NEWEST else weights)

    @property
    def rivals(self) -> Rivals:
        """Return the rivals in a form that workers take."""
        return replace(self._rivals, weights=self.driving)

    def newest_policy(self, before: int) -> torch.nn.Module:
        """Return the newest rival that is no snapshot of this iteration's policy, if there is one."""
        older = [number for number in self.weights if number < before] or [*self.weights]
        (policy,) = self._rivals.policies([self.weights[older[-1]]])
        return policy

    def take(self, iteration: int) -> bool:
        """Keep a snapshot of the learner if one is due; return whether the rivals change."""
        config = self._config
        if not config.is_own or (self.weights and iteration % config.snapshot_every):
            return False
        self.weights[iteration] = weights_of(self._learner)
        while len(self.weights) > config.pool_size:
            del self.weights[min(self.weights)]
        return True

    def state_dict(self) -> dict[str, Any]:
        """Return the snapshots; another run's policy is in a folder of its own."""
        if not self._config.is_own:
            return {}
        return {_STATE: {str(number): dict(weights) for number, weights in self.weights.items()}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the snapshots."""
        if self._config.is_own:
            kept = state[_STATE]
            self.weights = {number: kept[str(number)] for number in sorted(map(int, kept))}
