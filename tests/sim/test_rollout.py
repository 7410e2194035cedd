import numpy as np
import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.sim.batch import CarBatch
from deepracer_exp.sim.rollout import advance, drive_record, linearise, one_car, standing

PERIODS = 60


def commands(car, seed):
    random = np.random.default_rng(seed)
    full = np.deg2rad(car.max_steering_deg)
    speed = random.uniform(car.min_speed_mps, car.max_speed_mps, PERIODS)
    return np.column_stack([speed, random.uniform(-full, full, PERIODS)])


def driven(car, friction, given):
    cars, drive, states = one_car(car, friction), drive_record(), [standing(car, 1.0, 2.0, 0.5)]
    for command in given:
        after = np.empty_like(states[-1])
        advance(cars, drive, states[-1], command, (car.substeps, car.control_period_s / car.substeps), after)
        states.append(after)
    return np.array(states)


@pytest.mark.parametrize("name", ["deepracer_v4", "deepracer_v5", "deepracer_v6", "ideal"])
def test_a_rollout_is_where_the_simulator_is(name):
    car = compose_experiment([f"car={name}"])[0].car
    given, friction = commands(car, 0), 0.8
    cars = CarBatch(car, 1, 1, friction)
    cars.place(np.array([0]), np.array([1.0]), np.array([2.0]), np.array([0.5]))
    for command in given:
        cars.drive(*command)
    now, (*_, last) = cars.read(), driven(car, friction, given)
    com_m = car.com_x_m
    x_m, y_m = last[0] - com_m * (np.cos(last[2]) - 1.0), last[1] - com_m * np.sin(last[2])
    assert [x_m, y_m] == pytest.approx([now.x_m[0], now.y_m[0]], abs=1e-9)
    assert last[5] == pytest.approx(now.yaw_rate_radps[0], abs=1e-9)


def test_derivatives_predict_where_a_changed_command_leads_to():
    car = compose_experiment(["car=deepracer"])[0].car
    given = commands(car, 1)
    states = driven(car, 1.0, given)
    by_state, by_command = np.empty((PERIODS, 15, 15)), np.empty((PERIODS, 15, 2))
    step_s = car.control_period_s / car.substeps
    linearise(
        one_car(car, 1.0), drive_record(), states[:-1], given, (car.substeps, step_s), (by_state, by_command)
    )
    changed, change = given.copy(), np.array([1e-4, 1e-5])
    changed[20] += change
    predicted = by_command[20] @ change
    for k in range(21, 26):
        predicted = by_state[k] @ predicted
    found = driven(car, 1.0, changed)[26] - states[26]
    assert predicted == pytest.approx(found, rel=0.02, abs=2e-6)
