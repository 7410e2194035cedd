"""Smoothness of a policy: a loss on how far apart its actions are in states that are close to each other.

A policy that chooses -20 degrees in one state and +20 in the next makes the car zig-zag. The loss is that of CAPS
(Mysore et al. 2021, arXiv 2012.06644), temporal plus spatial:

    L_T = D(pi(s_t), pi(s_t+1)),   L_S = D(pi(s), pi(s')),   s' a variant of s

For pictures the variants are other pictures of the same place, as in image-based regularisation of action smoothness
(Cao et al. 2023, arXiv 2307.08230), which also has the idea that the weight follows the loss's impact on the update
instead of being a constant; what "impact" means here is said at `Smoothness`.
"""

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.distributions import Categorical, Distribution, Independent

from .actor_critic import ActorCritic

FEATURE_NOISE, LIDAR_NOISE = 0.05, 0.02
"""Standard deviations of a variant's noise; features are scaled to about -1 to 1, readings to 0 to 1."""
BRIGHTNESS, CONTRAST, PIXEL_NOISE = 25.0, 0.2, 8.0
"""Largest change of a variant's brightness (of 255) and contrast (a share), and of each pixel (of 255)."""
TEMPERATURE = 0.3
"""Temperature at which a discrete policy's actions are compared.

The policy that races takes the most probable action. Towards 0 only that one counts, and the loss has no gradient; at
1 the loss is that of the drawn actions, and asks for less exploration rather than for smoother driving.
"""
_LARGEST_WEIGHT = 10.0
"""Weight of the loss over `algorithm.smoothness` at most, for a policy that is sure of its actions: its loss then has
almost no gradient."""
_ROUNDING = 0.01
"""Distance below which the loss of a continuous policy is round instead of pointed."""
_VARIED_EVERY = 4
"""Steps of a minibatch of pictures for each one that is compared with a variant."""
_LARGEST_SEED = 2**62


