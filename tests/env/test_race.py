import numpy as np
import pytest
import shapely

from deepracer_exp.env.race import NonFinite
from deepracer_exp.env.trace_columns import PACKED, STATUS_CODE
from tests.env.conftest import drive, random_actions, spied
from tests.rewards.test_reward import KEYS

NOISY = ("randomization=aws", "action_space=continuous", "episode.max_steps=40")


# --- What a run depends on


def test_the_number_of_threads_changes_nothing(race_of):
    actions = random_actions(100, 12)
    one, two = (drive(race_of(*NOISY, n_cars=12, threads=threads), actions) for threads in (1, 2))
    assert one[:, :, PACKED["done"]].sum() > 12
    np.testing.assert_array_equal(one, two)


def test_without_noise_the_seed_changes_nothing(race_of):
    actions = random_actions(30, 2)
    a, b = (drive(race_of("action_space=continuous", f"seed={seed}", n_cars=2), actions) for seed in (0, 1))
    np.testing.assert_array_equal(a, b)


# --- One step


def test_the_first_step_is_the_prepare_step(race_of, column):
    race = race_of("track=reinvent_base", "reward=speed_on_track", n_cars=3)
    front = race.rules.now.front.copy()
    race.step(np.zeros(3, np.int64))
    assert (column(race, "episode_status") == STATUS_CODE["prepare"]).all()
    assert (column(race, "steps") == 1).all()
    assert not race.reward.any()
    assert not (race.terminated | race.truncated).any()
    np.testing.assert_allclose(race.rules.now.front, front, atol=1e-9)
    # The front point is 0.14 m ahead of the start.
    np.testing.assert_allclose(column(race, "progress"), 100 * 0.14 / race.setup.track.length_m, rtol=2e-3)
    race.step(np.zeros(3, np.int64))
    assert (column(race, "steps") == 2).all()
    assert (column(race, "episode_status") == STATUS_CODE["in_progress"]).all()
    assert (race.reward != 0).all()
    assert (np.linalg.norm(race.rules.now.front - front, axis=1) > 1e-3).all()


def test_the_reward_function_first_sees_step_two(race_of, spy):
    race = race_of(spy)
    for _ in range(3):
        race.step(np.zeros(1, np.int64))
    assert [params["steps"] for params in spied(race)[0]] == [2.0, 3.0]


def test_each_episode_starts_further_along_and_each_car_elsewhere(race_of):
    race = race_of("episode.start_offset=0.5", n_cars=3)
    starts = [race.rules.start_ndist.copy()]
    for _ in range(12):
        race.reset()
        starts.append(race.rules.start_ndist.copy())
    expected = (0.5 + 0.05 * (np.arange(13)[:, None] + np.arange(3))) % 1.0
    np.testing.assert_allclose((np.array(starts) - expected + 0.5) % 1.0, 0.5, atol=1e-12)
    origin = race.setup.track.project(np.column_stack([race.rules.now.x_m, race.rules.now.y_m]))
    np.testing.assert_allclose(origin.ndist, starts[-1], atol=1e-9)
    np.testing.assert_allclose(origin.offset_m, 0, atol=1e-9)
    np.testing.assert_allclose(np.cos(race.rules.now.yaw_rad - origin.heading_rad), 1, atol=1e-12)


def test_a_start_moves_on_for_the_car_whose_episode_ended_alone(race_of, column):
    race = race_of(n_cars=3)
    before = race.observation.copy()
    race.reset(np.array([1]))
    np.testing.assert_allclose(race.rules.start_ndist, [0.0, 0.1, 0.1])
    np.testing.assert_array_equal(race.observation[[0, 2]], before[[0, 2]])
    assert (race.observation[1] != before[1]).any()
    race.step(np.zeros(3, np.int64))
    np.testing.assert_array_equal(column(race, "episode"), [0, 1, 0])


def test_a_row_belongs_to_the_pose_its_action_was_chosen_at(race_of, column):
    race = race_of("action_space=continuous", n_cars=4)
    for action in random_actions(25, 4):
        seen, pose = race.observation.copy(), race.rules.now
        race.step(action)
        np.testing.assert_array_equal(column(race, "X"), pose.front[:, 0])
        np.testing.assert_allclose(pose.heading_error_rad, np.arctan2(seen[:, 1], seen[:, 2]), atol=1e-6)
        np.testing.assert_array_equal(column(race, "yaw"), np.degrees(pose.yaw_rad))
        np.testing.assert_allclose(column(race, "steer"), 30 * action[:, 0])
    assert (race.observation[:, 3] != seen[:, 3]).all()


