import ast
import dataclasses
import math
import re
from functools import cache
from typing import Any

import numpy as np
import pytest

from deepracer_exp.config.driving import RewardConfig
from deepracer_exp.rewards.params import TrackParams
from deepracer_exp.rewards.reward import RewardFunction
from deepracer_exp.rewards.source import load_reward_source, named_reward_source, zoo_names

WIDTH_M = 1.0


def closed(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    points = np.column_stack([x, y])
    return np.vstack([points, points[:1]])


T = np.linspace(0.0, 2.0 * np.pi, 90, endpoint=False)
S = np.linspace(0.0, 10.0, 60)
CORNER = [(x, 0.0) for x in np.arange(0, 6, 0.25)] + [(6.0, y) for y in np.arange(0.25, 6, 0.25)]
ROADS = {
    "oval": closed(5.0 * np.cos(T), 2.5 * np.sin(T)),
    "oval_reversed": closed(5.0 * np.cos(T), 2.5 * np.sin(T))[::-1],
    "wavy": closed((4.0 + 0.8 * np.cos(3 * T)) * np.cos(T), (4.0 + 0.8 * np.cos(3 * T)) * np.sin(T)),
    "circle": closed(2.0 * np.cos(T), 2.0 * np.sin(T)),
    "open": np.column_stack([S, np.sin(S)]),
    "corner": np.array(CORNER + [(x, 6.0) for x in np.arange(6, -0.1, -0.25)]),
}


def drive(
    road: str, index: np.ndarray, off: np.ndarray, heading_error: np.ndarray, **given: np.ndarray | float
) -> tuple[dict[str, np.ndarray], list[TrackParams]]:
    """Return columns and road of cars half way after waypoint `index`, `off` metres left of the line."""
    points = ROADS[road]
    n = len(index)
    step = points[index + 1] - points[index]
    heading = np.degrees(np.arctan2(step[:, 1], step[:, 0]))
    left = np.column_stack([-step[:, 1], step[:, 0]]) / np.hypot(*step.T)[:, None]
    place = points[index] + 0.5 * step + off[:, None] * left
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    columns: dict[str, Any] = {
        "x": place[:, 0],
        "y": place[:, 1],
        "heading": (heading + heading_error + 180.0) % 360.0 - 180.0,
        "distance_from_center": np.abs(off),
        "projection_distance": 0.5 * (lengths[index] + lengths[index + 1]),
        "progress": 100.0 * lengths[index] / lengths[-1],
        "previous_progress": 100.0 * lengths[index] / lengths[-1],
        "steps": 50.0,
        "speed": 2.0,
        "steering_angle": 0.0,
        "track_width": WIDTH_M,
        "sim_time": 3.0,
        "all_wheels_on_track": np.abs(off) < 0.5 * WIDTH_M - 0.1,
        "is_left_of_center": off > 0,
        "is_offtrack": np.abs(off) > 0.5 * WIDTH_M + 0.1,
        "closest_waypoints": np.column_stack([index, index + 1]),
    }
    columns.update(given)
    columns = {k: np.broadcast_to(v, (n, 2) if k == "closest_waypoints" else n) for k, v in columns.items()}
    waypoints = [tuple(point) for point in points.tolist()]
    return columns, [TrackParams(waypoints, float(lengths[-1]), road.endswith("reversed"))]


def anywhere(road: str, n: int) -> tuple[dict[str, np.ndarray], list[TrackParams]]:
    """Return n cars in all states a car can be in, and some beyond."""
    random = np.random.default_rng(sum(map(ord, road)))
    index = random.integers(0, len(ROADS[road]) - 1, n)
    off = random.choice([0.0, 0.2, 0.45, 0.5, 3.0], n) * random.uniform(-1.0, 1.0, n)
    columns, track_params = drive(
        road,
        index,
        off,
        random.uniform(-180.0, 180.0, n) * random.choice([0.0, 0.1, 1.0], n),
        speed=random.choice([0.0, 1.0, 4.0, 5.0], n),
        steering_angle=random.uniform(-30.0, 30.0, n),
        steps=random.integers(1, 400, n),
        progress=random.choice([-0.5, 0.0, 100.0, 37.0, 80.0], n),
        track_width=random.uniform(0.5, 1.4, n),
        all_wheels_on_track=random.random(n) < 0.7,
    )
    # The last place on the line, where the service gives the closing point and its repetition.
    pairs = columns["closest_waypoints"].copy()
    pairs[:3] = len(ROADS[road]) - 1, 0
    return {**columns, "closest_waypoints": pairs}, track_params


def among_others(columns: dict[str, np.ndarray], length_m: float) -> dict[str, np.ndarray]:
    """Add three objects around each car to columns, the next one often in its way."""
    n = len(columns["x"])
    random = np.random.default_rng(n)
    own = columns["distance_from_center"] * np.where(columns["is_left_of_center"], 1, -1)
    offset = random.uniform(-0.4, 0.4, (n, 3))
    offset[:, 1] = own + random.uniform(-0.5, 0.5, n)
    gap_m = np.column_stack([-3 * random.random(n), 2 * random.random(n), 2.5 + random.random(n)])
    return {
        **columns,
        "is_crashed": random.random(n) < 0.2,
        "closest_objects": np.tile([0, 1], (n, 1)),
        "objects_location": random.uniform(-5, 5, (n, 3, 2)),
        "objects_left_of_center": offset > 0,
        "object_in_camera": random.random(n) < 0.5,
        "objects_speed": random.choice([0.0, 0.75], (n, 3)),
        "objects_heading": random.uniform(-180, 180, (n, 3)),
        "objects_distance_from_center": np.abs(offset),
        "objects_distance": (columns["projection_distance"][:, None] + gap_m) % length_m,
        "objects_mask": np.ones((n, 3), bool),
    }


def zoo(name: str, n_cars: int, scalar: bool = False, **constants: float) -> RewardFunction:
    config = RewardConfig(name=name, file=None, constants=constants, time_limit_s=30.0)
    source = load_reward_source(config)
    if scalar:
        text = source.text.replace("def reward_batch(", "def not_called(")
        source = dataclasses.replace(source, text=text)
    return RewardFunction(source, n_cars, 30.0, None)


def pay(
    name: str, road: str = "oval", *, at: int = 10, off: float = 0.0, turned: float = 0.0, **given: float
) -> float:
    """Return what one car gets."""
    columns, track_params = drive(road, np.array([at]), np.array([off]), np.array([turned]), **given)
    return float(zoo(name, 1, scalar=True)(columns, track_params, None)[0])


FEWER = {"racing_line": {"SAMPLES": 40}}
"""Constants with which a line is worked out in no time."""


@pytest.mark.parametrize("name", zoo_names())
def test_every_reward_is_finite_in_every_state(name: str) -> None:
    for road in ROADS:
        columns, track_params = anywhere(road, 200)
        rewards = zoo(name, 200, **FEWER.get(name, {}))(columns, track_params, None)
        assert np.abs(rewards).max() < 1e4, road


@pytest.mark.parametrize("road", [*ROADS, "oval among others"])
@pytest.mark.parametrize("name", zoo_names())
def test_the_batch_formula_is_the_scalar_formula(name: str, road: str) -> None:
    n = 2 if name == "racing_line" else 60  # each car's module works the line out again
    columns, track_params = anywhere(road.split()[0], n)
    if road.endswith("others"):
        columns = among_others(columns, track_params[0].track_length)
    batch, scalar = (zoo(name, n, scalar, **FEWER.get(name, {})) for scalar in (False, True))
    # The step before, too, for what remembers it; half of the cars begin an episode after it.
    progress = columns["progress"] - np.arange(n) / n
    before = {**columns, "steps": columns["steps"] + 9, "progress": progress, "previous_progress": progress}
    begins = np.arange(n) % 2 == 0
    now = {
        **columns,
        "steps": np.where(begins, 2, columns["steps"] + 10),
        "previous_progress": np.where(begins, columns["progress"], before["progress"]),
    }
    for given in (before, now):
        np.testing.assert_allclose(
            batch(given, track_params, None), scalar(given, track_params, None), rtol=1e-9, atol=1e-12
        )


@pytest.mark.parametrize("name", zoo_names())
def test_every_reward_has_a_batch_without_memory(name: str) -> None:
    columns, track_params = anywhere("oval", 8)
    reward = zoo(name, 8)
    assert "def reward_batch(" in reward.source.text
    first = reward(columns, track_params, None)
    reward(anywhere("wavy", 8)[0], track_params, None)
    np.testing.assert_array_equal(reward(columns, track_params, None), first)


@pytest.mark.parametrize("name", zoo_names())
def test_every_reward_passes_the_rules_of_the_console(name: str) -> None:
    text = named_reward_source(name).text
    words = [
        "__import__",
        "load",
        "fromfile",
        "genfromtxt",
        "loadtxt",
        "tofile",
        "savez",
        "save",
        "savetxt",
        "memmap",
    ]
    assert [word for word in words if word in text] == []
    assert 1 <= len(text) <= 140_000
    tree = ast.parse(text)
    nodes = list(ast.walk(tree))
    imports = [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]
    assert all(node in tree.body for node in imports)
    modules = [a.name for node in imports if isinstance(node, ast.Import) for a in node.names] + [
        str(node.module) for node in imports if isinstance(node, ast.ImportFrom)
    ]
    assert {module.split(".")[0] for module in modules} <= {"math", "random", "numpy", "scipy", "shapely"}
    names = {node.id for node in nodes if isinstance(node, ast.Name)}
    assert not names & {"open", "exec", "eval", "compile", "input", "print"}


@pytest.mark.parametrize("name", zoo_names())
def test_every_reward_says_what_it_teaches_and_when_it_fails(name: str) -> None:
    docstring = ast.get_docstring(ast.parse(named_reward_source(name).text))
    assert docstring is not None
    assert docstring.startswith("Teaches ")
    assert re.search(r"\bFails\b", docstring)


@pytest.mark.parametrize("name", zoo_names())
def test_every_constant_has_an_effect(name: str) -> None:
    columns, track_params = anywhere("corner", 200)
    columns = {**columns, "previous_progress": 0.9 * columns["progress"]}
    columns = among_others(columns, track_params[0].track_length)

    def rewards(**changed: float) -> np.ndarray:
        return zoo(name, 200, **changed)(columns, track_params, None)

    fewer = FEWER.get(name, {})
    before = rewards(**fewer)
    for constant, value in (named_reward_source(name).constants | fewer).items():
        assert not np.array_equal(rewards(**fewer | {constant: value * 0.75}), before), constant


@pytest.mark.parametrize(
    ("name", "best_first"),
    [
        ("follow_center_line", [{"off": 0.0}, {"off": -0.2}, {"off": 0.4}]),
        ("center_speed_blend", [{"off": 0.1}, {"off": 0.3}]),
        ("center_speed_blend", [{"speed": 3.0}, {"speed": 2.0}]),
        ("speed_on_track", [{"speed": 3.0}, {"speed": 2.0}, {"speed": 0.0}]),
        ("self_motivator", [{"speed": 3.0}, {"speed": 2.0}]),
        ("self_motivator", [{"steps": 40}, {"steps": 60}]),
        ("progress_per_step", [{"steps": 40}, {"steps": 60}]),
        ("progress_per_step", [{"progress": 40}, {"progress": 20}]),
        ("prevent_zig_zag", [{"steering_angle": 10.0}, {"steering_angle": 20.0}, {"steering_angle": -30.0}]),
        ("follow_waypoint_heading", [{"turned": 0.0}, {"turned": 20.0}, {"turned": -50.0}]),
        ("look_ahead", [{"off": 0.3, "steering_angle": -15.0}, {"off": 0.3, "steering_angle": 15.0}]),
    ],
    ids=lambda value: value if isinstance(value, str) else " and ".join(value[0]),
)
def test_a_reward_pays_more_for_what_it_teaches(name: str, best_first: list[dict[str, float]]) -> None:
    rewards = [pay(name, **state) for state in best_first]
    assert rewards == sorted(set(rewards), reverse=True)


@pytest.mark.parametrize(
    ("name", "state"),
    [
        ("speed_on_track", {"speed": 3.0, "off": 0.6}),
        ("self_motivator", {"off": 0.6}),
        ("follow_waypoint_heading", {"turned": 180.0}),
    ],
    ids=["fast off the road", "ahead off the road", "pointing back"],
)
def test_a_reward_pays_next_to_nothing_for_what_it_forbids(name: str, state: dict[str, float]) -> None:
    assert pay(name, **state) < 0.01


def test_stay_inside_borders_pays_for_the_margin_and_nothing_else() -> None:
    inside = pay("stay_inside_borders", off=0.0)
    assert inside == pay("stay_inside_borders", off=0.35, speed=4.0, turned=30.0)
    assert inside > pay("stay_inside_borders", off=0.47, all_wheels_on_track=True)
    assert inside > pay("stay_inside_borders", off=0.0, all_wheels_on_track=False)


def test_prevent_zig_zag_pays_the_same_for_steering_to_either_side() -> None:
    assert pay("prevent_zig_zag", steering_angle=10.0) == pay("prevent_zig_zag", steering_angle=-10.0)


def test_follow_waypoint_heading_pays_1_for_pointing_along_the_road() -> None:
    assert pay("follow_waypoint_heading", turned=0.0) == pytest.approx(1.0)


def test_steps_to_finish_pays_for_being_ahead_and_for_an_early_finish() -> None:
    rewards = [pay("steps_to_finish", progress=50.0, steps=steps) for steps in (100, 150, 200)]
    assert rewards == sorted(rewards, reverse=True)
    assert rewards[1] == pytest.approx(1.0)
    finish = [pay("steps_to_finish", progress=100.0, steps=steps) for steps in (200, 300, 400)]
    assert finish == sorted(finish, reverse=True)
    assert finish[-1] > max(rewards)


@pytest.mark.parametrize("scalar", [False, True])
def test_progress_delta_adds_up_to_the_lap_less_the_time(scalar: bool) -> None:
    reward = zoo("progress_delta", 1, scalar=scalar)
    for progress in (np.linspace(0.5, 100.0, 40), np.linspace(0.5, 60.0, 20)):  # two episodes
        total = 0.0
        for step, (before, done) in enumerate(zip(np.append(progress[:1], progress), progress, strict=False)):
            given = {"progress": done, "previous_progress": before, "steps": step + 2.0}
            columns, roads = drive("oval", np.array([5]), np.zeros(1), np.zeros(1), **given)
            total += float(reward(columns, roads, None)[0])
        driven_m = (progress[-1] - progress[0]) / 100 * roads[0].track_length
        assert total == pytest.approx(driven_m - 0.045 * len(progress))


def beside_another(
    name: str, gap_m: float, *, off: float = 0.2, other_off: float = 0.2, **given: Any
) -> float:
    """Return what one car gets for a step of 0.1 m with an other at a gap along the lap, which drives 0.75 m/s."""
    columns, roads = drive("oval", np.array([10]), np.array([off]), np.zeros(1), **given)
    length_m = roads[0].track_length
    objects = among_others(columns, length_m)
    objects["previous_progress"] = columns["progress"] - 100 * 0.1 / length_m
    for key, value in {
        "objects_distance": (columns["projection_distance"][:, None] + gap_m) % length_m,
        "objects_left_of_center": np.array([[other_off > 0]]),
        "objects_distance_from_center": np.array([[abs(other_off)]]),
        "objects_speed": np.array([[0.75]]),
        "objects_heading": np.zeros((1, 1)),
        "objects_location": np.zeros((1, 1, 2)),
        "objects_mask": np.ones((1, 1), bool),
        "closest_objects": np.zeros((1, 2), np.int64),
        "is_crashed": np.zeros(1, bool),
    }.items():
        objects[key] = value
    return float(zoo(name, 1)(objects, roads, None)[0])


def test_overtake_pays_for_what_is_gained_on_a_near_car_ahead_or_behind() -> None:
    alone = beside_another("overtake", 8.0)
    # 0.1 m made, 0.05 m by the other.
    for gap_m in (1.5, 0.0, -1.5):
        assert beside_another("overtake", gap_m) - alone == pytest.approx(2.0 * 0.05)


def test_free_lane_costs_behind_a_near_object_on_the_own_side_only() -> None:
    alone = beside_another("free_lane", 8.0)
    assert beside_another("free_lane", 0.5) < beside_another("free_lane", 1.0) < alone
    assert beside_another("free_lane", 0.5, other_off=-0.2) == alone
    assert beside_another("free_lane", -0.5) == alone


def test_look_ahead_pays_most_for_the_arc_of_the_road() -> None:
    # The circle's radius is 2 m: the arc needs atan(wheelbase / radius), to the left.
    angles = np.arange(-30.0, 31.0)
    rewards = [pay("look_ahead", "circle", steering_angle=angle) for angle in angles]
    assert angles[int(np.argmax(rewards))] == pytest.approx(math.degrees(math.atan(0.164 / 2.0)), abs=1.0)


def test_slow_in_fast_out_pays_for_slow_before_a_corner_and_fast_after_it() -> None:
    # Waypoint 24 is the corner.
    slow_before, fast_before, slow_after, fast_after = (
        pay("slow_in_fast_out", "corner", at=at, speed=speed) for at in (20, 26) for speed in (1.2, 4.0)
    )
    assert slow_before > fast_before
    assert fast_after > slow_after


@cache
def racing_line(road: str) -> tuple[np.ndarray, ...]:
    namespace: dict[str, Any] = {}
    exec(named_reward_source("racing_line").text, namespace)
    return namespace["_work_out"](ROADS[road])


@pytest.mark.parametrize("road", ["oval", "wavy", "open", "corner"])
def test_the_racing_line_stays_in_its_room(road: str) -> None:
    x, y, direction, speed = racing_line(road)
    dense = np.column_stack(
        [np.interp(np.linspace(0, 1, 5000), np.linspace(0, 1, len(ROADS[road])), c) for c in ROADS[road].T]
    )
    distance = np.hypot(dense[:, 0, None] - x, dense[:, 1, None] - y).min(axis=0)
    assert distance.max() < 0.31
    np.testing.assert_allclose(np.hypot(*direction.T), 1.0)
    assert speed.min() > 0.5
    assert speed.max() <= 4.0


def test_the_racing_line_is_slower_in_corners_and_brakes_before_them() -> None:
    x, y, _, speed = racing_line("corner")
    slowest = int(speed[: len(speed) // 2].argmin())
    assert math.hypot(x[slowest] - 6.0, y[slowest]) < 1.5
    gaps = np.hypot(np.diff(x), np.diff(y))
    braking = (speed[:-1] ** 2 - speed[1:] ** 2) / (2.0 * gaps)
    assert braking.max() < 3.0 * 1.3  # pace is measured over two points, not one


def test_racing_line_pays_for_the_inside_of_a_corner_at_its_speed() -> None:
    x, y, _, speed = racing_line("oval")
    target = float(speed[np.hypot(x - 4.7, y).argmin()])
    off = np.array([0.25, -0.25, 0.25, 0.25])
    speeds = target + np.array([0.0, 0.0, -1.0, 1.0])
    # Waypoint 0 is the tip of the oval, where it turns left most.
    columns, track_params = drive("oval", np.zeros(4, int), off, np.zeros(4), speed=speeds)
    best, *others = zoo("racing_line", 4)(columns, track_params, None)
    assert best > max(others)
