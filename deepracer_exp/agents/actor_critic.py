"""Policy and value networks."""

import copy
import math

import torch
from tensordict.nn import (
    AddStateIndependentNormalScale,
    InteractionType,
    TensorDictModule,
    TensorDictModuleBase,
)
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution
from torchrl.modules import (
    MLP,
    ActorValueOperator,
    IndependentNormal,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)

from deepracer_exp.config.driving import ObservationShape
from deepracer_exp.config.learning import CNNConfig, NetworkConfig
from deepracer_exp.config.own_class import OwnClass, build_own
from deepracer_exp.errors import BadInput, reading

from .convolutions import convolve

CONTINUOUS_ACTION_SIZE = 2
"""Steering and speed."""

_ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU, "elu": nn.ELU, "silu": nn.SiLU}

# A policy that starts almost uniform (or centred) explores evenly; the value head starts at full scale.
HIDDEN_GAIN, POLICY_GAIN, VALUE_GAIN = math.sqrt(2), 0.01, 1.0
CRITIC_HIDDEN = (64, 64)
"""Units of a value network on features, for a policy on pictures."""
INITIAL_STD = 0.5
"""Initial standard deviation of a continuous policy on a user's network without an attribute `initial_std`."""


class PolicyNetworks(nn.Module):
    """A stochastic policy, with the further networks of its algorithm.

    Attributes:
        trunk: Layers that the policy shares with another network, -> `hidden`; None: it shares none.
        policy_head: The policy's layers after the trunk; without a trunk, all of them.
    """

    def __init__(self, policy_head: ProbabilisticActor, trunk: TensorDictModule | None = None) -> None:
        super().__init__()
        self.policy_head, self.trunk = policy_head, trunk

    @property
    def policy(self) -> TensorDictModuleBase:
        """The policy module of collectors: observation -> `action` and `action_log_prob`; it shares these parameters.

        It reads `observation`, or `pixels` and `lidar` where there are such sensors. It samples;
        `set_exploration_type(ExplorationType.DETERMINISTIC)` makes it take the likeliest action. A discrete action is
        an int64 index of shape [...], a continuous one two float32 numbers, which the environment clips to -1..1. The
        distribution's parameters are written beside them (`logits`, or `loc` and `scale`).
        """
        return self.policy_head

    @property
    def in_keys(self) -> list[str]:
        """Keys that the networks read."""
        raise NotImplementedError


class ActorCritic(PolicyNetworks):
    """A stochastic policy and a state value, with separate networks or on one trunk.

    Attributes:
        trunk: The shared part, -> `hidden`; None for separate networks.
        policy_head: The policy's layers after the trunk; without a trunk, all of them.
        value_head: The value's layers after the trunk; without a trunk, all of them.
    """

    def __init__(
        self,
        policy_head: ProbabilisticActor,
        value_head: ValueOperator,
        trunk: TensorDictModule | None = None,
    ) -> None:
        super().__init__(policy_head, trunk)
        self.value_head = value_head

    @property
    def policy(self) -> TensorDictModuleBase:
        """The policy of `PolicyNetworks`; continuous actions are unbounded."""
        if self.trunk is None:
            return self.policy_head
        policy = ActorValueOperator(self.trunk, self.policy_head, self.value_head).get_policy_operator()
        # The trunk's output is wider than the observation and would fill the collected batch.
        policy.select_out_keys(*self.policy_head.out_keys)
        return policy

    @property
    def value(self) -> TensorDictModuleBase:
        """The module from `in_keys`, or `observation`, to `state_value` of shape [..., 1]."""
        if self.trunk is None:
            return self.value_head
        return ActorValueOperator(self.trunk, self.policy_head, self.value_head).get_value_operator()

    @property
    def in_keys(self) -> list[str]:
        """Entries that policy and value read."""
        return sorted({*self.policy.in_keys, *self.value.in_keys})