def test_the_return_sums_the_rewards_of_the_episode(race_of, column):
    race = race_of("episode.max_steps=12", "reward=speed_on_track", n_cars=2)
    total = np.zeros(2)
    for _ in range(40):
        race.step(np.full(2, 3))
        total += race.reward
        np.testing.assert_allclose(column(race, "episode_return"), total)
        ended = race.terminated | race.truncated
        total[ended] = 0
        race.reset(np.flatnonzero(ended))


def test_the_clock_runs_at_the_control_rate_of_the_car_and_goes_on_over_episodes(race_of, column, spy):
    race = race_of("car.control_hz=30", spy)
    for steps in (6, 9):
        for _ in range(steps):
            race.step(np.zeros(1, np.int64))
        race.reset()
    assert column(race, "tstamp")[0] == pytest.approx(0.5)
    assert spied(race)[0][-1]["sim_time"] == pytest.approx(0.5)


# --- The params of a reward function


@pytest.mark.parametrize(
    ("name", "direction"),
    [
        ("reinvent_base", "forward"),
        ("Spain_track", "reversed"),
        ("Straight_track", "forward"),
        ("Straight_track", "reversed"),
    ],
)
def test_params_are_what_shapely_says_of_the_pose(race_of, column, steer_ahead, spy, name, direction):
    race = race_of(f"track={name}", f"track.direction={direction}", spy, "action_space=continuous", n_cars=3)
    track, rng = race.setup.track, np.random.default_rng(2)
    rows = []
    for step in range(60):
        action = steer_ahead(race, 0.3) + rng.uniform(-1, 1, (3, 2)) * [1.0, 0.3]
        pose = race.rules.now
        race.step(action)
        if step:
            rows.append((pose, race.trace.copy()))
    ring = shapely.LinearRing if track.closed else shapely.LineString
    center, inner, outer = (ring(points) for points in (track.waypoints, track.inner, track.outer))
    clockwise = (not center.is_ccw) if track.closed else direction == "reversed"
    seen = spied(race)
    for step in range(5, 59, 9):
        for car in range(3):
            params, (pose, row) = seen[car][step], rows[step]
            assert set(params) == set(KEYS)
            yaw = np.radians(params["heading"])
            forward = np.array([np.cos(yaw), np.sin(yaw)])
            origin = np.array([pose.x_m[car], pose.y_m[car]])
            place = shapely.Point(params["x"], params["y"])
            np.testing.assert_allclose([place.x, place.y], origin + 0.14 * forward, atol=1e-9)
            assert params["distance_from_center"] == pytest.approx(center.distance(place), abs=1e-9)
            assert params["projection_distance"] == pytest.approx(center.project(place), abs=1e-9)
            assert params["track_length"] == pytest.approx(center.length)
            at = center.interpolate(center.project(place))
            sides = [side.interpolate(side.project(at)) for side in (inner, outer)]
            assert params["track_width"] == pytest.approx(sides[0].distance(sides[1]), abs=1e-9)
            is_inside = place.distance(sides[0]) < place.distance(sides[1])
            assert params["is_left_of_center"] == (is_inside != clockwise)
            behind, ahead = params["closest_waypoints"]
            along = [center.project(shapely.Point(params["waypoints"][k])) for k in (behind, ahead)]
            if along[1] > along[0]:  # not across the closing point
                assert along[0] - 1e-9 <= params["projection_distance"] <= along[1] + 1e-9
            wheels = np.array(race.setup.car.wheel_points_m)
            left = np.array([-forward[1], forward[0]])
            on = [track.road.contains(shapely.Point(origin + x * forward + y * left)) for x, y in wheels]
            assert params["all_wheels_on_track"] == all(on)
            assert params["is_offtrack"] == (not any(on))
            assert params["steps"] == step + 2
            assert params["sim_time"] == pytest.approx((step + 2) / 15)
            assert params["speed"] == row[car, PACKED["throttle"]]
            assert params["steering_angle"] == row[car, PACKED["steer"]]
            assert params["progress"] == row[car, PACKED["progress"]]
            assert params["is_reversed"] == (direction == "reversed")
            assert params["waypoints"] == [tuple(point) for point in track.waypoints.tolist()]
            assert type(params["steps"]) is float
            assert type(params["is_offtrack"]) is bool


# --- Courses


