"""The forward pass of a perceptron policy on features, compiled.

With a hundred cars, TensorDict, modules and distributions take ten times as long as a pass's matrix products.
"""

import math
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch.distributions import Categorical
from torchrl.modules import IndependentNormal, ProbabilisticActor

from .inner_loop import (
    NO_ACTIVATION,
    activated,
    compiled,
    is_plain,
    limited_log_std,
    linear_layers,
    log_density,
    log_sum,
    outputs_of,
    policy_layers,
)

Floats = NDArray[np.float32]
Actions = NDArray[np.float32] | NDArray[np.int64]


class CompiledPolicy:
    """Computes actions with a policy's present weights."""

    def __init__(self, policy: ProbabilisticActor) -> None:
        """Use the parameters of a policy that fits (`of`) in place."""
        layers, self._log_std = policy_layers(policy)
        self._linear, self._activation = linear_layers(layers)
        self._outputs = outputs_of(self._linear, 0)

    @classmethod
    def of(cls, policy: torch.nn.Module) -> Self | None:
        """Return the compiled pass of a policy; None unless it is a perceptron of `build_actor_critic`."""
        fits = (
            isinstance(policy, ProbabilisticActor)
            and policy.in_keys == ["observation"]
            and policy[-1].distribution_class in (Categorical, IndependentNormal)
            and is_plain(policy_layers(policy)[0])
            and next(policy.parameters()).device.type == "cpu"
        )
        return cls(policy) if fits else None

    def sample(self, observation: Floats, noise: NDArray[np.float64]) -> tuple[Actions, Floats]:
        """Sample an action for each row; return it with its log-probability or log-density.

        Args:
            observation: [N, features].
            noise: Standard normal numbers to sample with: one for an index, [N, 1], two for steering and speed, [N, 2].

        Returns:
            int64 [N] or float32 [N, 2], and float32 [N].
        """
        outputs = self._pass(observation)
        log_prob = np.empty(len(outputs), np.float32)
        if self._log_std is None:
            indices = np.empty(len(outputs), np.int64)
            _sample_indices(outputs, noise, indices, log_prob)
            return indices, log_prob
        commands = np.empty_like(outputs)
        _sample_commands(outputs, self._log_std.detach().numpy(), noise, commands, log_prob)
        return commands, log_prob

    def likeliest(self, observation: Floats) -> Actions:
        """Return the likeliest action for each row of observations, [N, features]: int64 [N] or float32 [N, 2]."""
        outputs = self._pass(observation)
        return outputs.argmax(axis=1) if self._log_std is None else outputs.copy()

    def _pass(self, observation: Floats) -> Floats:
        """Return the outputs of the last layer, valid until the next call."""
        if len(self._outputs[0]) != len(observation):
            self._outputs = outputs_of(self._linear, len(observation))
        inputs = observation
        for number, (layer, outputs) in enumerate(zip(self._linear, self._outputs, strict=True), 1):
            kind = self._activation if number < len(self._linear) else NO_ACTIVATION
            weights = np.ascontiguousarray(layer.weight.detach().numpy().T)
            _layer(inputs, weights, layer.bias.detach().numpy(), kind, outputs)
            inputs = outputs
        return inputs


@compiled
def _layer(inputs, weights, bias, activation, outputs):  # type: ignore[no-untyped-def]
    """Write the outputs of a layer, [N, units], for weights [inputs, units].

    A row is always summed in the same order. In a BLAS, the order depends on the number of rows, and a run would depend
    on how its cars are spread over processes. Four rows at a time read each weight once, which takes half the time.
    """
    rows, units = outputs.shape
    together = rows - rows % 4
    for row in range(0, together, 4):
        y0, y1, y2, y3 = outputs[row], outputs[row + 1], outputs[row + 2], outputs[row + 3]
        for unit in range(units):
            y0[unit] = y1[unit] = y2[unit] = y3[unit] = bias[unit]
        for place in range(inputs.shape[1]):
            x0, x1 = inputs[row, place], inputs[row + 1, place]
            x2, x3 = inputs[row + 2, place], inputs[row + 3, place]
            for unit in range(units):
                weight = weights[place, unit]
                y0[unit] += x0 * weight
                y1[unit] += x1 * weight
                y2[unit] += x2 * weight
                y3[unit] += x3 * weight
    for row in range(together, rows):
        output = outputs[row]
        output[:] = bias
        for place in range(inputs.shape[1]):
            value = inputs[row, place]
            for unit in range(units):
                output[unit] += value * weights[place, unit]
    for row in range(rows):
        for unit in range(units):
            outputs[row, unit], _ = activated(outputs[row, unit], activation)


@compiled
def _sample_commands(loc, log_std, noise, commands, log_prob):  # type: ignore[no-untyped-def]
    """Write steering and speed, [N, 2], and their log-densities, [N]."""
    scale = limited_log_std(log_std)
    for row in range(len(loc)):
        for axis in range(loc.shape[1]):
            commands[row, axis] = loc[row, axis] + math.exp(scale[axis]) * noise[row, axis]
        log_prob[row] = log_density(commands[row], loc[row], scale)


@compiled
def _sample_indices(logits, noise, indices, log_prob):  # type: ignore[no-untyped-def]
    """Sample indices, [N], by inverse transform, and write them with their log-probabilities."""
    for row in range(len(logits)):
        normal = log_sum(logits[row])
        # The standard normal distribution function.
        share = 0.5 * math.erfc(-noise[row, 0] * math.sqrt(0.5))
        below = 0.0
        index = 0
        for candidate in range(logits.shape[1] - 1):
            below += math.exp(logits[row, candidate] - normal)
            index += share >= below
        indices[row], log_prob[row] = index, logits[row, index] - normal
