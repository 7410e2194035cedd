"""Laws of reading model_metadata.json and hyperparameters.json; tests/test_user_files.py has those of hostile files."""

import contextlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given
from hypothesis import strategies as st

from deepracer_exp.aws.models import model_metadata
from deepracer_exp.aws.models.hyperparameters import (
    KEYS,
    Hyperparameters,
    hyperparameters_text,
    read_hyperparameters,
)
from deepracer_exp.aws.models.model_metadata import (
    Action,
    LidarSectors,
    ModelMetadata,
    model_metadata_text,
    read_model_metadata,
)
from deepracer_exp.errors import BadInput
from tests.config.conftest import HYPERPARAMETERS as DRFC
from tests.conftest import refused
from tests.examples import examples

SENSORS = ["FRONT_FACING_CAMERA", "DISCRETIZED_SECTOR_LIDAR"]
DISCRETE = [{"steering_angle": -30, "speed": 0.6}, {"steering_angle": 30, "speed": 1.2}]
CONTINUOUS = {"steering_angle": {"low": -20, "high": 30}, "speed": {"low": 1, "high": 2}}


def hyperparameters(folder: Path, content: object) -> Hyperparameters:
    path = folder / "hyperparameters.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return read_hyperparameters(path)


def metadata(folder: Path, **content: Any) -> ModelMetadata:
    path = folder / "model_metadata.json"
    path.write_text(json.dumps(content))
    return read_model_metadata(path)


def test_every_key_of_deepracer_for_clouds_file_is_read(tmp_path):
    found = hyperparameters(tmp_path, {"momentum": [0.9], **DRFC})
    assert set(DRFC) == set(KEYS)
    assert {key: getattr(found, key) for key in KEYS} == DRFC
    assert found.set_keys == ("momentum", *DRFC)
    assert found.beyond_console() == ()


def test_a_missing_hyperparameter_has_the_services_default(tmp_path):
    found = hyperparameters(tmp_path, {"lr": 1e-4})
    assert found == Hyperparameters(lr=1e-4, set_keys=("lr",))
    assert (found.batch_size, found.num_epochs, found.discount_factor) == (64, 10, 0.999)
    assert (found.loss_type, found.num_episodes_between_training) == ("mean squared error", 20)


def test_numbers_may_be_text_and_words_have_any_case(tmp_path):
    text = {key: str(value).upper() for key, value in DRFC.items()}
    assert hyperparameters(tmp_path, text) == hyperparameters(tmp_path, DRFC)
    assert hyperparameters(tmp_path, '\ufeff{"lr": 1e-3, "lr": 2e-4}').lr == 2e-4  # the last one counts


@pytest.mark.parametrize(
    ("key", "value", "beyond"),
    [
        ("batch_size", 100, True),
        ("batch_size", 1024, True),
        ("num_epochs", 2, True),
        ("lr", 0.01, True),
        ("num_episodes_between_training", 200, True),
        ("batch_size", 512, False),
    ],
)
def test_values_that_only_the_console_refuses_are_reported(tmp_path, key, value, beyond):
    found = hyperparameters(tmp_path, DRFC | {key: value})
    assert getattr(found, key) == value
    assert found.beyond_console() == ((key,) if beyond else ())


@pytest.mark.parametrize(
    ("key", "value", "accepted"),
    [
        ("batch_size", 0, "a number from 1 to 1e+06"),
        ("batch_size", 64.5, "a whole number from 1"),
        ("batch_size", "many", "a number from 1"),
        ("batch_size", True, "a number from 1"),
        ("num_epochs", [10], "a number from 1 to 1000"),
        ("lr", None, "a number from 1e-10 to 1"),
        ("lr", float("nan"), "a number from 1e-10 to 1"),
        ("lr", float("inf"), "a number from 1e-10 to 1"),
        ("discount_factor", 99, "a number from 0 to 1"),
        ("loss_type", "hubber", "did you mean huber?"),
        ("loss_type", 1, "huber, mean squared error"),
        ("exploration_type", "greedy", "categorical, e-greedy"),
    ],
)
def test_a_bad_hyperparameter_is_named_with_what_is_accepted(tmp_path, key, value, accepted):
    message = refused(hyperparameters, tmp_path, DRFC | {key: value})
    assert message.startswith(f"{tmp_path / 'hyperparameters.json'}: {key}: ")
    assert accepted in message


