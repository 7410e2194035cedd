"""Laws that hold for pictures and for the LIDAR's readings."""

import gymnasium
import numpy as np
import pytest

import deepracer_exp.env.gym_env  # noqa: F401 - registers DeepRacer-v0
from tests.env.conftest import drive_and_see

PICTURES, SCANS = ("observation=camera_small",), ("observation=lidar", "observation.lidar.reach_m=12")
RANDOM = "randomization=sim2real"


@pytest.mark.parametrize(("key", "sensors"), [("pixels", PICTURES), ("lidar", SCANS)])
def test_starting_one_car_leaves_what_the_others_see(race_of, key, sensors):
    race = race_of(*sensors, n_cars=3)
    before = drive_and_see(race, 5)[-1][key]
    race.reset(np.array([1]))
    now = race.seen[key]
    np.testing.assert_array_equal(now[[0, 2]], before[[0, 2]])
    assert not np.array_equal(now[1], before[1])
    if key == "pixels":
        there = race_of(*sensors, "episode.start_offset=0.05", n_cars=3)
        np.testing.assert_array_equal(now[1], there.pixels[1])


@pytest.mark.parametrize(
    ("steps", "overrides"),
    [
        (7, (*PICTURES, "observation.camera.frames=2", RANDOM)),
        (6, (*SCANS, "randomization.observation_dropout=[0.3,0.3]")),
        (7, (*SCANS, RANDOM)),
    ],
)
def test_a_restored_race_sees_the_same_as_the_original(race_of, steps, overrides):
    race, other = race_of(*overrides, n_cars=4), race_of(*overrides, n_cars=4)
    drive_and_see(race, steps)
    other.load_state_dict(race.state_dict())
    np.testing.assert_equal(drive_and_see(race, 5), drive_and_see(other, 5))


@pytest.mark.parametrize(("key", "overrides"), [("pixels", (*PICTURES, RANDOM)), ("lidar", SCANS)])
def test_what_a_car_sees_depends_on_its_number_and_not_on_the_batch(race_of, key, overrides):
    overrides = (*overrides, "episode.start_advance=0")
    together, alone = race_of(*overrides, n_cars=5), race_of(*overrides, n_cars=2, first_car=3)
    for ours, theirs in zip(drive_and_see(together, 4), drive_and_see(alone, 4), strict=True):
        np.testing.assert_array_equal(ours[key][3:], theirs[key])


@pytest.mark.parametrize(
    ("sensors", "shapes"),
    [
        ("camera_small", {"pixels": (1, 60, 80)}),
        ("lidar", {"lidar": (64,)}),
        ("camera_lidar", {"pixels": (1, 120, 160), "lidar": (64,)}),
    ],
)
def test_gymnasium_sees_one_sensor_or_a_dictionary_of_both(sensors, shapes):
    overrides = [f"observation={sensors}", "action_space=discrete"]
    env = gymnasium.make("DeepRacer-v0", overrides=overrides)
    seen, _ = env.reset()
    assert env.observation_space.contains(seen)
    cars = gymnasium.make_vec("DeepRacer-v0", num_envs=3, overrides=overrides)
    cars.reset()
    all_seen, *_ = cars.step(np.full(3, 7))
    assert cars.observation_space.contains(all_seen)
    if len(shapes) == 1:
        (key,) = shapes
        seen, all_seen = {key: seen}, {key: all_seen}
    assert {key: values.shape for key, values in seen.items()} == shapes
    assert {key: values.shape[1:] for key, values in all_seen.items()} == shapes
