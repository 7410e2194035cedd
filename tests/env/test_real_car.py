"""The physical car: what it can run, and how it sees and acts."""

import copy
import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.driving import ContinuousActionSpace, SpeedRange, SteeringRange
from deepracer_exp.config.evaluation import (
    CarControlsConfig,
    CarPictureConfig,
    CarTimingConfig,
    RealCarConfig,
)
from deepracer_exp.env.action_space import ContinuousActions, DiscreteActions
from deepracer_exp.env.race import Race
from deepracer_exp.env.real_car import UNCOMPRESSED, Servos, as_the_car, car_pictures, car_refusals
from deepracer_exp.env.setup import build_setup
from deepracer_exp.env.trace_columns import PACKED


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


# --- How it sees and acts

WHOLE = RealCarConfig(
    picture=CarPictureConfig(jpeg_quality=95),
    timing=CarTimingConfig(frames_per_s=30, latency_s=0.044),
    controls=CarControlsConfig(full_lock_deg=30, full_throttle_mps=None),
)
NONE = RealCarConfig(picture=None, timing=None, controls=None)


@pytest.fixture(scope="module")
def setup():
    """A camera on a car that goes where it is steered; ten physics steps between two actions."""
    lines = ("observation=camera", "action_space=continuous", "car=ideal", "car.substeps=10")
    return build_setup(compose_experiment(lines)[0])


@pytest.fixture
def blind(setup):
    return replace(setup, observation=replace(setup.observation, camera=None))


def test_a_picture_is_the_mean_of_the_middle_two_by_two_of_each_four_by_four_pixels():
    frame = np.zeros((4, 8), np.uint8)
    # The mean of the left middle is 25.75, to be rounded; of the right block all but the middle is white.
    frame[1:3, 1:3] = [[10, 20], [30, 43]]
    frame[:, 4:] = 255
    frame[1:3, 5:7] = 7
    np.testing.assert_array_equal(car_pictures(frame[None, None], UNCOMPRESSED), [[[[26, 7]]]])


def test_compressing_grey_is_as_good_as_compressing_colour_and_turning_it_grey(setup):
    pictures = []
    for color in ("grey", "rgb"):
        camera = replace(setup.observation.camera, color=color)
        race = Race(replace(setup, observation=replace(setup.observation, camera=camera)), 1)
        race.reset()
        pictures.append(race.pixels[0])
    grey, rgb = pictures
    file = io.BytesIO()
    # OpenCV's default of chroma: half the resolution.
    Image.fromarray(np.moveaxis(rgb, 0, -1)).save(file, "JPEG", quality=95, subsampling="4:2:0")
    decoded = np.asarray(Image.open(file), np.float64) @ np.array([0.299, 0.587, 0.114])
    ours = car_pictures(np.kron(grey[None], np.ones((1, 4, 4), np.uint8)), 95)[0, 0]
    difference = np.abs(decoded - ours)
    assert difference.mean() < 0.5
    assert np.quantile(difference, 0.999) < 4
    assert np.abs(ours.astype(float) - grey[0]).max() > 1  # it does compress


def test_with_every_part_off_the_cars_drive_and_see_as_before_bit_for_bit(setup):
    off = replace(NONE, timing=CarTimingConfig(frames_per_s=15, latency_s=0))
    driven = []
    for one in (setup, as_the_car(setup, NONE), as_the_car(setup, off)):
        race = Race(one, 2)
        race.reset()
        actions = np.random.default_rng(0).uniform(-1, 1, (12, 2, 2))
        driven.append([(race.step(action), race.trace.copy(), race.pixels)[1:] for action in actions])
    for other in driven[1:]:
        np.testing.assert_equal(other, driven[0])


def drive_path(setup, frames_per_s, latency_s, actions):
    """Return where a car was at each of its actions, the prepare step left out, (steps, 2), metres."""
    timing = CarTimingConfig(frames_per_s=frames_per_s, latency_s=latency_s)
    race = Race(as_the_car(setup, replace(NONE, timing=timing)), 1)
    race.reset()
    race.step(actions[:1])
    path = []
    for action in actions:
        race.step(action[None])
        path.append(race.trace[0, [PACKED["X"], PACKED["Y"]]])
    return np.array(path)


@pytest.fixture
def turns():
    """A new random action every third frame, (45, 2)."""
    return np.repeat(np.random.default_rng(1).uniform(-1, 1, (15, 2)), 3, axis=0)


def test_a_latency_of_whole_frames_delays_the_whole_drive_by_them(blind, turns):
    at_once, late = (drive_path(blind, 30, latency_s, turns) for latency_s in (0.0, 0.1))
    assert np.ptp(at_once, axis=0).min() > 0.05
    np.testing.assert_array_equal(late[:4], np.tile(at_once[0], (4, 1)))
    np.testing.assert_allclose(late[3:], at_once[:-3], rtol=0, atol=1e-12)


def test_a_latency_of_half_a_frame_delays_the_drive_by_half_a_frame(blind, turns):
    late = drive_path(blind, 15, 1 / 30, turns)
    twice_as_often = drive_path(blind, 30, 0.0, np.repeat(turns, 2, axis=0))
    np.testing.assert_allclose(late[1:], twice_as_often[1:-1:2], rtol=0, atol=1e-9)


def test_the_largest_angle_becomes_full_lock_and_half_the_speed_four_fifths():
    actions = DiscreteActions(np.array([-20.0, 0.0, 10.0]), np.array([1.0, 2.0, 1.0]))
    lock_deg, curve = np.full(3, 30.0), np.ones(3)
    servos = Servos(actions, lock_deg, curve)
    steering_deg, speed_mps = servos.follow(*actions.commands(np.array([0, 1, 2])))
    np.testing.assert_allclose(steering_deg, [-30.0, 0.0, 15.0])
    np.testing.assert_allclose(speed_mps, [1.6, 2.0, 1.6])
    faster = Servos(actions, lock_deg, curve, full_throttle_mps=4.0)
    np.testing.assert_allclose(faster.follow(*actions.commands(np.array([0, 1, 2])))[1], [3.2, 4.0, 3.2])


def test_steering_that_the_servo_refuses_leaves_the_last_until_the_car_is_put_back():
    actions = ContinuousActions(np.array([-27.0, 1.0]), np.array([25.0, 3.0]))
    servos = Servos(actions, np.full(2, 30.0), np.ones(2))
    steered = [
        servos.follow(np.array([degrees, 5.0]), np.ones(2))[0][0] for degrees in (12.5, -26.0, -25.0, -27.0)
    ]
    np.testing.assert_allclose(steered, [15.0, 15.0, -30.0, -30.0])
    servos.center(np.array([0]))
    np.testing.assert_allclose(servos.follow(np.full(2, -27.0), np.ones(2))[0], [0.0, 6.0])


def test_rules_hold_for_as_many_seconds_at_twice_the_frames(setup):
    timed = as_the_car(setup, WHOLE)
    assert timed.episode.immobilized_steps == 2 * setup.episode.immobilized_steps
    assert timed.episode.reversed_steps == 2 * setup.episode.reversed_steps
    assert timed.car.control_period_s / timed.car.substeps <= setup.car.control_period_s / setup.car.substeps
