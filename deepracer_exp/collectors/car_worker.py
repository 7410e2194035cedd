"""The environment of a collector's process."""

import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.data import Unbounded
from torchrl.envs.utils import set_exploration_type

from deepracer_exp.env.others.head_to_head import HeadToHead, Rivals, Weights
from deepracer_exp.env.race import Race
from deepracer_exp.env.race_env import RaceEnv
from deepracer_exp.env.randomization.car_randomization import CarStreams, Purpose, StepNoise
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.errors import RunFailed
from deepracer_exp.lifeline import end_with_owner
from deepracer_exp.rewards.prints import RewardPrints
from deepracer_exp.runs.crash_dump import write_crash_dump
from deepracer_exp.runs.run_files import REWARD_PRINTS

from .sampling import NOISE


class CarCollector(Collector):
    """TorchRL's collector of a `RaceEnv`, driven by a `SamplingPolicy` of this process.

    It leaves out what nothing here needs: trajectory ids and moves to another device.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Set up as the base class does."""
        super().__init__(*arguments, **options)
        self.storing_device = None
        self._batch = self.fake_tensordict()

    def put_weights(self, weights: Weights) -> None:
        """Drive with these weights of the policy from the next step on."""
        self.policy.load_state_dict({name: torch.from_numpy(values) for name, values in weights.items()})

    @torch.no_grad()
    def rollout(self) -> TensorDictBase:
        """Drive a batch and return it, [N, T], valid until the next one.

        Each step is written where it belongs in the batch. The base class makes a TensorDict of each and stacks them in
        the end, which takes a seventh of the time.
        """
        batch, env, policy = self._batch, self.env, self.policy
        names = [key for key in batch.keys(True, True) if key[0] != "collector"]
        columns = {key: batch.get(key).numpy() for key in names}
        with set_exploration_type(self.exploration_type):
            for step in range(self.frames_per_batch):
                seen = env.seen
                acted = policy.act(seen)
                following = env.drive(acted["action"])
                for key, values in (*seen.items(), *acted.items()):
                    columns[key][:, step] = values
                for key, values in following.items():
                    columns["next", key][:, step] = values
                env.begin_again(following["done"])
        return batch


@dataclass(frozen=True, kw_only=True)
class EnvFactory:
    """Builds the cars of one process; it is sent there and called there.

    `heartbeat` is a file of one int64 per worker, mapped by all of them: control steps done so far, -1 before the
    first. A file needs no clean-up protocol: it lies in the run folder and never outlives it.
    """

    setup: RaceSetup
    worker: int
    n_cars: int
    threads: int
    run_dir: Path
    rivals: Rivals | None = None
    """Rivals of the cars; None: they are alone."""
    heartbeat: Path | None = None
    """File of the counted steps; None if the environment does not live in a worker process."""

    def __call__(self) -> RaceEnv:
        """Prepare this process, and return the environment."""
        if self.heartbeat is not None:
            # A terminal sends Ctrl-C, a service manager SIGTERM, to all processes: the training process handles it.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            end_with_owner()
        race = self._race()
        if self.heartbeat is None:
            return _StateKeepingEnv(race, self.rivals, None)
        beats, worker = np.memmap(self.heartbeat, np.int64, "r+"), self.worker
        beats[worker] = 0

        def beat() -> None:
            beats[worker] += 1

        def end(error: RunFailed) -> None:
            write_crash_dump(self.run_dir, error, worker)
            sys.stderr.flush()
            # No traceback from here: the training process finds the dump, prints its line and sets the exit code.
            sys.exit(RunFailed.exit_code)

        return _StateKeepingEnv(race, self.rivals, beat, end)

    def _race(self) -> Race:
        options: dict[str, Any] = {
            "threads": self.threads,
            "first_car": self.worker * self.n_cars,
            "prints": RewardPrints(self.run_dir / REWARD_PRINTS),
        }
        if self.rivals is None:
            return Race(self.setup, self.n_cars, **options)
        race = HeadToHead(self.setup, self.n_cars, self.rivals.setup, **options)
        race.drive_with(self.rivals.policies(self.rivals.weights))
        return race


class _StateKeepingEnv(RaceEnv):
    """A RaceEnv for `SamplingPolicy`, whose state can be taken and restored, and whose errors carry the cars' state."""

    def __init__(
        self,
        race: Race,
        rivals: Rivals | None,
        on_step: Callable[[], None] | None,
        on_failure: Callable[[RunFailed], None] = lambda error: None,
    ):
        super().__init__(race, on_step)
        self._rivals = rivals
        self._on_failure = on_failure
        width = 2 if race.setup.actions.n is None else 1
        streams = CarStreams(race.setup.seed, race.cars.tolist(), Purpose.POLICY)
        self._noise = StepNoise(streams, race.n_cars, width)
        self._draw()
        self.observation_spec[NOISE] = Unbounded((race.n_cars, width), dtype=torch.float64)

    def fake_tensordict(self) -> TensorDictBase:
        """Return a step as batches hold it: `trace` only under `next`, where the training reads it."""
        return super().fake_tensordict().exclude("trace")

    def _reset(self, tensordict: TensorDictBase | None, **options: object) -> TensorDictBase:
        return super()._reset(tensordict, **options).exclude("trace")

    def take_state(self) -> dict[str, Any]:
        """Return the state of the cars, and how many actions each has drawn numbers for."""
        return {"race": self.race.state_dict(), "drawn": self._noise.steps}

    def put_state(self, state: Mapping[str, Any]) -> None:
        """Continue from a state of `take_state`; the reset that follows leaves the cars there and draws nothing."""
        self.resume_from(state["race"])
        self._noise.steps = state["drawn"] - 1
        self._draw()

    def put_rivals(self, weights: Sequence[Weights]) -> None:
        """Let policies with these weights drive the rivals."""
        assert isinstance(self.race, HeadToHead)
        assert self._rivals is not None
        self.race.drive_with(self._rivals.policies(weights))

    @property
    def seen(self) -> dict[str, np.ndarray]:
        """The present observation, by key."""
        return {**super().seen, NOISE: self._drawn}

    def drive(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """Step all cars, with new numbers for their next actions; see `RaceEnv.drive`."""
        self._draw()
        try:
            return super().drive(action)
        except RunFailed as error:
            if not hasattr(error, "arrays"):
                error.arrays = self.race.state_arrays()  # type: ignore[attr-defined]
            self._on_failure(error)
            raise

    def _draw(self) -> None:
        # A copy: the next block of numbers is written over this one.
        self._drawn = self._noise.normal().copy()
