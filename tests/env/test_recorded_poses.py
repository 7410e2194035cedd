"""The environment's rules on what the real service recorded: its poses go through the very code a race uses."""

import numpy as np
import pandas as pd
import pytest

from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.rule_passes import nearer_of
from deepracer_exp.env.rules import RaceRules
from deepracer_exp.env.setup import build_setup
from deepracer_exp.env.trace_columns import EPISODE_STATUS
from deepracer_exp.rewards.reward import RewardFunction
from deepracer_exp.rewards.source import RewardSource
from deepracer_exp.sim.batch import CarState
from tests.conftest import REFERENCE

TRACES = REFERENCE / "console_training/sim-trace"
FRONT_M = 0.14
JUDGED = ("progress", "all_wheels_on_track", "status", "done", "reward", "steps")

# The console's sample for following the centre line, in our words.
FOLLOW = """
import numpy as np

def reward_batch(params):
    share = params["distance_from_center"] / params["track_width"]
    return np.select([share <= 0.1, share <= 0.25, share <= 0.5], [1.0, 0.5, 0.1], 1e-3)
"""


def recorded(folder: str) -> pd.DataFrame:
    """Return the recorded steps with their poses; episodes are numbered over all files."""
    if not (TRACES / folder).is_dir():
        pytest.skip("the recordings of the real service are not on this machine")
    rows = read_recording(TRACES / folder).steps
    rows["episode"] = rows.groupby(["stream", "episode"], sort=False, observed=True).ngroup()
    return rows.sort_values(["episode", "steps"], kind="stable", ignore_index=True)


def judged(rows: pd.DataFrame, setup) -> pd.DataFrame:
    """Judge every recorded pose, all episodes side by side, one car each; row by row beside `rows`."""
    car, step = rows["episode"].to_numpy(), rows["steps"].to_numpy(np.int64) - 1
    cars, steps = car.max() + 1, step.max() + 1
    yaw_rad = np.radians(rows["yaw"].to_numpy())
    recorded_pose = np.array(
        [rows["X"] - FRONT_M * np.cos(yaw_rad), rows["Y"] - FRONT_M * np.sin(yaw_rad), yaw_rad]
    )
    # A car whose episode is over waits where it ended.
    poses = np.repeat(recorded_pose[:, rows.groupby("episode")["steps"].idxmax()][:, None], steps, axis=1)
    poses[:, step, car] = recorded_pose
    rules = RaceRules(setup, cars)
    source = RewardSource("follow", "follow.py", FOLLOW, "", {}, {})
    reward = RewardFunction(source, cars, 30.0, None)
    # The service does not log where an episode began; the first progress implies it.
    first = rows.groupby("episode").first()
    begun = setup.track.project(first[["X", "Y"]].to_numpy()).ndist - first["progress"].to_numpy() / 100
    rules.reset(start_ndist=begun % 1)
    out = np.empty((steps, cars, len(JUDGED)))
    closest, front = np.empty((steps, cars, 2), np.intp), np.empty((steps, cars, 2))
    for at in range(steps):
        rules.measure(CarState(*poses[:, at], *np.zeros((4, cars))))
        result = rules.apply()
        paid = reward(
            rules.params(result, np.zeros(cars), np.zeros(cars)), rules.track_params, result.running
        )
        closest[at], front[at] = result.now.closest_waypoints, result.now.front
        out[at] = np.column_stack(
            [
                result.progress,
                result.all_wheels_on_track,
                result.status,
                result.terminated | result.truncated,
                paid,
                rules.steps,
            ]
        )
    table = pd.DataFrame(out[step, car], columns=JUDGED)
    around = zip(closest[step, car], front[step, car], strict=True)
    table["closest_waypoint"] = [nearer_of(*pair, rules.tracks.waypoints[0], 0) for pair in around]
    table["status"] = [EPISODE_STATUS[int(code)] for code in table["status"]]
    return table.assign(start=(begun % 1)[car])


@pytest.fixture(scope="module")
def setup():
    route = f"track.file={REFERENCE / 'routes/reinvent_base.npy'}"
    if not (REFERENCE / "routes").is_dir():
        pytest.skip("the routes of the real service are not on this machine")
    return build_setup(compose_experiment([route, "episode.max_steps=0"])[0])


@pytest.fixture(scope="module")
def training(setup) -> tuple[pd.DataFrame, pd.DataFrame]:
    rows = recorded("training")
    return rows, judged(rows, setup)


@pytest.fixture(scope="module")
def evaluation(setup) -> tuple[pd.DataFrame, pd.DataFrame]:
    rows = recorded("evaluation")
    return rows, judged(rows, setup)


