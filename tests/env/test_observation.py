import re
from pathlib import Path

import numpy as np
import pytest

from deepracer_exp.env.observation import feature_names


def features(race) -> dict[str, np.ndarray]:
    return dict(zip(race.feature_names, race.observation.T, strict=True))


def put(race, offset_m: float, turn_rad: float) -> None:
    """Put car 0 beside the centre line by `offset_m` to the left, turned by `turn_rad` to the left."""
    pose = race.setup.track.start_pose(np.array([0.3]))
    yaw = pose.yaw_rad + turn_rad
    left = np.array([-np.sin(pose.yaw_rad), np.cos(pose.yaw_rad)])
    front = race.setup.car.front_point_m * np.array([np.cos(yaw), np.sin(yaw)])
    x, y = np.array([pose.x, pose.y]) + offset_m * left - front
    race._batch.place(np.array([0]), x, y, yaw)
    race._observe()


@pytest.mark.parametrize("direction", ["forward", "reversed"])
def test_left_is_positive(race_of, direction):
    race = race_of("track=Straight_track", f"track.direction={direction}")
    half_m = race.setup.track.width_m / 2
    put(race, 0.2, 0.3)
    seen = features(race)
    assert seen["offset"][0] == pytest.approx(0.2 / half_m, rel=0.02)
    assert seen["heading_error_sin"][0] == pytest.approx(np.sin(0.3), abs=0.02)
    assert seen["heading_error_cos"][0] == pytest.approx(np.cos(0.3), abs=0.02)
    # Turned to the left and left of the centre line, the road ahead lies to the right.
    assert seen["ahead_y_1"][0] < 0
    put(race, -0.2, -0.3)
    mirrored = features(race)
    for name in ("offset", "heading_error_sin", "ahead_y_1", "ahead_y_2"):
        np.testing.assert_allclose(mirrored[name], -seen[name], atol=0.02)
    for name in ("heading_error_cos", "ahead_x_1", "ahead_x_2"):
        np.testing.assert_allclose(mirrored[name], seen[name], atol=0.02)


def test_the_road_ahead_is_where_the_centre_line_continues(race_of):
    race = race_of("observation.lookahead_m=[0.5,1.5]", "observation.lookahead_scale_m=3", n_cars=20)
    now, track, seen = race.rules.now, race.setup.track, features(race)
    for distance in (0.5, 1.5):
        point = track.points_at(now.ndist + distance / track.length_m)
        x, y = 3 * seen[f"ahead_x_{distance}"], 3 * seen[f"ahead_y_{distance}"]
        cos, sin = np.cos(now.yaw_rad), np.sin(now.yaw_rad)
        np.testing.assert_allclose(now.front[:, 0] + cos * x - sin * y, point[:, 0], atol=1e-6)
        np.testing.assert_allclose(now.front[:, 1] + sin * x + cos * y, point[:, 1], atol=1e-6)


def test_motion_and_last_action_are_scaled(race_of):
    race = race_of(
        "action_space=continuous",
        "observation.speed_scale_mps=2",
        "observation.yaw_rate_scale_radps=3",
        n_cars=2,
    )
    for _ in range(20):
        race.step(np.array([[1.0, 0.5], [-0.5, 1.0]]))
    seen, now, space = features(race), race.rules.now, race.setup.actions
    np.testing.assert_allclose(seen["speed"], now.speed_mps / 2, rtol=1e-6)
    np.testing.assert_allclose(seen["yaw_rate"], now.yaw_rate_radps / 3, rtol=1e-6)
    assert seen["yaw_rate"][0] > 0 > seen["yaw_rate"][1]
    np.testing.assert_allclose(seen["last_steering"], [1.0, -0.5])
    middle = space.low[1] + 0.75 * (space.high[1] - space.low[1])
    np.testing.assert_allclose(seen["last_speed"], [middle / space.high[1], 1.0], rtol=1e-6)


def test_a_new_episode_has_no_last_action(race_of):
    race = race_of(n_cars=2)
    for _ in range(5):
        race.step(np.zeros(2, np.int64))
    race.reset(np.array([0]))
    seen = features(race)
    assert seen["last_steering"][0] == seen["last_speed"][0] == seen["speed"][0] == 0
    assert seen["last_speed"][1] != 0


@pytest.mark.parametrize(
    ("lookahead_m", "size", "last"),
    [("[]", 7, "last_speed"), ("[0.25,4,10]", 13, "ahead_y_10")],
    ids=["no road ahead", "three places"],
)
def test_names_and_size_agree_for_any_lookahead(race_of, lookahead_m, size, last):
    race = race_of(f"observation.lookahead_m={lookahead_m}")
    race.step(np.zeros(1, np.int64))
    assert race.feature_names == feature_names(race.setup.observation)
    assert race.feature_names[-1] == last
    assert race.observation.shape[1] == len(race.feature_names) == size


def test_every_feature_is_documented(race_of):
    page = (Path(__file__).parents[2] / "docs/observation.md").read_text()
    named = set(re.findall(r"^\| `(\w+)`", page, re.MULTILINE))
    assert named == {re.sub(r"_[\d.]+$", "_D", name) for name in race_of().feature_names}


def test_a_sliding_car_sees_its_speed_to_the_side_and_the_angle_of_its_wheels(race_of):
    race = race_of("car=deepracer_v4", "action_space=continuous", "observation.sliding=true", n_cars=2)
    assert race.feature_names[-2:] == ("side_speed", "wheel_angle")
    angles = []
    for _ in range(8):
        race.step(np.array([[1.0, 1.0], [-1.0, 1.0]]))
        angles.append(features(race)["wheel_angle"].copy())
    seen, state = features(race), race._batch.read()
    np.testing.assert_allclose(seen["side_speed"], state.lateral_mps / 4, rtol=1e-6)
    np.testing.assert_allclose(seen["wheel_angle"], np.degrees(state.wheel_angle_rad) / 30, rtol=1e-6)
    left, right = np.array(angles).T
    # The command is full left at once; the wheels of this car need half a second for two thirds of the way.
    assert seen["last_steering"][0] == 1.0
    assert (np.diff(left) > 0).all()
    assert 0.5 < left[-1] < 0.9
    np.testing.assert_allclose(right, -left)
    assert seen["side_speed"][0] * seen["side_speed"][1] < 0
