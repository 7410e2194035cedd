import dataclasses

import mujoco
import pytest
from pydantic import TypeAdapter, ValidationError

from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.options import options
from deepracer_exp.sim.mujoco_model import build_spec


@pytest.fixture(params=options("car"))
def car(request) -> CarConfig:
    return compose_experiment([f"car={request.param}"])[0].car


def test_the_car_of_today_is_that_of_version_6():
    today, sixth = (compose_experiment([f"car={name}"])[0].car for name in ("deepracer", "deepracer_v6"))
    assert today == sixth


@pytest.mark.parametrize(
    "change",
    [
        {"min_speed_mps": 5.0},
        {"rear_axle_x_m": 0.1},
        {"com_x_m": 0.1},
        {"substeps": 0},
        {"steering_kick": 1.0},
        {"steering_delay_s": 0.07},
        {"front_motor_gain_nms": 0.0, "rear_motor_gain_nms": 0.0},
    ],
)
def test_impossible_cars_are_refused(car, change):
    with pytest.raises(ValidationError):
        TypeAdapter(CarConfig).validate_python(dataclasses.asdict(car) | change)


def test_the_model_weighs_what_the_links_of_the_published_car_weigh(car):
    # Chassis, shell, camera and its mount, two hinges, four wheels.
    assert build_spec(car).compile().body_mass.sum() == pytest.approx(
        5 + 0.3 + 2 * 0.34055 + 2 * 0.1 + 4 * 0.34055, abs=1e-3
    )


def test_the_model_turns_about_its_centre_of_mass(car):
    model = build_spec(car).compile()
    data = mujoco.MjData(model)
    data.qvel[2] = 3.0
    before = model.body("chassis").ipos[0]
    mujoco.mj_step(model, data, nstep=20)
    mujoco.mj_kinematics(model, data)
    assert data.xipos[1][:2] == pytest.approx([before, 0.0], abs=1e-12)
    assert data.qvel == pytest.approx([0.0, 0.0, 3.0], abs=1e-12)


def test_the_car_in_films_has_wheels_that_steer_and_spin(car):
    model = build_spec(car, visual=True).compile()
    names = [model.joint(number).name for number in range(model.njnt)]
    assert names[:3] == ["x", "y", "yaw"]
    assert sum(name.endswith("_steer") for name in names) == 2
    assert sum(name.endswith("_spin") for name in names) == 4
