"""Clipped proximal policy optimisation from TorchRL's parts."""

import copy
import math
from typing import Any, NoReturn

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from deepracer_exp.config.learning import PPOConfig
from deepracer_exp.errors import RunFailed

from .actor_critic import ActorCritic
from .algorithm import Algorithm, UpdateMetrics, require_finite
from .inner_loop import InnerLoop
from .schedules import Schedule

_CPU = torch.device("cpu")
_PICTURES_AT_ONCE = 1024
_VALUE_LOSSES = {"huber": "smooth_l1", "mean squared error": "l2"}
_LOSS_NAMES = {
    "loss_objective": "policy loss",
    "loss_critic": "value loss",
    "loss_entropy": "entropy",
}


class _Loss(ClipPPOLoss):
    """ClipPPOLoss for distributions with an entropy in closed form.

    The library's version looks at every entropy of the minibatch and falls back to sampling where one is not finite,
    which ends in an error of torch.multinomial that does not name the value.
    """

    def _get_entropy(self, dist: Distribution, adv_shape: torch.Size) -> Tensor:
        return dist.entropy().unsqueeze(-1)


class PPO(Algorithm):
    """Clipped PPO.

    Hyperparameters have DeepRacer's meaning: advantages are standardised once over the whole batch, the clip range is
    constant, every epoch reshuffles, and a partial last minibatch is dropped. Unlike in DeepRacer's trainer, episodes
    need not be complete: an open or truncated one is bootstrapped from the value of its last observation.
    """

    networks: ActorCritic
    config: PPOConfig

    def __init__(
        self,
        actor_critic: ActorCritic,
        config: PPOConfig,
        schedule: Schedule,
        seed: int,
        device: torch.device = _CPU,
    ) -> None:
        """Set up loss, advantages and optimizer.

        The networks, on the CPU, where they drive, are updated in place; if `device` is not the CPU, by a copy of them
        there. The seed is that of the stream that shuffles the minibatches.
        """
        super().__init__(actor_critic, config, schedule, seed)
        self._generator = torch.Generator().manual_seed(seed)
        self._device = device
        self._learner = actor_critic if device == _CPU else copy.deepcopy(actor_critic).to(device)
        self._parameters = list(self._learner.parameters())
        # Adam's epsilon as in DeepRacer's trainer; one fused kernel instead of a dozen over all tensors.
        self._optimizer = torch.optim.Adam(self._parameters, lr=config.lr, eps=1e-5, fused=True)
        self._max_grad_norm = config.max_grad_norm or math.inf
        self._epochs, self._batch_size = config.epochs, config.batch_size
        self._advantages = GAE(
            gamma=config.discount,
            lmbda=config.gae_lambda,
            value_network=None,
            average_gae=True,
            vectorized=True,
            device=device,
        )
        self._loss = _Loss(
            self._learner.policy_head,
            self._learner.value_head,
            clip_epsilon=config.clip_epsilon,
            entropy_coeff=config.entropy_coeff,
            critic_coeff=config.critic_coeff,
            loss_critic_type=_VALUE_LOSSES[config.loss_type],
            functional=False,
            log_explained_variance=False,
            device=device,
        )
        fits = config.compiled and device == _CPU and InnerLoop.fits(actor_critic)
        self._compiled = InnerLoop(actor_critic, self._optimizer, config) if fits else None

    @property
    def _inner_loop(self) -> InnerLoop | None:
        """Return the compiled loop that makes the gradient steps of `loss`; None where autograd makes them."""
        return self._compiled if type(self).loss is PPO.loss else None

    def __str__(self) -> str:
        """Return the algorithm's name, and whether its gradient steps are compiled."""
        return f"{type(self).__name__}, {'compiled' if self._inner_loop is not None else 'by its loss in autograd'}"

    def loss(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Return the losses of a minibatch; override it for a loss of your own.

        Args:
            minibatch: [N] steps with the networks' inputs (and the trunk's `hidden`), `action`, `action_log_prob`,
                `advantage` and `value_target`.

        Returns:
            `loss_objective`, `loss_critic` and `loss_entropy`, which are added up, and `entropy`, `clip_fraction`,
            `mean_ratio` and `kl_approx`, which are recorded.
        """
        return self._loss(minibatch)

    def rates(self, iteration: int, fraction: float) -> dict[str, float]:
        """Return the learning rate and the weight of the entropy bonus, see `Algorithm.rates`."""
        coeff, end = self.config.entropy_coeff, self.config.entropy_end_factor
        return super().rates(iteration, fraction) | {"entropy bonus": coeff * (1 + (end - 1) * fraction)}

    def update(self, batch: TensorDictBase, iteration: int, fraction: float) -> UpdateMetrics:
        """Run all epochs on one batch, see `Algorithm.update`."""
        rates = self.rates(iteration, fraction)
        lr, entropy_coeff = rates["learning rate"], rates["entropy bonus"]
        for group in self._optimizer.param_groups:
            group["lr"] = lr
        self._loss.entropy_coeff.fill_(entropy_coeff)
        if self._learner is not self.networks:
            self._learner.load_state_dict(self.networks.state_dict())
            batch = batch.to(self._device, non_blocking_pin=self._device.type == "cuda")
        steps, explained_variance = self._prepare(batch)
        count = steps.shape[0]
        size = min(self._batch_size, count)
        minibatches = count // size
        orders = (self._shuffled(count)[: minibatches * size] for _ in range(self._epochs))
        loop = self._inner_loop
        if loop is None:
            table = torch.stack(
                [self._gradient_step(_rows(steps, part)) for order in orders for part in order.split(size)]
            )
        else:
            table = torch.cat([self._epoch(loop, steps, order, size, lr, entropy_coeff) for order in orders])
        # One transfer for all metrics; only the test for finite numbers waits for each gradient step.
        policy_loss, value_loss, entropy, clip_fraction, _, grad_norm = table.mean(0).tolist()
        kl = table[-minibatches:, 4].mean().item()
        self.schedule.observe(kl)
        if self._learner is not self.networks:
            self.networks.load_state_dict(self._learner.state_dict())
        return UpdateMetrics(
            policy_loss=policy_loss,
            value_loss=value_loss / self.config.critic_coeff,
            entropy=entropy,
            kl=kl,
            clip_fraction=clip_fraction,
            explained_variance=explained_variance,
            grad_norm=grad_norm,
            lr=lr,
        )

    def state_dict(self) -> dict[str, Any]:
        """Return networks, optimizer, schedule and shuffling stream: tensors on the CPU and plain values only."""
        optimizer = self._optimizer.state_dict()
        moments = {
            index: {key: value.cpu() for key, value in state.items()}
            for index, state in optimizer["state"].items()
        }
        updating = {"optimizer": {**optimizer, "state": moments}, "generator": self._generator.get_state()}
        return super().state_dict() | updating

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over a `state_dict`; further updates are those of the original bit for bit."""
        super().load_state_dict(state)
        self._optimizer.load_state_dict(state["optimizer"])
        self._generator.set_state(state["generator"])

    def _shuffled(self, count: int) -> Tensor:
        return torch.randperm(count, generator=self._generator).to(self._device)

    @torch.no_grad()
    def _prepare(self, batch: TensorDictBase) -> tuple[TensorDictBase, float]:
        """Return the steps in one row with `advantage` and `value_target`, and the explained variance."""
        require_finite(batch)
        value = self._value_of(batch)
        # An unfinished step's next observation is the next row's observation, whose value is known: only ends
        # of episodes and of the batch are evaluated. 4 ms for 8192 steps, against 14 ms of two full passes.
        ends = batch["next", "done"].squeeze(-1).clone()
        ends[..., -1] = True
        next_value = value.roll(-1, dims=-2)
        next_value[ends] = self._value_of(batch["next"].select(*self._learner.value.in_keys)[ends])
        estimates = TensorDict(
            {
                "state_value": value,
                "next": {
                    "state_value": next_value,
                    **{key: batch["next", key] for key in ("reward", "done", "terminated")},
                },
            },
            batch.batch_size,
        )
        self._advantages(estimates)
        target = estimates["value_target"]
        unexplained, total = (target - value).var(correction=0), target.var(correction=0)
        steps = batch.select(*self._learner.in_keys, "action", "action_log_prob")
        steps.update(estimates.select("advantage", "value_target"))
        steps = steps.reshape(-1)
        # A constant target has no variance to explain.
        explained = 1 - unexplained / total.clamp_min(torch.finfo(total.dtype).tiny)
        return steps, explained.item() if total > 0 else 0.0

    def _value_of(self, steps: TensorDictBase) -> Tensor:
        steps = steps.select(*self._learner.value.in_keys)
        if "pixels" not in steps:
            return self._learner.value(steps)["state_value"]
        # The outputs of the first layer for all steps at once would take gigabytes.
        parts = steps.reshape(-1).split(_PICTURES_AT_ONCE)
        values = torch.cat([self._learner.value(part)["state_value"] for part in parts])
        return values.reshape(*steps.shape, 1)

    def _gradient_step(self, minibatch: TensorDictBase) -> Tensor:
        """Step along one minibatch's gradient and return the parts of UpdateMetrics on the device."""
        if self._learner.trunk is not None:
            minibatch = self._learner.trunk(minibatch)
        losses = self.loss(minibatch)
        loss = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
        self._optimizer.zero_grad()
        loss.backward()
        grad_norm = nn.utils.get_total_norm([p.grad for p in self._parameters if p.grad is not None])
        if not torch.isfinite(loss.detach() + grad_norm):
            self._fail(losses)
        nn.utils.clip_grads_with_norm_(self._parameters, self._max_grad_norm, grad_norm)
        self._optimizer.step()
        # E[r - 1 - log r] for r = new / old probability: never negative, and far less noisy than E[-log r].
        kl = losses["mean_ratio"] - 1 + losses["kl_approx"]
        keys = ("loss_objective", "loss_critic", "entropy", "clip_fraction")
        return torch.stack([*(losses[key].detach() for key in keys), kl, grad_norm])

    def _epoch(
        self,
        loop: InnerLoop,
        steps: TensorDictBase,
        order: Tensor,
        size: int,
        lr: float,
        entropy_coeff: float,
    ) -> Tensor:
        """Make the gradient steps of an epoch, and return the metrics of each, as `_gradient_step` does."""
        columns = [steps[key] for key in ("observation", "action", "action_log_prob")]
        columns += [steps[key].squeeze(-1) for key in ("advantage", "value_target")]
        columns = [column.index_select(0, order) for column in columns]
        made = loop.run(columns, size, lr, entropy_coeff, self.threads)
        if len(made) * size < len(order):
            self._gradient_step(_rows(steps, order.split(size)[len(made)]))  # names what is not finite
        return made

    def _fail(self, losses: TensorDictBase) -> NoReturn:
        """Raise RunFailed with the first thing that is not finite."""
        for key, name in _LOSS_NAMES.items():
            if key in losses and not torch.isfinite(losses[key]):
                raise RunFailed(f"{name} is {losses[key].item()}; the gradient step was not made")
        for name, parameter in self._learner.named_parameters():
            if parameter.grad is not None and not torch.isfinite(parameter.grad).all():
                raise RunFailed(f"gradient of {name} is not finite; the gradient step was not made")
        raise RunFailed("norm of the gradient is not finite; the gradient step was not made")


def _rows(steps: TensorDictBase, order: Tensor) -> TensorDictBase:
    """Select steps; pictures are copied in a ninth of the time of `steps[order]`."""
    rows = steps.apply(lambda values: values.index_select(0, order), batch_size=order.shape)
    assert rows is not None
    return rows
