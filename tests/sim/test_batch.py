import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.compose import compose_option
from deepracer_exp.errors import RunFailed
from deepracer_exp.sim.batch import CarBatch

VERSIONS = ("deepracer_v4", "deepracer_v5", "deepracer_v6")
CARS = {name: compose_option("car", name, CarConfig) for name in (*VERSIONS, "ideal")}
CAR, IDEAL = CARS["deepracer_v5"], CARS["ideal"]
EVEN = dataclasses.replace(CAR, steering_trim_deg=0.0)
STILL = dataclasses.replace(CAR, min_speed_mps=0.0)
# At rest: within a tenth of a millimetre, and slower than that a second. The service calls a car standing below
# 0.3 mm a step, 4.5 mm/s.
REST = 1e-4


@pytest.fixture(autouse=True)
def _log_elsewhere(tmp_path, monkeypatch):
    # MuJoCo leaves MUJOCO_LOG.TXT in the working directory when it warns.
    monkeypatch.chdir(tmp_path)


def test_all_cores_are_taken_where_the_system_does_not_say_which_are_allowed(monkeypatch):
    monkeypatch.delattr("os.sched_getaffinity")  # as on macOS
    assert CarBatch(CAR, 1, threads=0).n_cars == 1


def random_commands(n_cars: int, steps: int):
    rng = np.random.default_rng(3)
    return rng.uniform(0.1, 4.0, (steps, n_cars)), np.deg2rad(rng.uniform(-30, 30, (steps, n_cars)))


def drive(cars: CarBatch, speed_mps, steering_deg, steps: int):
    speed = np.broadcast_to(np.asarray(speed_mps, float), (cars.n_cars,))
    steering = np.broadcast_to(np.deg2rad(steering_deg), (cars.n_cars,))
    for _ in range(steps):
        cars.drive(speed, steering)
    return cars.read()


@settings(max_examples=20, deadline=None)
@given(x=st.floats(-50, 50), y=st.floats(-50, 50), yaw=st.floats(-3.1, 3.1), driven=st.integers(0, 5))
def test_a_placed_car_is_where_it_was_put_and_stays_there(x, y, yaw, driven):
    cars = CarBatch(STILL, 2, 1)
    drive(cars, 2.0, 20.0, driven)
    cars.place([1], [x], [y], [yaw])
    for state in (cars.read(), drive(cars, 0.0, 0.0, 15)):
        assert state.x_m[1] == pytest.approx(x, abs=REST)
        assert state.y_m[1] == pytest.approx(y, abs=REST)
        assert state.yaw_rad[1] == pytest.approx(yaw, abs=REST)
        assert abs(state.speed_mps[1]) < REST
        assert abs(state.lateral_mps[1]) < REST


def test_placing_a_car_leaves_the_others_alone():
    cars = CarBatch(CAR, 3, 1)
    drive(cars, 2.0, 10.0, 5)
    before = cars.state
    cars.place(np.array([1]), 3.0, 4.0, 1.0)
    np.testing.assert_array_equal(cars.state[[0, 2]], before[[0, 2]])


def test_a_placed_car_drives_the_same_path_whatever_it_did_before():
    cars = CarBatch(CAR, 2, 1)
    drive(cars, [0.5, 4.0], [0.0, 30.0], 20)
    cars.place(np.arange(2), 0.0, 0.0, 0.5)
    drive(cars, 2.0, 15.0, 20)
    np.testing.assert_array_equal(cars.state[0], cars.state[1])


def test_driving_does_not_depend_on_place_and_heading():
    cars = CarBatch(CAR, 2, 1)
    cars.place([0, 1], [0.0, 7.0], [0.0, -3.0], [0.0, 2.0])
    state = drive(cars, 1.5, 15.0, 15)
    dx, dy = state.x_m - [0.0, 7.0], state.y_m - [0.0, -3.0]
    turned = (np.cos(2) * dx[0] - np.sin(2) * dy[0], np.sin(2) * dx[0] + np.cos(2) * dy[0])
    np.testing.assert_allclose(turned, (dx[1], dy[1]), atol=1e-9)


@pytest.mark.parametrize("name", CARS)
@pytest.mark.parametrize("speed", [0.1, 0.5, 1.0, 2.0, 3.0])
def test_a_car_steering_straight_goes_straight_at_about_the_speed_it_was_sent(name, speed):
    car = dataclasses.replace(CARS[name], steering_trim_deg=0.0)
    state = drive(CarBatch(car, 1, 1), speed, 0.0, 60)
    assert abs(state.y_m[0]) < 1e-9
    assert abs(state.yaw_rad[0]) < 1e-9
    assert 0.95 < state.speed_mps[0] / speed < 1.06


