import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
from pydantic import TypeAdapter, ValidationError

from deepracer_exp.config.car import CarConfig
from deepracer_exp.sim.car import WHEELS, build_model

CAR_FILE = Path(__file__).parents[2] / "conf/car/deepracer.yaml"


CAR_FILES = sorted(CAR_FILE.parent.glob("*.yaml"))


@pytest.fixture(scope="module", params=CAR_FILES, ids=lambda path: path.stem)
def car(request) -> CarConfig:
    return TypeAdapter(CarConfig).validate_python(yaml.safe_load(request.param.read_text()))


@pytest.mark.parametrize("path", CAR_FILES, ids=lambda path: path.stem)
def test_the_yaml_holds_exactly_the_fields_of_the_dataclass(path):
    assert set(yaml.safe_load(path.read_text())) == {field.name for field in dataclasses.fields(CarConfig)}


@pytest.mark.parametrize("path", CAR_FILES, ids=lambda path: path.stem)
def test_every_key_of_the_yaml_is_explained_on_the_line_above(path):
    lines = path.read_text().splitlines()
    keys = [i for i, line in enumerate(lines) if line and not line.startswith("#")]
    assert all(lines[i - 1].startswith("# ") for i in keys)


@pytest.mark.parametrize(
    "change",
    [
        {"min_speed_mps": 5.0},
        {"rear_axle_x_m": 0.1},
        {"substeps": 0},
        {"contact_impedance": 1.0},
        {"servo_kick": 1.0},
        {"front_motor_gain_nms": 0.0, "rear_motor_gain_nms": 0.0},
    ],
)
def test_impossible_cars_are_refused(change):
    values = yaml.safe_load(CAR_FILE.read_text())
    with pytest.raises(ValidationError):
        TypeAdapter(CarConfig).validate_python(values | change)


def test_the_model_weighs_what_its_parts_weigh(car):
    parts = car.chassis_mass_kg + 2 * car.front_hub_mass_kg + 4 * car.wheel_mass_kg
    assert build_model(car).body_mass.sum() == pytest.approx(parts)
    # The sum of all links of the published car.
    assert parts == pytest.approx(7.543, abs=0.001)


def test_each_body_has_its_mass_where_it_belongs(car):
    model = build_model(car)
    np.testing.assert_allclose(model.body("chassis").ipos, car.chassis_com_m)
    for name in WHEELS:
        np.testing.assert_array_equal(model.body(name).ipos, 0.0)


def test_only_wheels_touch_the_floor_and_nothing_else(car):
    model = build_model(car, visual=True)
    assert not any(model.geom(i).conaffinity[0] or model.geom(i).contype[0] for i in range(model.ngeom))
    touching = {
        (model.geom(pair.geom1[0]).name, model.geom(pair.geom2[0]).name)
        for pair in (model.pair(i) for i in range(model.npair))
    }
    assert touching == {("floor", wheel) for wheel in WHEELS}


def test_the_visible_car_moves_exactly_as_the_bare_one(car):
    states = []
    for visual in (False, True):
        model = build_model(car, visual)
        data = mujoco.MjData(model)
        data.ctrl[:] = [0.2, 0.2, 30, 30, 30, 30]
        mujoco.mj_step(model, data, nstep=50)
        states.append((data.qpos.copy(), data.qvel.copy()))
    np.testing.assert_array_equal(states[0][0], states[1][0])
    np.testing.assert_array_equal(states[0][1], states[1][1])


def test_a_contact_settles_in_no_less_than_two_physics_steps(car):
    # Below that MuJoCo would silently simulate softer contacts than the ones asked for.
    least_s = 2 * car.control_period_s / car.substeps
    assert min(car.contact_time_s, car.front_slip_time_s, car.rear_slip_time_s) >= least_s
