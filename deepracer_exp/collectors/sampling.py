"""Actions that depend on the car and not on the process it drives in."""

from collections.abc import Mapping
from typing import Any

import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.distributions import Categorical, Distribution, Independent
from torchrl.modules import TanhNormal

from deepracer_exp.agents.compiled_policy import CompiledPolicy

NOISE = "noise"
"""Standard normal numbers of each car for its next action, float64: one for an index, two for steering and speed."""


class SamplingPolicy(TensorDictModuleBase):
    """A policy that draws each car's action from the car's own random numbers, the key `NOISE`.

    Sampling from a generator of the process would make a run depend on how its cars are spread over processes. It has
    the policy's inputs, shares its parameters, and writes `action` and `action_log_prob`.
    """

    def __init__(self, policy: TensorDictModuleBase) -> None:
        """Wrap an `ActorCritic.policy`."""
        super().__init__()
        self.policy = policy
        self.in_keys, self.out_keys = [*policy.in_keys, NOISE], ["action", "action_log_prob"]
        self._compiled = CompiledPolicy.of(policy)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add action and log-probability."""
        for key, values in self.act({key: tensordict.get(key).numpy() for key in self.in_keys}).items():
            tensordict.set(key, torch.from_numpy(values))
        return tensordict

    def act(self, seen: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Return `action` and `action_log_prob` of N cars for their observations, (N, ...) by key."""
        if self._compiled is not None:
            action, log_prob = self._compiled.sample(seen["observation"], seen[NOISE])
            return {"action": action, "action_log_prob": log_prob}
        noise = torch.from_numpy(seen[NOISE])
        read = {key: torch.from_numpy(seen[key]) for key in self.policy.in_keys}
        drawn = _drawn(self.policy.get_dist(TensorDict(read, [len(noise)])), noise)
        return dict(zip(self.out_keys, (values.detach().numpy() for values in drawn), strict=True))


def _drawn(distribution: Distribution, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Return samples for standard normal numbers and their log-density, by the inverse of the distribution function."""
    if isinstance(distribution, Categorical):
        below = distribution.probs.cumsum(-1)[..., :-1]  # the last is 1, up to rounding
        action = (torch.special.ndtr(noise) >= below).sum(-1)
        return action, distribution.log_prob(action)
    if isinstance(distribution, TanhNormal):
        # Scored before the tangent, which cannot be inverted near -1 and 1.
        before, log_prob = _drawn(distribution.base_dist, noise)
        (tangent,) = distribution.transforms
        action = tangent(before)
        return action, log_prob - tangent.log_abs_det_jacobian(before, action).sum(-1)
    assert isinstance(distribution, Independent)
    normal = distribution.base_dist
    action = normal.loc + normal.scale * noise.to(normal.loc.dtype)
    return action, distribution.log_prob(action)
