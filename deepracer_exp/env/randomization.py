"""What each car suffers in each of its episodes, drawn from its own random streams."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from deepracer_exp.config.randomization import OFF, QUANTITIES, RandomizationConfig
from deepracer_exp.sim.batch import CarBatch

from .state import fitting
from .streams import CarStreams, Purpose, StepNoise

Floats = NDArray[np.float64]
Ids = NDArray[np.intp]

_SAG_S = 20.0
"""Seconds of driving over which a battery sags: about a lap, so that one episode meets all of it."""

_COLUMN = {name: column for column, name in enumerate(QUANTITIES)}
_KNOWN = ("last_steering", "last_speed")
"""Features that are no measurements: a car knows what it was told."""


class Randomization:
    """Draws each episode's car and disturbs what is sent to it and what is seen of it.

    What an episode draws depends on the seed, the car's number and the episode's number alone; the noise within it
    on the seed, the car's number and the steps driven since the seed was set. What is off draws nothing.

    Attributes:
        values: what the cars drew for their episodes, columns `QUANTITIES`, (N, Q), float64 numbers that float32
            holds exactly, so that a trace tells them as they were.
    """

    def __init__(
        self,
        configs: Sequence[RandomizationConfig],
        cars: Sequence[int],
        batch: CarBatch,
        features: Sequence[str],
    ):
        """Give the cars what is the same in all episodes; `seed` and then `begin` come before the rest.

        Args:
            configs: ranges of all quantities, of each car.
            cars: numbers of the cars over all processes.
            batch: their physics.
            features: names of the observation's entries.
        """
        ranges = np.array([[getattr(config, name) for name in QUANTITIES] for config in configs], np.float64)
        self._cars = list(cars)
        self._rows = np.arange(len(self._cars))
        self._low: Floats = ranges[..., 0]
        self._span: Floats = ranges[..., 1] - self._low
        # What is on for one of the cars changes nothing for those that have it off.
        self._on = {name for name, place in _COLUMN.items() if (ranges[:, place] != OFF[name]).any()}
        varying = {name for name, place in _COLUMN.items() if self._span[:, place].any()}
        # Of 0 to 2 steps, each is drawn by a third.
        self._span[:, _COLUMN["action_delay_steps"]] += 1
        self.values: Floats = self._low.astype(np.float32).astype(np.float64)
        tyre_friction = batch.car.tyre_friction
        physics: dict[str, Callable[[Ids, Floats], None]] = {
            "friction_scale": lambda ids, scale: batch.set_tyre_friction(ids, tyre_friction * scale),
            "mass_scale": batch.set_mass_scale,
            "motor_scale": batch.set_motor_scale,
            "servo_scale": batch.set_servo_scale,
        }
        for name in self._on & physics.keys():
            physics[name](self._rows, self._of(name))
        self._varying_physics = {name: apply for name, apply in physics.items() if name in varying}
        self._draws = bool(varying)
        self._sag_steps = _SAG_S / batch.car.control_period_s
        self._measured = np.array([name not in _KNOWN for name in features], np.float64)
        self._first_noise: Floats = np.zeros((len(self._cars), len(features)))
        slots = int(ranges[:, _COLUMN["action_delay_steps"], 1].max()) + 1
        self._sent: Floats = np.zeros((slots, len(self._cars), 2))
        self._deaf_until = np.ones(len(self._cars), np.int64)

    def seed(self, seed: int) -> None:
        """Begin all streams anew."""
        self._seed = seed
        acts = self._on & {"steering_noise_deg", "speed_noise"}
        sees = self._on & {"observation_noise", "observation_dropout"}
        self._episodes = CarStreams(seed, self._cars, Purpose.EPISODE)
        self._action = self._step_noise(seed, Purpose.ACTION, 2) if acts else None
        width = 1 + len(self._measured)
        self._observation = self._step_noise(seed, Purpose.OBSERVATION, width) if sees else None

    def state_dict(self) -> dict[str, Any]:
        """Return what the cars are in their episodes, commands on their way, and how far the noise has come."""
        return {
            "seed": self._seed,
            "values": self.values.copy(),
            "sent": self._sent.copy(),
            "deaf_until": self._deaf_until.copy(),
            "first_noise": self._first_noise.copy(),
            "action_steps": 0 if self._action is None else self._action.steps,
            "observation_steps": 0 if self._observation is None else self._observation.steps,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a `state_dict`, and make the cars' physics what they drew.

        Raises:
            BadInput: it is of another number of cars or features, or of another longest delay.
        """
        self.values = fitting(state, "values", self.values.shape)
        self._sent = fitting(state, "sent", self._sent.shape)
        self._deaf_until = fitting(state, "deaf_until", self._deaf_until.shape)
        self._first_noise = fitting(state, "first_noise", self._first_noise.shape)
        for name, apply in self._varying_physics.items():
            apply(self._rows, self._of(name))
        self.seed(state["seed"])
        for noise, steps in ((self._action, "action_steps"), (self._observation, "observation_steps")):
            if noise is not None:
                noise.steps = state[steps]

    def begin(self, ids: Ids, episodes: NDArray[np.int64]) -> None:
        """Draw what the cars `ids` are in their new episodes, whose numbers are counted per car from 0."""
        self._deaf_until[ids] = 1
        noisy = "observation_noise" in self._on
        if not (self._draws or noisy):
            return
        uniform = np.empty((len(ids), len(QUANTITIES)))
        for row, (place, episode) in enumerate(zip(ids.tolist(), episodes.tolist(), strict=True)):
            stream = self._episodes.at(place, episode)
            # All quantities are drawn, so that switching one on leaves the others as they were.
            stream.random(out=uniform[row])
            if noisy:
                stream.standard_normal(out=self._first_noise[place])
        drawn = self._low[ids] + self._span[ids] * uniform
        np.floor(drawn[:, _COLUMN["action_delay_steps"]], out=drawn[:, _COLUMN["action_delay_steps"]])
        self.values[ids] = drawn.astype(np.float32)
        for name, apply in self._varying_physics.items():
            apply(ids, self.values[ids, _COLUMN[name]])

    def sent(
        self, steering_deg: Floats, speed_mps: Floats, steps: NDArray[np.int64]
    ) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Return what reaches the cars of what is commanded now.

        Args:
            steering_deg: commanded, (N,).
            speed_mps: commanded, (N,).
            steps: control steps of the episode, the prepare step being 1, (N,).

        Returns:
            Steering, speed, and False for cars that stand because no command has reached them yet, each (N,).
        """
        moving = steps > 1
        if "action_delay_steps" in self._on:
            late = steps - self._of("action_delay_steps").astype(np.int64)
            slots = len(self._sent)
            self._sent[steps % slots, self._rows] = np.stack([steering_deg, speed_mps], axis=1)
            steering_deg, speed_mps = self._sent[late % slots, self._rows].T
            moving = late > self._deaf_until
        if "battery_sag" in self._on:
            driven = np.clip((steps - 2) / self._sag_steps, 0.0, 1.0)
            speed_mps = speed_mps * (1 - self._of("battery_sag") * driven)
        if self._action is not None:
            noise = self._action.normal()
            steering_deg = steering_deg + self._of("steering_noise_deg") * noise[:, 0]
            speed_mps = speed_mps * (1 + self._of("speed_noise") * noise[:, 1])
        if "steering_offset_deg" in self._on:
            steering_deg = steering_deg + self._of("steering_offset_deg")
        return steering_deg, speed_mps, moving

    def forget_commands(self, ids: Ids, steps: NDArray[np.int64]) -> None:
        """Let what was commanded up to these steps, (n,), no longer reach the cars `ids`, which stand until then."""
        self._deaf_until[ids] = steps

    def seen(self, features: NDArray[np.float32], before: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what the policies see of the features now, given what they saw one step before, each (N, F)."""
        if self._observation is None:
            return features
        normal = self._observation.normal()
        if "observation_noise" in self._on:
            features = features + self._noise(self._rows, normal[:, 1:])
        lost = ndtr(normal[:, 0]) < self._of("observation_dropout")
        return np.where(lost[:, None], before, features)

    def first_seen(self, ids: Ids, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what the policies of the cars `ids` see of the features their episodes begin with, (n, F)."""
        if "observation_noise" not in self._on:
            return features
        return features + self._noise(ids, self._first_noise[ids])

    def _noise(self, ids: Ids, normal: Floats) -> NDArray[np.float32]:
        deviation = self.values[ids, _COLUMN["observation_noise"], None] * self._measured
        return np.asarray(deviation * normal, np.float32)

    def _step_noise(self, seed: int, purpose: Purpose, width: int) -> StepNoise:
        return StepNoise(CarStreams(seed, self._cars, purpose), len(self._cars), width)

    def _of(self, name: str) -> Floats:
        return self.values[:, _COLUMN[name]]
