"""Gymnasium environments; importing this module registers `DeepRacer-v0` and, for each track, `DeepRacer/TRACK-v0`.

import gymnasium
import deepracer_exp.env.gym_env

env = gymnasium.make("DeepRacer/Oval_track-v0")
cars = gymnasium.make_vec("DeepRacer-v0", num_envs=64, overrides=["action_space=continuous"])

An id stands for the default experiment on the track in its name. Its version is raised by a change that makes older
results incomparable.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from deepracer_exp.aws.worlds.catalogue import worlds
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.others.rival import refuse_rivals
from deepracer_exp.errors import BadInput
from deepracer_exp.sim.lidar_rays import FURTHEST_M

from .race import Race
from .setup import RaceSetup, build_setup, deal
from .top_view import TopView
from .trace_columns import EPISODE_STATUS, PACKED

Observed = Any
"""An array, or with two sensors a dictionary of arrays."""

_KIND = "a Gymnasium environment"
_METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 15}
_BOUNDS = {"observation": (-np.inf, np.inf), "pixels": (0, 255), "lidar": (0, FURTHEST_M)}


class DeepRacerEnv(gym.Env[Observed, Any]):
    """One car; with several tracks, its episodes are distributed over them by their weights.

    Observation: the features of `Features`, float32; with a camera or a LIDAR, instead, its pictures, uint8, or
    readings, float32; with both, a dictionary of `pixels` and `lidar`. Action: an index into the action space's list,
    or steering and speed in -1..1. `info` has `progress` in per cent and `episode_status`, both of the pose before the
    step. `render` returns the track from above; `gymnasium.make(..., render_mode="human")` shows it in a window.
    """

    metadata = _METADATA

    def __init__(
        self, overrides: Sequence[str] = (), render_mode: str | None = None, track: str | None = None
    ):
        """Compose an experiment and put its car on the track.

        Args:
            overrides: as for `deepracer-exp train`.
            render_mode: `rgb_array`, or None for no pictures.
            track: an option of the group track, unless an override has another; None: the default's.

        Raises:
            BadInput: an override or a file it names is not accepted, or there is no such mode.
        """
        self.render_mode = _checked(render_mode)
        setup = refuse_rivals(_composed(track, overrides), _KIND)
        self._race = Race(setup, 1)
        self._weights = setup.weights
        self._courses = deal(self._weights)
        self.observation_space, self.action_space = _spaces(self._race)
        self._view = TopView(self._race)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Start an episode, further along the track than the last; with a seed, start over."""
        super().reset(seed=seed)
        if seed is not None:
            self._race.seed(seed)
            self._courses = deal(self._weights)
        # Successive episodes are distributed over the courses as cars are.
        self._race.reset(course=np.array([next(self._courses)]))
        return _observed(self._race, 0), {}

    def step(self, action: Any) -> tuple[Observed, float, bool, bool, dict[str, Any]]:
        """Drive for 1/15 s."""
        race = self._race
        race.step(np.asarray(action)[None])
        info = {
            "progress": float(race.trace[0, PACKED["progress"]]),
            "episode_status": EPISODE_STATUS[int(race.trace[0, PACKED["episode_status"]])],
        }
        terminated, truncated = bool(race.terminated[0]), bool(race.truncated[0])
        return _observed(race, 0), float(race.reward[0]), terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return the track with the car from above, (height, width, 3); None without a `render_mode`."""
        return None if self.render_mode is None else self._view.picture(0)


class DeepRacerVectorEnv(VectorEnv[Observed, NDArray[Any], NDArray[Any]]):
    """Many cars, stepped together; a car whose episode ended starts a new one in the same step.

    `infos` holds arrays `progress` and `episode_status` (codes of `env.trace_columns.EPISODE_STATUS`) of the poses
    before the step. In a step that ended episodes it also holds, as Gymnasium's own vector environments do, `final_obs`
    (objects: an observation, or None) with the mask `_final_obs`, and `final_info` with `_final_info`.
    """

    metadata = {**_METADATA, "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012 - Gymnasium's protocol

    def __init__(
        self,
        num_envs: int = 1,
        overrides: Sequence[str] = (),
        threads: int = 1,
        setup: RaceSetup | None = None,
        render_mode: str | None = None,
        track: str | None = None,
    ):
        """Compose an experiment and put its cars on the track.

        Args:
            num_envs: number of cars.
            overrides: as for `deepracer-exp train`.
            threads: physics threads; 0 means one per core.
            setup: the race, if it is built already; replaces `overrides` and `track`.
            render_mode: `rgb_array`, or None for no pictures.
            track: an option of the group track, unless an override has another; None: the default's.

        Raises:
            BadInput: an override or a file it names is not accepted, or there is no such mode.
        """
        self.render_mode = _checked(render_mode)
        setup = refuse_rivals(setup or _composed(track, overrides), _KIND)
        if num_envs < len(setup.courses):
            raise BadInput(
                f"num_envs={num_envs} with {len(setup.courses)} tracks: every track needs a car; accepted: at "
                f"least {len(setup.courses)}"
            )
        self._race = Race(setup, num_envs, threads)
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = _spaces(self._race)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._view = TopView(self._race)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Start an episode with every car; with a seed (of a list, the first), start over."""
        first = seed[0] if isinstance(seed, list) else seed
        super().reset(seed=first)
        if first is not None:
            self._race.seed(first)
        self._race.reset()
        return _observed(self._race), {}

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Observed, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Drive for 1/15 s with every car."""
        race = self._race
        race.step(np.asarray(actions))
        reward, terminated, truncated = race.reward, race.terminated, race.truncated
        infos: dict[str, Any] = {
            "progress": race.trace[:, PACKED["progress"]].copy(),
            "episode_status": race.trace[:, PACKED["episode_status"]].astype(np.int64),
        }
        ended = terminated | truncated
        if ended.any():
            ids = np.flatnonzero(ended)
            final = np.full(self.num_envs, None, dtype=object)
            for car in ids.tolist():
                final[car] = _observed(race, car)
            infos |= {
                "final_obs": final,
                "_final_obs": ended,
                "final_info": infos.copy(),
                "_final_info": ended,
            }
            race.reset(ids)
        return _observed(race), reward, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return each car on its track from above, (height, width, 3); None without a `render_mode`."""
        return None if self.render_mode is None else tuple(map(self._view.picture, range(self.num_envs)))


