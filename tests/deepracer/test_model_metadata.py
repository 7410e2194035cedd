"""Laws of reading model_metadata.json."""

import contextlib
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from deepracer_exp.deepracer.model_metadata import Action, LidarConfig, ModelMetadata, read_model_metadata
from deepracer_exp.errors import BadInput

DISCRETE = [{"steering_angle": -30, "speed": 0.6}, {"steering_angle": 30, "speed": 1.2}]
CONTINUOUS = {"steering_angle": {"low": -20, "high": 30}, "speed": {"low": 1, "high": 2}}


def write(folder: Path, content: Any) -> Path:
    path = folder / "model_metadata.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def read(folder: Path, content: Any) -> ModelMetadata:
    return read_model_metadata(write(folder, content))


def complaint(folder: Path, content: Any) -> str:
    path = write(folder, content)
    with pytest.raises(BadInput) as caught:
        read_model_metadata(path)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    assert "accepted:" in message
    return message


def test_a_file_with_nothing_but_actions_gets_every_default(tmp_path: Path) -> None:
    assert read(tmp_path, {"action_space": DISCRETE}) == ModelMetadata(
        action_space_type="discrete",
        actions=(Action(-30.0, 0.6), Action(30.0, 1.2)),
        low=None,
        high=None,
        sensor=("observation",),
        neural_network="DEEP_CONVOLUTIONAL_NETWORK_SHALLOW",
        version=1,
        training_algorithm="clipped_ppo",
        lidar_config=LidarConfig(num_sectors=8, num_values_per_sector=8, clipping_dist_m=2.0),
        given=("action_space",),
        renumbered=False,
    )


@pytest.mark.parametrize("version", [1, 2, 3, 4, 5, 6])
@pytest.mark.parametrize("write_it", [int, float, str, lambda number: f"{number}.0"])
def test_every_version_is_read_as_number_and_as_text(tmp_path: Path, version: int, write_it: Any) -> None:
    metadata = read(
        tmp_path,
        {"action_space": DISCRETE, "version": write_it(version), "sensor": ["FRONT_FACING_CAMERA"]},
    )
    assert metadata.version == version
    # Version 1 knows no sensors, so its `sensor` key is not looked at.
    assert metadata.sensor == (("observation",) if version == 1 else ("FRONT_FACING_CAMERA",))


def test_without_a_version_the_sensor_key_tells_version_two_from_one(tmp_path: Path) -> None:
    assert read(tmp_path, {"action_space": DISCRETE}).version == 1
    assert read(tmp_path, {"action_space": DISCRETE, "sensor": ["STEREO_CAMERAS", "LIDAR"]}).version == 2


def test_actions_written_as_text_are_numbers(tmp_path: Path) -> None:
    metadata = read(tmp_path, {"action_space": [{"steering_angle": "-30", "speed": " 0.6 ", "index": 0}]})
    assert metadata.actions == (Action(-30.0, 0.6),)


def test_the_place_in_the_list_is_the_action_number_whatever_the_index_says(tmp_path: Path) -> None:
    space = [dict(action, index=5 - place) for place, action in enumerate(DISCRETE)]
    assert read(tmp_path, {"action_space": space}).actions == (Action(-30.0, 0.6), Action(30.0, 1.2))


def test_unknown_keys_are_ignored(tmp_path: Path) -> None:
    plain = read(tmp_path, {"action_space": DISCRETE})
    assert read(tmp_path, {"action_space": DISCRETE, "preprocess_type": "GREY_SCALE", "x": [None]}) == plain


def test_a_continuous_space_has_ranges_and_no_list(tmp_path: Path) -> None:
    metadata = read(
        tmp_path,
        {"action_space": CONTINUOUS, "action_space_type": " Continuous", "training_algorithm": "SAC "},
    )
    assert (metadata.low, metadata.high) == (Action(-20.0, 1.0), Action(30.0, 2.0))
    assert metadata.actions == ()
    assert metadata.training_algorithm == "sac"


