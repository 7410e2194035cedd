"""Physics alone against the whole environment, for the same driving."""

import ast
import dataclasses
import tempfile
import time
from pathlib import Path

import mujoco.batch
import numpy as np
import torch

from deepracer_exp.config.driving import RewardConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.race import Race
from deepracer_exp.env.race_env import RaceEnv
from deepracer_exp.env.setup import RaceSetup, build_setup
from deepracer_exp.rewards.source import load_reward_source, source_with_constants

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

    Both times the same cars do the same: the actions are drawn beforehand, the race begins anew from its seed, and
    every step of the bare physics starts from the state in which the environment's began.
    """

    def __init__(self, experiment: Experiment, n_cars: int):
        """Drive the pass once to write down each step's state."""
        setup = scalar_setup(experiment)
        self.substeps = setup.car.substeps
        self._env = RaceEnv(Race(setup, n_cars, threads=1))
        torch.manual_seed(experiment.seed)
        self._actions = [self._env.action_spec.rand() for _ in range(PASS_STEPS)]
        cars = self._env.race._batch
        self._physics = cars._batch
        noting = _Noting(self._physics)
        cars._batch = noting
        self.env_pass_s()
        cars._batch = self._physics
        self._before, self._last = noting.before, noting.after

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
        """Return the seconds of the pass inside `Batch.step` alone.

        Raises:
            AssertionError: the cars did not end where the environment's did.
        """
        physics, rows, substeps = self._physics, self._physics.state, self.substeps
        seconds = 0.0
        for before in self._before:
            rows[:] = before
            began = time.perf_counter()
            physics.step(nstep=substeps)
            seconds += time.perf_counter() - began
        assert np.array_equal(rows, self._last), "the physics alone drove another way than the environment"
        return seconds


class _Noting:
    """A batch that notes the state in which each of its steps begins, and in which the last one ended."""

    def __init__(self, batch: mujoco.batch.Batch):
        self._batch = batch
        self.before: list[np.ndarray] = []
        self.after: np.ndarray

    def step(self, nstep: int) -> None:
        self.before.append(self._batch.state.copy())
        self._batch.step(nstep=nstep)
        self.after = self._batch.state.copy()
