"""Many tracks in one batch."""

import dataclasses

import numpy as np
import pytest

from deepracer_exp.env.gym_env import DeepRacerEnv, DeepRacerVectorEnv
from deepracer_exp.env.race import Race
from deepracer_exp.env.setup import courses_of_cars, usual_cars
from deepracer_exp.env.trace_columns import PACKED
from deepracer_exp.errors import BadInput
from tests.env.conftest import drive, spied

THREE = ("track=[reinvent_wood,Straight_track,Spain_track]", "track.Spain_track.direction=reversed")
WAYS = ("action_space=continuous", "episode.max_steps=20", "randomization=sim2real")
GIVEN = """
import numpy as np
def reward_function(params):
    return params["track_length"] + 1000 * params["is_reversed"] + len(params["waypoints"]) / 1000
def reward_batch(params):
    given = params["track_length"] + 1000 * params["is_reversed"] + len(params["waypoints"]) / 1000
    return np.full(len(params["x"]), given)
"""


# --- Which cars drive where


@pytest.mark.parametrize("weights", [[1, 1, 1], [2, 1], [0.5, 7, 1, 1], [100, 1], [1] * 18])
def test_cars_are_shared_out_by_weight(weights):
    cars = 60
    count = np.bincount(courses_of_cars(weights, cars), minlength=len(weights))
    wanted = cars * np.array(weights) / np.sum(weights)
    assert np.abs(count - np.maximum(wanted, 1)).max() < 2
    assert count.min() >= 1


@pytest.mark.parametrize("cars", [3, 5, 18])
def test_every_course_has_a_car_as_soon_as_there_are_as_many(cars):
    weights = 10.0 ** np.arange(cars)
    assert set(courses_of_cars(weights.tolist(), cars)) == set(range(cars))


def test_every_process_has_its_share():
    """Any row of neighbouring cars holds the courses by their weights, to within two cars."""
    chosen = courses_of_cars([3, 2, 1], 240)
    for first in range(12, 240, 12):
        count = np.bincount(chosen[first : first + 12], minlength=3)
        assert np.abs(count - [6, 4, 2]).max() <= 1


def test_the_number_of_processes_does_not_change_a_cars_course(setup_of):
    setup = setup_of(*THREE, "track.Straight_track.weight=2")
    whole = Race(setup, 12).rules.course
    parts = [Race(setup, 4, first_car=first).rules.course for first in (0, 4, 8)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)


@pytest.mark.parametrize("tracks", [1, 2, 3, 5, 13, 21, 34, 68])
def test_about_the_same_share_of_the_cars_differs_on_each_track(tracks):
    course = courses_of_cars([1.0] * tracks, 256)
    for share in (0.25, 0.5, 0.75):
        usual = usual_cars([1.0] * tracks, share, 256)
        for one in range(tracks):
            count, differ = np.count_nonzero(course == one), np.count_nonzero(~usual[course == one])
            assert abs(differ - share * count) <= 2
            assert 0 < differ < count or share == 0.25


def test_on_a_track_whose_cars_all_differ_all_laps_count():
    assert usual_cars([1, 1], 1.0, 4).all()
    # Car 0 of each track differs with a share of 1 only.
    assert usual_cars([1, 1], 0.99, 4).tolist() == [True, True, False, False]
    assert usual_cars([1, 1], 0.99, 2).all()


# --- Cars of several courses beside one another


def test_each_car_drives_bit_for_bit_as_alone_on_its_course(race_of):
    actions = np.random.default_rng(4).uniform(-1, 1, (50, 6, 2))
    race = race_of(*THREE, *WAYS, n_cars=6)
    np.testing.assert_array_equal(race.rules.course, [0, 1, 2, 0, 1, 2])
    rows = drive(race, actions)
    assert rows[:, :, PACKED["done"]].sum() >= 12
    for car, course in enumerate(race.rules.course):
        own = dataclasses.replace(race.setup, courses=race.setup.courses[course : course + 1])
        alone = Race(own, 1, first_car=car)
        alone.reset()
        own_rows = drive(alone, actions[:, car : car + 1])
        own_rows[:, :, PACKED["track"]] = course
        np.testing.assert_array_equal(rows[:, car], own_rows[:, 0])


def test_the_trace_reports_course_and_length(race_of):
    race = race_of(*THREE, n_cars=4)
    rows = drive(race, np.zeros((2, 4), np.int64))
    lengths = [course.tracks[0].length_m for course in race.setup.courses]
    np.testing.assert_array_equal(rows[1, :, PACKED["track"]], [0, 1, 2, 0])
    np.testing.assert_array_equal(rows[1, :, PACKED["track_len"]], np.array(lengths)[[0, 1, 2, 0]])


