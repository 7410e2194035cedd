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
from deepracer_exp.env.reward_source import load_reward_source, source_with_constants
from deepracer_exp.env.setup import RaceSetup, build_setup
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

    Both times the same cars do the same: the actions are drawn beforehand, the race begins anew from its seed, and
    the bare batch gets the motor and servo commands and the new starts that the race gave its own.
    """

    def __init__(self, experiment: Experiment, n_cars: int):
        """Drive the pass once to write down what the physics was told."""
        setup = scalar_setup(experiment)
        self.substeps = setup.car.substeps
        self._env = RaceEnv(Race(setup, n_cars, threads=1))
        torch.manual_seed(experiment.seed)
        self._actions = [self._env.action_spec.rand() for _ in range(PASS_STEPS)]
        own = CarBatch(setup.car, n_cars, 1, setup.track.floor.friction)
        self._batch = mujoco.batch.Batch(own.model, n_cars, 1)
        self._rows, self._ctrl = self._batch.state, self._batch.bind("ctrl")
        self._write_down()

    @property
    def car_steps(self) -> int:
        """Control steps of one pass over all cars."""
        return PASS_STEPS * self._env.race.n_cars

    def env_pass_s(self) -> float:
        """Return the seconds of the pass in the environment, new episodes included."""
        root = self._begin()
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
        rows, ctrl, batch, substeps = self._rows, self._ctrl, self._batch, self.substeps
        rows[:] = self._first
        seconds = 0.0
        for commands, (ids, starts) in zip(self._commands, self._starts, strict=True):
            ctrl[:] = commands
            began = time.perf_counter()
            batch.step(nstep=substeps)
            seconds += time.perf_counter() - began
            rows[ids] = starts
        assert np.array_equal(rows, self._last), "the physics alone drove another way than the environment"
        return seconds

    def _begin(self):  # type: ignore[no-untyped-def]
        self._env.race.seed(self._env.race.setup.seed)
        return self._env.reset()

    def _write_down(self) -> None:
        root = self._begin()
        self._first = self._state()
        self._commands, self._starts = [], []
        for action in self._actions:
            root.set("action", action)
            following = self._env.step(root)["next"]
            # The commands are part of the state.
            self._rows[:] = self._state()
            self._commands.append(self._ctrl.copy())
            ids = np.flatnonzero(following["done"].numpy())
            root = following.select("observation")
            if len(ids):
                self._env.race.reset(ids)
            self._starts.append((ids, self._state()[ids]))
        self._last = self._state()

    def _state(self) -> np.ndarray:
        return self._env.race.state_arrays()["physics_state"]