class Smoothness:
    """The loss of a policy whose actions change much from state to state, and its weight.

    D is the distance |c - c'| of two commands c = (steering, speed), each -1 to 1 over the range of the action space.
    It is not squared: turning into a bend then costs as much in one step as in five, and only going back and forth
    costs more, however small the angle. A continuous policy's command is its mean, before it is clipped. A discrete
    policy's are drawn from its probabilities, sharpened to p^(1 / TEMPERATURE), independently in both states:

        D = E|c - c'| = sum_ij p_i p'_j |c_i - c_j|

    The difference of the expected commands, |E c - E c'|, would be 0 for a policy that likes -20 and +20 degrees
    equally in every state, which is the zig-zag itself; E|c - c'| is 0 only if it likes one action in both.

    Passes of a network of pictures take nearly all of an update. There the successors are the minibatch's own: steps
    are shuffled in pairs, and each is compared with the next one in its pair; one step of four has a variant. So a
    policy of pictures sees a quarter more states for it, one of features three times as many.

    The weight is set once an update, so that the gradient of the loss is `strength` times as long as that of the
    policy's objective, both over the policy's parameters, in the update's first minibatch.
    """

    def __init__(
        self,
        networks: ActorCritic,
        strength: float,
        commands: Tensor | None,
        seed: int,
        device: torch.device,
    ) -> None:
        """Set up the loss.

        Args:
            networks: the ones that learn, on `device`.
            strength: length of the loss's gradient over that of the policy's objective.
            commands: [actions, 2], steering and speed of each action, -1 to 1; None for a continuous policy.
            seed: of the stream of the variants.
            device: where the loss is computed.

        `in_pairs` says whether a minibatch is to have each step beside the next, as `pairs` orders them.
        """
        self._policy, self._head = networks.policy, networks.policy_head
        self._parameters = list(self._policy.parameters())
        self.in_pairs = "pixels" in self._policy.in_keys
        self._strength, self._device = strength, device
        self._distances = None if commands is None else torch.cdist(commands, commands).to(device)
        self._generator = torch.Generator().manual_seed(seed)
        self._on_device = torch.Generator(device)
        self._weight: Tensor | None = None

    def prepare(self, steps: TensorDictBase, batch: TensorDictBase) -> None:
        """Begin an update: add to its steps [N] what the policy sees one control step later, as `successor`.

        `batch` is that of `Algorithm.update`: what follows the last step of an episode is that episode's last state,
        so that no two episodes are compared. In pairs, `number` of each step is added instead, and `continues`: whether
        the one with the next number follows it.
        """
        self._weight = None
        if self.in_pairs:
            continues = ~batch["next", "done"].squeeze(-1)
            continues[..., -1] = False
            steps["continues"] = continues.reshape(-1)
            steps["number"] = torch.arange(len(steps), device=self._device)
        else:
            steps["successor"] = batch["next"].select(*self._policy.in_keys).reshape(-1)

    def __call__(self, minibatch: TensorDictBase, objective: Tensor, acted: Distribution) -> Tensor:
        """Return the weighted loss of a minibatch, a scalar.

        Args:
            minibatch: [N] steps with what the policy's head reads, what the policy sees, and what `prepare` added.
            objective: the policy's loss in the same minibatch, with its graph.
            acted: the policy's distribution in these steps, with its graph.
        """
        loss = self._of_pairs(minibatch, acted) if self.in_pairs else self._of_successors(minibatch)
        if self._weight is None:
            share = self._length(objective) / self._length(loss).clamp_min(torch.finfo(loss.dtype).tiny)
            self._weight = self._strength * share.clamp_max(_LARGEST_WEIGHT)
        return self._weight * loss

    def _of_successors(self, minibatch: TensorDictBase) -> Tensor:
        # Both in one pass of the network.
        others = TensorDict.cat([minibatch["successor"], self._variant(minibatch)])
        ours = self._actions(self._head.get_dist_params(minibatch))
        theirs = self._actions(self._policy.get_dist_params(others))
        return 2 * self._distance(torch.cat([ours, ours]), theirs).mean()

    def _of_pairs(self, minibatch: TensorDictBase, acted: Distribution) -> Tensor:
        assert isinstance(acted, Categorical | Independent)
        seen = {"logits": acted.logits} if isinstance(acted, Categorical) else {"loc": acted.base_dist.loc}
        ours, number = self._actions(seen), minibatch["number"]
        follows = minibatch["continues"][:-1] & (number[1:] == number[:-1] + 1)
        successive = (self._distance(ours[:-1], ours[1:]) * follows).sum() / follows.sum().clamp_min(1)
        some = minibatch[::_VARIED_EVERY]
        varied = self._actions(self._policy.get_dist_params(self._variant(some)))
        return successive + self._distance(ours[::_VARIED_EVERY], varied).mean()

    def state_dict(self) -> dict[str, Tensor]:
        """Return the stream of the variants."""
        return {"generator": self._generator.get_state()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore a `state_dict`."""
        self._generator.set_state(state["generator"])

    def _actions(self, parameters: TensorDictBase | Mapping[str, Tensor]) -> Tensor:
        """Return a continuous policy's command, [N, 2], or a discrete one's sharpened probabilities, [N, n]."""
        if self._distances is None:
            return parameters["loc"]
        return (parameters["logits"] / TEMPERATURE).softmax(-1)

    def _distance(self, actions: Tensor, others: Tensor) -> Tensor:
        """Return the distances between two batches of actions, [N], both as `_actions` returns them."""
        if self._distances is None:
            # Its gradient at 0 must exist.
            return ((actions - others).square().sum(-1) + _ROUNDING**2).sqrt()
        return ((actions @ self._distances) * others).sum(-1)

    def _length(self, loss: Tensor) -> Tensor:
        """Return the length of a loss's gradient over the policy's parameters."""
        gradients = torch.autograd.grad(loss, self._parameters, retain_graph=True, allow_unused=True)
        return torch.nn.utils.get_total_norm([gradient for gradient in gradients if gradient is not None])

    def _variant(self, steps: TensorDictBase) -> TensorDict:
        """Return what the policy could have seen instead: features and readings with noise, other pictures."""
        seed = torch.randint(_LARGEST_SEED, (), generator=self._generator)
        self._on_device.manual_seed(int(seed))
        seen = {key: self._varied(key, steps[key]) for key in self._policy.in_keys}
        return TensorDict(seen, steps.batch_size)

    def _varied(self, key: str, values: Tensor) -> Tensor:
        if key != "pixels":
            noise = FEATURE_NOISE if key == "observation" else LIDAR_NOISE
            return values + noise * self._uniform(values.shape) * 3**0.5
        each = (len(values), 1, 1, 1)
        picture = values.float()
        middle = picture.mean((-3, -2, -1), keepdim=True)
        picture = (picture - middle) * (1 + CONTRAST * self._uniform(each)) + middle
        picture += BRIGHTNESS * self._uniform(each) + PIXEL_NOISE * self._uniform(values.shape)
        return picture.round_().clamp_(0, 255).to(torch.uint8)

    @staticmethod
    def pairs(count: int, generator: torch.Generator) -> Tensor:
        """Return the numbers up to `count` in random pairs of an even one and the next."""
        first = 2 * torch.randperm((count + 1) // 2, generator=generator)
        both = torch.stack([first, first + 1], dim=-1).reshape(-1)
        return both[both < count]

    def _uniform(self, shape: Sequence[int]) -> Tensor:
        """Draw numbers from -1 to 1."""
        return 2 * torch.rand(shape, generator=self._on_device, device=self._device) - 1
