"""The cars of a collector's process, and the sampling of their actions."""

import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.distributions import Categorical, Distribution, Independent
from torchrl.collectors import Collector
from torchrl.data import Unbounded
from torchrl.envs.utils import set_exploration_type
from torchrl.modules import TanhNormal

from deepracer_exp.agents.compiled_policy import CompiledPolicy
from deepracer_exp.env.others.head_to_head import HeadToHead, Rivals, Weights
from deepracer_exp.env.race import Race
from deepracer_exp.env.race_env import RaceEnv
from deepracer_exp.env.randomization.car_randomization import CarStreams, Purpose, StepNoise
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.errors import RunFailed
from deepracer_exp.lifeline import end_with_owner
from deepracer_exp.rewards.prints import RewardPrints
from deepracer_exp.runs.folder import write_crash_dump
from deepracer_exp.runs.run_files import REWARD_PRINTS


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


NOISE = "noise"
"""Standard normal numbers of each car for its next action, float64: one for an index, two for steering and speed."""


class SamplingPolicy(TensorDictModuleBase):
    """A policy that draws each car's action from the car's own random numbers, the key `NOISE`.

    Sampling from a generator of the process would make a run depend on how its cars are spread over processes. It has
    the policy's inputs, shares its parameters, and writes `action` and `action_log_prob`.
    """

    def __init__(self, policy: TensorDictModuleBase) -> None:
        """Wrap an `ActorCritic.policy`."""
        super().__init__()
        self.policy = policy
        self.in_keys, self.out_keys = [*policy.in_keys, NOISE], ["action", "action_log_prob"]
        self._compiled = CompiledPolicy.of(policy)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add action and log-probability."""
        for key, values in self.act({key: tensordict.get(key).numpy() for key in self.in_keys}).items():
            tensordict.set(key, torch.from_numpy(values))
        return tensordict

    def act(self, seen: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Return `action` and `action_log_prob` of N cars for their observations, (N, ...) by key."""
        if self._compiled is not None:
            action, log_prob = self._compiled.sample(seen["observation"], seen[NOISE])
            return {"action": action, "action_log_prob": log_prob}
        noise = torch.from_numpy(seen[NOISE])
        read = {key: torch.from_numpy(seen[key]) for key in self.policy.in_keys}
        drawn = _drawn(self.policy.get_dist(TensorDict(read, [len(noise)])), noise)
        return dict(zip(self.out_keys, (values.detach().numpy() for values in drawn), strict=True))


def _drawn(distribution: Distribution, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Transform standard normal noise into samples (inverse transform); return them with their log-density."""
    if isinstance(distribution, Categorical):
        below = distribution.probs.cumsum(-1)[..., :-1]  # the last is 1, up to rounding
        action = (torch.special.ndtr(noise) >= below).sum(-1)
        return action, distribution.log_prob(action)
    if isinstance(distribution, TanhNormal):
        # Scored before the tangent, which cannot be inverted near -1 and 1.
        before, log_prob = _drawn(distribution.base_dist, noise)
        (tangent,) = distribution.transforms
        action = tangent(before)
        return action, log_prob - tangent.log_abs_det_jacobian(before, action).sum(-1)
    assert isinstance(distribution, Independent)
    normal = distribution.base_dist
    action = normal.loc + normal.scale * noise.to(normal.loc.dtype)
    return action, distribution.log_prob(action)
