"""Soft actor-critic from TorchRL's parts."""

import copy
import math
from dataclasses import dataclass
from typing import Any, NoReturn

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import DiscreteSACLoss, SACLoss, SoftUpdate

from deepracer_exp.config.learning import SACConfig
from deepracer_exp.errors import RunFailed

from .actor_critic import PolicyNetworks
from .algorithm import Algorithm, UpdateMetrics, require_finite
from .replay import Replay
from .schedules import Schedule
from .soft_actor_critic import SoftActorCritic

_CPU = torch.device("cpu")
_LOSSES = {
    "loss_actor": "policy loss",
    "loss_qvalue": "loss of the critics",
    "loss_alpha": "loss of the temperature",
}
_DISTANCES = {"huber": "smooth_l1", "mean squared error": "l2"}


@dataclass(frozen=True, kw_only=True)
class SACMetrics(UpdateMetrics):
    """Metrics of an update of `SAC`; `value_loss` is the critics', `entropy` an estimate from sampled actions."""

    alpha: float
    """Temperature at the end of the update."""
    target_entropy: float | None
    """Target entropy in nats of a learned temperature; None: the temperature is fixed."""
    q_value: float | None
    """The critics' value of the policy's actions: discounted rewards, without the entropy of the first step."""
    replay_steps: int
    """Steps in the replay."""
    gradient_steps: int
    """Gradient steps of this update."""