def test_a_reward_function_gets_its_cars_own_course(race_of, spy):
    race = race_of(*THREE, spy, n_cars=6)
    drive(race, np.zeros((3, 6), np.int64))
    for car, seen in enumerate(spied(race)):
        track = race.setup.courses[race.rules.course[car]].tracks[0]
        for params in seen:
            assert params["track_length"] == track.length_m
            assert params["is_reversed"] == track.reversed
            assert params["waypoints"] == [tuple(point) for point in track.waypoints.tolist()]
            ahead = params["waypoints"][params["closest_waypoints"][1]]
            assert np.hypot(params["x"] - ahead[0], params["y"] - ahead[1]) < 1.5


def test_the_batch_form_is_called_for_each_course(race_of, tmp_path):
    (tmp_path / "given.py").write_text(GIVEN)
    (tmp_path / "scalar.py").write_text(GIVEN.replace("reward_batch", "unused"))
    paid = []
    for name in ("given", "scalar"):
        race = race_of(*THREE, f"reward.file={tmp_path / name}.py", n_cars=7)
        drive(race, np.zeros((2, 7), np.int64))
        paid.append(race.reward)
    np.testing.assert_array_equal(*paid)
    assert len(set(paid[0])) == 3
    assert (paid[0][race.rules.course == 2] > 1000).all()


def test_open_courses_start_at_their_start_and_closed_ones_further_along(setup_of):
    race = Race(setup_of(*THREE), 6)
    for _ in range(3):
        race.reset()
    on = race.rules.course == 1
    assert not race.rules.start_ndist[on].any()
    assert race.rules.start_ndist[~on].all()


def test_a_start_inside_an_open_course_is_refused_among_others(setup_of):
    with pytest.raises(BadInput, match=r"episode.start_offset=0.5: the open course Straight_track"):
        setup_of(*THREE, "episode.start_offset=0.5")


def test_a_floor_acts_on_its_own_cars_alone(race_of):
    """On ice a car is slow to start, and the car beside it on the road is not."""
    race = race_of("track=[reinvent_base,Oval_track]", "track.reinvent_base.floor.friction=0.05", n_cars=2)
    drive(race, np.full((8, 2), 7))
    assert race.trace[0, PACKED["speed_mps"]] < 0.7 * race.trace[1, PACKED["speed_mps"]]
    race.reset(np.arange(2), course=np.array([1, 0]))
    for _ in range(8):
        race.step(np.full(2, 7))
    assert race.trace[1, PACKED["speed_mps"]] < 0.7 * race.trace[0, PACKED["speed_mps"]]


# --- Direction


def test_the_direction_alternates_episode_by_episode_for_each_car(setup_of):
    race = Race(setup_of("track=Oval_track", "track.direction=alternate"), 3)
    reversed_ = [track.reversed for track in race.setup.courses[0].tracks]
    assert reversed_ == [False, True]
    race.reset()
    np.testing.assert_array_equal(race.rules.track_index, [0, 0, 0])
    race.reset(np.array([1]))
    np.testing.assert_array_equal(race.rules.track_index, [0, 1, 0])
    race.reset()
    np.testing.assert_array_equal(race.rules.track_index, [1, 0, 1])
    race.seed(0)
    race.reset()
    np.testing.assert_array_equal(race.rules.track_index, [0, 0, 0])


def test_an_alternating_car_looks_and_is_paid_along_its_direction(setup_of, spy, steer_ahead):
    setup = setup_of("track=Oval_track", "track.direction=alternate", "action_space=continuous", spy)
    race = Race(setup, 1)
    (seen,) = spied(race)
    for episode in range(4):
        race.reset()
        seen.clear()
        for _ in range(25):
            race.step(steer_ahead(race, 0.2))
        assert {params["is_reversed"] for params in seen} == {episode % 2 == 1}
        progress = [params["progress"] for params in seen]
        assert progress[-1] > progress[0] + 2
        assert abs(race.rules.now.heading_error_rad[0]) < 0.5


# --- Gymnasium


def test_a_gym_car_goes_from_track_to_track():
    env = DeepRacerEnv([THREE[0], "track.direction=alternate"])
    driven = []
    for _ in range(6):
        env.reset()
        driven.append((int(env._race.rules.course[0]), int(env._race.rules.track_index[0])))
    assert driven == [(0, 0), (1, 2), (2, 4), (0, 1), (1, 3), (2, 5)]
    env.reset(seed=3)
    assert env._race.rules.track_index[0] == 0


def test_gym_cars_are_shared_out_and_each_track_needs_one():
    env = DeepRacerVectorEnv(4, [THREE[0]])
    observation, _ = env.reset()
    assert observation.shape == (4, env.single_observation_space.shape[0])
    np.testing.assert_array_equal(env._race.rules.course, [0, 1, 2, 0])
    with pytest.raises(BadInput, match="num_envs=2 with 3 tracks"):
        DeepRacerVectorEnv(2, [THREE[0]])


@pytest.mark.slow
def test_all_tracks_drive_together(race_of):
    race = race_of("track=all", n_cars=100)
    drive(race, np.full((3, 100), 2))
    assert np.isfinite(race.observation).all()
    assert len(set(race.trace[:, PACKED["track"]])) == len(race.setup.courses)
