"""The TorchRL environment: N cars stepped together."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from deepracer_exp.sim.lidar_rays import FURTHEST_M

from .race import Race

_FLAGS = ("done", "terminated", "truncated")


class RaceEnv(EnvBase):
    """A `Race` as a TorchRL environment of batch size [N].

    Keys: `observation` (float32 features), with a camera `pixels` (uint8, channels x height x width), with a LIDAR
    `lidar` (float32), `action` (int64 index, or float32 steering and speed in -1..1), and under `next` also `reward`,
    `done`, `terminated` and `truncated`. `trace` (float64, columns those of `Race.trace`) is the last step that each
    car has made, at the start of an episode that of the one before. Like the `info` of Gymnasium's environments in
    TorchRL it is among the observations, so that transforms of rewards leave it alone; no policy of ours reads it.
    """

    def __init__(self, race: Race, on_step: Callable[[], None] | None = None):
        """Wrap a race.

        `on_step` is called after every step, as a heartbeat.
        """
        super().__init__(device="cpu", batch_size=[race.n_cars])
        self.race = race
        self._on_step = on_step
        self._resumed = False
        n_cars, size = race.observation.shape
        n_actions = race.setup.actions.n
        self.observation_spec = Composite(
            observation=Unbounded((n_cars, size), dtype=torch.float32),
            trace=Unbounded(race.trace.shape, dtype=torch.float64),
            shape=(n_cars,),
        )
        if "pixels" in race.seen:
            self.observation_spec["pixels"] = Bounded(0, 255, race.pixels.shape, dtype=torch.uint8)
        if "lidar" in race.seen:
            self.observation_spec["lidar"] = Bounded(0.0, FURTHEST_M, race.lidar.shape, dtype=torch.float32)
        self.action_spec = (
            Bounded(-1.0, 1.0, (n_cars, 2), dtype=torch.float32)
            if n_actions is None
            else Categorical(n_actions, shape=(n_cars,), dtype=torch.int64)
        )
        self.reward_spec = Unbounded((n_cars, 1), dtype=torch.float32)
        flags = {key: Categorical(2, shape=(n_cars, 1), dtype=torch.bool) for key in _FLAGS}
        self.full_done_spec = Composite(flags, shape=(n_cars,))
        self._no = torch.zeros(n_cars, 1, dtype=torch.bool)

    @property
    def seen(self) -> dict[str, np.ndarray]:
        """The present observation, by key."""
        return self.race.seen

    def drive(self, action: np.ndarray) -> dict[str, np.ndarray]:
        """Step all cars and return the entries under `next`, by key; `trace` is valid until the next step.

        Actions are as for `Race.step`, which also says what is raised.
        """
        race = self.race
        race.step(action)
        if self._on_step is not None:
            self._on_step()
        terminated, truncated = race.terminated[:, None], race.truncated[:, None]
        return {
            **self.seen,
            "reward": race.reward.astype(np.float32)[:, None],
            "trace": race.trace,
            "done": terminated | truncated,
            "terminated": terminated,
            "truncated": truncated,
        }

    def begin_again(self, done: np.ndarray) -> None:
        """Start new episodes with the cars whose episodes ended, (N, 1)."""
        if done.any():
            self.race.reset(np.flatnonzero(done))

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Step, and start new episodes where one ended, as the base class does but faster.

        The base class takes about 0.6 ms a step to check specs and copy keys.
        """
        following = self._step(tensordict)
        tensordict.set("next", following)
        self.begin_again(following.get("done").numpy())
        return tensordict, self._begun()

    def resume_from(self, state: Mapping[str, Any]) -> None:
        """Restore a `Race.state_dict`; the next reset of all cars keeps that state.

        Raises:
            BadInput: the state does not fit.
        """
        self.race.load_state_dict(state)
        self._resumed = True

    def _reset(self, tensordict: TensorDictBase | None, **_: object) -> TensorDictBase:
        ids = None
        if tensordict is not None and "_reset" in tensordict:
            ids = np.flatnonzero(tensordict.get("_reset").numpy())
        if ids is None and self._resumed:
            self._resumed = False
        else:
            self.race.reset(ids)
        return self._begun()

    def _begun(self) -> TensorDict:
        """Return the observations, with all flags of the end of an episode False."""
        flags = {key: self._no.clone() for key in _FLAGS}
        seen = {key: torch.from_numpy(values) for key, values in self.seen.items()}
        seen["trace"] = torch.from_numpy(self.race.trace.copy())
        return TensorDict({**seen, **flags}, batch_size=self.batch_size, device=self.device)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        following = self.drive(tensordict.get("action").detach().numpy())
        following["trace"] = following["trace"].copy()
        tensors = {key: torch.from_numpy(values) for key, values in following.items()}
        return TensorDict(tensors, batch_size=self.batch_size, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.race.seed(seed)