class SAC(Algorithm):
    """Soft actor-critic (Haarnoja et al. 2018) on a replay of all cars' steps.

    With continuous actions by TorchRL's `SACLoss`, with a list of actions by its `DiscreteSACLoss` (Christodoulou
    2019), in which expectations over actions are sums. Each update adds a batch to the replay and makes a number of
    gradient steps in proportion to the batch.
    """

    networks: SoftActorCritic
    config: SACConfig
    replay: Replay

    def __init__(
        self,
        networks: SoftActorCritic,
        config: SACConfig,
        schedule: Schedule,
        seed: int,
        device: torch.device = _CPU,
    ) -> None:
        """Set up replay, losses, targets and optimizer.

        The networks, on the CPU, where the policy drives, are updated in place; if `device` is not the CPU, by a copy
        of the policy there. The seed is that of the streams that draw steps and actions.
        """
        super().__init__(networks, config, schedule, seed)
        self._device = device
        self._generator = torch.Generator().manual_seed(seed)
        self.replay = Replay(networks.in_keys, config.replay_steps, config.replay_mb * 10**6, self._generator)
        self._learner = networks if device == _CPU else copy.deepcopy(networks).to(device)
        self._loss = self._build_loss()
        self._loss.make_value_estimator(gamma=config.discount)
        self._targets = SoftUpdate(self._loss, tau=config.tau)
        self._parameters = [weight for weight in self._loss.parameters() if weight.requires_grad]
        self._optimizer = torch.optim.Adam(self._parameters, lr=config.lr, eps=1e-5, fused=True)
        self._collected_steps, self._owed_steps = 0, 0.0

    def update(self, batch: TensorDictBase, iteration: int, fraction: float) -> SACMetrics:
        """Add the batch to the replay and learn from it, see `Algorithm.update`."""
        require_finite(batch)
        lr = self.rates(iteration, fraction)["learning rate"]
        for group in self._optimizer.param_groups:
            group["lr"] = lr
        self.replay.extend(batch)
        self._collected_steps += batch.numel()
        steps = self._steps_due(batch.numel())
        seed = int(torch.randint(2**62, (), generator=self._generator))
        devices = [] if self._device == _CPU else [self._device]
        with torch.random.fork_rng(devices=devices):
            torch.manual_seed(seed)  # TorchRL draws the policy's actions from the global stream
            table = [self._gradient_step() for _ in range(steps)]
        if steps:
            self._publish()
        means = torch.stack(table).mean(0).tolist() if table else [None] * 5
        policy_loss, value_loss, entropy, q_value, grad_norm = means
        return SACMetrics(
            policy_loss=policy_loss,
            value_loss=value_loss,
            entropy=entropy,
            grad_norm=grad_norm,
            lr=lr,
            alpha=self._alpha,
            target_entropy=float(self._loss.target_entropy) if self.config.learn_alpha else None,
            q_value=q_value,
            replay_steps=len(self.replay),
            gradient_steps=steps,
        )

    def state_dict(self) -> dict[str, Any]:
        """Return everything except the replay, which has its own state: tensors on the CPU and plain values only."""
        optimizer = self._optimizer.state_dict()
        moments = {
            index: {key: value.cpu() for key, value in state.items()}
            for index, state in optimizer["state"].items()
        }
        loss = {name: value.detach().cpu().clone() for name, value in self._own_of_loss().items()}
        return super().state_dict() | {
            "optimizer": {**optimizer, "state": moments},
            "generator": self._generator.get_state(),
            "loss": loss,
            "collected_steps": self._collected_steps,
            "owed_steps": self._owed_steps,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`; with that of the replay, further updates equal the original's bit for bit."""
        super().load_state_dict(state)
        self._take_networks()
        self._optimizer.load_state_dict(state["optimizer"])
        self._generator.set_state(state["generator"])
        with torch.no_grad():
            for name, value in self._own_of_loss().items():
                value.copy_(state["loss"][name])
        self._collected_steps, self._owed_steps = state["collected_steps"], state["owed_steps"]

    def begin_with(self, networks: PolicyNetworks) -> None:
        """Start from the networks of another run, with an empty replay; the targets are copies of its critics."""
        super().begin_with(networks)
        self._take_networks()

    def _build_loss(self) -> SACLoss | DiscreteSACLoss:
        config, learner = self.config, self._learner
        options: dict[str, Any] = {
            "loss_function": _DISTANCES[config.loss_type],
            "alpha_init": config.alpha,
            "fixed_alpha": not config.learn_alpha,
            "deactivate_vmap": True,  # as fast, and works for every layer of a user's own
        }
        critics = list(learner.critics)
        count = learner.action_count
        if count is not None:
            target = config.target_entropy_share * math.log(count)
            loss = DiscreteSACLoss(
                learner.policy_head,
                critics,
                action_space="categorical",
                num_actions=count,
                target_entropy=target,
                **options,
            )
        else:
            loss = SACLoss(learner.policy_head, critics, target_entropy=config.target_entropy, **options)
        return loss.to(self._device)

    def _steps_due(self, collected: int) -> int:
        """Return the number of gradient steps after a batch."""
        if self._collected_steps < self.config.warmup_steps:
            return 0
        self._owed_steps += collected / self.config.steps_per_gradient_step
        due = int(self._owed_steps)
        self._owed_steps -= due
        return due

    def _gradient_step(self) -> Tensor:
        """Make a gradient step and return the parts of SACMetrics."""
        losses = self._loss(self.replay.sample(self.config.batch_size).to(self._device))
        names = [name for name in _LOSSES if name != "loss_alpha" or self.config.learn_alpha]
        loss = torch.stack([losses[name] for name in names]).sum()
        self._optimizer.zero_grad()
        loss.backward()
        grad_norm = nn.utils.get_total_norm(
            [weight.grad for weight in self._parameters if weight.grad is not None]
        )
        if not torch.isfinite(loss.detach() + grad_norm):
            self._fail(losses, names)
        if self.config.max_grad_norm:
            nn.utils.clip_grads_with_norm_(self._parameters, self.config.max_grad_norm, grad_norm)
        self._optimizer.step()
        self._targets.step()
        entropy = losses["entropy"]
        q_value = -losses["loss_actor"].detach() - losses["alpha"] * entropy
        return torch.stack(
            [losses["loss_actor"].detach(), losses["loss_qvalue"].detach(), entropy, q_value, grad_norm]
        )

    def _fail(self, losses: TensorDictBase, names: list[str]) -> NoReturn:
        """Raise RunFailed with the first thing that is not finite."""
        for name in names:
            if not torch.isfinite(losses[name]):
                raise RunFailed(f"{_LOSSES[name]} is {losses[name].item()}; the gradient step was not made")
        raise RunFailed("norm of the gradient is not finite; the gradient step was not made")

    @property
    def _alpha(self) -> float:
        return math.exp(self._loss.log_alpha.item())

    def _own_of_loss(self) -> dict[str, Tensor]:
        """Return the state that only the loss holds, by name: target networks and log temperature."""
        held = [*self._loss.named_parameters(), *self._loss.named_buffers()]
        return {
            name: value
            for name, value in held
            if name == "log_alpha" or (name.startswith("target_") and "_params" in name)
        }

    @torch.no_grad()
    def _publish(self) -> None:
        """Copy the learned weights into `networks`; TorchRL keeps those of the critics in one stack."""
        for number, critic in enumerate(self.networks.critics):
            stack = self._loss.qvalue_network_params.data[number]
            TensorDict.from_module(critic).data.copy_(stack)
        if self._learner is not self.networks:
            self.networks.policy_head.load_state_dict(self._learner.policy_head.state_dict())

    @torch.no_grad()
    def _take_networks(self) -> None:
        """Load the weights of `networks` into the learner and the target networks."""
        if self._learner is not self.networks:
            self._learner.load_state_dict(self.networks.state_dict())
        for number, critic in enumerate(self.networks.critics):
            self._loss.qvalue_network_params.data[number].copy_(TensorDict.from_module(critic).data)
        self._loss.target_qvalue_network_params.data.copy_(self._loss.qvalue_network_params.data)
