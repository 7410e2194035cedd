"""The compiled inner loop of clipped PPO, for perceptrons on features.

A minibatch of a few hundred feature vectors is so small that TorchRL, TensorDict and autograd take four times as long
as its matrix products. Here the gradient of `ClipPPOLoss` is written out by hand, and an epoch is one compiled call.
Pictures, shared trunks, and networks and losses of the user's own go through autograd, see `PPO`.
"""

import functools
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController
from torch import Tensor, nn
from torchrl.modules import MLP, ProbabilisticActor

from deepracer_exp.config.learning import PPOConfig
from deepracer_exp.jit import njit

from .actor_critic import ActorCritic

Floats = NDArray[np.float32]

NO_ACTIVATION = -1
_ACTIVATIONS: dict[type[nn.Module], int] = {nn.ReLU: 0, nn.Tanh: 1, nn.ELU: 2, nn.SiLU: 3}
_LEAST_LOG_STD = math.log(1e-4)
"""Lower bound of the log standard deviation, as in the library's `AddStateIndependentNormalScale`."""
_HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)
_BETA1, _BETA2 = 0.9, 0.999
_NO_SCALE: Floats = np.zeros(0, np.float32)
COLUMNS = ("policy loss", "value loss", "entropy", "clip fraction", "kl", "gradient norm")
"""Columns returned for each gradient step: the value loss is weighted by `critic_coeff`, entropy and `kl` are in nats,
and the norm is that before clipping."""

# Sums may be reordered; NaN and infinity must be preserved, since they end a run.
compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "arcp", "nsz"})


class Steps(NamedTuple):
    """Steps that are learned from, N in a row."""

    observation: Floats
    """[N, features]."""
    action: NDArray[Any]
    """[N, 2] float32, or int64 [N] of a discrete policy."""
    log_prob: Floats
    """Log-probability or log-density of the action when it was collected, [N]."""
    advantage: Floats
    target: Floats
    """Target of the value network, [N]."""


class Scale(NamedTuple):
    """Log standard deviation of a continuous policy, (2,), empty for a discrete one, and its gradient."""

    log_std: Floats
    by_log_std: Floats


class Loss(NamedTuple):
    """Coefficients of the loss."""

    entropy_coeff: float
    critic_coeff: float
    clip_epsilon: float
    huber: bool
    """Whether the value loss is Huber's instead of the mean squared error."""