@pytest.mark.parametrize(
    "course",
    [
        ("track=reinvent_base",),
        ("track=reinvent_base", "track.direction=reversed"),
        ("track=Straight_track",),
        ("track=Straight_track", "track.direction=reversed"),
    ],
    ids="-".join,
)
def test_a_course_can_be_completed(race_of, column, steer_ahead, course):
    race = race_of(*course, "action_space=continuous", n_cars=2)
    for _ in range(400):
        race.step(steer_ahead(race, -0.7))
        ended = race.terminated | race.truncated
        if ended.any():
            break
    assert ended.any()
    assert (column(race, "episode_status")[ended] == STATUS_CODE["lap_complete"]).all()
    assert (column(race, "progress")[ended] == 100.0).all()
    # The road goes on behind a closed track's line, and the car sees it as anywhere else.
    closed = race.setup.track.closed
    assert (race.truncated[ended] == closed).all()
    assert (race.terminated[ended] != closed).all()


def test_a_lap_terminates_an_episode_where_the_experiment_says_so(race_of, column, steer_ahead):
    race = race_of("track=reinvent_base", "episode.lap_terminates=true", "action_space=continuous")
    while not race.terminated[0]:
        race.step(steer_ahead(race, -0.7))
        assert not race.truncated[0]
    assert column(race, "episode_status")[0] == STATUS_CODE["lap_complete"]


def test_a_batch_gets_the_progress_of_the_step_before(race_of, column, tmp_path):
    file = tmp_path / "before.py"
    functions = (
        "def reward_function(params): pass",
        "def reward_batch(params): return params['previous_progress']",
    )
    file.write_text("\n".join(functions))
    race = race_of(f"reward.file={file}", "action_space=continuous", "episode.max_steps=9", n_cars=3)
    before = np.zeros(3)
    for action in random_actions(40, 3):
        race.step(action)
        now, driven = column(race, "progress"), column(race, "steps")
        # The function is called from the second step on, where it has nothing to compare with yet.
        expected = np.select([driven == 1, driven == 2], [0.0, now], before)
        np.testing.assert_array_equal(race.reward, expected)
        before = now.copy()
        race.reset(np.flatnonzero(race.terminated | race.truncated))


def test_a_car_that_drives_back_is_reversed(race_of, column):
    race = race_of("track=Straight_track", "action_space=continuous")
    pose = race.setup.track.start_pose(np.array([0.4]))
    race._batch.place(np.array([0]), pose.x, pose.y, pose.yaw_rad + np.pi)
    race._observe()
    for _ in range(60):
        race.step(np.array([[0.0, 0.0]]))
        if race.terminated[0]:
            break
    assert column(race, "episode_status")[0] == STATUS_CODE["reversed"]
    assert 16 <= column(race, "steps")[0] <= 20


def test_a_car_that_hardly_moves_is_immobilized(race_of, column):
    race = race_of("track=Straight_track", "action_space=deepracer", "episode.immobilized_m=1")
    for _ in range(16):
        assert not race.terminated[0]
        race.step(np.array([2]))
    assert race.terminated[0]
    assert column(race, "episode_status")[0] == STATUS_CODE["immobilized"]


# --- Faults


def test_a_car_that_became_nan_is_named_with_its_step_and_state(race_of, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a MUJOCO_LOG.TXT where it is
    race = race_of(n_cars=4, first_car=10)
    for _ in range(3):
        race.step(np.zeros(4, np.int64))
    race._batch._qvel[2, 0] = np.nan
    with pytest.raises(NonFinite, match=r"car 12 at step 4 of its episode 0") as caught:
        race.step(np.zeros(4, np.int64))
    state = caught.value.arrays["physics_state"]
    np.testing.assert_array_equal(np.flatnonzero(~np.isfinite(state).all(axis=1)), [2])
    assert {"observation", "steps", "episode", "trace", "action"} <= caught.value.arrays.keys()


def test_an_action_that_is_nan_is_named_before_anything_is_paid_for_it(race_of):
    race = race_of("action_space=continuous", n_cars=3)
    action = np.zeros((3, 2))
    action[1, 1] = np.nan
    with pytest.raises(NonFinite, match=r"action 'speed' of car 1 at step 1 .* became nan"):
        race.step(action)


def test_a_space_without_steering_keeps_its_features_finite(race_of):
    race = race_of("action_space.actions=[{steering_angle: 0, speed: 1}]")
    for _ in range(5):
        race.step(np.zeros(1, np.int64))
    assert race.observation[0, race.feature_names.index("last_steering")] == 0
