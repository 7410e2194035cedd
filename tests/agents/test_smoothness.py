"""`algorithm.smoothness`: actions in neighbouring states come closer to each other, and nothing else changes."""

import copy
import dataclasses
import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint

from deepracer_exp.agents.actor_critic import ActorCritic, build_actor_critic
from deepracer_exp.agents.algorithm import Algorithm
from deepracer_exp.agents.build import build_agent
from deepracer_exp.agents.ppo import PPO, Distillation
from deepracer_exp.agents.smoothness import Smoothness
from deepracer_exp.config import acting
from deepracer_exp.config.compose import compose_option
from deepracer_exp.config.driving import ObservationShape
from deepracer_exp.config.learning import CNNConfig, LRScheduleConfig
from deepracer_exp.config.own_class import allow_given
from deepracer_exp.errors import BadInput, RunFailed

from .test_ppo import KINDS, drive, make, parameters, train

COMMANDS = torch.tensor([[-1.0, 0.0], [0.0, 0.0], [1.0, 0.0]])
STRENGTH = 0.5


def smooth(
    shared: bool = False,
    actions: int | None = 3,
    seed: int = 0,
    device: str = "cpu",
    smoothness: float = STRENGTH,
    **changes: object,
) -> tuple[ActorCritic, PPO]:
    networks, plain = make(shared, actions, seed, device, smoothness=smoothness, **changes)
    if smoothness:
        plain.smooth(COMMANDS if actions else None)
    return networks, plain


def apart(networks: ActorCritic, batch: TensorDict) -> float:
    """Return how far apart the most probable steering of successive states is."""
    with torch.no_grad():
        found = [networks.policy.get_dist(some.select("observation")) for some in (batch, batch["next"])]
    steering = [
        COMMANDS[one.probs.argmax(-1), 0] if hasattr(one, "probs") else one.mean[..., 0] for one in found
    ]
    return (steering[0] - steering[1]).abs().mean().item()


@pytest.mark.parametrize(("shared", "actions"), KINDS)
def test_a_policy_trained_with_it_steers_more_evenly(shared, actions):
    found = []
    for strength in (0.0, 3.0):
        networks, ppo = smooth(shared, actions, smoothness=strength)
        train(networks, ppo, 20)
        found.append(apart(networks, drive(networks, seed=99)))
    assert found[1] < 0.7 * found[0]


@pytest.mark.parametrize(("shared", "actions"), KINDS)
def test_without_it_nothing_is_added_to_batch_loss_or_checkpoint(shared, actions):
    networks, ppo = smooth(shared, actions, smoothness=0.0)
    same, plain = make(shared, actions)
    train(networks, ppo, 2)
    train(same, plain, 2)
    assert torch.equal(parameters(networks), parameters(same))
    assert set(ppo.state_dict()) == {"networks", "schedule", "optimizer", "generator"}
    steps, _ = ppo._prepare(drive(networks))
    assert "successor" not in steps


def test_a_step_is_compared_with_the_next_of_its_own_episode():
    networks, ppo = smooth()
    batch = drive(networks)
    steps, _ = ppo._prepare(batch)
    assert batch["next", "done"].any()
    assert torch.equal(steps["successor", "observation"], batch["next", "observation"].reshape(-1, 4))


def policy_of(logits: torch.Tensor) -> ActorCritic:
    """Return networks whose policy prefers actions by the first entry of the observation: `logits` where positive."""
    networks, _ = make(actions=3)

    class Fixed(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.logits = torch.nn.Parameter(logits.clone())

        def forward(self, observation: torch.Tensor) -> torch.Tensor:
            return torch.where(observation[..., :1] > 0, self.logits[0], self.logits[1])

    networks.policy_head.module[0].module = Fixed()
    return networks


def loss_of(networks: ActorCritic) -> float:
    """Return the unweighted loss where each state follows one of the other kind."""
    loss = Smoothness(networks, 1.0, COMMANDS, 0, torch.device("cpu"))
    observation = torch.tensor([[5.0, 0, 0, 0], [-5.0, 0, 0, 0]]).repeat(8, 1)
    steps = TensorDict({"observation": observation, "successor": {"observation": -observation}}, [16])
    loss._weight = torch.ones(())
    return loss(steps, torch.zeros(()), networks.policy.get_dist(steps)).item()


LEFT, RIGHT, EITHER = [-9.0, -9.0, 9.0], [9.0, -9.0, -9.0], [5.0, -5.0, 5.0]


def test_a_policy_that_cannot_choose_between_left_and_right_is_not_smooth():
    even, turning, undecided = (
        loss_of(policy_of(torch.tensor(one))) for one in ([LEFT, LEFT], [LEFT, RIGHT], [EITHER, EITHER])
    )
    assert even == pytest.approx(0.0, abs=1e-6)
    assert undecided > 0.9
    assert turning > 0.9


def test_it_costs_the_same_to_turn_in_one_step_as_in_several():
    networks, _ = make(actions=None)
    loss = Smoothness(networks, 1.0, None, 0, torch.device("cpu"))
    at_once = torch.tensor([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]])
    slowly = torch.tensor([[0.0, 0.0], [0.5, 0.0], [1.0, 0.0]])
    back_and_forth = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    costs = [loss._distance(one[1:], one[:-1]).mean().item() for one in (at_once, slowly, back_and_forth)]
    assert costs[0] == pytest.approx(costs[1], rel=0.02)
    assert costs[2] == pytest.approx(2 * costs[0], rel=0.02)


