import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepracer_exp.config.driving import EpisodeConfig
from deepracer_exp.env.rule_passes import Judged, judge_car
from deepracer_exp.env.rules import RaceRules
from deepracer_exp.env.trace_columns import EPISODE_STATUS
from deepracer_exp.sim.batch import CarState

from .conftest import make_setup

CONFIG = EpisodeConfig(
    start_offset=0.0,
    start_advance=0.05,
    max_steps=1000,
    immobilized_steps=15,
    immobilized_m=0.0003,
    reversed_steps=15,
)


SETUP = make_setup()


class OneCar:
    """Judges one car step by step; a step that does not say otherwise moves forward on the road."""

    def __init__(self, **changes: float):
        config = dataclasses.replace(CONFIG, **changes)
        rules = RaceRules(dataclasses.replace(SETUP, episode=config), 1)._rules
        self.rules = rules.limits, rules.codes
        self.steps, self.progress = 0, 10.0
        self.counters = 0, 0

    def step(
        self,
        progress: float | None = None,
        moved_m: float = 0.1,
        off_track: bool = False,
        ahead: float = 0.01,
    ) -> str:
        self.steps += 1
        before = self.progress
        self.progress = before + ahead if progress is None else progress
        judged = Judged(self.steps, self.progress, before, float(moved_m), off_track)
        status, *self.counters = judge_car(judged, *self.counters, self.rules)
        return EPISODE_STATUS[status]

    def steps_until(self, status: str, most: int, **how: float) -> int | None:
        for count in range(1, most + 1):
            if self.step(**how) == status:
                return count
        return None


@pytest.fixture
def car() -> OneCar:
    car = OneCar()
    car.step()
    return car


@given(progress=st.floats(-100, 100), moved_m=st.floats(0, 1), off_track=st.booleans())
def test_nothing_ends_an_episode_in_its_prepare_step(progress, moved_m, off_track):
    assert OneCar(max_steps=1).step(progress, moved_m, off_track) == "prepare"


def test_full_progress_completes_the_lap(car):
    assert car.step(progress=99.999) == "in_progress"
    assert car.step(progress=100.0) == "lap_complete"


@pytest.mark.parametrize(
    ("status", "fault", "just_none"),
    [
        ("immobilized", {"moved_m": 0.0003}, {"moved_m": 0.000301}),
        ("reversed", {"ahead": -0.01}, {"ahead": 0.0}),
    ],
)
def test_standing_or_falling_back_ends_the_episode_at_the_fifteenth_step_in_a_row(
    car, status, fault, just_none
):
    assert car.steps_until(status, 14, **fault) is None
    assert car.step(**just_none) == "in_progress"
    assert car.steps_until(status, 20, **fault) == 15


def test_the_last_allowed_step_is_time_up():
    car = OneCar(max_steps=20)
    car.step()
    assert car.steps_until("time_up", 40) == 19


@pytest.mark.parametrize(
    ("rule", "how"),
    [("max_steps", {}), ("immobilized_steps", {"moved_m": 0.0}), ("reversed_steps", {"ahead": -0.001})],
)
def test_zero_switches_a_rule_off(rule, how):
    car = OneCar(**{"max_steps": 0, rule: 0})
    car.step()
    assert all(car.step(**how) == "in_progress" for _ in range(2000))


@given(complete=st.booleans(), off_track=st.booleans(), late=st.booleans(), still=st.booleans())
def test_time_comes_before_the_lap_and_the_lap_before_the_rest(complete, off_track, late, still):
    car = OneCar(max_steps=16 if late else 1000)
    car.step()
    for _ in range(14):
        car.step(moved_m=0.0 if still else 0.1)
    status = car.step(100.0 if complete else None, 0.0 if still else 0.1, off_track)
    expected = (
        "time_up"
        if late
        else "lap_complete"
        if complete
        else "off_track"
        if off_track
        else "immobilized"
        if still
        else "in_progress"
    )
    assert status == expected


def test_a_new_episode_counts_from_zero_and_leaves_the_other_cars_alone():
    assert SETUP.episode.immobilized_steps == 15
    rules = RaceRules(SETUP, 3)
    rules.measure(CarState(*rules.reset(start_ndist=np.full(3, 0.5)), *np.zeros((4, 3))))

    def stand(steps: int) -> list[str]:
        for _ in range(steps):
            status = rules.apply().status
        return [EPISODE_STATUS[code] for code in status]

    assert stand(11) == ["in_progress"] * 3
    rules.reset(np.array([1]), np.array([0.5]))
    assert stand(5) == ["immobilized", "in_progress", "immobilized"]
