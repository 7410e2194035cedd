from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.race import Race
from deepracer_exp.env.setup import RaceSetup, build_setup
from deepracer_exp.env.trace_columns import PACKED


@lru_cache(maxsize=40)  # a setup of one track holds megabytes
def make_setup(*overrides: str) -> RaceSetup:
    """Compose and build a setup: the list of 15 actions and plain cars, unless others are named."""
    plain = [
        f"{group}={option}"
        for group, option in (("action_space", "discrete"), ("randomization", "none"))
        if not any(line.startswith(f"{group}=") for line in overrides)
    ]
    return build_setup(compose_experiment([*plain, *overrides])[0])


def random_actions(steps: int, cars: int) -> np.ndarray:
    return np.random.default_rng(5).uniform(-1, 1, (steps, cars, 2))


def put(race: Race, distance_m: float, offset_m: float = 0.0) -> None:
    """Put all cars' origins at a distance along the centre line, to the left of it."""
    track = race.setup.track
    pose = track.start_pose(np.full(race.n_cars, distance_m / track.length_m))
    x, y = pose.x - offset_m * np.sin(pose.yaw_rad), pose.y + offset_m * np.cos(pose.yaw_rad)
    race._batch.place(np.arange(race.n_cars), x, y, pose.yaw_rad)
    race.rules.measure(race._batch.read())


def drive(race: Race, actions: np.ndarray) -> np.ndarray:
    """Drive with actions (steps, cars, ...), start new episodes as they end.

    Return (steps, cars, C): the trace of every step, and after its columns the observation.
    """
    rows = []
    for action in actions:
        race.step(action)
        rows.append(np.concatenate([race.trace, race.observation], axis=1))
        race.reset(np.flatnonzero(race.terminated | race.truncated))
    return np.array(rows)


def drive_and_see(race: Race, steps: int) -> list[dict[str, np.ndarray]]:
    """Drive all cars with action 7; return what is seen after each step."""
    return [(race.step(np.full(race.n_cars, 7)), race.seen)[1] for _ in range(steps)]


@pytest.fixture
def setup_of() -> Callable[..., RaceSetup]:
    return make_setup


@pytest.fixture
def race_of() -> Callable[..., Race]:
    """Build a race of n cars that stand at their starts."""

    def build(*overrides: str, n_cars: int = 1, **options) -> Race:
        race = Race(make_setup(*overrides), n_cars, **options)
        race.reset()
        return race

    return build


@pytest.fixture
def column() -> Callable[[Race, str], np.ndarray]:
    return lambda race, name: race.trace[:, PACKED[name]]


@pytest.fixture
def steer_ahead() -> Callable[[Race, float], np.ndarray]:
    """Return continuous actions that steer towards the road about a metre ahead."""

    def act(race: Race, speed: float = 0.0) -> np.ndarray:
        at = race.feature_names.index("ahead_x_1")
        angle_rad = np.arctan2(race.observation[:, at + 1], race.observation[:, at])
        # With a larger gain the car would weave.
        steering = np.clip(1.4 * angle_rad / np.radians(30), -1, 1)
        return np.column_stack([steering, np.full(race.n_cars, speed)])

    return act


@pytest.fixture
def spy(tmp_path: Path) -> str:
    """The override of a reward function that pays 1 and keeps its params; `spied` returns them."""
    file = tmp_path / "spy.py"
    file.write_text("seen = []\ndef reward_function(params):\n    seen.append(params)\n    return 1.0\n")
    return f"reward.file={file}"


def spied(race: Race) -> list[list[dict[str, Any]]]:
    """Return the params of all calls, by car."""
    return [function.__globals__["seen"] for function in race._reward_function.functions]
