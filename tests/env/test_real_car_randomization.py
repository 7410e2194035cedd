"""How far the cars of each episode are the physical one."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.driving import (
    CarControlsRanges,
    CarPictureRanges,
    CarRandomizationConfig,
    CarTimingRanges,
)
from deepracer_exp.config.evaluation import (
    CarControlsConfig,
    CarPictureConfig,
    CarTimingConfig,
    RealCarConfig,
)
from deepracer_exp.env.race import Race
from deepracer_exp.env.real_car import as_the_car
from deepracer_exp.env.trace_columns import PACKED
from deepracer_exp.errors import BadInput
from tests.env.conftest import drive, make_setup, random_actions

CAMERA = ("observation=camera", "action_space=continuous")
LATENCY_S = 0.1
WHOLE = CarRandomizationConfig(
    picture=CarPictureRanges(jpeg_quality=(80, 80)),
    timing=CarTimingRanges(latency_s=(LATENCY_S, LATENCY_S)),
    controls=CarControlsRanges(full_lock_deg=(27.0, 27.0), throttle_curve=(1.0, 1.0)),
)
SAME = RealCarConfig(
    picture=CarPictureConfig(jpeg_quality=80),
    timing=CarTimingConfig(frames_per_s=15, latency_s=LATENCY_S),
    controls=CarControlsConfig(full_lock_deg=27, full_throttle_mps=None),
)
PARTS = ("picture", "timing", "controls")


def with_car(setup, real_car, **ranges):
    """Return a race whose cars are drawn from these ranges, and others of sim2real."""
    return replace(setup, randomization=replace(setup.randomization, real_car=real_car, **ranges))


def drawn(race) -> np.ndarray:
    """Return what the cars of a race have of the physical one, (N, 5)."""
    car = race._real_car
    return np.stack([car.jpeg_quality, car.full_lock_deg, car.throttle_curve, *car.late_steps], axis=1)


def driven(setup, n_cars=2, steps=8) -> list[np.ndarray]:
    race = Race(setup, n_cars)
    race.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, n_cars, 2))
    return [array for action in actions for array in (race.step(action), race.trace.copy(), race.pixels)[1:]]


@pytest.mark.parametrize("parts", [*((part,) for part in PARTS), PARTS], ids="+".join)
def test_ranges_of_one_value_are_the_car_of_an_evaluation_bit_for_bit(parts):
    setup = make_setup(*CAMERA)
    left_out = dict.fromkeys(set(PARTS) - set(parts))
    trained = driven(with_car(setup, replace(WHOLE, **left_out)))
    np.testing.assert_equal(trained, driven(as_the_car(setup, replace(SAME, **left_out))))
    assert any((one != other).any() for one, other in zip(trained, driven(setup), strict=True))


def test_the_car_of_an_evaluation_replaces_the_draws_of_its_conditions():
    setup = make_setup(*CAMERA, "randomization=real_car")
    race = Race(as_the_car(setup, SAME), 4)
    race.reset()
    np.testing.assert_array_equal(drawn(race), np.tile([80, 27.0, 1.0, 1, 1], (4, 1)))


def test_each_episode_draws_again_within_the_ranges_whatever_happened_before():
    setup = make_setup("action_space=continuous", "randomization=real_car")
    found: dict[tuple[int, int], list[float]] = {}
    for max_steps in (4, 9):
        race = Race(replace(setup, episode=replace(setup.episode, max_steps=max_steps)), 16)
        race.reset()
        for action in random_actions(40, 16):
            race.step(action)
            for car, (episode, values) in enumerate(
                zip(race.rules.episode.tolist(), drawn(race), strict=True)
            ):
                np.testing.assert_array_equal(found.setdefault((car, episode), values), values)
            race.reset(np.flatnonzero(race.terminated | race.truncated))
    values = np.array(list(found.values()))
    assert len(values) > 100
    quality, lock_deg, curve, *late = values.T
    ranges = setup.randomization.real_car
    for column, (low, high) in (
        (quality, ranges.picture.jpeg_quality),
        (lock_deg, ranges.controls.full_lock_deg),
        (curve, ranges.controls.throttle_curve),
    ):
        assert low <= column.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < column.max() <= high
    assert (quality == quality.round()).all()
    assert set(late[0]) == {0, 1}
    assert np.abs(np.corrcoef([quality, lock_deg, curve, late[0]]) - np.eye(4)).max() < 0.3


def test_a_part_that_is_left_out_changes_no_other_draw():
    setup = make_setup("action_space=continuous", "randomization=real_car")
    plain = make_setup(
        "action_space=continuous", "randomization=sim2real", "randomization.action_delay_steps=[0,0]"
    )
    races = {
        "whole": Race(setup, 6),
        "controls": Race(with_car(setup, replace(setup.randomization.real_car, controls=None)), 6),
        "none": Race(plain, 6),
    }
    for race in races.values():
        race.reset()
    np.testing.assert_array_equal(drawn(races["whole"])[:, [0, 3, 4]], drawn(races["controls"])[:, [0, 3, 4]])
    for race in races.values():
        np.testing.assert_array_equal(race.randomization.values, races["whole"].randomization.values)


def test_cars_of_all_kinds_see_and_drive_together_as_alone():
    setup = make_setup(*CAMERA, "randomization=real_car")
    kinds = [setup.randomization, replace(setup.randomization, real_car=None), setup.randomization]
    n_cars = 21  # more frames than are taken at once
    together = Race(setup, n_cars, randomizations=[kinds[car % 3] for car in range(n_cars)])
    together.reset()
    alone = [Race(setup, 1, first_car=car, randomizations=[kinds[car % 3]]) for car in (0, 1, 20)]
    for race in alone:
        race.reset()
    actions = np.random.default_rng(2).uniform(-1, 1, (4, n_cars, 2))
    for action in actions:
        together.step(action)
        for race in alone:
            car = race.cars[0]
            race.step(action[[car]])
            np.testing.assert_array_equal(race.trace[0], together.trace[car])
            np.testing.assert_array_equal(race.pixels[0], together.pixels[car])


@pytest.mark.parametrize("option", ["sim2real", "real_car"])
def test_any_number_of_threads_takes_the_same_pictures(option):
    setup = make_setup(*CAMERA, f"randomization={option}", "race=object_avoidance")
    races = [Race(setup, 19, threads=threads) for threads in (1, 3)]
    for race in races:
        race.reset()
        for action in random_actions(1, 19):
            race.step(action)
    np.testing.assert_array_equal(races[0].pixels, races[1].pixels)
    assert len(np.unique(races[0].pixels, axis=0)) == 19


def test_a_proportional_throttle_and_a_lock_of_the_largest_angle_drive_as_the_simulator():
    setup = make_setup("action_space=continuous")
    as_commanded = CarControlsRanges(full_lock_deg=(30.0, 30.0), throttle_curve=(0.0, 0.0))
    races = [Race(one, 3) for one in (setup, with_car(setup, CarRandomizationConfig(controls=as_commanded)))]
    traces = []
    for race in races:
        race.reset()
        traces.append(drive(race, random_actions(40, 3)))
    np.testing.assert_allclose(traces[1], traces[0], rtol=0, atol=1e-6)


def test_a_race_continues_from_a_state_as_the_race_it_was_taken_from():
    # The servo refuses steering beyond the range's high end and keeps its last angle, which is state.
    setup = make_setup(
        "action_space=continuous",
        *("action_space.steering_angle.high=20", "randomization=real_car", "episode.max_steps=15"),
    )
    race, other = Race(setup, 4), Race(setup, 4)
    race.reset()
    drive(race, random_actions(37, 4))
    state = race.state_dict()
    kept = copy.deepcopy(state)
    expected = drive(race, random_actions(40, 4))
    other.seed(8)
    other.reset()
    other.load_state_dict(state)
    np.testing.assert_equal(other.state_dict(), kept)
    np.testing.assert_array_equal(drive(other, random_actions(40, 4)), expected)


def test_a_latency_arrives_between_two_control_steps():
    setup = make_setup("action_space=continuous", "car=ideal")
    paths = {}
    for latency_s in (0.0, 0.5 / 15, 1 / 15):
        timing = CarTimingRanges(latency_s=(latency_s, latency_s))
        race = Race(with_car(setup, CarRandomizationConfig(timing=timing)), 1)
        race.reset()
        trace = drive(race, np.zeros((12, 1, 2)))
        paths[latency_s] = trace[:, 0, PACKED["progress"]]
    at_once, half, late = paths.values()
    np.testing.assert_allclose(late[1:], at_once[:-1], atol=1e-9)
    moving = slice(4, None)
    assert (late[moving] < half[moving]).all()
    assert (half[moving] < at_once[moving]).all()


def test_delays_that_together_end_every_episode_are_refused():
    lines = ["observation=camera", "randomization=real_car", "randomization.action_delay_steps=[0,10]"]
    assert compose_experiment([*lines, "randomization.real_car.timing.latency_s=[0,0.25]"])
    with pytest.raises(BadInput, match=r"real_car\.timing\.latency_s reaches 14 .*up to 13"):
        compose_experiment([*lines, "randomization.real_car.timing.latency_s=[0,0.27]"])
