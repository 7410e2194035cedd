"""The laws of the tyres, at their limits."""

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.sim.batch import CarBatch
from deepracer_exp.sim.tyres import GRAVITY_MPS2, _grip

CARS = {
    name: compose_experiment([f"car={name}"])[0].car
    for name in ("deepracer_v4", "deepracer_v5", "deepracer_v6")
}
CAR = dataclasses.replace(CARS["deepracer_v5"], steering_trim_deg=0.0, min_speed_mps=0.0)


def energy_j(cars: CarBatch) -> np.ndarray:
    state, car = cars.read(), cars.car
    lateral = state.lateral_mps + car.com_x_m * state.yaw_rate_radps
    return (
        0.5 * car.mass_kg * (state.speed_mps**2 + lateral**2)
        + 0.5 * car.inertia_kgm2[2] * state.yaw_rate_radps**2
    )


def sliding(*motions: tuple[float, float, float], floor_friction: float = 1.0) -> CarBatch:
    """Cars at the origin with these speeds ahead, to the left (m/s) and yaw rates (rad/s); their wheels stand."""
    cars = CarBatch(CAR, len(motions), 1, floor_friction)
    cars._qvel[:] = motions
    cars._qvel[:, 1] += CAR.com_x_m * cars._qvel[:, 2]
    return cars


@given(
    stiffness=st.floats(1, 5000),
    limit=st.floats(0.01, 100),
    slip=st.floats(-20, 20).filter(lambda v: abs(v) > 1e-6),
)
def test_a_tyres_force_is_the_mean_over_a_rotation_of_the_wheel(stiffness, limit, slip):
    turn = (np.arange(20_000) + 0.5) / 20_000 * np.pi / 2
    mean = np.minimum(stiffness * abs(slip), limit * np.cos(turn)).mean()
    assert _grip(stiffness, limit, slip) * abs(slip) == pytest.approx(mean, rel=1e-4)


@given(limit=st.floats(0.01, 100), slips=st.lists(st.floats(1e-6, 20), min_size=2, max_size=2))
def test_more_slip_never_gives_less_force_and_never_more_than_friction(limit, slips):
    less, more = (_grip(100.0, limit, slip) * slip for slip in sorted(slips))
    assert less <= more * (1 + 1e-9)
    assert more <= 2 / np.pi * limit * (1 + 1e-9)


def test_a_car_without_grip_is_not_moved():
    cars = sliding((2.0, 0.5, 1.0), floor_friction=0.0)
    before = energy_j(cars)
    for _ in range(15):
        cars.drive([4.0], [0.5])
    assert energy_j(cars) == pytest.approx(before)


@pytest.mark.parametrize("motion", [(3.0, 0.0, 0.0), (0.0, 3.0, 0.0), (0.0, 0.0, 20.0), (2.0, -2.0, 8.0)])
def test_a_car_commanded_to_stand_loses_its_energy_and_stays(motion):
    cars = sliding(motion)
    energies = [energy_j(cars)[0]]
    for _ in range(60):
        cars.drive([0.0], [0.0])
        energies.append(energy_j(cars)[0])
    assert all(after <= before + 1e-9 for before, after in itertools.pairwise(energies))
    assert energies[-1] < 1e-6
    rests = cars.read()
    cars.drive([0.0], [0.0])
    assert cars.read().x_m == pytest.approx(rests.x_m, abs=1e-6)
    assert cars.read().y_m == pytest.approx(rests.y_m, abs=1e-6)


def test_braking_and_sliding_are_bounded_by_friction():
    most = 2 / np.pi * CAR.tyre_friction * GRAVITY_MPS2
    cars = sliding((3.5, 0.0, 0.0), (0.0, 3.5, 0.0))
    cars.drive([0.0, 0.0], [0.0, 0.0])
    slid = cars.read()
    lost = 3.5 - np.hypot(slid.speed_mps, slid.lateral_mps)
    assert (lost <= most * CAR.control_period_s * 1.001).all()
    # Sideways only friction brakes, and all of it.
    assert lost[1] > 0.9 * most * CAR.control_period_s