class InnerLoop:
    """Makes the gradient steps of an epoch, for a policy and a value network that share no layers."""

    def __init__(self, networks: ActorCritic, optimizer: torch.optim.Adam, config: PPOConfig) -> None:
        """Use the parameters of the networks and the moments of the optimizer in place.

        The networks fit (`fits`); the optimizer is that of `networks.parameters()`, without weight decay.
        """
        self._networks, self._optimizer, self._config = networks, optimizer, config
        layers, self._log_std = policy_layers(networks.policy_head)
        self._layers: tuple[nn.Module, nn.Module] = layers, networks.value_head.module
        self._second = ThreadPoolExecutor(1, "value network")
        self.gradients: dict[Tensor, Floats] = {
            parameter: np.zeros(parameter.shape, np.float32) for parameter in networks.parameters()
        }
        """Gradients of the last step, after clipping, by parameter."""

    @staticmethod
    def fits(networks: ActorCritic) -> bool:
        """Return whether the networks are perceptrons of `build_actor_critic` that share no layers."""
        heads = (policy_layers(networks.policy_head)[0], networks.value_head.module)
        return networks.trunk is None and all(map(is_plain, heads))

    def run(
        self, columns: Sequence[Tensor], size: int, lr: float, entropy_coeff: float, threads: int = 1
    ) -> Tensor:
        """Make the gradient steps of an epoch in place.

        Args:
            columns: Shuffled observation [N, features], action ([N, 2], or int64 [N] of a discrete policy),
                log-probability when it was collected, advantage and value target, each [N].
            size: Steps of a minibatch; N is a multiple of it.
            lr: Learning rate.
            entropy_coeff: Weight of the entropy bonus.
            threads: More than one: the two networks are differentiated at the same time. The result is the same.

        Returns:
            [gradient steps, `COLUMNS`]. It ends before the first step whose loss or gradient is not finite.
        """
        config = self._config
        policy, value = (self._arrays(layers, size) for layers in self._layers)
        scale = Scale(_NO_SCALE, _NO_SCALE)
        if self._log_std is not None:
            scale = Scale(self._log_std.detach().numpy(), self.gradients[self._log_std])
        moments, taken = self._moments()
        steps = Steps(*(column.numpy() for column in columns))
        loss = Loss(entropy_coeff, config.critic_coeff, config.clip_epsilon, config.loss_type == "huber")
        adam = (lr, config.max_grad_norm or math.inf, self._optimizer.defaults["eps"], taken)
        epoch = _epoch if threads == 1 else self._epoch_of_two
        _limit_products()
        table, made = epoch(steps, size, (policy, value, scale), loss, moments, adam)
        for parameter in self._networks.parameters():
            self._optimizer.state[parameter]["step"] += made
        return torch.from_numpy(table[:made])

    def _epoch_of_two(self, steps, size, networks, loss, moments, adam) -> tuple[Floats, int]:  # type: ignore[no-untyped-def]
        """Make the gradient steps of `_epoch`, bit for bit, with the value network on a thread of its own.

        The threads sleep while one waits for the other: waiting in a loop, as OpenMP does, takes away the core that
        the other needs on a busy machine.
        """
        policy, value, scale = networks
        minibatches = len(steps.action) // size
        table = np.zeros((minibatches, len(COLUMNS)), np.float32)
        for number in range(minibatches):
            row, minibatch = table[number], _minibatch(steps, number * size, size)
            values = self._second.submit(_value_gradient, minibatch, value, loss, row)
            _policy_gradient(minibatch, policy, scale, loss, row)
            values.result()
            if not _step(moments, adam, number, row):
                return table, number
        return table, minibatches

    def _arrays(self, layers: nn.Module, rows: int) -> tuple[Any, ...]:
        """Return weights, biases, their gradients, outputs, slopes and gradients by outputs, and the activation."""
        linear, activation = linear_layers(layers)
        return (
            tuple(layer.weight.detach().numpy() for layer in linear),
            tuple(layer.bias.detach().numpy() for layer in linear),
            tuple(self.gradients[layer.weight] for layer in linear),
            tuple(self.gradients[layer.bias] for layer in linear),
            *(outputs_of(linear, rows) for _ in range(3)),
            activation,
        )

    def _moments(self) -> tuple[tuple[Any, ...], int]:
        """Return (parameters, gradients, first moments, second moments), flat, and the gradient steps made so far."""
        state = self._optimizer.state
        rows = []
        for parameter, gradient in self.gradients.items():
            if not state[parameter]:
                zeros = torch.zeros_like(parameter)
                state[parameter] = {"step": torch.tensor(0.0), "exp_avg": zeros, "exp_avg_sq": zeros.clone()}
            adam = state[parameter]
            tensors = (parameter.detach(), torch.from_numpy(gradient), adam["exp_avg"], adam["exp_avg_sq"])
            rows.append(tuple(tensor.view(-1).numpy() for tensor in tensors))
        return tuple(zip(*rows, strict=True)), int(adam["step"])


@functools.cache
def _limit_products() -> None:
    """Limit matrix products in this process to one thread from now on: more would wait for one another.

    Limits for each call alone cost a millisecond an epoch.
    """
    ThreadpoolController().limit(limits=1, user_api="blas")


def is_plain(layers: nn.Module) -> bool:
    """Return whether layers are linear with biases, one kind of activation between them and none at the end."""
    if type(layers) is not MLP:  # a class of the user's own may compute anything
        return False
    linear, activations = list(layers.children())[::2], list(layers.children())[1::2]
    return (
        len(linear) == len(activations) + 1
        and all(type(layer) is nn.Linear and layer.bias is not None for layer in linear)
        and len({type(layer) for layer in activations}) <= 1
        and all(type(layer) in _ACTIVATIONS and getattr(layer, "alpha", 1.0) == 1.0 for layer in activations)
    )