@pytest.fixture(params=["training", "evaluation"])
def both(request) -> tuple[pd.DataFrame, pd.DataFrame]:
    return request.getfixturevalue(request.param)


def test_nothing_of_the_training_is_left_out(training):
    assert len(training[0]) == 44_247
    assert training[0]["episode"].nunique() == 560


def test_every_row_has_the_services_progress_closest_waypoint_reward_and_length(both, setup):
    rows, ours = both
    np.testing.assert_allclose(ours["progress"], rows["progress"], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(ours["closest_waypoint"], rows["closest_waypoint"])
    np.testing.assert_array_equal(ours["reward"], rows["reward"])
    assert {0.0, 0.1, 0.5, 1.0} <= set(rows["reward"])
    assert set(rows["track_len"]) == {setup.track.length_m}


def test_the_wheels_are_on_the_track_but_for_the_lean_of_the_car(both):
    rows, ours = both
    assert (ours["all_wheels_on_track"].astype(bool) != rows["all_wheels_on_track"]).sum() <= 5


def test_episodes_end_where_and_why_they_ended(both):
    rows, ours = both
    differs = ours["status"] != rows["episode_status"]
    assert differs.sum() <= 5
    # Only a wheel on the border may be judged differently: the log does not have the car's lean.
    assert set(rows["episode_status"][differs]) | set(ours["status"][differs]) <= {"off_track", "in_progress"}
    np.testing.assert_array_equal(ours["done"].astype(bool)[~differs], rows["done"][~differs])


def test_the_first_row_of_an_episode_is_the_prepare_step_and_pays_nothing(both):
    rows, ours = both
    first = rows["steps"] == 1
    np.testing.assert_array_equal(rows["episode_status"] == "prepare", first)
    np.testing.assert_array_equal(ours["status"] == "prepare", first)
    assert not ours["reward"][first].any()
    assert not rows["reward"][first].any()
    np.testing.assert_array_equal(ours["steps"], rows["steps"])


def test_training_episodes_start_where_our_cars_start(training, setup):
    """The service moves the start on by a twentieth of a lap after every episode of training."""
    rows, ours = training
    recorded_start = ours["start"][rows["steps"] == 1].to_numpy()
    assert len(recorded_start) == 560
    one = RaceRules(setup, 1)
    own_start = []
    for _ in recorded_start:
        one.reset()
        own_start.append(one.start_ndist[0])
    away = (recorded_start - own_start + 0.5) % 1 - 0.5
    np.testing.assert_allclose(away, 0, atol=1e-9)


def test_evaluation_episodes_start_at_the_start_line(evaluation):
    rows, ours = evaluation
    start = ours["start"][rows["steps"] == 1].to_numpy()
    np.testing.assert_allclose((start + 0.5) % 1 - 0.5, 0, atol=1e-9)


def test_a_car_stands_at_its_start_until_it_is_released(training, setup):
    """The pose of the prepare step is the start pose of the rule, but for a few millimetres of settling."""
    rows, ours = training
    first = rows["steps"] == 1
    pose = setup.track.start_pose(ours["start"][first].to_numpy())
    x_m, y_m = pose.x + FRONT_M * np.cos(pose.yaw_rad), pose.y + FRONT_M * np.sin(pose.yaw_rad)
    away_m = np.hypot(rows["X"][first] - x_m, rows["Y"][first] - y_m)
    assert away_m.max() < 0.02
    turned = (np.radians(rows["yaw"][first]) - pose.yaw_rad + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(turned).max() < np.radians(3)


def test_poses_from_the_middle_of_a_lap_are_judged_as_in_the_whole_lap(training, setup):
    rows, ours = training
    steps = rows.groupby("episode")["steps"].transform("max")
    middle = rows.index[(rows["steps"] == 30) & (steps > 31)].to_numpy()[:50]
    rules = RaceRules(setup, len(middle))
    rules.reset(start_ndist=ours["start"].to_numpy()[middle])
    rules.start_midway(rows["steps"].to_numpy()[middle], rows["progress"].to_numpy()[middle])
    after = rows.iloc[middle + 1]
    yaw_rad = np.radians(after["yaw"].to_numpy())
    x_m, y_m = after["X"] - FRONT_M * np.cos(yaw_rad), after["Y"] - FRONT_M * np.sin(yaw_rad)
    rules.measure(CarState(x_m.to_numpy(), y_m.to_numpy(), yaw_rad, *np.zeros((4, len(middle)))))
    np.testing.assert_allclose(rules.apply().progress, after["progress"], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(rules.steps, after["steps"])