@pytest.mark.parametrize("name", CARS)
def test_no_manoeuvre_takes_more_than_friction(name):
    car = CARS[name]
    cars, everyone = CarBatch(car, 8, 1), np.arange(8)
    # Both directions of a wheel have a limit of their own.
    most = np.sqrt(2) * 2 / np.pi * car.tyre_friction * GRAVITY_MPS2
    rng, before = np.random.default_rng(1), np.zeros(8, complex)
    for step in range(60):
        cars.drive(np.linspace(0.5, 4.0, 8), np.where(everyone % 2, 0.5, rng.uniform(-0.5, 0.5, 8)))
        state = cars.read()
        lateral = state.lateral_mps + car.com_x_m * state.yaw_rate_radps
        after = (state.speed_mps + 1j * lateral) * np.exp(1j * state.yaw_rad)
        assert (np.abs(after - before) <= most * car.control_period_s * (1 + 1e-9)).all(), step
        before = after


def test_load_moves_to_the_outer_and_the_rear_wheels():
    # With a high centre of mass the inner wheels lift first, and less sideways force is left.
    low, high = (dataclasses.replace(CAR, com_z_m=height) for height in (0.001, 0.09))
    yaw_rates = []
    for car in (low, high):
        cars = CarBatch(car, 1, 1)
        for _ in range(45):
            cars.drive([2.5], [np.deg2rad(20)])
        yaw_rates.append(cars.read().yaw_rate_radps[0])
    assert abs(yaw_rates[0] - yaw_rates[1]) > 0.01 * yaw_rates[0]


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), name=st.sampled_from(sorted(CARS)))
def test_the_mirrored_car_drives_the_mirrored_path(seed, name):
    rng = np.random.default_rng(seed)
    car = dataclasses.replace(CARS[name], steering_trim_deg=0.0)
    cars = CarBatch(car, 2, 1)
    for _ in range(20):
        speed, steering = rng.uniform(0.1, 4.0), rng.uniform(-0.5, 0.5)
        cars.drive([speed, speed], [steering, -steering])
    state = cars.read()
    assert state.x_m[0] == pytest.approx(state.x_m[1], abs=1e-9)
    assert state.y_m[0] == pytest.approx(-state.y_m[1], abs=1e-9)


def drive_wildly(name: str, steps: int, n_cars: int, threads: int) -> CarBatch:
    """Drive cars of every extreme of the randomization: a third at random, the others full lock at 4 m/s."""
    cars = CarBatch(CARS[name], n_cars, threads)
    everyone = np.arange(n_cars)
    extremes = np.array(list(itertools.product((0.3, 1.5), (0.5, 2.0), (0.4, 1.6), (0.2, 2.0))))[
        everyone % 16
    ]
    cars.set_friction_scale(everyone, extremes[:, 0])
    cars.set_mass_scale(everyone, extremes[:, 1])
    cars.set_motor_scale(everyone, extremes[:, 2])
    cars.set_servo_scale(everyone, extremes[:, 3])
    rng = np.random.default_rng(7)
    lock = np.deg2rad(30)
    most_j = 0.0
    for step in range(steps):
        speed = np.where(everyone % 3 == 0, rng.uniform(0.1, 4.0, n_cars), 4.0)
        alternating = lock * (1 - 2 * ((step + everyone) % 2))
        steering = np.choose(
            everyone % 3, [rng.uniform(-lock, lock, n_cars), np.full(n_cars, lock), alternating]
        )
        if step % 40 < 4:
            speed = np.where(everyone % 2 == 0, 0.1, speed)
        cars.drive(speed, steering)
        most_j = max(most_j, float(energy_j(cars).max()))
    assert np.isfinite(cars.state).all()
    # No faster than the wheels drive it, with turning: 0.5 m v2 at 3.7 m/s is 52 J.
    assert most_j < 80.0
    return cars


@pytest.mark.parametrize("name", CARS)
def test_the_wildest_driving_leaves_every_state_finite_and_the_same_for_any_number_of_threads(name):
    one, *others = (drive_wildly(name, 100, 48, threads).state for threads in (1, 2, 5, 0))
    for state in others:
        np.testing.assert_array_equal(state, one)


@pytest.mark.slow
@pytest.mark.parametrize("name", CARS)
def test_a_million_wild_control_steps_leave_every_state_finite(name):
    drive_wildly(name, 21_000, 48, 0)
