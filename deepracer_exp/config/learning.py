"""Network, algorithm and learning-rate schedule."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag

from .bounds import Fraction, NonNegative, Positive, UpTo1000
from .own_class import OURS_OR_OWN, OwnClass, Reference

# Eight layers of this size take seconds to build; of twice the size, minutes.
Units = Annotated[int, Field(ge=1, le=2048)]
Steps = Annotated[int, Field(ge=1, le=10**7)]
By = Literal["iteration", "fraction"]
"""Unit of a schedule's lengths: training iterations, or fractions of the budget (0 to 1)."""


@dataclass(frozen=True, kw_only=True)
class MLPConfig:
    """A multi-layer perceptron for policy and value."""

    hidden: Annotated[tuple[Units, ...], Field(min_length=1, max_length=8)]
    activation: Literal["tanh", "relu", "elu", "silu"]
    shared_trunk: bool
    initial_std: Positive


@dataclass(frozen=True, kw_only=True)
class CNNConfig:
    """Convolutional layers without padding for the pictures of a camera, then a multi-layer perceptron.

    The readings of a LIDAR go through layers of their own and join before one of the perceptron's.
    """

    filters: Annotated[tuple[Annotated[int, Field(ge=1, le=512)], ...], Field(max_length=8)]
    kernels: tuple[Annotated[int, Field(ge=1, le=16)], ...]
    strides: tuple[Annotated[int, Field(ge=1, le=8)], ...]
    hidden: Annotated[tuple[Units, ...], Field(min_length=1, max_length=8)]
    activation: Literal["tanh", "relu", "elu", "silu"]
    critic: Literal["features", "pictures"]
    shared_trunk: bool
    initial_std: Positive
    attention: Units | None = None
    lidar_hidden: Annotated[tuple[Units, ...], Field(min_length=1, max_length=8)] = (32, 32)
    lidar_joins_after: Annotated[int, Field(ge=0, le=7)] = 0

    def __post_init__(self) -> None:
        """Refuse layers that are not complete, and a trunk that has nothing to share."""
        if not len(self.filters) == len(self.kernels) == len(self.strides):
            raise ValueError("filters, kernels and strides: one number each per layer")
        if self.shared_trunk and self.critic == "features":
            raise ValueError("shared_trunk=true: a value network that sees features has no layers to share")
        if self.attention is not None and not self.filters:
            raise ValueError(f"attention={self.attention}: needs filters; accepted without: null")

    def outputs(self, height: int, width: int) -> tuple[int, int]:
        """Return height and width after the convolutions; below 1 where a picture is too small for them."""
        for kernel, stride in zip(self.kernels, self.strides, strict=True):
            height, width = (height - kernel) // stride + 1, (width - kernel) // stride + 1
        return height, width


def _network_kind(value: Any) -> str:
    """Return the tag of a network's values."""
    if isinstance(value, dict) and "target" in value:
        return "own"
    return "cnn" if isinstance(value, dict) and "kernels" in value else "mlp"


NetworkConfig = Annotated[
    Annotated[MLPConfig, Tag("mlp")] | Annotated[CNNConfig, Tag("cnn")] | Annotated[OwnClass, Tag("own")],
    Discriminator(_network_kind),
]


@dataclass(frozen=True, kw_only=True)
class AlgorithmConfig:
    """The hyperparameters of every algorithm: gradient step and length of an iteration."""

    lr: Positive
    batch_size: Annotated[int, Field(ge=1, le=10**6)]
    discount: Fraction
    loss_type: Literal["huber", "mean squared error"]
    max_grad_norm: NonNegative
    frames_per_iteration: Steps | None
    episodes_per_iteration: Annotated[int, Field(ge=1, le=10**5)] | None


