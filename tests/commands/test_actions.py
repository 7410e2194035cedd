"""`deepracer-exp actions`: from a run and from its logs to an action space that trainings take."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from deepracer_exp.commands.actions import FREE, write_lap_actions
from deepracer_exp.commands.tracks import experiment_on
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.action_space import build_action_space, describe_actions
from deepracer_exp.evaluation.fastest.fastest_lap import COLUMNS, FastestLap, Question, _keep
from deepracer_exp.sweeps.plan import plan_sweep
from tests.aws.made_up_logs import write_run_as_logs
from tests.conftest import refused

LAPS = ("track=Straight_track", "action_space=deepracer", "reward=speed_on_track", "budget.env_steps=16384")


@pytest.fixture
def run_dir(copied) -> Path:
    """A copy of a trained run that completes laps."""
    return copied(*LAPS)


@pytest.fixture
def logs(run_dir, call, tmp_path) -> Path:
    """The run's logs as the service writes them, and the file of the run's actions."""
    folder = write_run_as_logs(run_dir, tmp_path / "from aws", "Straight_track")
    assert call("export", str(run_dir), "format=aws", "-o", str(folder)).code == 0
    return folder


def described(*overrides: str) -> str:
    return describe_actions(build_action_space(compose_experiment(list(overrides))[0].action_space))


def test_the_option_and_the_file_of_a_run_are_the_same_actions(run_dir, call, tmp_path, monkeypatch):
    ended = call("actions", str(run_dir), "--count", "8", "--name", "mine")
    assert ended.code == 0, ended.stderr
    monkeypatch.chdir(tmp_path)
    assert described("action_space=mine") == described("custom_files=mine")
    # Which angle stands between -30 and 0 follows from the laps, and these from the processor.
    assert re.match(
        r"5 actions -30°/0\.6 -1[0-5]°/0\.6 0°/0\.6 1[0-5]°/0\.6 30°/0\.6$", described("action_space=mine")
    )
    assert (tmp_path / "mine" / "actions.png").read_bytes().startswith(b"\x89PNG")
    assert "train action_space=mine" in ended.stdout
    assert re.search(r"\d of \d complete laps? without a reset on Straight_track", ended.stdout)
    # The run has a list of five actions, all at 0.6 m/s.
    assert "5 of 8: the other commands of the laps are the same once rounded" in ended.stdout


def test_the_table_has_the_actions_of_the_file(logs, call, tmp_path):
    ended = call("actions", str(logs), "--count", "7")
    assert ended.code == 0, ended.stderr
    rows = re.findall(r"^ +\d+ +(-?[\d.]+) +([\d.]+) +[\d.]+", ended.stdout, re.MULTILINE)
    metadata = json.loads((tmp_path / "actions-from-aws" / "model_metadata.json").read_text())
    listed = [(action["steering_angle"], action["speed"]) for action in metadata["action_space"]]
    assert [(float(steering), float(speed)) for steering, speed in rows] == listed
    assert listed == sorted(listed)
    assert (tmp_path / "conf" / "action_space" / "actions-from-aws.yaml").is_file()


def test_the_fastest_lap_of_a_track_has_actions(call, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    # A lap that a search has kept, of known commands.
    experiment, course = experiment_on(["track=Oval_track", "car=deepracer_v5", *FREE])
    steps = np.zeros((91, len(COLUMNS)))
    steps[1:, COLUMNS.index("steering_deg")] = np.repeat([4.0, 12.0, 20.0], 30)
    steps[1:, COLUMNS.index("commanded_mps")] = np.repeat([4.0, 3.0, 2.0], 30)
    lap = FastestLap(lap_time_s=6.0, bound_s=5.9, steps=steps)
    _keep(Question.of(experiment, course), lap)
    ended = call("actions", "oval track", "--name", "mine", "car=deepracer_v5")
    assert ended.code == 0, ended.stderr
    assert "Oval_track: the fastest lap of deepracer_v5 on Oval_track, 6.00 s" in ended.stdout
    metadata = json.loads((tmp_path / "mine" / "model_metadata.json").read_text())
    listed = {(action["steering_angle"], action["speed"]) for action in metadata["action_space"]}
    assert {(4.0, 4.0), (12.0, 3.0), (20.0, 2.0)} <= listed
    # The prepare step commands nothing; to the right the car goes to recover only.
    assert {speed for _, speed in listed} == {1.3, 2.0, 3.0, 4.0}
    assert {angle for angle, _ in listed if angle <= 0} == {-30.0, -10.0, 0.0}
    assert metadata["version"] == "5"


def test_a_sweep_gets_the_lists_of_the_command_once(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    plan = plan_sweep(["sweep=season"], is_only_shown=True)
    assert plan.lap_actions is not None
    write_lap_actions(plan.lap_actions)
    assert call("actions", "reinvent_base", "--name", "mine", "--count", "12").code == 0
    assert described("action_space=lap12-reinvent_base") == described("action_space=mine")
    files = {file: file.stat().st_mtime_ns for file in (tmp_path / "conf" / "action_space").iterdir()}
    assert {file.stem for file in files} == {"lap12-reinvent_base", "lap20-reinvent_base", "mine"}
    write_lap_actions(plan.lap_actions)
    assert {file: file.stat().st_mtime_ns for file in files} == files


@pytest.mark.parametrize(
    ("overrides", "searched"),
    [
        (["track=Oval_track"], "continuous,discrete_fast,lap12-Oval_track,lap20-Oval_track"),
        (["track=Ace Speedway", "sweep.lap_actions=[9]"], "continuous,discrete_fast,lap9-2022_april_open"),
        (
            ["car=deepracer_v5", "track.direction=reversed", "sweep.lap_actions=[9]"],
            "continuous,discrete_fast,lap9-reinvent_base-deepracer_v5-reversed",
        ),
        # Those that the command line names are all.
        (["action_space=discrete,grid"], "discrete,grid"),
        (["action_space=discrete"], None),
        (["sweep.lap_actions=[]"], "continuous,discrete_fast"),
    ],
)
def test_lists_from_a_lap_compete_with_the_actions_of_a_ready_made_search(overrides, searched):
    plan = plan_sweep(["sweep=season", *overrides], is_only_shown=True)
    assert plan.request.space.get("action_space") == searched
    assert (plan.lap_actions is None) == ("lap" not in str(searched))


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("track=[Oval_track,reinvent_base]", "2 tracks; accepted: one track"),
        ("track=Oval_track,reinvent_base", "track is searched"),
        ("sweep.lap_actions=[5]", "sweep.lap_actions"),
        ("sweep.lap_actions=[12,12]", "one is listed twice"),
    ],
)
def test_lists_from_a_lap_need_one_track_and_a_number_of_actions(override, words):
    assert words in refused(plan_sweep, ["sweep=season", override], is_only_shown=True)


def test_a_training_takes_them(run_dir, call, train_here):
    assert call("actions", str(run_dir), "--name", "mine").code == 0
    quick = ("budget.iterations=1", "evaluation.trials=1", "evaluation.time_s=2", "evaluation.held_out=null")
    ended = train_here("action_space=mine", "name=next", *quick)
    assert ended.code == 0, ended.stderr


def test_nothing_that_is_there_is_overwritten(run_dir, call, tmp_path):
    assert call("actions", str(run_dir), "--name", "mine").code == 0
    call("actions", str(run_dir), "--name", "mine").assert_refused("--name mine", "exists already")
    shutil.rmtree(tmp_path / "conf")
    metadata = tmp_path / "mine" / "model_metadata.json"
    metadata.write_text("precious")
    call("actions", str(run_dir), "--name", "mine").assert_refused("--output mine", "model_metadata.json")
    assert metadata.read_text() == "precious"
    assert not (tmp_path / "conf").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["accepted: one run, logs or a track"]),
        (["RUN", "nowhere"], ["2 given"]),
        (["nowhere"], ["nowhere"]),
        (["empty"], ["empty"]),
        (["RUN", "--count", "5"], ["--count 5", "accepted: 6 to 100"]),
        (["RUN", "--count", "a dozen"], ["a dozen", "whole number"]),
        (["RUN", "--name", "../mine"], ["--name"]),
        (["RUN", "--name", "discrete"], ["--name discrete", "exists already"]),
        (["RUN", "--track", "Oval_track"], ["--track Oval_track", "is no log"]),
        (["empty", "checkpoint=last"], ["checkpoint=last", "is a log"]),
        (["Oval_track", "--track", "Oval_track"], ["--track Oval_track", "is a track itself"]),
        (["Oval_track", "action_space.speed.high=100"], ["action_space"]),
        (["RUN", "seed=3"], ["seed=3", "no such key"]),
    ],
)
def test_bad_input_is_one_line(run_dir, call, tmp_path, arguments, words):
    (tmp_path / "empty").mkdir()
    call("actions", *(str(run_dir) if word == "RUN" else word for word in arguments)).assert_refused(*words)
    assert not (tmp_path / "conf").exists()
