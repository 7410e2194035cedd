"""The physical car: what it can run."""

import copy
from dataclasses import replace

import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.driving import ContinuousActionSpace, SpeedRange, SteeringRange
from deepracer_exp.env.real_car import car_refusals


@pytest.fixture(scope="module")
def sees():
    """Sees with a camera and a LIDAR."""
    return compose_experiment(["observation=camera_lidar", "observation.lidar.reach_m=0.5"])[0]


@pytest.mark.parametrize(
    ("camera", "lidar", "words"),
    [
        (None, None, ["no features"]),
        ({"width": 80, "height": 60}, None, ["80x60"]),
        ({"color": "rgb"}, None, ["rgb"]),
        ({"width": 80, "height": 60, "frames": 3}, None, ["80x60", "frames=3"]),
        ({}, {"reach_m": None}, []),  # an archive's lidar_config sets the reach
        ({}, {"yaw_deg": 0.0}, ["accepted: 180"]),
        (None, {"kind": "discretized"}, ["discretized"]),
        ({}, None, []),
        ({"stereo_m": 0.06}, None, []),
        ({}, {}, []),
        (None, {"kind": "sectors", "reach_m": None}, []),
    ],
)
def test_what_the_car_could_not_run_or_would_see_otherwise_is_refused(sees, camera, lidar, words):
    observation = replace(
        sees.observation,
        camera=None if camera is None else replace(sees.observation.camera, **camera),
        lidar=None if lidar is None else replace(sees.observation.lidar, **lidar),
    )
    experiment = copy.copy(sees)
    vars(experiment)["observation"] = observation  # not replace: the network would have to fit, too
    refusals = car_refusals(experiment)
    assert len(refusals) == len(words)
    for line, word in zip(refusals, words, strict=True):
        assert word in line
        assert "accepted: " in line


@pytest.mark.parametrize(("low_mps", "refused"), [(3.0, 1), (1.0, 0)])
def test_a_continuous_range_of_one_value_is_refused(sees, low_mps, refused):
    space = ContinuousActionSpace(
        kind="continuous",
        steering_angle=SteeringRange(low=-30.0, high=30.0),
        speed=SpeedRange(low=low_mps, high=3.0),
        file=None,
    )
    assert len(car_refusals(replace(sees, action_space=space))) == refused
