"""Another reward function on recorded steps."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from deepracer_exp.aws.logs.recorded import STEP_COLUMNS
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.parse import parse_experiment
from deepracer_exp.env.trace_columns import SCHEMA
from deepracer_exp.errors import BadInput
from deepracer_exp.reports.tables import reward_replay
from deepracer_exp.reports.tables.log_course import driven_against
from deepracer_exp.reports.tables.log_view import ONE_WAY, LogView, prepare
from deepracer_exp.reports.tables.reward_replay import ReplayedRewards
from deepracer_exp.rewards.source import named_reward_source
from deepracer_exp.runs import trace
from deepracer_exp.runs.recording import read_run_recording
from deepracer_exp.runs.run_files import read_config
from deepracer_exp.tracks.track import Track
from tests.conftest import IN_PROCESS, call_in

from .conftest import CONSOLE
from .made_up import Drive, made_up_recording, typed

QUICK = ("evaluation.trials=1", "evaluation.time_s=5", "evaluation.held_out=null")
FOLLOW = """
def reward_function(params):
    share = params["distance_from_center"] / params["track_width"]
    return 1.0 if share <= 0.1 else 0.5 if share <= 0.25 else 0.1 if share <= 0.5 else 1e-3
"""


def replay_reward(view: LogView, reward: str, **more) -> ReplayedRewards:
    car = compose_experiment([])[0].car
    return reward_replay.replay_reward(view, named_reward_source(reward), car, **more)


@pytest.fixture(scope="module")
def own(trained) -> LogView:
    return prepare(read_run_recording(trained("reward=progress_delta", "budget.iterations=2").folder))


@pytest.fixture
def reward(tmp_path):
    """Write a reward function and return its file."""

    def write(text: str) -> str:
        file = tmp_path / "mine.py"
        file.write_text(text)
        return str(file)

    return write


def test_the_services_own_reward_is_paid_again_in_all_rows_and_in_the_evaluations(console, reward):
    route = np.load(CONSOLE.parent / "routes" / "reinvent_base.npy")
    view = replace(console, course=Track.from_route(route, "reinvent_base"))
    replayed = replay_reward(view, reward(FOLLOW))
    assert (
        replayed.steps["stream"] == "training"
    ).sum() == 44_247 + 595  # the text log has the last iteration
    np.testing.assert_array_equal(replayed.steps["new_reward"], replayed.steps["reward"])
    assert len(replayed.steps) > len(view.steps)
    assert len(replayed.laps) > 48
    assert replayed.laps["rank"].tolist() == replayed.laps["new_rank"].tolist()


@pytest.mark.parametrize(
    "overrides", [(), ("track=Bowtie_track", "track.direction=alternate", "reward=progress_delta")]
)
def test_a_runs_own_reward_is_paid_again_in_every_row(tmp_path, monkeypatch, overrides):
    # Without the rounding of traces, whose effect the test below measures.
    monkeypatch.setattr(trace, "_STORED", SCHEMA)
    monkeypatch.setattr(trace, "_ENCODINGS", {})
    run = call_in(tmp_path, "train", *IN_PROCESS, *QUICK, *overrides, "budget.iterations=2").folder
    source = named_reward_source(str(run / "reward_function.py"))
    car = parse_experiment(read_config(run)).car
    view = prepare(read_run_recording(run))
    replayed = reward_replay.replay_reward(view, source, car)
    np.testing.assert_allclose(replayed.steps["new_reward"], replayed.steps["reward"], rtol=0, atol=1e-9)
    both = {False, True} if "track.direction=alternate" in overrides else {False}
    assert set(replayed.waypoints["reversed"]) == both
    # Everything else on its page is of one direction: at a waypoint the other way is another place.
    alone = {problem.reason for problem in view.problems} == {ONE_WAY}
    assert alone is (len(both) == 2)
    assert (len(view.steps) < len(replayed.steps)) is alone
    assert not driven_against(view.course, view.steps, view.steps["episode"].to_numpy()).any()


def test_the_decimals_of_a_trace_are_enough_to_pay_a_reward_again(own):
    replayed = replay_reward(own, "progress_delta")
    # A step's gain is known to 1e-6% of a lap of 17.7 m, the recorded reward to seven digits.
    np.testing.assert_allclose(replayed.steps["new_reward"], replayed.steps["reward"], rtol=1e-6, atol=4e-7)


def test_step_by_step_and_all_at_once_pay_the_same(own, reward):
    name = "progress_delta"
    text = named_reward_source(name).text.replace("def reward_batch", "def unused")
    at_once, one_by_one = replay_reward(own, name), replay_reward(own, reward(text))
    np.testing.assert_allclose(
        at_once.steps["new_reward"], one_by_one.steps["new_reward"], rtol=0, atol=1e-12
    )


def test_a_reward_with_a_memory_sees_the_steps_of_an_episode_in_a_row(own, reward):
    count = """