def policy_layers(policy_head: ProbabilisticActor) -> tuple[nn.Module, nn.Parameter | None]:
    """Return a policy's layers and, of a continuous policy, the logarithm of its standard deviation."""
    policy = policy_head[0].module
    scale = (
        getattr(policy[-1], "state_independent_scale", None) if isinstance(policy, nn.Sequential) else None
    )
    return (policy, None) if scale is None else (policy[0], scale)


def linear_layers(layers: nn.Module) -> tuple[list[nn.Linear], int]:
    """Return the linear layers of a plain perceptron, and the number of its activation."""
    linear = [layer for layer in layers.children() if isinstance(layer, nn.Linear)]
    kinds = [_ACTIVATIONS[type(layer)] for layer in layers.children() if type(layer) in _ACTIVATIONS]
    return linear, kinds[0] if kinds else NO_ACTIVATION


def outputs_of(linear: Sequence[nn.Linear], rows: int) -> tuple[Floats, ...]:
    """Return an array for each layer's outputs, [rows, units]."""
    return tuple(np.empty((rows, layer.out_features), np.float32) for layer in linear)


@njit(cache=True, nogil=True)
def _epoch(steps, size, networks, loss, moments, adam):  # type: ignore[no-untyped-def]
    """Make the gradient steps; return the table of `COLUMNS` and how many rows of it were made.

    `networks` are arrays of policy and value network (`InnerLoop._arrays`) and the policy's `Scale`; `adam` are the
    learning rate, the largest norm, epsilon and the steps made so far.
    """
    policy, value, scale = networks
    minibatches = len(steps.action) // size
    table = np.zeros((minibatches, len(COLUMNS)), np.float32)
    for number in range(minibatches):
        row, minibatch = table[number], _minibatch(steps, number * size, size)
        _policy_gradient(minibatch, policy, scale, loss, row)
        _value_gradient(minibatch, value, loss, row)
        if not _step(moments, adam, number, row):
            return table, number
    return table, minibatches