def build_actor_critic(
    network: NetworkConfig,
    observed: ObservationShape,
    action_count: int | None,
    generator: torch.Generator | None,
) -> ActorCritic:
    """Build the networks with weights drawn from `generator`.

    Args:
        network: Sizes and kind, or a class of the user's own: a `torch.nn.Module` called with the numbers of inputs and
            outputs, once for the policy and once for the value. With a camera the inputs are channels,
            height and width of `pixels`; the number of a LIDAR's readings follows as an argument of its own.
        observed: The observation to read.
        action_count: Number of discrete actions, or None for the two continuous ones.
        generator: Source of the initial weights; the global random state has no part in them. None: they will be
            replaced.

    Raises:
        BadInput: a class of the user's own cannot be used.
    """
    continuous = action_count is None
    outputs = CONTINUOUS_ACTION_SIZE if action_count is None else action_count
    if isinstance(network, OwnClass):
        keys = list(observed.seen)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(torch.randint(2**62, (), generator=generator)))
            policy_network, value = (own_network(network, observed, size) for size in (outputs, 1))
        with reading(f"network.target={network.target}: initial_std"):
            initial_std = float(getattr(policy_network, "initial_std", INITIAL_STD))
        return ActorCritic(
            _policy(keys, policy_network, continuous, initial_std), ValueOperator(value, in_keys=keys)
        )
    keys = list(observed.seen) if isinstance(network, CNNConfig) else ["observation"]

    def layers(outputs: int | None, gain: float) -> nn.Module:
        """Build layers for the observation; without `outputs` the last hidden layer is the output."""
        net: nn.Module = (
            SensorNet(network, observed, outputs)
            if isinstance(network, CNNConfig)
            else dense(observed.features, network.hidden, network.activation, outputs)
        )
        return initialize(net, gain, generator)

    if network.shared_trunk:
        trunk = TensorDictModule(layers(None, HIDDEN_GAIN), keys, ["hidden"])

        def head(outputs: int, gain: float) -> nn.Module:
            return initialize(nn.Sequential(nn.Linear(network.hidden[-1], outputs)), gain, generator)

        policy = _policy(["hidden"], head(outputs, POLICY_GAIN), continuous, network.initial_std)
        return ActorCritic(policy, ValueOperator(head(1, VALUE_GAIN), in_keys=["hidden"]), trunk)
    policy = _policy(keys, layers(outputs, POLICY_GAIN), continuous, network.initial_std)
    if not isinstance(network, CNNConfig) or network.critic == "pictures":
        return ActorCritic(policy, ValueOperator(layers(1, VALUE_GAIN), in_keys=keys))
    critic = dense(observed.features, CRITIC_HIDDEN, network.activation, 1)
    return ActorCritic(
        policy, ValueOperator(initialize(critic, VALUE_GAIN, generator), in_keys=["observation"])
    )


def own_network(network: OwnClass, observed: ObservationShape, outputs: int) -> nn.Module:
    """Build a network of the user's own and call a copy of it, with two observations."""
    # The number itself where an input has only one axis.
    inputs = [shape if len(shape) > 1 else shape[0] for shape in observed.seen.values()]
    built = build_own(network, "network.target", nn.Module, *inputs, outputs)
    seen = [
        torch.zeros(2, *shape, dtype=torch.uint8 if key == "pixels" else torch.float32)
        for key, shape in observed.seen.items()
    ]
    what = f"network.target={network.target}"
    with reading(what), torch.no_grad():
        output = copy.deepcopy(built).eval()(*seen)
    shape = tuple(output.shape) if isinstance(output, Tensor) else type(output).__name__
    if shape != (2, outputs):
        raise BadInput(what, f"returns {shape} for two observations", f"a tensor of shape (2, {outputs})")
    return built


def dense(inputs: int, hidden: tuple[int, ...], activation: str, outputs: int | None = None) -> MLP:
    """Return a perceptron; without `outputs` its last hidden layer is the output."""
    *before, last = hidden if outputs is None else (*hidden, outputs)
    return MLP(
        inputs,
        last,
        num_cells=before,
        activation_class=_ACTIVATIONS[activation],
        activate_last_layer=outputs is None,
    )


