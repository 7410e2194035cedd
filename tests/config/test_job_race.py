"""Boxes and bots of run.env and training_params.yaml."""

import json
from pathlib import Path

import pytest

from deepracer_exp.aws.models.job_settings import race_values, read_training_params
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.custom_files.job_overrides import job_overrides
from deepracer_exp.config.custom_files.job_race import recorded_race
from tests.conftest import refused

from .conftest import METADATA, REWARD, composed

FIXED = {"DR_RACE_TYPE": "OBJECT_AVOIDANCE", "DR_OA_OBJECT_POSITIONS": "0.23,-1;0.46,1"}
BOTS = {
    "DR_RACE_TYPE": "HEAD_TO_BOT",
    "DR_H2B_NUMBER_OF_BOT_CARS": "4",
    "DR_H2B_BOT_CAR_SPEED": "0.75",
    "DR_H2B_IS_LANE_CHANGE": "True",
    "DR_H2B_LOWER_LANE_CHANGE_TIME": "1.0",
    "DR_H2B_BOT_CAR_PENALTY": "5.0",
}


@pytest.fixture
def job(tmp_path):
    """Write a folder with a reward, an action space, and run.env or training_params.yaml."""

    def write(file: str, values: dict[str, str]) -> Path:
        (tmp_path / "reward_function.py").write_text(REWARD)
        (tmp_path / "model_metadata.json").write_text(json.dumps(METADATA))
        mark = "=" if file == "run.env" else ": "
        (tmp_path / file).write_text("".join(f"{key}{mark}{value}\n" for key, value in values.items()))
        return tmp_path

    return write


def test_fixed_boxes_of_deepracer_for_cloud_are_those_of_the_race_and_the_policy_sees_them(job):
    experiment, notes = composed(job("run.env", FIXED))
    boxes = experiment.race.boxes
    assert [(box.lap, box.lane) for box in boxes.positions] == [(0.23, "outer"), (0.46, "inner")]
    assert (boxes.placement, boxes.count, experiment.race.bots.count) == ("fixed", 2, 0)
    assert experiment.observation.next_objects == 2
    assert any(
        "race.boxes.placement=fixed" in note and "observation.next_objects=2" in note for note in notes
    )


def test_without_positions_boxes_are_as_many_as_deepracer_for_cloud_places_by_default(job):
    experiment, notes = composed(job("run.env", {"DR_RACE_TYPE": "OBJECT_AVOIDANCE"}))
    boxes = experiment.race.boxes
    assert (boxes.number, boxes.placement, boxes.min_distance_m) == (6, "random", 2.0)
    assert any("race.quirks=service does the same" in note for note in notes)


def test_bots_of_deepracer_for_cloud_are_those_of_the_race(job):
    experiment, _ = composed(job("run.env", BOTS))
    bots = experiment.race.bots
    assert (bots.number, bots.speed_mps, bots.pause_s, bots.placement) == (4, 0.75, 5.0, "alternating")
    assert tuple(bots.lane_change_after_s) == (1.0, 5.0)
    assert experiment.race.boxes.count == 0


def test_the_type_of_the_race_decides_which_keys_deepracer_for_cloud_reads(job):
    experiment, notes = composed(job("run.env", BOTS | {"DR_RACE_TYPE": "TIME_TRIAL"}))
    assert experiment.race.others == 0
    assert any("not read, because DR_RACE_TYPE is not HEAD_TO_BOT" in note for note in notes)


def test_in_training_params_numbers_decide_whatever_the_type_and_both_may_be_there(job):
    values = {
        "RACE_TYPE": "TIME_TRIAL",
        "OBJECT_POSITIONS": '["0.1,-1", "0.25,1"]',
        "NUMBER_OF_BOT_CARS": "1",
        "OBSTACLE_TYPE": "amazon_box_obstacle",
        "IS_OBSTACLE_BOT_CAR": "true",
    }
    params = read_training_params(str(job("training_params.yaml", values) / "training_params.yaml"))
    lines, notes = job_overrides(params, {})
    experiment, _ = compose_experiment(lines)
    assert [box.lap for box in experiment.race.boxes.positions] == [0.1, 0.25]
    assert (experiment.race.bots.number, experiment.race.bots.lane_change_after_s) == (1, None)
    assert any("OBSTACLE_TYPE=amazon_box_obstacle: not applied" in note for note in notes)
    assert any("IS_OBSTACLE_BOT_CAR=True: not applied" in note for note in notes)


def test_the_user_s_own_race_has_priority(job):
    experiment, notes = composed(job("run.env", BOTS), "race=time_trial")
    assert experiment.race.others == 0
    assert any("race.bots.number: not used, because of race=time_trial" in note for note in notes)
    experiment, _ = composed(job("run.env", BOTS), "race.bots.number=2", "observation=camera")
    assert (experiment.race.bots.number, experiment.observation.next_objects) == (2, 0)


@pytest.mark.parametrize(
    ("key", "value", "accepted"),
    [
        ("DR_OA_OBJECT_POSITIONS", "0.2;0.4", "1 inner or -1 outer"),
        ("DR_OA_OBJECT_POSITIONS", "1.2,1", "1 inner or -1 outer"),
        ("DR_OA_NUMBER_OF_OBSTACLES", "many", "a number from 0 up"),
    ],
)
def test_a_value_that_the_service_would_not_accept_is_refused_in_one_line(job, key, value, accepted):
    line = refused(composed, job("run.env", {"DR_RACE_TYPE": "OBJECT_AVOIDANCE", key: value}))
    assert f"{key}={value}" in line
    assert accepted in line


def test_what_a_recording_s_parameters_leave_open_is_not_known():
    lists = {"OBJECT_POSITIONS": ["0.1,-1", "0.25,1"], "NUMBER_OF_BOT_CARS": ["1"], "BOT_CAR_SPEED": 0.5}
    race = recorded_race(race_values(lists))
    assert [(box.lap, box.lane) for box in race.boxes.positions] == [(0.1, "outer"), (0.25, "inner")]
    assert (race.bots.number, race.bots.speed_mps) == (1, 0.5)
    moved = recorded_race(race_values(lists | {"IS_LANE_CHANGE": True}))
    assert (moved.boxes.count, moved.bots.count) == (2, 0)
    # The distance between boxes that are spread depends on the version of the service.
    assert recorded_race({"NUMBER_OF_OBSTACLES": "4"}) is None
    assert recorded_race({}) is None


def test_a_box_at_the_end_of_the_lap_is_one_at_its_beginning():
    race = recorded_race({"OBJECT_POSITIONS": "1.0,-1;0,1"})
    assert [(box.lap, box.lane) for box in race.boxes.positions] == [(0.0, "outer"), (0.0, "inner")]