@pytest.mark.parametrize(("shared", "actions"), KINDS)
def test_its_gradient_is_as_long_as_asked_for(shared, actions):
    networks, ppo = smooth(shared, actions)
    train(networks, ppo, 1)
    steps, _ = ppo._prepare(drive(networks, seed=5))
    losses = ppo.loss(steps if networks.trunk is None else networks.trunk(steps))
    policy = list(networks.policy.parameters())
    lengths = []
    for key in ("loss_objective", "loss_smoothness"):
        # A continuous policy's deviation has no part in its mean.
        gradient = torch.autograd.grad(losses[key], policy, retain_graph=True, allow_unused=True)
        lengths.append(torch.nn.utils.get_total_norm([one for one in gradient if one is not None]).item())
    assert lengths[1] == pytest.approx(STRENGTH * lengths[0], rel=1e-3)


@pytest.mark.parametrize(("shared", "actions"), KINDS)
def test_a_restored_learner_continues_bit_for_bit(shared, actions, tmp_path):
    networks, ppo = smooth(shared, actions)
    train(networks, ppo, 2)
    Checkpoint(agent=ppo).save(tmp_path / "checkpoint")
    train(networks, ppo, 2, start=2)
    others, restored = smooth(shared, actions, seed=77)
    Checkpoint(agent=restored).load(tmp_path / "checkpoint")
    train(others, restored, 2, start=2)
    assert torch.equal(parameters(networks), parameters(others))


def test_a_policy_trained_without_it_can_be_trained_on_with_it():
    networks, ppo = make()
    train(networks, ppo, 1)
    others, restored = smooth(seed=3)
    restored.load_state_dict(copy.deepcopy(ppo.state_dict()))
    assert torch.equal(parameters(networks), parameters(others))
    train(others, restored, 1, start=1)


@pytest.mark.parametrize(
    "device",
    [
        "cpu:0",
        pytest.param(
            "cuda",
            marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch finds no GPU here"),
        ),
    ],
)
def test_another_device_computes_the_same(device):
    results = []
    for one in ("cpu", device):
        networks, ppo = smooth(device=one)
        train(networks, ppo, 2)
        results.append(parameters(networks))
    if device == "cpu:0":
        assert torch.equal(*results)
    else:  # the variants are drawn there
        assert all(torch.isfinite(one).all() for one in results)


def test_a_teacher_is_imitated_as_without_it():
    results = []
    for strength in (0.0, STRENGTH):
        networks, ppo = smooth(smoothness=strength)
        teacher, _ = make(seed=7)
        config = dataclasses.replace(ppo.config, teacher_iterations=2, teacher_batch_size=32)
        pupil = Distillation(networks, config, ppo.schedule, 0, teacher.policy)
        if strength:
            pupil.smooth(COMMANDS)
        train(networks, pupil, 2)
        results.append(parameters(networks))
    assert torch.equal(*results)


def pictures_network(actions: int | None = 3) -> ActorCritic:
    network = CNNConfig(
        filters=(4,),
        kernels=(4,),
        strides=(4,),
        hidden=(8,),
        activation="relu",
        critic="features",
        shared_trunk=False,
        initial_std=0.5,
    )
    observed = ObservationShape(4, (1, 24, 32), 8)
    return build_actor_critic(network, observed, actions, torch.Generator().manual_seed(0))