@njit(cache=True, nogil=True)
def _minibatch(steps, first, size):  # type: ignore[no-untyped-def]
    """Return `size` of the steps from the `first` on."""
    rows = slice(first, first + size)
    return Steps(
        steps.observation[rows], steps.action[rows], steps.log_prob[rows], steps.advantage[rows],
        steps.target[rows],
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _policy_gradient(steps, policy, scale, loss, row):  # type: ignore[no-untyped-def]
    """Fill the policy's gradients, and its part of the row of `COLUMNS`."""
    outputs = _forward(steps.observation, policy)
    row[0], row[2], row[3], row[4] = _differentiate(outputs, policy[6][-1], steps.action, steps, scale, loss)
    _backward(steps.observation, policy)


@njit(cache=True, nogil=True)
def _value_gradient(steps, value, loss, row):  # type: ignore[no-untyped-def]
    """Fill the value network's gradients, and its part of the row of `COLUMNS`."""
    outputs = _forward(steps.observation, value)
    row[1] = _value_loss(outputs, value[6][-1], steps.target, loss)
    _backward(steps.observation, value)


@njit(cache=True, nogil=True)  # reordered, the test for finite numbers would find NaN finite
def _step(moments, adam, number, row):  # type: ignore[no-untyped-def]
    """Make a gradient step, `number` of the epoch; return whether losses and gradients were finite and it was made."""
    lr, max_norm, epsilon, taken = adam
    norm = _norm(moments[1])
    row[5] = norm
    if not np.isfinite(norm + row[0] + row[1] + row[2]):
        return False
    # As torch.nn.utils.clip_grads_with_norm_ does.
    share = min(1.0, max_norm / (norm + 1e-6))
    _adam(moments, np.float32(share), lr, taken + number + 1, epsilon)
    return True


@compiled
def _norm(gradients):  # type: ignore[no-untyped-def]
    square = 0.0
    for number in range(len(gradients)):
        for value in gradients[number]:
            square += value * value
    return math.sqrt(square)


@compiled
def _forward(inputs, network):  # type: ignore[no-untyped-def]
    """Fill outputs and slopes of the layers, and return the last outputs."""
    weights, biases, _, _, outputs, slopes, _, activation = network
    for number in range(len(weights)):
        out, bias = outputs[number], biases[number]
        if number == 0:
            np.dot(inputs, weights[number].T, out)
        else:
            np.dot(outputs[number - 1], weights[number].T, out)
        if number == len(weights) - 1:
            out += bias
        else:
            _activate(out, bias, slopes[number], activation)
    return outputs[-1]


@compiled
def _activate(values, bias, slopes, activation):  # type: ignore[no-untyped-def]
    """Add a bias, apply the activation and write its slope."""
    for row in range(values.shape[0]):
        for unit in range(values.shape[1]):
            values[row, unit], slopes[row, unit] = activated(values[row, unit] + bias[unit], activation)


@compiled
def activated(value, activation):  # type: ignore[no-untyped-def]
    """Return the activation of a number, and the derivative there."""
    one, zero = np.float32(1.0), np.float32(0.0)
    if activation == NO_ACTIVATION:
        slope = one
    elif activation == 0:
        slope = one if value > zero else zero
        value = value * slope if value == value else value
    elif activation == 1:
        value = np.tanh(value)
        slope = one - value * value
    elif activation == 2:
        slope = one if value > zero else np.exp(value)
        value = value if value > zero else slope - one
    else:
        share = one / (one + np.exp(-value))
        slope = share * (one + value * (one - share))
        value = value * share
    return value, slope


@compiled
def _backward(inputs, network):  # type: ignore[no-untyped-def]
    """Fill the gradients of weights and biases, given those by the last outputs."""
    weights, _, by_weights, by_biases, outputs, slopes, by_outputs, _ = network
    for number in range(len(weights) - 1, -1, -1):
        gradient = by_outputs[number]
        by_bias = by_biases[number]
        by_bias[:] = 0.0
        for row in range(gradient.shape[0]):
            for unit in range(gradient.shape[1]):
                by_bias[unit] += gradient[row, unit]
        if number == 0:
            np.dot(gradient.T, inputs, by_weights[number])
        else:
            np.dot(gradient.T, outputs[number - 1], by_weights[number])
            before, slope = by_outputs[number - 1], slopes[number - 1]
            np.dot(gradient, weights[number], before)
            for row in range(before.shape[0]):
                for unit in range(before.shape[1]):
                    before[row, unit] *= slope[row, unit]


@compiled
def limited_log_std(log_std):  # type: ignore[no-untyped-def]
    """Return the log standard deviations, (2,), with which a continuous policy samples."""
    return np.maximum(log_std, np.float32(_LEAST_LOG_STD))


@compiled
def log_density(action, loc, log_std):  # type: ignore[no-untyped-def]
    """Return the log-density of an action under a diagonal normal distribution; arguments are (2,)."""
    density = 0.0
    for axis in range(len(loc)):
        apart = (action[axis] - loc[axis]) * math.exp(-log_std[axis])
        density -= 0.5 * apart * apart + log_std[axis] + _HALF_LOG_2PI
    return density


@compiled
def log_sum(logits):  # type: ignore[no-untyped-def]
    """Return the log-sum-exp of logits: subtracted from them, it gives log-probabilities."""
    largest = logits.max()
    total = 0.0
    for index in range(len(logits)):
        total += math.exp(logits[index] - largest)
    return largest + math.log(total)


@compiled
def _differentiate(outputs, by_outputs, action, steps, scale, loss):  # type: ignore[no-untyped-def]
    """Write the gradient of the clipped loss and entropy bonus with respect to the policy's outputs and log scale.

    `action` is that of the steps, passed separately so that numba knows its dimensions. Returns the loss, the entropy,
    the share of clipped ratios and the KL divergence.

    Source of the loss: Schulman et al. 2017, arXiv 1707.06347, equation 7.
    """
    count, size = outputs.shape
    log_prob, advantage = steps.log_prob, steps.advantage
    entropy_coeff, clip_epsilon = loss.entropy_coeff, loss.clip_epsilon
    log_std, by_log_std = scale
    low, high = math.log1p(-clip_epsilon), math.log1p(clip_epsilon)
    policy_loss = entropy = clipped = kl = 0.0
    if action.ndim == 2:
        by_log_std[:] = -entropy_coeff
        log_scale = limited_log_std(log_std)
        for axis in range(size):
            entropy += log_scale[axis] + 0.5 + _HALF_LOG_2PI
    for step in range(count):
        if action.ndim == 2:
            now = log_density(action[step], outputs[step], log_scale)
        else:
            normal = log_sum(outputs[step])
            now = outputs[step, action[step]] - normal
        log_ratio = now - log_prob[step]
        ratio = math.exp(log_ratio)
        limited = min(max(log_ratio, low), high)
        gain = ratio * advantage[step]
        least = math.exp(limited) * advantage[step]
        inside = limited == log_ratio
        by_log_prob = -gain / count if inside or gain <= least else 0.0
        policy_loss -= min(gain, least)
        clipped += not inside
        # E[r - 1 - log r] for r = new / old probability: never negative, and far less noisy than E[-log r].
        kl += ratio - 1.0 - log_ratio
        if action.ndim == 2:
            for axis in range(size):
                shrink = math.exp(-log_scale[axis])
                apart = (action[step, axis] - outputs[step, axis]) * shrink
                by_outputs[step, axis] = by_log_prob * apart * shrink
                by_log_std[axis] += by_log_prob * (apart * apart - 1.0)
        else:
            step_entropy = 0.0
            for index in range(size):
                log_p = outputs[step, index] - normal
                step_entropy -= math.exp(log_p) * log_p
            entropy += step_entropy / count
            for index in range(size):
                log_p = outputs[step, index] - normal
                p = math.exp(log_p)
                by_outputs[step, index] = p * ((log_p + step_entropy) * entropy_coeff / count - by_log_prob)
            by_outputs[step, action[step]] += by_log_prob
    if action.ndim == 2:
        for axis in range(size):
            if log_std[axis] < _LEAST_LOG_STD:
                by_log_std[axis] = 0.0
    return policy_loss / count, entropy, clipped / count, kl / count


@compiled
def _value_loss(values, by_values, target, loss):  # type: ignore[no-untyped-def]
    """Return the value loss, and write its gradient with respect to the values."""
    count, total = len(target), 0.0
    huber, weight = loss.huber, loss.critic_coeff
    for step in range(count):
        error = values[step, 0] - target[step]
        if huber and abs(error) >= 1.0:
            total += abs(error) - 0.5
            slope = 1.0 if error > 0 else -1.0
        else:
            total += (0.5 if huber else 1.0) * error * error
            slope = error * (1.0 if huber else 2.0)
        by_values[step, 0] = slope * weight / count
    return total / count * weight


@compiled
def _adam(moments, share, lr, step, epsilon):  # type: ignore[no-untyped-def]
    """Scale the gradients and step along them. Source: Kingma and Ba 2015, arXiv 1412.6980, algorithm 1."""
    length = np.float32(lr / (1.0 - _BETA1**step))
    unbias = np.float32(1.0 / math.sqrt(1.0 - _BETA2**step))
    kept, kept_square = np.float32(_BETA1), np.float32(_BETA2)
    new, new_square, least = np.float32(1.0 - _BETA1), np.float32(1.0 - _BETA2), np.float32(epsilon)
    all_parameters, all_gradients, all_first, all_second = moments
    for number in range(len(all_parameters)):
        parameters, gradients = all_parameters[number], all_gradients[number]
        first, second = all_first[number], all_second[number]
        for index in range(len(parameters)):
            gradient = gradients[index] * share
            gradients[index] = gradient
            first[index] = kept * first[index] + new * gradient
            second[index] = kept_square * second[index] + new_square * gradient * gradient
            parameters[index] -= length * first[index] / (np.sqrt(second[index]) * unbias + least)