def test_a_file_with_actions_only_gets_every_default(tmp_path):
    wanted = ModelMetadata(
        actions=(Action(-30.0, 0.6), Action(30.0, 1.2)), sensor=("observation",), version=1
    )
    found = metadata(tmp_path, action_space=DISCRETE)
    assert (found, found.set_keys) == (wanted, ("action_space",))
    assert metadata(tmp_path, action_space=DISCRETE, preprocess_type="GREY_SCALE", x=[None]) == wanted


@pytest.mark.parametrize("version", [1, 2, 3, 4, 5, 6])
@pytest.mark.parametrize("write_it", [int, float, str, lambda number: f"{number}.0"])
def test_every_version_is_read_as_number_and_as_text(tmp_path, version, write_it):
    found = metadata(
        tmp_path, action_space=DISCRETE, version=write_it(version), sensor=["FRONT_FACING_CAMERA"]
    )
    assert found.version == version
    # Version 1 knows no sensors, so its `sensor` key is ignored.
    assert found.sensor == (("observation",) if version == 1 else ("FRONT_FACING_CAMERA",))


def test_without_a_version_the_sensor_key_distinguishes_version_two_from_one(tmp_path):
    assert metadata(tmp_path, action_space=DISCRETE).version == 1
    assert metadata(tmp_path, action_space=DISCRETE, sensor=["STEREO_CAMERAS", "LIDAR"]).version == 2


def test_the_position_in_the_list_is_the_action_number_whatever_the_index_says(tmp_path):
    space = [dict(action, index=5 - place) for place, action in enumerate(DISCRETE)]
    found = metadata(tmp_path, action_space=space)
    assert found.actions == (Action(-30.0, 0.6), Action(30.0, 1.2))
    assert found.renumbered
    text = [{"steering_angle": "-30", "speed": " 0.6 ", "index": "0"}]
    found = metadata(tmp_path, action_space=text)
    assert (found.actions, found.renumbered) == ((Action(-30.0, 0.6),), False)


def test_a_continuous_space_has_ranges_and_no_list(tmp_path):
    found = metadata(
        tmp_path, action_space=CONTINUOUS, action_space_type=" Continuous", training_algorithm="SAC "
    )
    assert (found.low, found.high, found.actions) == (Action(-20.0, 1.0), Action(30.0, 2.0), ())
    assert (found.action_space_type, found.training_algorithm) == ("continuous", "sac")


