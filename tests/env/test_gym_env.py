import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import RenderCollection
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from deepracer_exp.aws.worlds.catalogue import worlds
from deepracer_exp.env.gym_env import DeepRacerEnv, DeepRacerVectorEnv
from deepracer_exp.env.sb3 import DeepRacerVecEnv
from deepracer_exp.env.trace_columns import EPISODE_STATUS
from deepracer_exp.errors import BadInput

SPACES = ["action_space=discrete", "action_space=continuous"]


def _objections(env):
    """Return what Gymnasium's checker finds wrong with an environment."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        check_env(env)
    # Offsets and look-ahead points have no bounds; made with keywords, and unwrapped, on purpose.
    known = ("minimum value is -infinity", "maximum value is infinity", "A Box observation space m")
    return [str(w.message) for w in found if not any(part in str(w.message) for part in known)]


@pytest.mark.parametrize("space", SPACES)
def test_gymnasiums_checker_finds_nothing(space):
    assert _objections(gym.make("DeepRacer-v0", overrides=[space]).unwrapped) == []


@pytest.mark.parametrize("track", ["Straight_track", "Oval_track"])
def test_gymnasiums_checker_finds_nothing_on_the_track_of_an_id(track):
    env = gym.make(f"DeepRacer/{track}-v0").unwrapped
    assert env._race.setup.track.name == track
    assert _objections(env) == []


def test_every_track_of_the_catalogue_has_an_id_and_no_other_name_has():
    named = {spec.name for spec in gym.registry.values() if spec.namespace == "DeepRacer"}
    assert named == set(worlds())
    with pytest.raises(gym.error.NameNotFound, match="Did you mean: `Monaco`"):
        gym.make("DeepRacer/Monacoo-v0")


def test_overrides_leave_the_track_of_an_id_as_it_is_unless_they_name_another():
    def driven(**kwargs):
        return gym.make_vec("DeepRacer/Straight_track-v0", num_envs=2, **kwargs).unwrapped

    discrete = driven(overrides=SPACES[:1])
    assert (discrete._race.setup.track.name, discrete.single_action_space.n > 1) == ("Straight_track", True)
    single = driven(vectorization_mode="sync", overrides=SPACES[:1])
    assert isinstance(single, SyncVectorEnv)
    np.testing.assert_array_equal(single.reset(seed=0)[0][0], discrete.reset(seed=0)[0][0])
    assert driven(overrides=["track=Oval_track"])._race.setup.track.name == "Oval_track"


def test_a_car_alone_drives_as_in_the_race(race_of):
    env = gym.make("DeepRacer-v0", overrides=["action_space=continuous", "episode.max_steps=30"])
    race = race_of("action_space=continuous", "episode.max_steps=30")
    observation, _ = env.reset()
    np.testing.assert_array_equal(observation, race.observation[0])
    for action in np.random.default_rng(0).uniform(-1, 1, (50, 2)).astype(np.float32):
        observation, reward, terminated, truncated, info = env.step(action)
        race.step(action[None])
        np.testing.assert_array_equal(observation, race.observation[0])
        assert (reward, terminated, truncated) == (race.reward[0], race.terminated[0], race.truncated[0])
        assert info["episode_status"] in EPISODE_STATUS
        if terminated or truncated:
            race.reset()
            observation, _ = env.reset()
            np.testing.assert_array_equal(observation, race.observation[0])


def test_a_bad_override_is_bad_input():
    with pytest.raises(BadInput, match="no such track"):
        gym.make("DeepRacer-v0", overrides=["track=Nowhere"])


def test_the_vector_environment_is_made_by_name():
    env = gym.make_vec("DeepRacer-v0", num_envs=3, overrides=SPACES[1:])
    assert isinstance(env.unwrapped, DeepRacerVectorEnv)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    observation, infos = env.reset(seed=1)
    assert infos == {}
    assert env.observation_space.contains(observation)
    assert env.single_observation_space.contains(observation[0])
    assert env.action_space.contains(env.action_space.sample())
    assert {values.shape for values in env.step(env.action_space.sample())[1:4]} == {(3,)}
    env.close()


def test_one_batch_of_cars_equals_gymnasiums_vector_of_single_cars():
    """Over 80 steps, the infos of ended episodes included; all cars start at one place, as single cars do."""
    overrides = ["action_space=continuous", "episode.max_steps=35", "episode.start_advance=0"]
    overrides.append("randomization=none")  # which differs by the number of the car, 0 for each single one
    ours = DeepRacerVectorEnv(3, overrides)
    row = SyncVectorEnv([lambda: DeepRacerEnv(overrides)] * 3, autoreset_mode=AutoresetMode.SAME_STEP)
    np.testing.assert_array_equal(ours.reset()[0], row.reset()[0])
    assert (ours.single_observation_space, ours.action_space) == (
        row.single_observation_space,
        row.action_space,
    )
    ended = 0
    for action in np.random.default_rng(0).uniform(-1, 1, (80, 3, 2)).astype(np.float32):
        *a, infos = ours.step(action)
        *b, expected = row.step(action)
        for mine, theirs in zip(a, b, strict=True):
            np.testing.assert_array_equal(mine, theirs)
        assert ("final_obs" in infos) == ("final_obs" in expected)
        if "final_obs" in infos:
            ended += infos["_final_obs"].sum()
            np.testing.assert_array_equal(infos["_final_obs"], expected["_final_obs"])
            np.testing.assert_array_equal(infos["_final_info"], expected["_final_info"])
            for car in np.flatnonzero(infos["_final_obs"]):
                np.testing.assert_array_equal(infos["final_obs"][car], expected["final_obs"][car])
                for key in ("progress", "episode_status"):
                    mine, theirs = infos["final_info"][key][car], expected["final_info"][key][car]
                    assert (EPISODE_STATUS[mine] if key == "episode_status" else mine) == theirs
            for car in np.flatnonzero(~infos["_final_obs"]):
                assert infos["final_obs"][car] is None
    assert ended > 5


@pytest.mark.parametrize("seed", [4, [4, 9, None]])
def test_a_seed_begins_the_vector_environment_again(seed):
    env = DeepRacerVectorEnv(3, [SPACES[0], "randomization=aws", "episode.max_steps=20"])
    actions = np.random.default_rng(0).integers(0, env.single_action_space.n, (40, 3))

    def drive() -> np.ndarray:
        return np.array([env.reset(seed=seed)[0], *(env.step(action)[0] for action in actions)])

    first = drive()
    env.reset()
    np.testing.assert_array_equal(drive(), first)
    env.reset(seed=5)
    assert (np.array([env.step(action)[0] for action in actions]) != first[1:]).any()


def test_gymnasiums_vector_wrappers_take_it():
    env = RecordEpisodeStatistics(DeepRacerVectorEnv(2, [SPACES[0], "episode.max_steps=10"]))
    env.reset()
    for _ in range(10):
        infos = env.step(np.zeros(2, np.int64))[4]
    np.testing.assert_array_equal(infos["episode"]["l"], 10)
    listed = DictInfoToList(DeepRacerVectorEnv(2, [SPACES[0], "episode.max_steps=10"]))
    listed.reset()
    for _ in range(10):
        infos = listed.step(np.zeros(2, np.int64))[4]
    assert infos[1]["final_info"]["episode_status"] == EPISODE_STATUS.index("time_up")
    assert infos[1]["final_obs"].shape == listed.single_observation_space.shape


# --- Stable-Baselines3


@pytest.mark.parametrize("space", SPACES)
def test_stable_baselines_trains_on_the_vector_environment_and_logs_its_episodes(space):
    cars = VecMonitor(DeepRacerVecEnv(8, [space, "episode.max_steps=12"]))
    model = PPO("MlpPolicy", cars, n_steps=16, batch_size=64, n_epochs=1, device="cpu", seed=0)
    before = [p.clone() for p in model.policy.parameters()]
    model.learn(2 * 8 * 16)
    assert model.num_timesteps == 256
    assert all(p.isfinite().all() for p in model.policy.parameters())
    assert any((p != q).any() for p, q in zip(model.policy.parameters(), before, strict=True))
    assert 0 < np.mean([episode["l"] for episode in model.ep_info_buffer]) <= 12


def test_stable_baselines_drives_the_same_cars_and_is_told_how_episodes_ended():
    overrides = ["action_space=continuous", "episode.max_steps=12"]
    cars, plain = DeepRacerVecEnv(3, overrides), DeepRacerVectorEnv(3, overrides)
    cars.seed(7)
    np.testing.assert_array_equal(cars.reset(), plain.reset(seed=7)[0])
    for action in np.random.default_rng(0).uniform(-1, 1, (30, 3, 2)).astype(np.float32):
        observation, reward, ended, infos = cars.step(action)
        expected, wanted, terminated, truncated, more = plain.step(action)
        np.testing.assert_array_equal(observation, expected)
        np.testing.assert_array_equal(reward, wanted)
        np.testing.assert_array_equal(ended, terminated | truncated)
        for car, info in enumerate(infos):
            if not ended[car]:
                assert info == {}
                continue
            np.testing.assert_array_equal(info["terminal_observation"], more["final_obs"][car])
            assert info["TimeLimit.truncated"] == truncated[car]
            assert info["progress"] == more["progress"][car]


def test_stable_baselines_trains_on_a_single_car():
    cars = DummyVecEnv([lambda: gym.make("DeepRacer-v0", overrides=[SPACES[0], "episode.max_steps=40"])])
    model = PPO("MlpPolicy", cars, n_steps=32, batch_size=32, n_epochs=1, device="cpu", seed=0)
    model.learn(64)
    assert model.num_timesteps == 64
    assert all(p.isfinite().all() for p in model.policy.parameters())


# --- Pictures


@pytest.mark.parametrize("track", ["reinvent_base", "Straight_track"])
def test_the_picture_shows_the_car_where_it_is(track):
    env = gym.make("DeepRacer-v0", render_mode="rgb_array", overrides=[SPACES[0], f"track={track}"])
    env.reset(seed=0)

    def where():
        picture = env.render()
        assert picture.dtype == np.uint8
        assert picture.shape[0] % 2 == picture.shape[1] % 2 == 0
        red = (picture == (0xD6, 0x27, 0x28)).all(axis=-1)
        row, column = np.argwhere(red).mean(axis=0)
        return np.array([column, -row])

    race = env.unwrapped._race
    pixels, metres = [where()], [race.rules.now.front[0]]
    for _ in range(25):
        env.step(env.action_space.n // 2)
    pixels.append(where())
    metres.append(race.rules.now.front[0])
    moved_px, moved_m = pixels[1] - pixels[0], metres[1] - metres[0]
    assert np.hypot(*moved_m) > 0.5
    cosine = moved_px @ moved_m / np.hypot(*moved_px) / np.hypot(*moved_m)
    assert cosine > 0.99


def test_what_gymnasium_and_stable_baselines_ask_for_pictures_gets_them():
    env = gym.make("DeepRacer-v0", render_mode="rgb_array", overrides=SPACES[:1])
    collected = RenderCollection(env)
    collected.reset()
    collected.step(0)
    assert len(collected.render()) == 2
    assert env.metadata["render_fps"] == 15
    cars = DeepRacerVecEnv(4, render_mode="rgb_array")
    cars.reset()
    height, width, _ = env.render().shape
    assert cars.render().shape == (2 * height, 2 * width, 3)


def test_without_a_mode_nothing_is_rendered_and_another_mode_is_refused():
    env = DeepRacerEnv()
    env.reset()
    assert env.render() is None
    with pytest.raises(BadInput, match=r"render_mode=ansi: .*accepted: rgb_array"):
        DeepRacerEnv(render_mode="ansi")
