import copy
import dataclasses

import numpy as np
import pytest

from deepracer_exp.env.race import Race
from deepracer_exp.env.rules import RaceRules
from deepracer_exp.env.trace_columns import STATUS_CODE
from deepracer_exp.sim.batch import CarState
from tests.conftest import refused
from tests.env.conftest import make_setup

EVERYTHING = (
    "track=[reinvent_carpet,Oval_track]",
    "track.direction=alternate",
    "randomization=sim2real",
    "episode.max_steps=25",
    "reward=follow_center_line",
)
SHOWN = ("observation", "reward", "terminated", "truncated", "trace")


def future(race: Race, seed: int, turns: int) -> list[np.ndarray]:
    """Drive at random: actions, new episodes, other courses, cars put back; return everything that can be observed."""
    dice, seen = np.random.default_rng(seed), []
    for _ in range(turns):
        n_actions = race.setup.actions.n
        race.step(
            dice.uniform(-1.2, 1.2, (race.n_cars, 2))
            if n_actions is None
            else dice.integers(n_actions, size=race.n_cars)
        )
        seen += [getattr(race, name).copy() for name in SHOWN]
        ended = np.flatnonzero(race.terminated | race.truncated)
        if len(ended):
            course = dice.integers(len(race.setup.courses), size=len(ended)) if dice.random() < 0.5 else None
            race.reset(ended, course)
        if dice.random() < 0.1:
            race.put_back(dice.permutation(race.n_cars)[:2], dice.uniform(0, 60, 2))
        if dice.random() < 0.02:
            race.reset()
        seen += [race.observation.copy(), race.rules.now.front.copy()]
    return seen


def assert_same(arrays, expected) -> None:
    assert len(arrays) == len(expected)
    for array, wanted in zip(arrays, expected, strict=True):
        np.testing.assert_array_equal(array, wanted)


@pytest.fixture(scope="module")
def everything():
    setup = make_setup(*EVERYTHING)
    # On floors alike, the state could do without them.
    assert len({course.tracks[0].floor.friction for course in setup.courses}) > 1
    return setup


@pytest.mark.parametrize("space", ["discrete", "continuous"])
def test_a_race_continues_from_a_state_as_the_race_it_was_taken_from(everything, space):
    setup = dataclasses.replace(everything, actions=make_setup(f"action_space={space}").actions)
    race, used = Race(setup, 5, first_car=3), Race(setup, 5, first_car=3)
    race.seed(1234)
    race.reset()
    used.seed(77)
    used.reset()
    future(used, 5, 30)
    for seed, turns in enumerate([0, 60]):
        future(race, seed, turns)
        state = race.state_dict()
        kept = copy.deepcopy(state)
        expected = future(race, seed, 30)
        for other in (Race(setup, 5, first_car=3), used):
            other.load_state_dict(state)
            np.testing.assert_equal(other.state_dict(), kept)
            assert_same(future(other, seed, 30), expected)
        # Whichever race drove, the state is still what it was.
        np.testing.assert_equal(state, kept)


@pytest.mark.parametrize("off", ["randomization=none", "randomization=aws"])
def test_a_race_with_little_or_no_randomization_continues_as_well(off):
    setup = make_setup(off, "episode.max_steps=30")
    race, other = Race(setup, 4), Race(setup, 4)
    race.reset()
    future(race, 0, 40)
    other.load_state_dict(race.state_dict())
    assert_same(future(other, 1, 60), future(race, 1, 60))


@pytest.mark.parametrize(
    ("overrides", "options", "what"),
    [
        ((), {"n_cars": 4}, "'physics' of its cars has shape (3, "),
        ((), {"n_cars": 3, "first_car": 3}, "first car has number 0; accepted here: 3"),
        (
            ("track=reinvent_carpet",),
            {"n_cars": 3},
            "'driven' of its cars has shape (3, 2), these cars need (3, 1)",
        ),
        (("observation.lookahead_m=[0.5]",), {"n_cars": 3}, "'observation' of its cars has shape (3, "),
    ],
    ids=["cars", "other cars", "tracks", "features"],
)
def test_a_state_of_another_race_is_refused(everything, overrides, options, what):
    race = Race(everything, 3)
    race.reset()
    other = Race(make_setup(*EVERYTHING, *overrides), **options)
    message = refused(other.load_state_dict, race.state_dict())
    assert "the checkpoint does not fit" in message
    assert what in message


def test_a_car_that_was_reversed_for_ten_steps_ends_its_episode_after_five_more():
    setup = make_setup()
    assert setup.episode.reversed_steps == 15
    before, after = RaceRules(setup, 1), RaceRules(setup, 1)

    def fall_back(rules: RaceRules, step: int) -> int:
        pose = rules.tracks.start_pose(np.array([0.5 - 0.001 * step]), rules.track_index)
        rules.measure(CarState(*pose, *np.zeros((4, 1))))
        return int(rules.apply().status[0])

    before.reset()
    for step in range(11):  # the prepare step, and ten
        fall_back(before, step)
    after.load_state_dict(before.state_dict())
    verdicts = [fall_back(after, step) for step in range(11, 16)]
    assert verdicts == [STATUS_CODE["in_progress"]] * 4 + [STATUS_CODE["reversed"]]


def test_a_car_that_stands_ends_its_episode_in_the_same_step_although_its_race_was_interrupted():
    # At a commanded speed of 0 a car rolls a few millimetres a step.
    setup = make_setup("action_space=continuous", "action_space.speed.low=0", "episode.immobilized_m=0.01")
    before, after = Race(setup, 1), Race(setup, 1)

    def steps_until_the_end(race: Race, most: int) -> int:
        for step in range(most):
            race.step(np.array([[0.0, -1.0]]))
            if race.terminated[0]:
                return step
        return most

    before.reset()
    assert steps_until_the_end(before, 12) == 12
    after.load_state_dict(before.state_dict())
    assert steps_until_the_end(after, 40) == steps_until_the_end(before, 40) < 40