calls = 0
last = None
def reward_function(params):
    global calls, last
    if last is not None and params["steps"] != last + 1:
        calls += 1
    last = params["steps"]
    return calls
"""
    steps = replay_reward(own, reward(count)).steps
    driven = steps[steps["steps"] > 1]
    assert driven.groupby("episode")["new_reward"].nunique().max() == 1
    # Episode after episode, though 16 cars drove side by side.
    firsts = driven.groupby("episode")["new_reward"].first()
    assert firsts.tolist() == list(range(len(firsts)))


def test_the_prepare_step_is_not_paid(own, reward):
    steps = replay_reward(own, reward("def reward_function(params):\n    return 1.0\n")).steps
    assert set(steps["new_reward"][steps["steps"] == 1]) == {0.0}
    assert set(steps["new_reward"][steps["steps"] > 1]) == {1.0}


def test_the_function_sees_an_off_track_step(own, reward):
    text = "def reward_function(params):\n    return float(params['is_offtrack'])\n"
    steps = replay_reward(own, reward(text)).steps
    assert ((steps["new_reward"] == 1.0) == (steps["episode_status"] == "off_track")).all()


def circle() -> Track:
    angle = np.linspace(0.0, 2 * np.pi, 101)
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    ring[-1] = ring[0]
    return Track.from_route(np.hstack([10 * ring, 9.5 * ring, 10.5 * ring]), "circle")


def laps_of(times: dict[int, int], back: tuple[int, ...] = ()) -> LogView:
    """Make laps of so many steps around a circle of 10 m radius, some of them driven the other way."""
    parts = []
    for episode, count in times.items():
        angle = np.linspace(0.0, 2 * np.pi, count + 1) + 1e-6
        angle[-1] = 2 * np.pi - 1e-6
        part = pd.DataFrame({"steps": np.arange(1, count + 2), "progress": 100 * angle / (2 * np.pi)})
        part["X"], part["Y"], part["yaw"] = 10 * np.cos(angle), 10 * np.sin(angle), 0.0
        part["Y"] *= -1 if episode in back else 1
        part["tstamp"], part["reward"], part["episode"] = part["steps"] / 15, 1.0, episode
        part["closest_waypoint"] = np.round(part["progress"]).astype(int)
        part.loc[count, "progress"] = 100.0
        part["episode_status"] = ["prepare", *["in_progress"] * (count - 1), "lap_complete"]
        part["done"] = part["steps"] == count + 1
        parts.append(part)
    steps = pd.concat(parts, ignore_index=True).assign(
        stream="training", track="circle", all_wheels_on_track=True
    )
    missing = {name: 0 for name in STEP_COLUMNS if name not in steps}
    steps = typed(steps.assign(**missing), STEP_COLUMNS)
    return replace(prepare(replace(made_up_recording([Drive()]), steps=steps)), course=circle())


@pytest.fixture(scope="module")
def fifty_steps() -> LogView:
    return laps_of({0: 50})


def test_laps_are_ranked_by_the_new_reward(reward):
    # Paid a lap, not a step: the fastest ranks first.
    once = "def reward_function(p):\n    return 10000 / p['steps'] ** 2 if p['progress'] == 100 else 0\n"
    replayed = replay_reward(laps_of({0: 100, 1: 80, 2: 120, 3: 90}), reward(once))
    assert replayed.laps["episode"].tolist() == [1, 3, 0, 2]
    assert replayed.laps["new_rank"].tolist() == [1, 2, 3, 4]
    assert replayed.laps["time_rank"].tolist() == [1, 2, 3, 4]
    assert replayed.laps["rank"].tolist() == [4, 3, 2, 1]
    assert replayed.correlations == pytest.approx({"old_new": -1.0, "old_time": 1.0, "new_time": -1.0})
    np.testing.assert_allclose(replayed.laps["time_s"], np.array([81, 91, 101, 121]) / 15)


def test_places_are_compared_between_0_and_1(reward):
    by_place = "def reward_function(p):\n    return 3 * p['closest_waypoints'][0]\n"
    waypoints = replay_reward(laps_of({0: 400}), reward(by_place)).waypoints
    # The recorded reward is the same everywhere, and says nothing of places.
    assert set(waypoints["share"]) == {0.5}
    assert (waypoints["new_share"].min(), waypoints["new_share"].max()) == (0.0, 1.0)


def test_laps_driven_the_other_way_are_reversed(reward):
    text = "def reward_function(p):\n    return 2.0 if p['is_reversed'] else 1.0\n"
    laps = replay_reward(laps_of({0: 100, 1: 100}, back=(1,)), reward(text)).laps
    assert laps.set_index("episode")["new_reward"].to_dict() == {0: 100.0, 1: 200.0}


def test_rows_without_a_position_have_no_reward_and_those_without_a_course_are_refused(reward):
    one = reward("def reward_function(p):\n    return 1\n")
    view = laps_of({0: 50, 1: 60})
    lost = view.recording.steps["episode"] == 1
    view.recording.steps.loc[lost, "X"] = np.nan
    replayed = replay_reward(view, one)
    assert replayed.steps["new_reward"].isna().tolist() == lost.tolist()
    assert replayed.laps["episode"].tolist() == [0]
    with pytest.raises(BadInput, match="no step is on a known course"):
        replay_reward(replace(view, course=None), one)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "def reward_function(p):\n    return 1 / (p['steps'] - 7)\n",
            r"raised ZeroDivisionError: .* in line 2 of .*mine.py \(training, episode 0, step 7\)",
        ),
        ("def reward_function(p):\n    return None\n", r"returned None; .*\(training, episode 0, step 2\)"),
        (
            "def reward_function(p):\n    return 0\ndef reward_batch(p):\n    return 1 / (p['steps'] - 7)\n",
            r"reward_batch returned inf; .*\(training, episode 0, step 7\)",
        ),
        (
            "def reward_function(p):\n    return 0\ndef reward_batch(p):\n    return p['missing']\n",
            r"reward_batch raised KeyError: 'missing' in line 4 .*\(50 steps at once\)",
        ),
        (
            "def reward_function(p):\n    while p['steps'] == 9:\n        pass\n    return 0\n",
            r"took longer than the time limit of 0.5 s .*\(training, episode 0, step 9\)",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore:divide by zero")
def test_a_function_that_fails_is_reported_with_episode_and_step(fifty_steps, reward, text, words):
    with pytest.raises(BadInput, match=words) as error:
        replay_reward(fifty_steps, reward(text), time_limit_s=0.5)
    assert "\n" not in str(error.value)


def test_steps_are_paid_at_once_without_sharing_one_limit(reward):
    """All steps together use more CPU than the limit, 0.05 ms each."""
    text = (
        "import time\ndef reward_function(p):\n    return 0.0\ndef reward_batch(p):\n"
        "    until = time.thread_time() + 5e-5 * len(p['x'])\n"
        "    while time.thread_time() < until: pass\n    return p['x'] * 0.0 + 1.0\n"
    )
    replayed = replay_reward(laps_of({0: 10_000}), reward(text), time_limit_s=0.4)
    assert replayed.steps["new_reward"].sum() > 9_000
