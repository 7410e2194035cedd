"""The losses of soft actor-critic in few operations, for critics that are perceptrons.

They are those of TorchRL's `SACLoss` and `DiscreteSACLoss` and draw the same numbers. A minibatch of features is small,
so that TensorDict and a call for every layer of every critic take longer than the products; here both critics are one
product a layer, and nothing is copied.
"""

import math
from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional
from torchrl.modules import ValueOperator
from torchrl.objectives import DiscreteSACLoss, SACLoss

from deepracer_exp.config.learning import SACConfig

from .inner_loop import is_plain
from .soft_actor_critic import SoftActorCritic

_HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)
_LOG_2 = math.log(2.0)
_ACTIVATIONS: dict[type[nn.Module], Callable[[Tensor], Tensor]] = {
    nn.ReLU: functional.relu,
    nn.Tanh: torch.tanh,
    nn.ELU: functional.elu,
    nn.SiLU: functional.silu,
}
_Layers = list[tuple[Tensor, Tensor]]
"""Weights [2, outputs, inputs] and biases [2, 1, outputs] of both critics, layer by layer."""


class SACLosses:
    """Computes the losses on the parameters that a loss of TorchRL holds."""

    def __init__(self, learner: SoftActorCritic, loss: SACLoss | DiscreteSACLoss, config: SACConfig) -> None:
        """Take the parameters of `loss`, which stay its own; critics and policy of `learner` fit (`fits`)."""
        self._policy, self._loss = learner.policy_head[0], loss
        self._continuous, self._discount = learner.action_count is None, config.discount
        self._distance = functional.smooth_l1_loss if config.loss_type == "huber" else functional.mse_loss
        layers = _layers_of(learner.critics[0])
        self._names = [name for name, layer in layers.named_children() if isinstance(layer, nn.Linear)]
        kinds = [_ACTIVATIONS[type(layer)] for layer in layers.children() if type(layer) in _ACTIVATIONS]
        self._activation = kinds[0] if kinds else torch.tanh

    @staticmethod
    def fits(learner: SoftActorCritic) -> bool:
        """Return whether the critics are perceptrons of features."""
        return all(is_plain(_layers_of(critic)) for critic in learner.critics)

    def __call__(self, steps: TensorDictBase) -> dict[str, Tensor]:
        """Return `loss_actor`, `loss_qvalue`, `loss_alpha`, and without gradients `alpha` and `entropy`.

        Args:
            steps: [size], of `Replay.sample`.
        """
        log_alpha = self._loss.log_alpha
        alpha = log_alpha.detach().exp()
        weights = self._layers(self._loss.qvalue_network_params)
        following, seen = steps["next"], steps["observation"]
        with torch.no_grad():
            targets = self._layers(self._loss.target_qvalue_network_params)
            expected = self._soft_value(following, targets, alpha)
            going = (~following["terminated"].squeeze(-1)).to(expected.dtype)
            target = following["reward"].squeeze(-1) + self._discount * going * expected
        action = steps["action"]
        if self._continuous:
            values = self._critics(torch.cat([seen, action], dim=-1), weights).squeeze(-1)
        else:
            chosen = action.expand(2, -1).unsqueeze(-1)
            values = self._critics(seen, weights).gather(-1, chosen).squeeze(-1)
        # The mean over steps, the sum over critics.
        loss_qvalue = 2.0 * self._distance(values, target.expand_as(values))
        fixed = [(weight.detach(), bias.detach()) for weight, bias in weights]
        if self._continuous:
            action, log_prob = self._act(steps)
            least = self._critics(torch.cat([seen, action], dim=-1), fixed).amin(0).squeeze(-1)
            loss_actor = (alpha * log_prob - least).mean()
        else:
            every_log_prob = self._log_probs(steps)
            every_prob = every_log_prob.exp()
            least = self._critics(seen, fixed).amin(0)
            loss_actor = (every_prob * (alpha * every_log_prob - least)).sum(-1).mean()
            log_prob = (every_prob * every_log_prob).sum(-1)
        entropy = -log_prob.detach().mean()
        return {
            "loss_actor": loss_actor,
            "loss_qvalue": loss_qvalue,
            "loss_alpha": -log_alpha * (self._loss.target_entropy - entropy),
            "alpha": alpha,
            "entropy": entropy,
        }

    def _soft_value(self, steps: TensorDictBase, critics: _Layers, alpha: Tensor) -> Tensor:
        """Return the value of what is seen, with the policy's entropy, by the smaller of both critics, [size]."""
        if self._continuous:
            action, log_prob = self._act(steps)
            inputs = torch.cat([steps["observation"], action], dim=-1)
            return self._critics(inputs, critics).amin(0).squeeze(-1) - alpha * log_prob
        log_prob = self._log_probs(steps)
        values = self._critics(steps["observation"], critics).amin(0) - alpha * log_prob
        return (log_prob.exp() * values).sum(-1)

    def _act(self, steps: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return actions of the policy [size, 2] and the logarithm of their density [size]."""
        mean, scale = self._policy.module(*(steps[key] for key in self._policy.in_keys))
        noise = torch.randn_like(mean)
        before = mean + scale * noise
        log_prob = -0.5 * noise.square() - scale.log() - _HALF_LOG_2PI
        # Of the hyperbolic tangent (Haarnoja et al. 2018, appendix C), without overflow.
        log_prob = log_prob - 2.0 * (_LOG_2 - before - functional.softplus(-2.0 * before))
        return before.tanh(), log_prob.sum(-1)

    def _log_probs(self, steps: TensorDictBase) -> Tensor:
        """Return the logarithms of the probabilities of all actions, [size, actions]."""
        return self._policy.module(*(steps[key] for key in self._policy.in_keys)).log_softmax(-1)

    def _layers(self, params: TensorDictBase) -> _Layers:
        return [
            (params["module", name, "weight"], params["module", name, "bias"].unsqueeze(1))
            for name in self._names
        ]

    def _critics(self, inputs: Tensor, layers: _Layers) -> Tensor:
        """Return the outputs of both critics, [2, size, outputs]."""
        values = inputs.expand(2, *inputs.shape)
        for number, (weight, bias) in enumerate(layers):
            values = torch.baddbmm(bias, values, weight.transpose(1, 2))
            if number < len(layers) - 1:
                values = self._activation(values)
        return values


def _layers_of(critic: nn.Module) -> nn.Module:
    assert isinstance(critic, ValueOperator)
    return critic.module
