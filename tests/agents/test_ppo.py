import dataclasses
import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint

from deepracer_exp.agents.actor_critic import ActorCritic, PolicyNetworks, build_actor_critic
from deepracer_exp.agents.algorithm import Algorithm
from deepracer_exp.agents.ppo import PPO
from deepracer_exp.agents.schedules import PresetSchedule
from deepracer_exp.config.driving import ObservationShape
from deepracer_exp.config.learning import AdaptiveKLLR, MLPConfig, PPOConfig
from deepracer_exp.errors import RunFailed

CONFIG = PPOConfig(
    lr=3e-3,
    batch_size=64,
    epochs=4,
    discount=0.9,
    gae_lambda=0.8,
    clip_epsilon=0.2,
    entropy_coeff=0.0,
    critic_coeff=0.5,
    loss_type="huber",
    max_grad_norm=0.5,
    frames_per_iteration=256,
    episodes_per_iteration=None,
)
KINDS = [(shared, actions) for shared in (False, True) for actions in (3, None)]


def make(
    shared: bool = False, actions: int | None = 3, seed: int = 0, device: str = "cpu", **changes: object
) -> tuple[ActorCritic, PPO]:
    network = MLPConfig(hidden=(16, 16), activation="tanh", shared_trunk=shared, initial_std=0.5)
    networks = build_actor_critic(network, ObservationShape(4), actions, torch.Generator().manual_seed(seed))
    schedule = PresetSchedule(
        AdaptiveKLLR(
            kind="adaptive_kl",
            by="iteration",
            warmup=0,
            target_kl=0.01,
            step_factor=1.5,
            lowest_factor=0.1,
            highest_factor=2.0,
        )
    )
    config = dataclasses.replace(CONFIG, **changes)
    return networks, PPO(networks, config, schedule, seed, torch.device(device))


def drive(networks: PolicyNetworks, cars: int = 8, length: int = 32, seed: int = 0) -> TensorDict:
    """Made-up driving: the action named by the observation pays 1, episodes end at random."""
    generator = torch.Generator().manual_seed(seed)
    observation = torch.randn(cars, length + 1, 4, generator=generator)
    batch = TensorDict({"observation": observation[:, :-1]}, [cars, length])
    # Another seed than the observations': the action noise must not be a copy of them.
    torch.manual_seed(seed + 1000)
    with torch.no_grad():
        networks.policy(batch)
    if batch["action"].dtype == torch.int64:
        reward = (batch["action"] == batch["observation"][..., :3].argmax(-1)).float()
    else:
        reward = -(batch["action"] - batch["observation"][..., :2].clamp(-1, 1)).square().sum(-1)
    terminated = torch.rand(cars, length, 1, generator=generator) < 0.1
    truncated = ~terminated & (torch.rand(cars, length, 1, generator=generator) < 0.1)
    done = terminated | truncated
    # The last observation of an episode is another one than the first of the next.
    final = torch.where(done, torch.randn(cars, length, 4, generator=generator), observation[:, 1:])
    batch["next"] = TensorDict(
        {
            "observation": final,
            "reward": reward.unsqueeze(-1),
            "done": done,
            "terminated": terminated,
            "truncated": truncated,
        },
        [cars, length],
    )
    return batch


def train(networks: PolicyNetworks, agent: Algorithm, iterations: int, start: int = 0) -> list[float]:
    rewards = []
    for iteration in range(start, start + iterations):
        batch = drive(networks, seed=iteration)
        rewards.append(batch["next", "reward"].mean().item())
        agent.update(batch, iteration, 0.0)
    return rewards


def parameters(networks: ActorCritic) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in networks.parameters()])


@pytest.mark.parametrize(("shared", "actions"), KINDS)
def test_it_learns_to_take_the_action_that_pays(shared, actions):
    networks, ppo = make(shared, actions)
    rewards = train(networks, ppo, 20)
    if actions:
        assert rewards[0] < 0.5 < 0.7 < sum(rewards[-3:]) / 3
    else:
        assert rewards[0] < -1.2 < -0.5 < sum(rewards[-3:]) / 3


