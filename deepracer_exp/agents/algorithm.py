"""The base class of algorithms, and the metrics of an update."""

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase

from deepracer_exp.config.learning import AlgorithmConfig
from deepracer_exp.errors import RunFailed

from .actor_critic import PolicyNetworks
from .replay import Replay
from .schedules import Schedule


@dataclass(frozen=True, kw_only=True)
class UpdateMetrics:
    """Figures of one update, means over its gradient steps unless said otherwise. A subclass may add columns.

    None: the algorithm has no such number, or the update made no gradient step.
    """

    policy_loss: float | None
    value_loss: float | None
    """Loss of the value networks, before it is weighted by `critic_coeff`."""
    entropy: float | None
    """Entropy of the policy in nats."""
    kl: float | None = None
    """KL divergence of the collecting policy from the updated one, estimated over the last epoch."""
    clip_fraction: float | None = None
    """Share of steps whose probability ratio was clipped."""
    explained_variance: float | None = None
    """Share of the variance of the value targets that the values before the update explain; 1 is perfect."""
    grad_norm: float | None
    """Norm of the gradient before clipping."""
    lr: float


class Algorithm:
    """Improves networks from batches of its own driving; base class of your own algorithms.

    Attributes:
        replay: Past steps that it learns from again, saved with the last checkpoint; None: it needs none.
        threads: Number that an update of networks on features may use.
    """

    replay: Replay | None = None
    threads: int = 1

    def __init__(
        self, networks: PolicyNetworks, config: AlgorithmConfig, schedule: Schedule, seed: int
    ) -> None:
        """Store the parts.

        Networks are updated in place; the seed is that of the algorithm's own random streams.
        """
        self.networks, self.config, self.schedule = networks, config, schedule

    def __str__(self) -> str:
        """Return the algorithm's name for the first line of a training."""
        return type(self).__name__

    def rates(self, iteration: int, fraction: float) -> dict[str, float]:
        """Return the scheduled values of the coming update, by name; arguments as for `update`."""
        return {"learning rate": self.config.lr * self.schedule.factor(iteration, fraction)}

    def update(self, batch: TensorDictBase, iteration: int, fraction: float) -> UpdateMetrics:
        """Learn from one batch.

        Args:
            batch: Leading dimensions [..., T], time last and contiguous. Holds `observation` (`pixels`, `lidar`),
                `action`, `action_log_prob` and `next` with `observation` (of a finished episode: its last one, not
                the first of the new one), `reward`, `done`, `terminated`, each of the latter [..., T, 1].
            iteration: Updates made before this one.
            fraction: Share of the budget spent, 0 to 1; with `budget.schedule_until`, of that part of it.

        Raises:
            RunFailed: Input, loss or gradient is not finite; the networks are as before that gradient step.
        """
        raise NotImplementedError

    def begin_with(self, networks: PolicyNetworks) -> None:
        """Start from the networks of another run, which have the same layers."""
        self.networks.load_state_dict(networks.state_dict())

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint: tensors and plain values; evaluations read only `networks`."""
        return {"networks": self.networks.state_dict(), "schedule": self.schedule.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`."""
        self.networks.load_state_dict(state["networks"])
        self.schedule.load_state_dict(state["schedule"])


def require_finite(batch: TensorDictBase) -> None:
    """Refuse a batch with a number that is not finite.

    Raises:
        RunFailed: the message names the first one.
    """
    keys = ("observation", "action", "action_log_prob", ("next", "observation"), ("next", "reward"))
    for key in keys:
        finite = torch.isfinite(batch[key])
        if not finite.all():
            name = " ".join(key) if isinstance(key, tuple) else key
            position = (~finite).nonzero()[0].tolist()
            raise RunFailed(f"{name} is {batch[key][tuple(position)].item()} at {position} of the batch")
