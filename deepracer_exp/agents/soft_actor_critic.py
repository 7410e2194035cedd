"""Networks of soft actor-critic: a tanh-squashed policy and two Q-networks."""

import math

import torch
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator

from deepracer_exp.config.driving import ObservationShape
from deepracer_exp.config.learning import CNNConfig, NetworkConfig
from deepracer_exp.config.own_class import OwnClass
from deepracer_exp.errors import reading

from .actor_critic import (
    CONTINUOUS_ACTION_SIZE,
    CRITIC_HIDDEN,
    INITIAL_STD,
    POLICY_GAIN,
    VALUE_GAIN,
    PolicyNetworks,
    SensorNet,
    actor,
    dense,
    initialize,
    own_network,
)

_LOG_STD = -20.0, 2.0
"""Bounds of the log standard deviation, as in the service (deepracer-simapp, `heads/sac_head.py`)."""


class SoftActorCritic(PolicyNetworks):
    """A policy and two critics, which share no layers.

    Attributes:
        critics: Each reads the observation and a continuous `action` -> `state_action_value` [..., 1]; or, for a list
            of n actions, only the observation -> `action_value` [..., n].
        action_count: Number of discrete actions, None for the continuous ones.
    """

    def __init__(
        self, policy_head: ProbabilisticActor, critics: list[ValueOperator], action_count: int | None
    ) -> None:
        super().__init__(policy_head)
        self.critics, self.action_count = nn.ModuleList(critics), action_count

    @property
    def in_keys(self) -> list[str]:
        """Keys that policy and critics read."""
        networks = [self.policy_head, *self.critics]
        return sorted({key for network in networks for key in network.in_keys if key != "action"})


class BoundedGaussian(nn.Module):
    """Mean and standard deviation before the tanh, from the same layers, [..., 2] each."""

    def __init__(self, layers: nn.Module) -> None:
        """Wrap layers with two outputs per action: the means, then the logarithms of the deviations."""
        super().__init__()
        self.layers = layers

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation."""
        mean, log_std = self.layers(*inputs).chunk(2, dim=-1)
        return mean, log_std.clamp(*_LOG_STD).exp()


def build_soft_actor_critic(
    network: NetworkConfig,
    observed: ObservationShape,
    action_count: int | None,
    generator: torch.Generator | None,
) -> SoftActorCritic:
    """Build the networks with weights drawn from `generator`; arguments and errors as for `build_actor_critic`.

    A network of the user's own is the policy; its critics are perceptrons that see features.
    """
    continuous = action_count is None
    outputs = 2 * CONTINUOUS_ACTION_SIZE if action_count is None else action_count
    actions = CONTINUOUS_ACTION_SIZE if continuous else 0
    if isinstance(network, OwnClass):
        policy_keys = list(observed.seen)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(torch.randint(2**62, (), generator=generator)))
            layers = own_network(network, observed, outputs)
        with reading(f"network.target={network.target}: initial_std"):
            initial_std = float(getattr(layers, "initial_std", INITIAL_STD))
    else:
        policy_keys = list(observed.seen) if isinstance(network, CNNConfig) else ["observation"]
        layers, initial_std = _layers(network, observed, outputs), network.initial_std
        initialize(layers, POLICY_GAIN, generator)
    if continuous:
        last = [layer for layer in layers.modules() if isinstance(layer, nn.Linear)][-1:]
        if generator is not None and last and last[0].out_features == outputs and last[0].bias is not None:
            nn.init.constant_(last[0].bias[CONTINUOUS_ACTION_SIZE:], math.log(initial_std))
        policy = actor(policy_keys, BoundedGaussian(layers), TanhNormal)
    else:
        policy = actor(policy_keys, layers, Categorical)

    values = action_count or 1
    value_key = "state_action_value" if continuous else "action_value"

    def critic() -> ValueOperator:
        if isinstance(network, CNNConfig) and network.critic == "pictures":
            keys, net = list(observed.seen), _layers(network, observed, values, actions)
        else:
            hidden = CRITIC_HIDDEN if isinstance(network, CNNConfig | OwnClass) else network.hidden
            activation = "relu" if isinstance(network, OwnClass) else network.activation
            keys, net = ["observation"], dense(observed.features + actions, hidden, activation, values)
        return ValueOperator(
            initialize(net, VALUE_GAIN, generator),
            in_keys=[*keys, *["action"] * (actions > 0)],
            out_keys=[value_key],
        )

    return SoftActorCritic(policy, [critic(), critic()], action_count)


def _layers(network: NetworkConfig, observed: ObservationShape, outputs: int, actions: int = 0) -> nn.Module:
    assert not isinstance(network, OwnClass)
    if isinstance(network, CNNConfig):
        return SensorNet(network, observed, outputs, actions)
    return dense(observed.features + actions, network.hidden, network.activation, outputs)
