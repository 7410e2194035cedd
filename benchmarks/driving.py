"""Physics alone against the whole environment, for the same driving."""

import ast
import dataclasses
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from deepracer_exp.config.driving import RewardConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.race import Race
from deepracer_exp.env.race_env import RaceEnv
from deepracer_exp.env.setup import RaceSetup, build_setup
from deepracer_exp.rewards.source import load_reward_source, source_with_constants
from deepracer_exp.sim.batch import CarBatch

PASS_STEPS = 150
"""Control steps of one pass: 10 s, several episodes of random driving."""


def scalar_setup(experiment: Experiment) -> RaceSetup:
    """Return what the experiment's cars need, with a reward function that is called once per car."""
    source = load_reward_source(experiment.reward)
    tree = ast.parse(source_with_constants(source))
    tree.body = [
        node for node in tree.body if not (isinstance(node, ast.FunctionDef) and node.name == "reward_batch")
    ]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{source.name}.py"
        file.write_text(ast.unparse(tree), encoding="utf-8")
        time_limit_s = experiment.reward.time_limit_s
        reward = RewardConfig(name=source.name, file=str(file), constants={}, time_limit_s=time_limit_s)
        return build_setup(dataclasses.replace(experiment, reward=reward))


class SameDriving:
    """One pass of random driving that can be timed with the whole environment and with the physics alone.

    The same cars do the same both times: the actions are drawn beforehand, the race begins again from its seed, and
    every step of the bare physics starts from the state in which the environment's began.
    """

    def __init__(self, experiment: Experiment, n_cars: int):
        """Drive the pass once to record each step's state."""
        setup = scalar_setup(experiment)
        self._env = RaceEnv(Race(setup, n_cars, threads=1))
        torch.manual_seed(experiment.seed)
        self._actions = [self._env.action_spec.rand() for _ in range(PASS_STEPS)]
        race = self._env.race
        self._cars = race._batch
        noting = _Noting(self._cars)
        race._batch = noting  # type: ignore[assignment]
        self.env_pass_s()
        race._batch = self._cars
        self._noted, self._last = noting.noted, noting.after

    @property
    def car_steps(self) -> int:
        """Control steps of one pass over all cars."""
        return PASS_STEPS * self._env.race.n_cars

    def env_pass_s(self) -> float:
        """Return the seconds of the pass in the environment, new episodes included."""
        self._env.race.seed(self._env.race.setup.seed)
        root = self._env.reset()
        began = time.perf_counter()
        for action in self._actions:
            root.set("action", action)
            _, root = self._env.step_and_maybe_reset(root)
        return time.perf_counter() - began

    def physics_pass_s(self) -> float:
        """Return the seconds of the pass inside `CarBatch.drive` alone.

        Raises:
            AssertionError: the cars did not end where the environment's did.
        """
        seconds = 0.0
        for before, command in self._noted:
            self._cars.state = before
            began = time.perf_counter()
            self._cars.drive(*command)
            seconds += time.perf_counter() - began
        assert np.array_equal(self._cars.state, self._last), (
            "the physics drove another way than the environment"
        )
        return seconds


class _Noting:
    """Cars that record the state in which each step begins, its command, and the state after the last step."""

    def __init__(self, cars: CarBatch):
        self._cars = cars
        self.noted: list[tuple[np.ndarray, tuple[np.ndarray, ...]]] = []
        self.after: np.ndarray

    def __getattr__(self, name: str) -> Any:
        return getattr(self._cars, name)

    def drive(self, speed_mps: np.ndarray, steering_rad: np.ndarray, moving: np.ndarray) -> None:
        command = speed_mps.copy(), steering_rad.copy(), moving.copy()
        self.noted.append((self._cars.state, command))
        self._cars.drive(*command)
        self.after = self._cars.state
