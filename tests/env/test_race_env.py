import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase, RewardSum, TransformedEnv
from torchrl.envs.utils import check_env_specs

from deepracer_exp.env.race import Race
from deepracer_exp.env.race_env import RaceEnv
from deepracer_exp.env.trace_columns import PACKED

SPACES = ["action_space=discrete", "action_space=continuous"]


@pytest.mark.parametrize(
    ("space", "sensors"), [(SPACES[0], "features"), (SPACES[1], "features"), (SPACES[1], "camera_lidar")]
)
def test_specs_and_rollouts_agree(setup_of, space, sensors):
    check_env_specs(RaceEnv(Race(setup_of(space, f"observation={sensors}"), 3)))


@pytest.mark.parametrize("space", SPACES)
def test_the_short_step_gives_exactly_what_the_generic_one_gives(setup_of, space):
    """120 steps; episodes end by the limit and off the track, and some steps end none."""
    setup = setup_of(space, "episode.max_steps=25", "randomization=aws")
    ours, generic = (RaceEnv(Race(setup, 5)) for _ in range(2))
    assert type(ours).step_and_maybe_reset is not EnvBase.step_and_maybe_reset
    root, generic_root = ours.reset(), generic.reset()
    ended = set()
    for _ in range(120):
        action = ours.action_spec.rand()
        stepped, root = ours.step_and_maybe_reset(root.set("action", action))
        expected, generic_root = generic._step_and_maybe_reset(generic_root.set("action", action.clone()))
        assert_same(stepped, expected)
        assert_same(root, generic_root.exclude("action"))
        ended |= {int(n) for n in stepped["next", "done"].sum(0)}
        truncated, terminated = stepped["next", "truncated"], stepped["next", "terminated"]
        assert not (truncated & terminated).any()
    assert len(ended) > 2


def assert_same(a: TensorDict, b: TensorDict) -> None:
    keys = set(a.keys(True, True))
    assert keys == set(b.keys(True, True))
    for key in keys:
        assert a[key].dtype == b[key].dtype, key
        assert a[key].shape == b[key].shape, key
        torch.testing.assert_close(a[key], b[key], rtol=0, atol=0, equal_nan=True, msg=str(key))


def test_a_batch_keeps_what_each_step_gave(setup_of):
    """Nothing that was handed out is written to later."""
    noisy = ("randomization=sim2real", "randomization.observation_dropout=[0.5,0.5]")
    env = RaceEnv(Race(setup_of("episode.max_steps=10", *noisy), 4))
    root, kept = env.reset(), []
    for _ in range(30):
        stepped, root = env.step_and_maybe_reset(root.set("action", env.action_spec.rand()))
        kept.append((stepped, stepped.clone()))
    for stepped, copy in kept:
        assert_same(stepped, copy)


def test_the_terminal_observation_stays_with_the_episode_that_ended(setup_of):
    env = RaceEnv(Race(setup_of("episode.max_steps=8"), 3))
    root = env.reset()
    for _ in range(8):
        stepped, root = env.step_and_maybe_reset(root.set("action", torch.full((3,), 3)))
    assert stepped["next", "truncated"].all()
    speed = env.race.feature_names.index("speed")
    assert (stepped["next", "observation"][:, speed] > 0.1).all()
    assert not root["observation"][:, speed].any()


def test_a_partial_reset_starts_the_marked_cars_alone(setup_of):
    env = RaceEnv(Race(setup_of(), 3))
    root = env.rollout(5)[:, -1]["next"]
    mark = torch.tensor([[False], [True], [False]])
    again = env.reset(root.clone().set("_reset", mark))
    np.testing.assert_array_equal((again["observation"] == root["observation"]).all(-1), [True, False, True])
    np.testing.assert_array_equal(env.race.rules.episode, [0, 1, 0])


def test_the_rewards_of_the_trace_are_the_rewards(setup_of):
    steps = RaceEnv(Race(setup_of(), 3)).rollout(40, break_when_any_done=False)
    trace = steps["next", "trace"]
    torch.testing.assert_close(trace[..., PACKED["reward"]].float(), steps["next", "reward"][..., 0])
    assert ((trace[..., PACKED["done"]] == 1) == steps["next", "done"][..., 0]).all()


def test_the_sum_of_an_episodes_rewards_is_that_of_the_reward_alone(setup_of):
    env = TransformedEnv(RaceEnv(Race(setup_of("episode.max_steps=8"), 3)), RewardSum())
    assert list(env.reward_keys) == ["reward"]
    steps = env.rollout(20, break_when_any_done=False)
    assert [key for key in steps["next"].keys() if key.startswith("episode_")] == ["episode_reward"]  # noqa: SIM118
    torch.testing.assert_close(steps["next", "episode_reward"][:, 7], steps["next", "reward"][:, :8].sum(1))


def test_a_car_at_its_start_shows_the_last_step_that_it_made(setup_of):
    steps = RaceEnv(Race(setup_of("episode.max_steps=5"), 3)).rollout(12, break_when_any_done=False)
    assert not steps["trace"][:, 0, PACKED["steps"]].any()
    assert torch.equal(steps["trace"][:, 1:], steps["next", "trace"][:, :-1])


def test_the_heartbeat_is_called_after_every_step(setup_of):
    beats = []
    env = RaceEnv(Race(setup_of(), 2), on_step=lambda: beats.append(1))
    env.rollout(7, break_when_any_done=False)
    assert len(beats) == 7