@pytest.mark.parametrize(("shared", "actions"), KINDS)
def test_the_same_seed_gives_identical_parameters(shared, actions):
    runs = []
    for seed in (5, 5, 6):
        networks, ppo = make(shared, actions, seed)
        train(networks, ppo, 2)
        runs.append(parameters(networks))
    assert torch.equal(runs[0], runs[1])
    assert not torch.equal(runs[0], runs[2])


@pytest.mark.parametrize(("shared", "actions"), KINDS)
def test_a_copy_on_another_device_teaches_the_networks_that_drive(shared, actions):
    results = []
    for device in ("cpu", "cpu:0"):  # the second is another device by name, and computes the same
        networks, ppo = make(shared, actions, device=device)
        again, restored = make(shared, actions, seed=1, device=device)
        ppo._compiled = restored._compiled = None  # only the CPU has it
        train(networks, ppo, 2)
        restored.load_state_dict(ppo.state_dict())
        train(again, restored, 2, start=2)
        results.append((parameters(networks), parameters(again)))
    for one, other in zip(*results, strict=True):
        assert torch.equal(one, other)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch finds no GPU here")
@pytest.mark.parametrize(("shared", "actions"), KINDS)
def test_a_gpu_learns_what_the_processor_learns(shared, actions):
    results = []
    for device in ("cpu", "cuda", "cuda"):
        networks, ppo = make(shared, actions, device=device)
        train(networks, ppo, 1)
        results.append(parameters(networks))
        state = ppo.state_dict()["optimizer"]["state"]
        assert all(value.device.type == "cpu" for one in state.values() for value in one.values())
    torch.testing.assert_close(results[1], results[0], rtol=1e-3, atol=1e-4)
    assert torch.equal(results[1], results[2])


@pytest.mark.parametrize("loss_type", ["huber", "mean squared error"])
def test_advantages_are_those_of_the_textbook_recursion_standardised_over_the_batch(loss_type):
    networks, ppo = make(loss_type=loss_type)
    batch = drive(networks, cars=3, length=40)
    assert batch["next", "terminated"].any()
    assert batch["next", "truncated"].any()
    steps, _ = ppo._prepare(batch)
    with torch.no_grad():
        value = networks.value(batch.select("observation"))["state_value"]
        next_value = networks.value(batch["next"].select("observation"))["state_value"]
    expected = torch.zeros(3, 40, 1)
    for car in range(3):
        running = torch.zeros(1)
        for t in reversed(range(40)):
            ended, terminated = batch["next", "done"][car, t], batch["next", "terminated"][car, t]
            future = torch.zeros(1) if terminated else next_value[car, t]
            delta = batch["next", "reward"][car, t] + CONFIG.discount * future - value[car, t]
            running = delta + (0 if ended else CONFIG.discount * CONFIG.gae_lambda * running)
            expected[car, t] = running
    torch.testing.assert_close(steps["value_target"], (expected + value).reshape(-1, 1), rtol=1e-4, atol=1e-5)
    standardised = ((expected - expected.mean()) / expected.std()).reshape(-1, 1)
    torch.testing.assert_close(steps["advantage"], standardised, rtol=1e-4, atol=1e-4)


def test_a_leading_dimension_for_processes_changes_nothing():
    flat, stacked = make(), make()
    batch = drive(flat[0])
    flat[1].update(batch, 0, 0.0)
    stacked[1].update(batch.reshape(2, 4, 32), 0, 0.0)
    torch.testing.assert_close(parameters(flat[0]), parameters(stacked[0]))


@pytest.mark.parametrize(("frames", "batch_size", "expected"), [(96, 64, 1), (128, 64, 2), (40, 64, 1)])
def test_a_remainder_is_left_out_unless_it_is_all_there_is(frames, batch_size, expected):
    networks, ppo = make(batch_size=batch_size, epochs=1)
    ppo.update(drive(networks, cars=1, length=frames), 0, 0.0)
    assert ppo.state_dict()["optimizer"]["state"][0]["step"] == expected


def test_the_metrics_describe_the_update():
    networks, ppo = make(actions=3)
    metrics = ppo.update(drive(networks), 0, 0.0)
    assert all(math.isfinite(value) for value in dataclasses.asdict(metrics).values())
    assert metrics.entropy == pytest.approx(math.log(3), abs=0.05)
    assert metrics.lr == CONFIG.lr
    assert metrics.kl > 0
    assert 0 <= metrics.clip_fraction <= 1
    assert metrics.explained_variance <= 1