@dataclass(frozen=True, kw_only=True)
class PPOConfig(AlgorithmConfig):
    """Clipped PPO, whose hyperparameters mean what they do in DeepRacer; or an algorithm of your own with them."""

    epochs: UpTo1000
    gae_lambda: Fraction
    clip_epsilon: Positive
    entropy_coeff: NonNegative
    entropy_end_factor: NonNegative = 1.0
    critic_coeff: Positive
    compiled: bool = True
    target: Reference | None = None
    kwargs: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse arguments for a class that is not named."""
        if self.kwargs and self.target is None:
            raise ValueError("kwargs are arguments of a class of your own; give target=package.module:Class")


@dataclass(frozen=True, kw_only=True)
class SACConfig(AlgorithmConfig):
    """Soft actor-critic with a replay of past steps."""

    steps_per_gradient_step: Annotated[float, Field(ge=0.01, le=10**6, allow_inf_nan=False)]
    warmup_steps: Annotated[int, Field(ge=0, le=10**7)]
    replay_steps: Annotated[int, Field(ge=1, le=10**8)]
    replay_mb: Annotated[int, Field(ge=1, le=4000)]  # a checkpoint is read up to 4 GiB
    alpha: Positive
    learn_alpha: bool
    target_entropy: Annotated[float, Field(ge=-100, le=1.4, allow_inf_nan=False)]
    target_entropy_share: Fraction
    tau: Annotated[float, Field(gt=0, le=1)]


ALGORITHMS: tuple[type[AlgorithmConfig], ...] = (PPOConfig, SACConfig)


def algorithm_kind(values: Mapping[str, Any]) -> type[AlgorithmConfig]:
    """Return the class of an algorithm's values: the one whose keys differ least from theirs."""
    return min(ALGORITHMS, key=lambda kind: len(_keys(kind) ^ values.keys()))


def keys_of_others(kind: type[AlgorithmConfig]) -> list[str]:
    """Return the keys that other algorithms have and this one does not."""
    others = (key.name for other in ALGORITHMS for key in fields(other))
    return [key for key in dict.fromkeys(others) if key not in _keys(kind)]


def _keys(kind: type[AlgorithmConfig]) -> set[str]:
    return {key.name for key in fields(kind)}


OneAlgorithm = Annotated[
    Annotated[PPOConfig, Tag("PPOConfig")] | Annotated[SACConfig, Tag("SACConfig")],
    Discriminator(lambda value: (algorithm_kind(value) if isinstance(value, dict) else PPOConfig).__name__),
]
"""Configuration of any algorithm, recognised by its keys."""


@dataclass(frozen=True, kw_only=True)
class _WarmedUp:
    by: By
    warmup: NonNegative


@dataclass(frozen=True, kw_only=True)
class ConstantLR(_WarmedUp):
    """The learning rate stays as it is after the warm-up."""

    kind: Literal["constant"]


@dataclass(frozen=True, kw_only=True)
class FallingLR(_WarmedUp):
    """A straight line, or half a cosine, down to `end_factor` over `length`."""

    kind: Literal["linear", "cosine"]
    length: Positive
    end_factor: NonNegative


@dataclass(frozen=True, kw_only=True)
class MultipliedLR(_WarmedUp):
    """Multiplied by `factor` after every `length`, or over each `length` continuously."""

    kind: Literal["step", "exponential"]
    length: Positive
    factor: Positive


@dataclass(frozen=True, kw_only=True)
class AdaptiveKLLR(_WarmedUp):
    """Raised while the policy moves less than `target_kl` an iteration, lowered while it moves more."""

    kind: Literal["adaptive_kl"]
    target_kl: Positive
    step_factor: Annotated[float, Field(gt=1, allow_inf_nan=False)]
    lowest_factor: Positive
    highest_factor: Positive


PresetLR = ConstantLR | FallingLR | MultipliedLR | AdaptiveKLLR
LRScheduleConfig = Annotated[
    Annotated[PresetLR, Field(discriminator="kind"), Tag("ours")] | Annotated[OwnClass, Tag("own")],
    OURS_OR_OWN,
]
