import io
import math
from multiprocessing.reduction import ForkingPickler

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from deepracer_exp.agents.actor_critic import ActorCritic, build_actor_critic
from deepracer_exp.config.driving import ObservationShape
from deepracer_exp.config.learning import MLPConfig

KINDS = [(shared, actions) for shared in (False, True) for actions in (5, None)]


def build(shared: bool = False, actions: int | None = 5, seed: int = 0, std: float = 0.5) -> ActorCritic:
    network = MLPConfig(hidden=(16, 16), activation="tanh", shared_trunk=shared, initial_std=std)
    return build_actor_critic(network, ObservationShape(4), actions, torch.Generator().manual_seed(seed))


def steps(count: int) -> TensorDict:
    observation = torch.randn(count, 4, generator=torch.Generator().manual_seed(1))
    return TensorDict({"observation": observation}, [count])


@pytest.mark.parametrize(("shared", "actions"), KINDS)
def test_the_policy_writes_only_what_a_batch_needs(shared, actions):
    driven = build(shared, actions).policy(steps(6))
    parameters = {"logits"} if actions else {"loc", "scale"}
    assert set(driven.keys()) == {"observation", "action", "action_log_prob"} | parameters
    assert driven["action_log_prob"].shape == (6,)
    assert driven["action"].dtype == (torch.int64 if actions else torch.float32)


@pytest.mark.parametrize(("shared", "actions"), KINDS)
def test_the_policy_carries_no_value_network(shared, actions):
    networks = build(shared, actions)
    value_only = {id(p) for p in networks.value_head.parameters()}
    assert value_only.isdisjoint(id(p) for p in networks.policy.parameters())


@pytest.mark.parametrize(("shared", "actions"), KINDS)
def test_the_policy_survives_the_way_to_a_spawned_process(shared, actions):
    policy = build(shared, actions).policy
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        expected = policy(steps(6))
        # Not ForkingPickler's reductions of tensors: those share memory through a live parent.
        buffer = io.BytesIO()
        torch.save(policy, buffer)
        buffer.seek(0)
        arrived = torch.load(buffer, weights_only=False)(steps(6))
    assert (arrived == expected).all()
    ForkingPickler.dumps(policy)


@pytest.mark.parametrize(("shared", "actions"), KINDS)
def test_the_generator_alone_decides_the_initial_weights(shared, actions):
    torch.manual_seed(1)
    one = build(shared, actions).state_dict()
    torch.manual_seed(2)
    other = build(shared, actions).state_dict()
    assert all(torch.equal(one[key], other[key]) for key in one)
    different = build(shared, actions, seed=9).state_dict()
    assert any(not torch.equal(one[key], different[key]) for key in one)


@pytest.mark.parametrize("shared", [False, True])
def test_a_new_discrete_policy_is_almost_uniform(shared):
    distribution = build(shared, 5).policy.get_dist(steps(100))
    assert distribution.entropy().mean().item() == pytest.approx(math.log(5), abs=1e-3)


@pytest.mark.parametrize("shared", [False, True])
def test_a_new_continuous_policy_is_centred_with_the_initial_std(shared):
    driven = build(shared, None, std=0.3).policy(steps(100))
    assert driven["loc"].abs().max() < 0.1
    torch.testing.assert_close(driven["scale"], torch.full((100, 2), 0.3))


@pytest.mark.parametrize(("shared", "actions"), KINDS)
def test_the_policy_explores_unless_asked_not_to(shared, actions):
    policy = build(shared, actions).policy
    assert not torch.equal(policy(steps(50))["action"], policy(steps(50))["action"])


def test_exploitation_takes_the_likeliest_action():
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        discrete, continuous = build().policy(steps(50)), build(actions=None).policy(steps(50))
    assert torch.equal(discrete["action"], discrete["logits"].argmax(-1))
    assert torch.equal(continuous["action"], continuous["loc"])


def test_a_shared_trunk_is_one_set_of_weights():
    networks = build(shared=True)
    trunk = {id(p) for p in networks.trunk.parameters()}
    assert trunk <= {id(p) for p in networks.policy.parameters()}
    assert trunk <= {id(p) for p in networks.value.parameters()}
    assert len(networks.state_dict()) == len(list(networks.parameters())) == 8