def test_the_wheels_of_the_service_do_not_reach_four_metres_a_second():
    # 100 rad/s at the radius by which the service divides: 3.5 m/s, of a wheel that is a little larger.
    state = drive(CarBatch(EVEN, 2, 1), [3.5, 4.0], 0.0, 60)
    assert state.speed_mps[0] == pytest.approx(state.speed_mps[1], rel=0.02)
    assert 3.5 < state.speed_mps[1] < 3.7


def test_a_car_steering_straight_pulls_to_where_its_wheels_are_trimmed():
    car = dataclasses.replace(CAR, steering_trim_deg=1.0)
    left, straight = (drive(CarBatch(car, 1, 1), 1.0, steering, 30).y_m[0] for steering in (0.0, -1.0))
    assert left > 0.01
    assert abs(straight) < 0.1 * left


@pytest.mark.parametrize("name", VERSIONS)
def test_two_thirds_of_the_speed_are_reached_within_half_a_second(name):
    cars = CarBatch(CARS[name], 1, 1)
    speeds = [drive(cars, 2.0, 0.0, 1).speed_mps[0] for _ in range(10)]
    reached = 1 + int(np.argmax(np.array(speeds) > 2.0 * 0.632))
    assert 2 <= reached <= 7
    assert speeds == sorted(speeds)


@pytest.mark.parametrize("name", CARS)
@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0])
def test_positive_steering_turns_left_and_negative_as_much_to_the_right(name, speed):
    car = dataclasses.replace(CARS[name], steering_trim_deg=0.0)
    state = drive(CarBatch(car, 2, 1), speed, [15.0, -15.0], 20)
    assert state.yaw_rate_radps[0] > 0.2
    assert state.y_m[0] > 0.02
    assert state.y_m[1] == pytest.approx(-state.y_m[0], abs=1e-9)


@pytest.mark.parametrize("name", VERSIONS)
def test_the_car_gets_around_the_tightest_corner_of_a_course(name):
    # 0.7 m radius at 1 m/s.
    cars = CarBatch(CARS[name], 1, 1)
    drive(cars, 1.0, 0.0, 15)
    state = drive(cars, 1.0, 30.0, 30)
    assert state.speed_mps[0] / state.yaw_rate_radps[0] < 0.75


@pytest.mark.parametrize("steering", [5.0, 10.0, 20.0, 30.0, -30.0])
def test_the_ideal_car_turns_as_the_bicycle_formula_says(steering):
    cars = CarBatch(IDEAL, 3, 1)
    state = drive(cars, [0.5, 1.0, 2.0], steering, 45)
    radius_m = IDEAL.wheelbase_m / np.tan(np.deg2rad(steering))
    np.testing.assert_allclose(state.speed_mps / state.yaw_rate_radps, radius_m, rtol=0.05)


@pytest.mark.parametrize("name", VERSIONS)
def test_the_fitted_cars_turn_wider_than_the_ideal_one(name):
    fitted, ideal = (drive(CarBatch(car, 1, 1), 1.0, 30.0, 45) for car in (CARS[name], IDEAL))
    assert fitted.yaw_rate_radps[0] / fitted.speed_mps[0] < 0.7 * ideal.yaw_rate_radps[0] / ideal.speed_mps[0]


def test_commands_beyond_the_limits_are_cut():
    cars = CarBatch(CAR, 2, 1)
    drive(cars, [99.0, CAR.max_speed_mps], [90.0, CAR.max_steering_deg], 10)
    np.testing.assert_array_equal(cars.state[0], cars.state[1])


def test_a_slippery_car_slides_and_the_others_do_not_notice():
    alike, one_slips = CarBatch(CAR, 3, 1), CarBatch(CAR, 3, 1)
    one_slips.set_friction_scale(np.array([1]), np.array([0.1 / CAR.tyre_friction]))
    for cars in (alike, one_slips):
        drive(cars, 2.0, 0.0, 30)
    grip, slip = drive(alike, 2.0, 20.0, 10), drive(one_slips, 2.0, 20.0, 10)
    np.testing.assert_array_equal(one_slips.state[[0, 2]], alike.state[[0, 2]])
    assert 0.0 < slip.y_m[1] < 0.7 * grip.y_m[1]


def test_a_slippery_floor_and_a_slippery_tyre_are_the_same():
    floor, tyre = CarBatch(CAR, 1, 1, floor_friction=0.4), CarBatch(CAR, 1, 1)
    tyre.set_friction_scale(np.array([0]), np.array([0.4]))
    drive(floor, 1.5, 20.0, 15), drive(tyre, 1.5, 20.0, 15)
    np.testing.assert_array_equal(floor.state, tyre.state)