def _composed(track: str | None, overrides: Sequence[str]) -> RaceSetup:
    return build_setup(compose_experiment([*([] if track is None else [f"track={track}"]), *overrides])[0])


def _checked(render_mode: str | None) -> str | None:
    accepted = _METADATA["render_modes"]
    if render_mode not in (None, *accepted):
        raise BadInput(f"render_mode={render_mode}", "not a way to render", ", ".join(accepted))
    return render_mode


def _keys(race: Race) -> list[str]:
    return [key for key in ("pixels", "lidar") if key in race.seen] or ["observation"]


def _observed(race: Race, car: int | slice = slice(None)) -> Observed:
    """Return the observation, of one car or of all, (N, ...)."""
    seen = {key: race.seen[key][car] for key in _keys(race)}
    return seen if len(seen) > 1 else seen.popitem()[1]


def _spaces(race: Race) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
    boxes: dict[str, spaces.Space[Any]] = {}
    for key in _keys(race):
        values = race.seen[key]
        boxes[key] = spaces.Box(*_BOUNDS[key], values.shape[1:], values.dtype.type)
    observation = spaces.Dict(boxes) if len(boxes) > 1 else boxes.popitem()[1]
    n_actions = race.setup.actions.n
    if n_actions is None:
        return observation, spaces.Box(-1.0, 1.0, (2,), np.float32)
    return observation, spaces.Discrete(n_actions)


def _register(name: str, **kwargs: str) -> None:
    here = "deepracer_exp.env.gym_env"
    gym.register(
        f"{name}-v0",
        entry_point=f"{here}:DeepRacerEnv",
        vector_entry_point=f"{here}:DeepRacerVectorEnv",
        kwargs=kwargs,
    )


_register("DeepRacer")
# Tracks of the working folder have no id: it would not mean the same to others.
for _track in worlds():
    _register(f"DeepRacer/{_track}", track=_track)
