"""Laws of action spaces."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.compose import compose_experiment, compose_option
from deepracer_exp.config.driving import (
    ActionSpaceConfig,
    ContinuousActionSpace,
    DiscreteAction,
    DiscreteActionSpace,
    GridActionSpace,
    SpeedRange,
    SteeringRange,
)
from deepracer_exp.config.options import options
from deepracer_exp.env.action_space import (
    ContinuousActions,
    DiscreteActions,
    action_remarks,
    build_action_space,
)
from deepracer_exp.errors import BadInput
from tests.conftest import refused


def grid(
    steering: tuple[float, float], steering_levels: int, speed: tuple[float, float], speed_levels: int
) -> Any:
    return GridActionSpace(
        kind="grid",
        steering_angle=SteeringRange(low=steering[0], high=steering[1]),
        steering_levels=steering_levels,
        speed=SpeedRange(low=speed[0], high=speed[1]),
        speed_levels=speed_levels,
        file=None,
    )


def continuous(steering: tuple[float, float], speed: tuple[float, float]) -> ContinuousActionSpace:
    return ContinuousActionSpace(
        kind="continuous",
        steering_angle=SteeringRange(low=steering[0], high=steering[1]),
        speed=SpeedRange(low=speed[0], high=speed[1]),
        file=None,
    )


def test_every_option_can_steer_both_ways_alike_and_stays_within_the_cars_limits() -> None:
    names = options("action_space")
    assert {"discrete", "discrete_fast", "deepracer", "grid", "continuous"} <= set(names)
    for name in names:
        space = build_action_space(compose_option("action_space", name, ActionSpaceConfig))
        assert space.low[0] == -space.high[0] >= -30, name
        assert 0.1 <= space.low[1] <= space.high[1] <= 4, name
        if isinstance(space, DiscreteActions):
            choices = set(zip(space.steering_deg.tolist(), space.speed_mps.tolist(), strict=True))
            assert len(choices) == space.n, name
            assert choices == {(-steering, speed) for steering, speed in choices}, name


def test_an_action_number_is_its_place_in_the_list() -> None:
    config = DiscreteActionSpace(
        kind="discrete",
        actions=(DiscreteAction(steering_angle=-5, speed=1), DiscreteAction(steering_angle=20, speed=2)),
        file=None,
    )
    space = build_action_space(config)
    assert space.n == 2
    steering_deg, speed_mps = space.commands(np.array([1, 0, 1]))
    np.testing.assert_array_equal(steering_deg, [20, -5, 20])
    np.testing.assert_array_equal(speed_mps, [2, 1, 2])


def test_a_grid_counts_speeds_within_angles() -> None:
    space = build_action_space(grid((-30, 30), 3, (1, 2), 2))
    assert isinstance(space, DiscreteActions)
    np.testing.assert_array_equal(space.steering_deg, [-30, -30, 0, 0, 30, 30])
    np.testing.assert_array_equal(space.speed_mps, [1, 2, 1, 2, 1, 2])


@given(steering_levels=st.integers(2, 12), speed_levels=st.integers(2, 6))
def test_a_grid_has_every_pair_of_levels_once_and_reaches_all_four_corners(
    steering_levels: int, speed_levels: int
) -> None:
    space = build_action_space(grid((-25, 30), steering_levels, (0.7, 3.1), speed_levels))
    assert isinstance(space, DiscreteActions)
    pairs = set(zip(space.steering_deg.tolist(), space.speed_mps.tolist(), strict=True))
    assert len(pairs) == space.n == steering_levels * speed_levels
    assert {(-25, 0.7), (-25, 3.1), (30, 0.7), (30, 3.1)} <= pairs


def test_one_level_is_a_constant() -> None:
    space = build_action_space(grid((-30, 30), 3, (1.5, 1.5), 1))
    assert isinstance(space, DiscreteActions)
    assert set(space.speed_mps) == {1.5}


BOUNDS = st.tuples(st.floats(-60, 60), st.floats(-60, 60)).map(sorted)


@given(BOUNDS, st.lists(st.tuples(st.floats(-5, 5), st.floats(-5, 5)), min_size=1, max_size=8))
def test_continuous_commands_never_leave_the_ranges_and_grow_with_the_action(
    bounds: list[float], actions: list[tuple[float, float]]
) -> None:
    space = build_action_space(continuous((bounds[0], bounds[1]), (1.0, 3.0)))
    assert space.n is None
    steering_deg, speed_mps = space.commands(np.array(sorted(actions), dtype=np.float32))
    assert steering_deg.shape == speed_mps.shape == (len(actions),)
    assert np.all((steering_deg >= bounds[0] - 1e-9) & (steering_deg <= bounds[1] + 1e-9))
    assert np.all((speed_mps >= 1.0) & (speed_mps <= 3.0))
    assert np.all(np.diff(steering_deg) >= -1e-9)


def test_minus_one_zero_and_one_are_low_middle_and_high_exactly() -> None:
    space = build_action_space(continuous((-30, 20), (0.7, 3.3)))
    steering_deg, speed_mps = space.commands(np.array([[-1, 1], [0, 0], [1, -1], [9, -9]], dtype=np.float32))
    np.testing.assert_array_equal(steering_deg, [-30, -5, 20, 20])
    np.testing.assert_array_equal(speed_mps, [3.3, 2.0, 0.7, 0.7])


def test_an_action_that_is_not_a_number_is_not_hidden() -> None:
    steering_deg, speed_mps = build_action_space(continuous((-30, 30), (1, 3))).commands(
        np.array([[np.nan, 0]])
    )
    assert np.isnan(steering_deg[0])
    assert speed_mps[0] == 2


@pytest.mark.parametrize(
    ("config", "numbers"),
    [
        (continuous((10, -10), (1, 2)), ("steering_angle", "10", "-10")),
        (continuous((-10, 10), (2, 1.5)), ("speed", "2", "1.5")),
        (grid((30, -30), 5, (1, 2), 2), ("steering_angle", "30", "-30")),
        (grid((-30, 30), 1, (1, 2), 2), ("steering_levels", "1", "-30", "30")),
        (grid((-30, 30), 5, (1, 2), 1), ("speed_levels", "1", "2")),
        (grid((-30, 30), 5, (2, 2), 3), ("speed_levels", "3", "2")),
        (DiscreteActionSpace(kind="discrete", actions=(), file=None), ("actions", "[]")),
    ],
)
def test_a_contradiction_is_named_with_its_key_and_both_numbers(
    config: ActionSpaceConfig, numbers: tuple[str, ...]
) -> None:
    message = refused(build_action_space, config)
    for word in numbers:
        assert word in message


def of_file(name: str, path: Path) -> ActionSpaceConfig:
    return compose_experiment([f"action_space={name}", f"action_space.file={path}"])[0].action_space


@pytest.mark.parametrize("name", ["discrete", "grid", "continuous"])
def test_a_file_takes_the_place_of_every_kind_of_group(tmp_path: Path, name: str) -> None:
    path = tmp_path / "model_metadata.json"
    path.write_text(json.dumps({"action_space": [{"steering_angle": "12", "speed": "4.5"}]}))
    space = build_action_space(of_file(name, path))
    assert isinstance(space, DiscreteActions)
    # Beyond the car's 4 m/s: the simulator clips, the action space does not.
    assert (space.steering_deg.tolist(), space.speed_mps.tolist()) == ([12.0], [4.5])

    ranges = {"steering_angle": {"low": -12, "high": 20}, "speed": {"low": 1, "high": 2}}
    path.write_text(json.dumps({"action_space": ranges, "action_space_type": "continuous", "version": "5"}))
    space = build_action_space(of_file(name, path))
    assert isinstance(space, ContinuousActions)
    assert (space.low.tolist(), space.high.tolist()) == ([-12, 1], [20, 2])


def test_a_missing_file_is_bad_input(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"none\.json"):
        of_file("discrete", tmp_path / "none.json")


CAR = compose_option("car", "deepracer", CarConfig)


@given(
    st.lists(
        st.tuples(
            st.sampled_from([-45.0, -30.0, -10.0, 0.0, 30.0, 60.0]),
            st.sampled_from([0.05, 0.1, 2.0, 4.0, 6.0]),
        ),
        min_size=1,
        max_size=8,
    )
)
def test_actions_that_the_car_makes_equal_are_named_and_no_others(actions: list[tuple[float, float]]) -> None:
    space = DiscreteActions(*np.array(actions).T)
    driven = [(min(max(steering, -30.0), 30.0), min(max(speed, 0.1), 4.0)) for steering, speed in actions]
    equal = {
        tuple(at for at, one in enumerate(driven) if one == each) for each in driven if driven.count(each) > 1
    }
    named = [line for line in action_remarks(space, CAR) if "are the same" in line]
    assert {
        tuple(map(int, line.split("actions ")[1].split(" are")[0].split(", "))) for line in named
    } == equal
    beyond = {line.split(" ")[1] for line in action_remarks(space, CAR) if "cuts it" in line}
    assert ("steering_angle" in beyond) == any(abs(steering) > 30 for steering, _ in actions)
    assert ("speed" in beyond) == any(not 0.1 <= speed <= 4 for _, speed in actions)


@pytest.mark.parametrize("name", options("action_space"))
def test_none_of_our_own_spaces_has_a_remark(name: str) -> None:
    assert (
        action_remarks(build_action_space(compose_option("action_space", name, ActionSpaceConfig)), CAR) == []
    )


def test_ranges_beyond_the_cars_are_named_with_its_own() -> None:
    (line,) = action_remarks(build_action_space(continuous((-45, 45), (1, 2))), CAR)
    assert "steering_angle from -45 to 45 degrees: the car cuts it to -30 to 30" in line


@pytest.mark.parametrize(
    ("file", "words"),
    [
        (
            "metadata_45_degrees.json",
            ["from -45 to 45 degrees", "actions 3, 4, 5 are the same", "3 of 6 actions differ"],
        ),
        (
            "metadata_same_actions.json",
            ["actions 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11", "1 of 12 actions differ"],
        ),
    ],
)
def test_files_of_racers_with_actions_that_the_car_makes_equal_are_remarked_upon(
    reference: Path, file: str, words: list[str]
) -> None:
    remarks = action_remarks(build_action_space(of_file("discrete", reference / "inputs" / file)), CAR)
    for word in words:
        assert any(word in line for line in remarks)


def test_a_racer_is_told_before_a_training_starts(train_here: Any) -> None:
    ended = train_here(
        "action_space.steering_angle.high=45", "budget.iterations=1", "report=false", "evaluation.trials=1"
    )
    assert ended.code == 0, ended.stderr
    log = (ended.folder / "log.txt").read_text(encoding="utf-8")
    for text in (ended.stderr, log):
        assert "steering_angle from -30 to 45 degrees: the car cuts it to -30 to 30" in text