@pytest.mark.parametrize(
    "setter", ["set_friction_scale", "set_mass_scale", "set_motor_scale", "set_servo_scale"]
)
def test_a_scale_of_one_changes_nothing(setter):
    plain, scaled = CarBatch(CAR, 2, 1), CarBatch(CAR, 2, 1)
    getattr(scaled, setter)(np.arange(2), np.ones(2))
    drive(plain, 2.0, 20.0, 15), drive(scaled, 2.0, 20.0, 15)
    np.testing.assert_array_equal(plain.state, scaled.state)


def test_a_car_made_heavier_drives_as_one_that_is_configured_so():
    made = CarBatch(CAR, 1, 1)
    made.set_mass_scale(np.array([0]), np.array([1.5]))
    heavy = {name: 1.5 * getattr(CAR, name) for name in ("mass_kg", "wheel_spin_inertia_kgm2")}
    inertia = tuple(1.5 * moment for moment in CAR.inertia_kgm2)
    configured = CarBatch(dataclasses.replace(CAR, **heavy, inertia_kgm2=inertia), 1, 1)
    for speed_mps, steering_deg in ((3.0, 0.0), (3.0, 25.0), (0.5, -25.0)):
        np.testing.assert_allclose(
            drive(made, speed_mps, steering_deg, 10),
            drive(configured, speed_mps, steering_deg, 10),
            atol=1e-9,
        )


def test_a_heavy_car_and_a_weak_motor_gain_speed_slowly():
    cars = CarBatch(CAR, 3, 1)
    cars.set_mass_scale(np.array([1]), np.array([2.0]))
    cars.set_motor_scale(np.array([2]), np.array([0.5]))
    speed = drive(cars, 2.0, 0.0, 4).speed_mps
    assert speed[1] < 0.7 * speed[0]
    assert speed[2] < 0.7 * speed[0]


def test_a_weak_servo_steers_late():
    cars = CarBatch(CARS["deepracer_v6"], 2, 1)
    drive(cars, 1.0, 0.0, 15)
    cars.set_servo_scale(np.array([1]), np.array([0.2]))
    rate = drive(cars, 1.0, 20.0, 4).yaw_rate_radps
    assert 0.0 < rate[1] < 0.7 * rate[0]


def test_a_restored_state_continues_bit_for_bit():
    speed, steering = random_commands(3, 20)
    cars, other = CarBatch(CAR, 3, 1), CarBatch(CAR, 3, 1)
    for t in range(10):
        cars.drive(speed[t], steering[t])
    kept = cars.state
    other.state = kept
    for t in range(10, 20):
        cars.drive(speed[t], steering[t])
        other.drive(speed[t], steering[t])
    np.testing.assert_array_equal(cars.state, other.state)
    assert not np.array_equal(kept, cars.state)


def test_a_state_of_another_number_of_cars_is_refused():
    with pytest.raises(ValueError, match="shape"):
        CarBatch(CAR, 2, 1).state = CarBatch(CAR, 3, 1).state


def test_a_state_that_is_not_finite_ends_the_run_and_names_the_car():
    cars = CarBatch(CAR, 4, 1)
    state = cars.state
    state[2, 1:] = np.nan
    cars.state = state
    with pytest.raises(RunFailed, match="car 2"):
        drive(cars, 1.0, 0.0, 1)
    # It is still there to be looked at: nothing has put the car back to its start.
    assert np.isnan(cars.read().x_m[2])
    assert np.isfinite(cars.read().x_m[[0, 1, 3]]).all()


@pytest.mark.parametrize(("speed", "steering"), [(np.nan, 0.0), (np.inf, 0.0), (1.0, np.nan), (1.0, -np.inf)])
def test_a_command_that_is_not_a_number_ends_the_run_and_names_the_car(speed, steering):
    cars = CarBatch(CAR, 3, 1)
    with pytest.raises(RunFailed, match="car 1: command"):
        cars.drive(np.array([1.0, speed, 1.0]), np.array([0.0, steering, 0.0]))


def test_a_held_car_stays_at_its_place_whatever_it_is_sent():
    cars = CarBatch(CAR, 2, 1)
    for _ in range(15):
        cars.drive([2.0, 2.0], [0.5, 0.5], moving=np.array([False, True]))
    state = cars.read()
    assert np.hypot(state.x_m, state.y_m)[0] < REST
    assert np.hypot(state.x_m, state.y_m)[1] > 0.5


def test_what_was_read_does_not_change_when_the_cars_move_on():
    cars = CarBatch(CAR, 1, 1)
    before = cars.read()
    drive(cars, 1.0, 0.0, 10)
    assert before.x_m[0] == 0.0