class SensorNet(nn.Module):
    """Convolutions for pictures, layers for a LIDAR, and a perceptron that joins them.

    Called with pictures, uint8 [..., channels, height, width], or readings, float32 [..., readings], or both; returns
    float32 [..., outputs]. With pictures, products are in bfloat16 on a GPU, and on processors with instructions for it
    (updates are 1.7 to 2.4 times as fast with AVX-512 BF16, three times with AMX); pictures are convolved as `convolve`
    says.
    """

    def __init__(
        self, config: CNNConfig, observed: ObservationShape, outputs: int | None, actions: int = 0
    ) -> None:
        """Build the layers; without `outputs` the last hidden layer is the output.

        With `actions`, that many numbers follow the sensors as the last input and join them, as for a critic.
        """
        super().__init__()
        activation = config.activation
        size, hidden = 0, config.hidden
        self.has_action = actions > 0
        self.has_picture, self.has_lidar = observed.picture is not None, observed.lidar is not None
        self.half_precision: bool = self.has_picture and torch.cpu.get_capabilities().get(
            "avx512_bf16", False
        )
        if observed.picture is not None:
            channels, *pixels = observed.picture
            layers: list[nn.Module] = []
            for filters, kernel, stride in zip(config.filters, config.kernels, config.strides, strict=True):
                layers += [nn.Conv2d(channels, filters, kernel, stride), _ACTIVATIONS[activation]()]
                channels = filters
            height, width = config.outputs(*pixels)
            if config.attention is not None:
                layers.insert(-1, Attention(channels, config.attention))
                height = 1
            self.convolutions = nn.Sequential(*layers)
            self.embedder: nn.Module = nn.Identity()
            size = channels * height * width
        if observed.lidar is not None:
            if config.lidar_joins_after:
                alone, hidden = hidden[: config.lidar_joins_after], hidden[config.lidar_joins_after :]
                self.embedder, size = dense(size, alone, activation), alone[-1]
            self.lidar = dense(observed.lidar, config.lidar_hidden, activation)
            size += config.lidar_hidden[-1]
        self.perceptron = dense(size + actions, hidden, activation, outputs)

    def forward(self, *sensed: Tensor) -> Tensor:
        """Return the outputs."""
        actions = []
        if self.has_action:
            sensed, actions = sensed[:-1], [sensed[-1].reshape(-1, sensed[-1].shape[-1])]
        batch = sensed[-1].shape[:-1] if self.has_lidar else sensed[0].shape[:-3]
        half = self.has_picture and (self.half_precision or sensed[0].is_cuda)
        parts = []
        if self.has_lidar:
            parts.append(self.lidar(sensed[-1].reshape(-1, sensed[-1].shape[-1])))
        with torch.autocast(sensed[0].device.type, torch.bfloat16, enabled=half):
            if self.has_picture:
                pictures = sensed[0].reshape(-1, *sensed[0].shape[-3:])
                if torch.compiler.is_exporting():
                    places = self.convolutions(pictures.to(torch.float32) / 255).flatten(1)
                else:
                    places = convolve(self.convolutions, pictures, torch.bfloat16 if half else torch.float32)
                parts.insert(0, self.embedder(places))
            parts += actions
            outputs = self.perceptron(parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1))
        return outputs.float().reshape(*batch, -1)


class Attention(nn.Module):
    """Attention pooling over the height of a picture, [n, channels, height, width] -> [n, channels, 1, width].

    The weights of each column sum to 1. Columns are not mixed, so that directions are kept. Source: deepracer-simapp,
    `bundle/markov/presets/left_stereo_attention.py`.
    """

    def __init__(self, channels: int, units: int) -> None:
        """Build the layer of `units` that scores each place."""
        super().__init__()
        self.score, self.weight = nn.Linear(channels, units), nn.Linear(units, 1)

    def forward(self, places: Tensor) -> Tensor:
        """Return the sums."""
        return (self.weights(places) * places).sum(dim=2, keepdim=True)

    def weights(self, places: Tensor) -> Tensor:
        """Return the weight of each place, [n, 1, height, width]."""
        scores = self.weight(self.score(places.movedim(1, -1)).tanh())
        return scores.movedim(-1, 1).softmax(dim=2)


def _policy(
    in_keys: list[str], layers: nn.Module, continuous: bool, initial_std: float
) -> ProbabilisticActor:
    if not continuous:
        return actor(in_keys, layers, Categorical)
    scale = AddStateIndependentNormalScale(CONTINUOUS_ACTION_SIZE, init_value=math.log(initial_std))
    return actor(in_keys, _Gaussian(layers, scale), IndependentNormal)


def actor(in_keys: list[str], layers: nn.Module, distribution: type[Distribution]) -> ProbabilisticActor:
    """Return a policy whose layers give the parameters of its distribution: `logits`, or `loc` and `scale`."""
    parameters = ["logits"] if distribution is Categorical else ["loc", "scale"]
    return ProbabilisticActor(
        TensorDictModule(layers, in_keys, parameters),
        in_keys=parameters,
        distribution_class=distribution,
        # Non-finite parameters are caught where they arise (PPO.update); a check per distribution costs
        # about 40 us of a 1 ms gradient step.
        distribution_kwargs={} if distribution is TanhNormal else {"validate_args": False},
        return_log_prob=True,
        # The library's default is the mode: a policy called outside a collector would not explore.
        default_interaction_type=InteractionType.RANDOM,
    )


class _Gaussian(nn.Sequential):
    """Layers for one or more inputs, and the scale after them."""

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        layers, scale = self
        parameters: tuple[Tensor, ...] = scale(layers(*inputs))
        return parameters


def initialize(layers: nn.Module, head_gain: float, generator: torch.Generator | None) -> nn.Module:
    """Draw orthogonal weights and zero the biases; the last layer gets its own gain."""
    if generator is None:
        return layers
    linear = [module for module in layers.modules() if isinstance(module, nn.Linear | nn.Conv2d)]
    for layer in linear:
        gain = head_gain if layer is linear[-1] else HIDDEN_GAIN
        nn.init.orthogonal_(layer.weight, gain, generator=generator)
        if layer.bias is not None:
            nn.init.zeros_(layer.bias)
    return layers
