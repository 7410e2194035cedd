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


@pytest.fixture(scope="module")
def car() -> CarConfig:
    return TypeAdapter(CarConfig).validate_python(yaml.safe_load(CAR_FILE.read_text()))


def test_the_yaml_holds_exactly_the_fields_of_the_dataclass():
    assert set(yaml.safe_load(CAR_FILE.read_text())) == {
        field.name for field in dataclasses.fields(CarConfig)
    }


def test_every_key_of_the_yaml_is_explained_on_the_line_above():
    lines = CAR_FILE.read_text().splitlines()
    keys = [i for i, line in enumerate(lines) if line and not line.startswith("#")]
    assert all(lines[i - 1].startswith("# ") for i in keys)


@pytest.mark.parametrize(
    "change", [{"min_speed_mps": 5.0}, {"rear_axle_x_m": 0.1}, {"substeps": 0}, {"contact_impedance": 1.0}]
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
    touching = {model.geom(i).name for i in range(model.ngeom) if model.geom(i).conaffinity[0]}
    assert touching == set(WHEELS)
    assert [model.geom(i).name for i in range(model.ngeom) if model.geom(i).contype[0]] == ["floor"]


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
    assert car.contact_time_s >= 2 * car.control_period_s / car.substeps
