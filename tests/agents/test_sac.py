import copy
import dataclasses
import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from deepracer_exp.agents.build import build_networks
from deepracer_exp.agents.sac import SAC
from deepracer_exp.agents.schedules import PresetSchedule
from deepracer_exp.agents.soft_actor_critic import SoftActorCritic
from deepracer_exp.config.driving import ObservationShape
from deepracer_exp.config.learning import ConstantLR, MLPConfig, SACConfig
from deepracer_exp.errors import RunFailed

from .test_ppo import drive, parameters, train

CONFIG = SACConfig(
    lr=3e-3,
    batch_size=64,
    discount=0.5,
    loss_type="mean squared error",
    max_grad_norm=0.0,
    frames_per_iteration=256,
    episodes_per_iteration=None,
    steps_per_gradient_step=32.0,
    warmup_steps=0,
    replay_steps=10_000,
    replay_mb=100,
    alpha=0.1,
    learn_alpha=True,
    target_entropy=-2.0,
    target_entropy_share=0.2,
    tau=0.05,
)
forms = pytest.mark.parametrize("actions", [None, 3], ids=["continuous", "list"])


def make(
    actions: int | None = None, seed: int = 0, device: str = "cpu", **changes: object
) -> tuple[SoftActorCritic, SAC]:
    network = MLPConfig(hidden=(16, 16), activation="tanh", shared_trunk=False, initial_std=0.5)
    config = dataclasses.replace(CONFIG, **changes)
    generator = torch.Generator().manual_seed(seed)
    networks = build_networks(network, config, ObservationShape(4), actions, generator)
    schedule = PresetSchedule(ConstantLR(kind="constant", by="iteration", warmup=0))
    return networks, SAC(networks, config, schedule, seed, torch.device(device))


@forms
def test_it_learns_to_take_the_action_that_is_rewarded(actions):
    networks, sac = make(actions, alpha=0.02, lr=1e-2, steps_per_gradient_step=16.0)
    rewards = train(networks, sac, 20)
    if actions:
        assert rewards[0] < 0.5 < 0.7 < sum(rewards[-3:]) / 3
    else:
        assert rewards[0] < -1.2 < -0.6 < sum(rewards[-3:]) / 3


@forms
def test_a_restored_agent_continues_bit_for_bit(actions):
    networks, sac = make(actions)
    train(networks, sac, 3)
    state, steps = copy.deepcopy((sac.state_dict(), sac.replay.state_dict()))
    others, resumed = make(actions, seed=9)
    resumed.load_state_dict(state)
    resumed.replay.load_state_dict(steps)
    for one, algorithm in ((networks, sac), (others, resumed)):
        train(one, algorithm, 3, start=3)
    assert torch.equal(parameters(networks), parameters(others))
    assert sac.update(drive(networks), 6, 0.0) == resumed.update(drive(others), 6, 0.0)


@forms
def test_the_same_seed_gives_identical_parameters_whatever_the_global_stream_does(actions):
    runs = []
    for seed, disturbance in ((5, 1), (5, 2), (6, 1)):
        networks, sac = make(actions, seed=seed)
        for iteration in range(2):
            batch = drive(networks, seed=iteration)
            torch.manual_seed(disturbance)
            sac.update(batch, iteration, 0.0)
        runs.append(parameters(networks))
    assert torch.equal(runs[0], runs[1])
    assert not torch.equal(runs[0], runs[2])


def test_gradient_steps_are_in_proportion_to_the_steps_driven_after_the_warm_up():
    networks, sac = make(steps_per_gradient_step=100.0, warmup_steps=300)
    made = [sac.update(drive(networks, seed=i), i, 0.0).gradient_steps for i in range(6)]
    assert made == [0, 2, 3, 2, 3, 2]  # 256 steps each