def test_a_byte_order_mark_does_not_matter(tmp_path: Path) -> None:
    path = tmp_path / "mit Umläuten und Leerzeichen.json"
    path.write_bytes(b"\xef\xbb\xbf" + json.dumps({"action_space": DISCRETE}).encode())
    assert len(read_model_metadata(path).actions) == 2


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"action_space": None}, ["action_space", "missing"]),
        ({"action_space": []}, ["action_space", "[]"]),
        ({"action_space": {}}, ["action_space", "list"]),
        ({"action_space": CONTINUOUS}, ["action_space", "discrete"]),
        ({"action_space": ["left"]}, ["action_space[0]", "left"]),
        ({"action_space": [DISCRETE[0], {"speed": 1}]}, ["action_space[1].steering_angle", "missing"]),
        ({"action_space": [{"steering_angle": 0}]}, ["action_space[0].speed", "missing"]),
        ({"action_space": [{"steering_angle": "left", "speed": 1}]}, ["steering_angle", '"left"', "60"]),
        ({"action_space": [{"steering_angle": True, "speed": 1}]}, ["steering_angle", "true"]),
        ({"action_space": [{"steering_angle": [1], "speed": 1}]}, ["steering_angle", "[1]"]),
        ({"action_space": [{"steering_angle": float("nan"), "speed": 1}]}, ["steering_angle", "NaN"]),
        ({"action_space": [{"steering_angle": 0, "speed": "inf"}]}, ["speed", "inf", "10"]),
        ({"action_space": [{"steering_angle": 0, "speed": 10**400}]}, ["speed", "1000", "10"]),
        ({"action_space": [{"steering_angle": 0, "speed": -1}]}, ["speed", "-1"]),
        ({"action_space": DISCRETE, "action_space_type": "grid"}, ["action_space_type", "grid"]),
        ({"action_space": DISCRETE, "action_space_type": "continuous"}, ["action_space", "continuous"]),
        ({"action_space": DISCRETE, "training_algorithm": "dqn"}, ["training_algorithm", "dqn"]),
        (
            {"action_space": DISCRETE, "training_algorithm": "sac"},
            ["training_algorithm", "sac", "continuous"],
        ),
        ({"action_space": DISCRETE, "training_algorithm": 3}, ["training_algorithm", "3"]),
        ({"action_space": DISCRETE, "neural_network": "RESNET"}, ["neural_network", "RESNET"]),
        ({"action_space": DISCRETE, "version": 7}, ["version", "7", "from 1 to 6"]),
        ({"action_space": DISCRETE, "version": "2.5"}, ["version", "2.5", "whole"]),
        ({"action_space": DISCRETE, "version": "new"}, ["version", "new"]),
        ({"action_space": DISCRETE, "sensor": "LIDAR"}, ["sensor", "LIDAR"]),
        ({"action_space": DISCRETE, "sensor": []}, ["sensor", "[]"]),
        ({"action_space": DISCRETE, "sensor": ["LIDAR"]}, ["sensor", "FRONT_FACING_CAMERA"]),
        ({"action_space": DISCRETE, "sensor": ["LEFT_CAMERA", "STEREO_CAMERAS"]}, ["sensor", "one of"]),
        ({"action_space": DISCRETE, "sensor": ["STEREO_CAMERA"]}, ["did you mean STEREO_CAMERAS?"]),
        (
            {"action_space": DISCRETE, "sensor": ["LEFT_CAMERA", "LIDAR", "SECTOR_LIDAR"]},
            ["sensor", "at most one"],
        ),
        ({"action_space": DISCRETE, "lidar_config": [8]}, ["lidar_config", "[8]"]),
        ({"action_space": DISCRETE, "lidar_config": {"num_sectors": 7}}, ["num_sectors", "7", "64"]),
        ({"action_space": DISCRETE, "lidar_config": {"num_values_per_sector": 0}}, ["per_sector", "0"]),
        ({"action_space": DISCRETE, "lidar_config": {"clipping_dist": 99}}, ["clipping_dist", "99", "12"]),
    ],
)
def test_each_bad_value_is_named_with_its_key_and_what_is_accepted(
    tmp_path: Path, change: dict[str, Any], named: list[str]
) -> None:
    message = complaint(tmp_path, change)
    for word in named:
        assert word in message


@pytest.mark.parametrize("key", ["steering_angle", "speed"])
def test_a_range_upside_down_is_named_with_both_numbers(tmp_path: Path, key: str) -> None:
    space = {**CONTINUOUS, key: {"low": 3, "high": 2.5}}
    message = complaint(tmp_path, {"action_space": space, "action_space_type": "continuous"})
    assert f"action_space.{key}" in message
    assert "low 3 not above high 2.5" in message


@pytest.mark.parametrize("bounds", [None, 3, {"low": 1}, {"high": 1}, {"low": "slow", "high": 2}])
def test_a_range_without_two_numbers_is_named(tmp_path: Path, bounds: Any) -> None:
    space = {**CONTINUOUS, "speed": bounds}
    message = complaint(tmp_path, {"action_space": space, "action_space_type": "continuous"})
    assert "action_space.speed" in message


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"action_space: []", b"\xff\xfe\x00", b"[" * 100_000, b"[]", b"3", b"null", b'{"a":\n\n}'],
)
def test_a_file_that_is_no_json_object_is_named_in_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "model_metadata.json"
    path.write_bytes(content)
    with pytest.raises(BadInput) as caught:
        read_model_metadata(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_a_folder_are_named(tmp_path: Path) -> None:
    for path in (tmp_path / "none.json", tmp_path):
        with pytest.raises(BadInput, match="accepted: a model_metadata"):
            read_model_metadata(path)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=6,
)
KEYS = (
    "action_space",
    "action_space_type",
    "sensor",
    "neural_network",
    "version",
    "training_algorithm",
    "lidar_config",
)


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(key=st.sampled_from(KEYS), value=JSON, continuous=st.booleans())
def test_no_value_of_any_key_ends_in_another_error_than_bad_input(
    tmp_path: Path, key: str, value: Any, continuous: bool
) -> None:
    content: dict[str, Any] = {"action_space": CONTINUOUS if continuous else DISCRETE, "version": "5"}
    content["action_space_type"] = "continuous" if continuous else "discrete"
    content[key] = value
    with contextlib.suppress(BadInput):
        metadata = read(tmp_path, content)
        assert (metadata.low is None) == bool(metadata.actions)


def test_an_index_that_is_not_the_position_is_told(tmp_path: Path) -> None:
    def numbered(*indices: object) -> bool:
        space = [{"steering_angle": 0, "speed": 1, "index": index} for index in indices]
        return read(tmp_path, {"action_space": space}).renumbered

    assert not numbered(0, 1, "2")
    assert numbered(1, 0)


def test_a_list_no_policy_could_choose_from_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"1001 actions.*at most 1000"):
        read(tmp_path, {"action_space": DISCRETE[:1] * 1001})