def test_the_kl_is_near_the_exact_one():
    networks, ppo = make(actions=3)
    batch = drive(networks, cars=64)
    old = networks.policy.get_dist(batch)
    metrics = ppo.update(batch, 0, 0.0)
    exact = torch.distributions.kl_divergence(old, networks.policy.get_dist(batch)).mean().item()
    assert metrics.kl == pytest.approx(exact, rel=0.3)


@pytest.mark.parametrize(("fraction", "coeff"), [(0.0, 0.4), (0.5, 0.3), (1.0, 0.2)])
def test_the_entropy_bonus_falls_along_a_straight_line_to_its_share(fraction, coeff):
    networks, ppo = make(entropy_coeff=0.4, entropy_end_factor=0.5)
    ppo.update(drive(networks), 0, fraction)
    same, constant = make(entropy_coeff=coeff)
    constant.update(drive(same), 0, fraction)
    torch.testing.assert_close(parameters(networks), parameters(same))
    assert not torch.equal(parameters(networks), parameters(make()[0]))


def test_no_limit_on_the_gradient_lets_it_through_whole():
    def first_step(max_grad_norm: float) -> torch.Tensor:
        networks, ppo = make(max_grad_norm=max_grad_norm, epochs=1, batch_size=256)
        before = parameters(networks)
        ppo.update(drive(networks), 0, 0.0)
        return (parameters(networks) - before).abs().sum()

    assert first_step(0) == first_step(1e9)
    # Adam's first step is lr * g / (|g| + eps): it shows a limit only near eps.
    assert first_step(1e-4) < first_step(0)


@pytest.mark.parametrize(
    ("key", "name"),
    [
        ("observation", "observation"),
        (("next", "observation"), "next observation"),
        (("next", "reward"), "next reward"),
        ("action_log_prob", "action_log_prob"),
    ],
)
def test_a_value_that_is_not_finite_is_named_and_changes_nothing(key, name):
    networks, ppo = make()
    before = parameters(networks)
    batch = drive(networks)
    batch[key][2, 7] = math.nan
    with pytest.raises(RunFailed, match=rf"^{name} is nan at \[2, 7"):
        ppo.update(batch, 0, 0.0)
    assert torch.equal(parameters(networks), before)


@pytest.mark.parametrize("actions", [3, None])
@pytest.mark.parametrize(("head", "name"), [("policy_head", "policy loss"), ("value_head", "value loss")])
def test_a_network_gone_bad_is_named_before_the_gradient_step(actions, head, name):
    networks, ppo = make(actions=actions)
    batch = drive(networks)
    prepared, _ = ppo._prepare(batch)
    with torch.no_grad():
        list(getattr(networks, head).parameters())[-1].fill_(math.nan)
    before = parameters(networks)
    with pytest.raises(RunFailed, match=name):
        ppo._gradient_step(prepared)
    torch.testing.assert_close(parameters(networks), before, rtol=0, atol=0, equal_nan=True)


def test_a_gradient_gone_bad_is_named_by_its_parameter():
    networks, ppo = make()
    before = parameters(networks)
    bad_name, bad = list(networks.named_parameters())[2]
    bad.register_hook(lambda gradient: gradient * math.nan)
    ppo._compiled = None
    with pytest.raises(RunFailed, match=f"gradient of {bad_name} is not finite"):
        ppo.update(drive(networks), 0, 0.0)
    assert torch.equal(parameters(networks), before)


@pytest.mark.parametrize(("shared", "actions"), KINDS)
def test_a_restored_learner_continues_bit_for_bit(shared, actions, tmp_path):
    networks, ppo = make(shared, actions)
    train(networks, ppo, 3)
    # Without pickle: the state holds tensors and plain values.
    Checkpoint(agent=ppo).save(tmp_path / "checkpoint")
    train(networks, ppo, 2, start=3)
    others, restored = make(shared, actions, seed=77)
    Checkpoint(agent=restored).load(tmp_path / "checkpoint")
    train(others, restored, 2, start=3)
    assert torch.equal(parameters(networks), parameters(others))
