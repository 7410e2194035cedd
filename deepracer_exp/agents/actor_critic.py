"""Policy and value networks."""

import math

import torch
from tensordict.nn import (
    AddStateIndependentNormalScale,
    InteractionType,
    TensorDictModule,
    TensorDictModuleBase,
)
from torch import nn
from torch.distributions import Categorical
from torchrl.modules import MLP, ActorValueOperator, IndependentNormal, ProbabilisticActor, ValueOperator

from deepracer_exp.config.learning import MLPConfig, NetworkConfig
from deepracer_exp.config.own_class import OwnClass, build_own

CONTINUOUS_ACTION_SIZE = 2
"""Steering and speed."""

_ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU, "elu": nn.ELU, "silu": nn.SiLU}

# A policy that starts almost uniform (or centred) explores evenly; the value head starts at full scale.
_HIDDEN_GAIN, _POLICY_GAIN, _VALUE_GAIN = math.sqrt(2), 0.01, 1.0
_INITIAL_STD = (
    0.5  # of a continuous policy, unless a network of the user's own has an attribute `initial_std`
)


class ActorCritic(nn.Module):
    """A stochastic policy and a state value, with separate networks or on one trunk.

    Attributes:
        trunk: The shared part, `observation` -> `hidden`; None for separate networks.
        policy_head: What follows the trunk to the policy; all of it without a trunk.
        value_head: What follows the trunk to the value; all of it without a trunk.
    """

    def __init__(
        self,
        policy_head: ProbabilisticActor,
        value_head: ValueOperator,
        trunk: TensorDictModule | None = None,
    ) -> None:
        super().__init__()
        self.policy_head, self.value_head, self.trunk = policy_head, value_head, trunk

    @property
    def policy(self) -> TensorDictModuleBase:
        """What collectors carry: `observation` -> `action` and `action_log_prob`, on these very parameters.

        It samples; `set_exploration_type(ExplorationType.DETERMINISTIC)` makes it take the likeliest action.
        A discrete action is an int64 index of shape [...], a continuous one two unbounded float32 numbers,
        which the environment clips to -1..1. The distribution's parameters are written beside them
        (`logits`, or `loc` and `scale`).
        """
        if self.trunk is None:
            return self.policy_head
        policy = ActorValueOperator(self.trunk, self.policy_head, self.value_head).get_policy_operator()
        # The trunk's output is wider than the observation and would fill the collected batch.
        policy.select_out_keys(*self.policy_head.out_keys)
        return policy

    @property
    def value(self) -> TensorDictModuleBase:
        """`observation` -> `state_value` of shape [..., 1]."""
        if self.trunk is None:
            return self.value_head
        return ActorValueOperator(self.trunk, self.policy_head, self.value_head).get_value_operator()


def build_actor_critic(
    network: NetworkConfig, observation_size: int, action_count: int | None, generator: torch.Generator
) -> ActorCritic:
    """Build the networks with weights drawn from `generator`.

    Args:
        network: Sizes and kind, or a class of the user's own: a `torch.nn.Module` called with the numbers of inputs and
            outputs, of which there is one for the policy and one for the value.
        observation_size: Length of `observation`.
        action_count: Number of discrete actions, or None for the two continuous ones.
        generator: Source of the initial weights; the global random state has no part in them.

    Raises:
        BadInput: a class of the user's own cannot be used.
    """
    outputs = CONTINUOUS_ACTION_SIZE if action_count is None else action_count
    if isinstance(network, OwnClass):
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(torch.randint(2**62, (), generator=generator)))
            layers, value = (
                build_own(network, "network.target", nn.Module, observation_size, size)
                for size in (outputs, 1)
            )
        initial_std = float(getattr(layers, "initial_std", _INITIAL_STD))
        policy = _policy("observation", layers, action_count is None, initial_std)
        return ActorCritic(policy, ValueOperator(value, in_keys=["observation"]))
    return _mlp(network, observation_size, outputs, action_count is None, generator)


def _mlp(
    network: MLPConfig, observation_size: int, outputs: int, continuous: bool, generator: torch.Generator
) -> ActorCritic:
    activation = _ACTIVATIONS[network.activation]

    def heads(
        in_key: str, in_features: int, hidden: tuple[int, ...]
    ) -> tuple[ProbabilisticActor, ValueOperator]:
        def mlp(outputs: int, gain: float) -> nn.Module:
            layers = MLP(in_features, outputs, num_cells=hidden, activation_class=activation)
            return _initialize(layers, gain, generator)

        policy = _policy(in_key, mlp(outputs, _POLICY_GAIN), continuous, network.initial_std)
        return policy, ValueOperator(mlp(1, _VALUE_GAIN), in_keys=[in_key])

    if not network.shared_trunk:
        return ActorCritic(*heads("observation", observation_size, network.hidden))
    width = network.hidden[-1]
    layers = MLP(
        observation_size,
        width,
        num_cells=network.hidden[:-1],
        activation_class=activation,
        activate_last_layer=True,
    )
    trunk = TensorDictModule(_initialize(layers, _HIDDEN_GAIN, generator), ["observation"], ["hidden"])
    return ActorCritic(*heads("hidden", width, ()), trunk)


def _policy(in_key: str, layers: nn.Module, continuous: bool, initial_std: float) -> ProbabilisticActor:
    if continuous:
        scale = AddStateIndependentNormalScale(CONTINUOUS_ACTION_SIZE, init_value=math.log(initial_std))
        layers, parameters, distribution = nn.Sequential(layers, scale), ["loc", "scale"], IndependentNormal
    else:
        parameters, distribution = ["logits"], Categorical
    return ProbabilisticActor(
        TensorDictModule(layers, [in_key], parameters),
        in_keys=parameters,
        distribution_class=distribution,
        # Non-finite parameters are caught where they arise (PPO.update); a check per distribution costs
        # about 40 us of a 1 ms gradient step.
        distribution_kwargs={"validate_args": False},
        return_log_prob=True,
        # The library's default is the mode: a policy called outside a collector would not explore.
        default_interaction_type=InteractionType.RANDOM,
    )


def _initialize(layers: nn.Module, head_gain: float, generator: torch.Generator) -> nn.Module:
    """Draw orthogonal weights and zero the biases; the last layer gets its own gain."""
    linear = [module for module in layers.modules() if isinstance(module, nn.Linear)]
    for layer in linear:
        gain = head_gain if layer is linear[-1] else _HIDDEN_GAIN
        nn.init.orthogonal_(layer.weight, gain, generator=generator)
        nn.init.zeros_(layer.bias)
    return layers
