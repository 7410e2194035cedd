"""The cars as a vectorised environment of Stable-Baselines3, which `pip install 'deepracer-exp[sb3]'` brings along.

from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor
from deepracer_exp.env.sb3 import DeepRacerVecEnv

cars = VecMonitor(DeepRacerVecEnv(64, ["track=Oval_track"]))
PPO("MlpPolicy", cars, n_steps=128, batch_size=1024).learn(500_000)
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from .gym_env import DeepRacerVectorEnv, Observed
from .setup import RaceSetup


class DeepRacerVecEnv(VecEnv):
    """A `DeepRacerVectorEnv` behind Stable-Baselines3's interface: all cars in this process, stepped together.

    Where an episode ended, the step's info has `terminal_observation`, `TimeLimit.truncated`, `progress` in per cent
    and `episode_status` (code of `env.trace_columns.EPISODE_STATUS`); elsewhere it is empty.
    """

    def __init__(
        self,
        num_envs: int,
        overrides: Sequence[str] = (),
        threads: int = 1,
        setup: RaceSetup | None = None,
        render_mode: str | None = None,
    ):
        """Put the cars on the track; arguments and errors as for `DeepRacerVectorEnv`."""
        self.cars = DeepRacerVectorEnv(num_envs, overrides, threads, setup, render_mode)
        super().__init__(num_envs, self.cars.single_observation_space, self.cars.single_action_space)
        self._first_seed: int | None = None

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the next reset, or seed it at random; return the seeds, one per car."""
        seeds: Sequence[int | None] = super().seed(seed)
        self._first_seed = seeds[0]
        return seeds

    def reset(self) -> Observed:
        """Start an episode with every car; after `seed(S)`, start over from S."""
        observation, _ = self.cars.reset(seed=self._first_seed)
        self._first_seed = None
        return observation

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions of the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[Observed, NDArray[Any], NDArray[Any], list[dict[str, Any]]]:
        """Drive for 1/15 s with every car."""
        observation, reward, terminated, truncated, infos = self.cars.step(self._actions)
        ended = terminated | truncated
        per_car: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for car in np.flatnonzero(ended).tolist():
            per_car[car] = {
                "terminal_observation": infos["final_obs"][car],
                "TimeLimit.truncated": bool(truncated[car]),
                "progress": float(infos["progress"][car]),
                "episode_status": int(infos["episode_status"][car]),
            }
        return observation, reward, ended, per_car

    def close(self) -> None:
        """Release the cars."""
        self.cars.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return each car on its track from above."""
        return self.cars.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the cars' environment, for each of these cars."""
        return [getattr(self.cars, attr_name)] * len(self._chosen(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: all cars are one environment."""
        raise NotImplementedError("the cars are one environment: none has attributes of its own")

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Refuse: all cars are one environment."""
        raise NotImplementedError("the cars are one environment: none has methods of its own")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return False for each of these cars."""
        return [False] * len(self._chosen(indices))

    def _chosen(self, indices: int | Iterable[int] | None) -> list[int]:
        if indices is None:
            return list(range(self.num_envs))
        return [indices] if isinstance(indices, int) else list(indices)