def test_an_update_without_a_gradient_step_changes_nothing_and_reports_no_losses():
    networks, sac = make(warmup_steps=1000)
    before = parameters(networks)
    metrics = sac.update(drive(networks), 0, 0.0)
    assert torch.equal(parameters(networks), before)
    assert (metrics.policy_loss, metrics.value_loss, metrics.entropy, metrics.gradient_steps) == (
        None,
        None,
        None,
        0,
    )


@pytest.mark.parametrize("actions", [None, 3])
def test_the_temperature_leads_the_entropy_to_its_target(actions):
    networks, sac = make(actions, lr=2e-2, alpha=1.0, target_entropy=0.5, target_entropy_share=0.6)
    target = 0.6 * math.log(3) if actions else 0.5
    for iteration in range(25):
        metrics = sac.update(drive(networks, seed=iteration), iteration, 0.0)
    assert metrics.target_entropy == pytest.approx(target)
    assert metrics.entropy == pytest.approx(target, abs=0.2)
    assert metrics.alpha < 0.9


def test_a_fixed_temperature_stays_and_has_no_target():
    networks, sac = make(learn_alpha=False, alpha=0.2)
    for iteration in range(3):
        metrics = sac.update(drive(networks, seed=iteration), iteration, 0.0)
    assert metrics.alpha == pytest.approx(0.2)
    assert metrics.target_entropy is None


def targets(sac: SAC) -> torch.Tensor:
    held = sac.state_dict()["loss"].items()
    return torch.cat([value.flatten() for name, value in held if name.startswith("target_")])


def test_targets_follow_by_tau_at_each_gradient_step():
    networks, sac = make(tau=0.25, steps_per_gradient_step=256.0)
    before = parameters(networks.critics)
    assert torch.allclose(targets(sac).sort().values, before.sort().values)
    sac.update(drive(networks), 0, 0.0)
    after = parameters(networks.critics)
    # As a sum, since TorchRL orders them in another way.
    assert targets(sac).sum().item() == pytest.approx((0.75 * before + 0.25 * after).sum().item(), abs=1e-4)
    assert not torch.equal(before, after)


def test_it_begins_with_the_critics_of_another_run():
    networks, sac = make()
    train(networks, sac, 3)
    others, clone = make(seed=4)
    clone.begin_with(networks)
    assert torch.equal(parameters(networks), parameters(others))
    assert torch.allclose(targets(clone).sort().values, parameters(networks.critics).sort().values)
    assert len(clone.replay) == 0


def test_the_policy_never_leaves_its_range_and_races_by_the_tangent_of_the_mean():
    networks, _ = make()
    with torch.no_grad():
        for parameter in networks.policy_head.parameters():
            parameter.mul_(30.0)
        seen = TensorDict({"observation": torch.randn(200, 4)}, [200])
        assert networks.policy(seen.clone())["action"].abs().max() <= 1.0
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            acted = networks.policy(seen.clone())
    assert torch.allclose(acted["action"], acted["loc"].tanh(), atol=1e-6)


@pytest.mark.parametrize("key", ["observation", ("next", "reward")])
def test_a_number_that_is_not_finite_is_named_and_nothing_is_learned(key):
    networks, sac = make()
    batch = drive(networks)
    before = parameters(networks)
    batch[key][3, 4] = math.nan
    with pytest.raises(RunFailed, match=f"{' '.join(key) if isinstance(key, tuple) else key} is nan"):
        sac.update(batch, 0, 0.0)
    assert torch.equal(parameters(networks), before)
    assert len(sac.replay) == 0


def test_a_loss_that_is_not_finite_is_named_and_the_step_is_not_made():
    networks, sac = make()
    with torch.no_grad():
        sac._loss.qvalue_network_params.data.apply_(lambda weights: weights.fill_(math.inf))
    before = parameters(networks.policy_head)
    with pytest.raises(RunFailed, match=r"(policy loss|loss of the critics) is .*not made"):
        sac.update(drive(networks), 0, 0.0)
    assert torch.equal(parameters(networks.policy_head), before)
