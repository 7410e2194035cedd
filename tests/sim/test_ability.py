import numpy as np
import pytest

from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.compose import compose_option
from deepracer_exp.sim.ability import ability_of
from deepracer_exp.sim.batch import CarBatch

CAR = compose_option("car", "deepracer", CarConfig)
LOW, HIGH = np.array([0.1, -np.deg2rad(30)]), np.array([4.0, np.deg2rad(30)])


@pytest.fixture(scope="module")
def ability():
    return ability_of(CAR, LOW, HIGH)


def test_tighter_bends_are_slower_and_nothing_is_faster_than_the_wheels(ability):
    speeds = ability.speed_at(np.linspace(0.0, 3.0, 50))
    assert (np.diff(speeds) <= 0).all()
    assert 3.0 < speeds[0] < 4.0


def test_no_steady_turn_is_faster(ability):
    count = 60
    cars = CarBatch(CAR, count, 1)
    speed, steering = np.linspace(0.5, 4.0, count), np.tile(np.linspace(0.05, np.deg2rad(30), 6), count // 6)
    for _ in range(60):
        cars.drive(speed, steering)
    now = cars.read()
    driven = np.hypot(now.speed_mps, now.lateral_mps)
    curvature = np.abs(now.yaw_rate_radps) / driven
    held = np.abs(now.lateral_mps) < 0.5 * now.speed_mps
    assert held.sum() > 20
    assert (driven[held] <= ability.speed_at(curvature[held]) + 0.03).all()


def test_less_grip_and_slower_commands_are_slower(ability):
    slippery, slow = ability_of(CAR, LOW, HIGH, 0.5), ability_of(CAR, LOW, np.array([2.0, HIGH[1]]))
    assert slippery.speed_at(np.array([1.0])) < ability.speed_at(np.array([1.0]))
    assert slippery.brake_mps2 < ability.brake_mps2
    assert slow.speed_mps.max() < 2.1