SPEED = {"speed": 1}
RANGES = {"action_space_type": "continuous"}


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"action_space": None}, ["action_space", "missing"]),
        ({"action_space": []}, ["action_space", "[]"]),
        ({"action_space": CONTINUOUS}, ["action_space", "list", "discrete"]),
        ({"action_space": ["left"]}, ["action_space[0]", "left"]),
        ({"action_space": [DISCRETE[0], SPEED]}, ["action_space[1].steering_angle", "missing"]),
        ({"action_space": [{"steering_angle": 0}]}, ["action_space[0].speed", "missing"]),
        ({"action_space": [{"steering_angle": "left", **SPEED}]}, ["steering_angle", '"left"', "60"]),
        ({"action_space": [{"steering_angle": True, **SPEED}]}, ["steering_angle", "true"]),
        ({"action_space": [{"steering_angle": [1], **SPEED}]}, ["steering_angle", "[1]"]),
        ({"action_space": [{"steering_angle": float("nan"), **SPEED}]}, ["steering_angle", "NaN"]),
        ({"action_space": [{"steering_angle": 0, "speed": "inf"}]}, ["speed", "inf", "10"]),
        ({"action_space": [{"steering_angle": 0, "speed": 10**400}]}, ["speed", "1000", "10"]),
        ({"action_space": DISCRETE[:1] * 1001}, ["1001 actions", "at most 1000"]),
        ({"action_space_type": "grid"}, ["action_space_type", "grid"]),
        (RANGES, ["action_space", "continuous"]),
        ({**RANGES, "action_space": {**CONTINUOUS, "speed": 3}}, ["action_space.speed", "3"]),
        ({**RANGES, "action_space": {**CONTINUOUS, "speed": {"low": 1}}}, ["speed.high", "missing"]),
        (
            {**RANGES, "action_space": {**CONTINUOUS, "speed": {"low": 3, "high": 2.5}}},
            ["action_space.speed", "low 3 not above high 2.5"],
        ),
        ({"training_algorithm": "dqn"}, ["training_algorithm", "dqn"]),
        ({"training_algorithm": "sac"}, ["training_algorithm", "sac", "continuous"]),
        ({"training_algorithm": 3}, ["training_algorithm", "3"]),
        ({"neural_network": "RESNET"}, ["neural_network", "RESNET"]),
        ({"version": 7}, ["version", "7", "from 1 to 6"]),
        ({"version": "2.5"}, ["version", "2.5", "whole"]),
        ({"sensor": "LIDAR"}, ["sensor", "LIDAR"]),
        ({"sensor": ["LIDAR"]}, ["sensor", "FRONT_FACING_CAMERA"]),
        ({"sensor": ["LEFT_CAMERA", "STEREO_CAMERAS"]}, ["sensor", "one of"]),
        ({"sensor": ["STEREO_CAMERA"]}, ["did you mean STEREO_CAMERAS?"]),
        ({"sensor": ["LEFT_CAMERA", "LIDAR", "SECTOR_LIDAR"]}, ["sensor", "at most one"]),
        ({"sensor": SENSORS, "lidar_config": [8]}, ["lidar_config", "num_sectors"]),
        ({"sensor": SENSORS, "lidar_config": {"num_sectors": 7}}, ["lidar_config.num_sectors", "7", "64"]),
        ({"sensor": SENSORS, "lidar_config": {"clipping_dist": 20}}, ["lidar_config.clipping_dist", "12"]),
    ],
)
def test_each_bad_value_is_named_with_its_key_and_what_is_accepted(tmp_path, change, named):
    message = refused(metadata, tmp_path, **{"action_space": DISCRETE, **change})
    for word in (str(tmp_path / "model_metadata.json"), "accepted:", *named):
        assert word in message


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=6,
)


@examples(200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(key=st.sampled_from(model_metadata.KEYS), value=JSON, continuous=st.booleans())
def test_no_value_of_any_key_ends_in_another_error_than_bad_input(tmp_path, key, value, continuous):
    content: dict[str, Any] = {"action_space": CONTINUOUS if continuous else DISCRETE, "version": "5"}
    content["action_space_type"] = "continuous" if continuous else "discrete"
    with contextlib.suppress(BadInput):
        found = metadata(tmp_path, **{**content, key: value})
        assert (found.low is None) == bool(found.actions)


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_written_files_read_as_they_were(tmp_path, kind):
    spaces = {
        "discrete": ModelMetadata(
            actions=(Action(-30.0, 0.6), Action(0.0, 2.25), Action(17.5, 4.0)),
            sensor=("STEREO_CAMERAS", "DISCRETIZED_SECTOR_LIDAR"),
            lidar_config=LidarSectors(16, 4, 3.5),
            neural_network="DEEP_CONVOLUTIONAL_NETWORK",
            version=4,
        ),
        "continuous": ModelMetadata(low=Action(-25.0, 0.5), high=Action(30.0, 3.0), training_algorithm="sac"),
    }
    found = metadata(tmp_path, **json.loads(model_metadata_text(spaces[kind])))
    assert (found, found.renumbered) == (spaces[kind], False)
    values = Hyperparameters(batch_size=128, lr=1e-5, loss_type="huber", term_cond_max_episodes=7)
    read = hyperparameters(tmp_path, hyperparameters_text(values))
    assert replace(read, set_keys=()) == values
    assert sorted(read.set_keys) == sorted(KEYS)