def test_a_picture_has_variants_that_are_pictures_of_the_same_place():
    networks = pictures_network()
    loss = Smoothness(networks, 1.0, COMMANDS, 0, torch.device("cpu"))
    ramp = torch.arange(24 * 32).reshape(1, 1, 24, 32) * 200 // (24 * 32) + 20
    seen = {"pixels": ramp.to(torch.uint8).repeat(6, 1, 1, 1), "lidar": torch.rand(6, 8)}
    variant = loss._variant(TensorDict(seen, [6]))
    assert variant["pixels"].dtype == torch.uint8
    assert variant["pixels"].shape == seen["pixels"].shape
    for before, after in zip(seen["pixels"].float(), variant["pixels"].float(), strict=True):
        assert 0 < (before - after).abs().mean() < 40
        assert torch.corrcoef(torch.stack([before.flatten(), after.flatten()]))[0, 1] > 0.95
    assert 0 < (variant["lidar"] - seen["lidar"]).abs().max() < 0.05


@pytest.mark.parametrize("actions", [3, None])
def test_pictures_are_compared_with_those_beside_them_in_the_minibatch(actions):
    networks = pictures_network(actions)
    loss = Smoothness(networks, 1.0, COMMANDS if actions else None, 0, torch.device("cpu"))
    assert loss.in_pairs
    pixels = torch.randint(0, 256, (2, 4, 1, 24, 32), dtype=torch.uint8)
    done = torch.zeros(2, 4, 1, dtype=torch.bool)
    done[0, 2] = True
    batch = TensorDict({"pixels": pixels, "lidar": torch.rand(2, 4, 8), "next": {"done": done}}, [2, 4])
    steps = batch.select("pixels", "lidar").reshape(-1)
    loss.prepare(steps, batch)
    # 2 ended an episode, 4 is another car's, and 1 and 4 are no pair.
    order = torch.tensor([2, 3, 0, 1, 4, 5, 3, 4])
    minibatch = steps[order]
    acted = networks.policy.get_dist(minibatch)
    seed = loss._generator.get_state()
    objective = (acted.logits if actions else acted.mean).square().mean()
    found = loss(minibatch, objective, acted)
    shown = networks.policy.get_dist_params(steps)
    ours = loss._actions(shown)
    pairs = [(0, 1), (4, 5)]
    expected = torch.stack([loss._distance(ours[[a]], ours[[b]])[0] for a, b in pairs]).mean()
    loss._generator.set_state(seed)
    varied = loss._actions(networks.policy.get_dist_params(loss._variant(minibatch[::4])))
    expected = expected + loss._distance(ours[order[::4]], varied).mean()
    assert found.item() == pytest.approx((loss._weight * expected).item(), rel=1e-3)
    found.backward()
    assert any(one.grad is not None and one.grad.any() for one in networks.policy.parameters())


@pytest.mark.parametrize("count", [1, 8, 9])
def test_pairs_are_all_steps_in_another_order(count):
    order = Smoothness.pairs(count, torch.Generator().manual_seed(0)).tolist()
    assert sorted(order) == list(range(count))
    assert all(order[order.index(step) + 1] == step + 1 for step in range(0, count - 1, 2))


def test_a_policy_gone_bad_is_named_before_the_gradient_step():
    networks, ppo = smooth()
    steps, _ = ppo._prepare(drive(networks))
    steps["successor", "observation"][0] = math.nan
    before = parameters(networks)
    with pytest.raises(RunFailed, match="smoothness loss is nan"):
        ppo._gradient_step(steps)
    assert torch.equal(parameters(networks), before)


class Own(PPO):
    """A class of the user's own, which knows nothing of smoothness."""


class NoLoss(Algorithm):
    pass


def built(own: type[Algorithm], actions: int | None) -> tuple[ActorCritic, Algorithm]:
    networks, plain = make(actions=actions, smoothness=STRENGTH)
    config = dataclasses.replace(plain.config, target=f"{own.__module__}:{own.__name__}")
    allow_given([f"algorithm.target={config.target}"])
    schedule = compose_option("lr_schedule", "constant", LRScheduleConfig)
    return networks, build_agent(networks, config, schedule, 0, commands=COMMANDS if actions else None)


@pytest.mark.parametrize("actions", [3, None])
def test_an_own_ppo_has_it_too(actions, monkeypatch):
    monkeypatch.setattr(acting, "_named", {})
    networks, own = built(Own, actions)
    other, ppo = smooth(actions=actions)
    for agent, driven in ((own, networks), (ppo, other)):
        agent.update(drive(driven), 0, 0.0)
    assert own.state_dict()["smoothness"].keys() == ppo.state_dict()["smoothness"].keys()


def test_what_is_no_ppo_is_refused(monkeypatch):
    monkeypatch.setattr(acting, "_named", {})
    with pytest.raises(BadInput, match=r"algorithm.smoothness=0.5: .*NoLoss is no PPO; accepted: 0"):
        built(NoLoss, 3)
