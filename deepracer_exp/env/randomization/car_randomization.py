"""Domain randomization: what each car draws for each of its episodes, from its own random streams."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.driving import OFF, QUANTITIES, RandomizationConfig, car_differs
from deepracer_exp.env.state import checked_array
from deepracer_exp.jit import compiled
from deepracer_exp.sim.batch import CarBatch

Floats = NDArray[np.float64]
Ids = NDArray[np.intp]

_SAG_S = 20.0
"""Seconds of driving over which the battery sags: about a lap, so that an episode covers the whole range."""

_COLUMN = {name: column for column, name in enumerate(QUANTITIES)}
_OF_COMMANDS = tuple(
    _COLUMN[name]
    for name in (
        *("action_delay_steps", "battery_sag", "steering_offset_deg"),
        *("steering_noise_deg", "speed_noise"),
    )
)
_OF_OBSERVATION = _COLUMN["observation_noise"], _COLUMN["observation_dropout"]
_KNOWN = ("last_steering", "last_speed")
"""Features that are commands, not measurements, and therefore exact."""

# Numbers drawn from a generator at once: one number from each of 256 generators would cost 0.5 ms a step.
_BLOCK = 128


class Purpose(IntEnum):
    """Purposes of random numbers: each has its own streams, so that its draws never shift those of another."""

    ACTION = 0
    OBSERVATION = 1
    EPISODE = 2
    PICTURE = 3
    LIDAR = 4
    LENS = 5
    POLICY = 6
    OTHERS = 7
    RIVALS = 8
    LOOKS = 9
    REAL_CAR = 10


class CarStreams:
    """Independent random streams per car, numbered from 0 without limit.

    A stream depends only on the seed, the purpose, the car's number and the stream's number: not on how many cars,
    processes or threads there are, nor on earlier draws.

    Attributes:
        keys: a number for each car that seed, purpose and its number decide, (N,), uint64.
    """

    def __init__(self, seed: int, cars: Sequence[int], purpose: Purpose):
        """Set up streams for cars, given their numbers over all processes."""
        # Not lists of entropy: SeedSequence([seed, car]) and SeedSequence([seed, car, 0]) are the same.
        self._keys: list[NDArray[np.uint64]] = [
            np.random.SeedSequence(seed, spawn_key=(purpose, car))
            .generate_state(2, np.uint64)
            .view(np.uint64)
            for car in cars
        ]
        self.keys = np.array([key[0] for key in self._keys])
        self._philox = np.random.Philox()
        self._generator = np.random.Generator(self._philox)
        self._state = self._philox.state

    def stream(self, place: int, number: int) -> np.random.Generator:
        """Return a generator, always the same object, at the start of stream `number` of the car `cars[place]`."""
        # A key and a counter are the whole state of Philox. Ten times faster than a new generator.
        self._state["state"] = {
            "key": self._keys[place],
            "counter": np.array([0, 0, 0, number], np.uint64),
        }
        self._philox.state = self._state
        return self._generator


class StepNoise:
    """Standard normal numbers for each car and control step.

    Attributes:
        steps: number of steps drawn; setting it continues from there.
    """

    def __init__(self, streams: CarStreams, n_cars: int, width: int, cars: Ids | None = None):
        """Start at step 0, with `width` numbers per car and step; cars other than `cars` have zeros, None: all draw."""
        self.steps = 0
        self._streams = streams
        self._drawing = range(n_cars) if cars is None else cars.tolist()
        self._block = np.zeros((n_cars, _BLOCK, width))
        self._block_number = -1

    def normal(self) -> np.ndarray:
        """Return the next numbers of each car, shape (cars, width)."""
        number, place = divmod(self.steps, _BLOCK)
        if number != self._block_number:
            for car in self._drawing:
                self._streams.stream(car, number).standard_normal(out=self._block[car])
            self._block_number = number
        self.steps += 1
        return self._block[:, place]


def of_each_car(configs: Sequence[RandomizationConfig], places: Sequence[int]) -> list[RandomizationConfig]:
    """Return each car's randomization, (N,): the configured one, or none for cars outside `car_share`.

    `places` are their numbers among those on their courses, see `places_of_cars`.
    """
    return [
        config if car_differs(place, config.car_share) else _without(config)
        for config, place in zip(configs, places, strict=True)
    ]


def _without(config: RandomizationConfig) -> RandomizationConfig:
    off: dict[str, Any] = {name: (value, value) for name, value in OFF.items()}
    return replace(config, **off, pictures=None, real_car=None)


class Randomization:
    """Draws the car of each episode, and disturbs its commands and observations.

    The values of an episode depend only on the seed, the car's number and the episode's number; the noise within it
    on the seed, the car's number and the steps since the seed was set. Without randomization nothing is drawn.

    Attributes:
        values: the values of the cars' episodes, columns `QUANTITIES`, (N, Q); float64 numbers that float32 holds
            exactly, so that the trace has the same values.
    """

    def __init__(
        self,
        configs: Sequence[RandomizationConfig],
        cars: Sequence[int],
        batch: CarBatch,
        features: Sequence[str],
        late_steps: NDArray[np.int64],
        most_late_steps: int,
    ):
        """Apply what is constant over all episodes; call `seed` and then `begin` next.

        Each car has its own ranges and its number over all processes; `features` names the observation's entries.
        Steering and speed commands reach the cars `late_steps` control steps later than the drawn delay, (2, N), at
        most `most_late_steps`. Later values of the array count.
        """
        ranges = np.array([[getattr(config, name) for name in QUANTITIES] for config in configs], np.float64)
        self._cars = list(cars)
        self._rows = np.arange(len(self._cars))
        self._low: Floats = ranges[..., 0]
        self._span: Floats = ranges[..., 1] - self._low
        # A quantity that is on for one car has no effect on cars with OFF values, which draw nothing.
        off = np.array(list(OFF.values()))[:, None]
        self._differs: NDArray[np.bool_] = (ranges != off).any(axis=(1, 2))
        self._on = {name for name, place in _COLUMN.items() if (ranges[:, place] != OFF[name]).any()}
        varying = {name for name, place in _COLUMN.items() if self._span[:, place].any()}
        # 0, 1 and 2 steps are drawn with equal probability.
        self._span[:, _COLUMN["action_delay_steps"]] += 1
        self.values: Floats = self._low.astype(np.float32).astype(np.float64)
        physics: dict[str, Callable[[Ids, Floats], None]] = {
            "friction_scale": batch.set_friction_scale,
            "mass_scale": batch.set_mass_scale,
            "motor_scale": batch.set_motor_scale,
            "servo_scale": batch.set_servo_scale,
        }
        for name in self._on & physics.keys():
            physics[name](self._rows, self._of(name))
        self._varying_physics = {name: apply for name, apply in physics.items() if name in varying}
        self._draws = bool(varying)
        self.dropped: NDArray[np.bool_] | None = None
        self._sag_steps = _SAG_S / batch.car.control_period_s
        self._measured = np.array([name not in _KNOWN for name in features], np.float64)
        self._first_noise: Floats = np.zeros((len(self._cars), len(features)))
        self._late_steps = late_steps
        slots = int(ranges[:, _COLUMN["action_delay_steps"], 1].max()) + most_late_steps + 1
        self._commands: Floats = np.zeros((slots, len(self._cars), 2))
        self._no_command_until = np.ones(len(self._cars), np.int64)

    def seed(self, seed: int) -> None:
        """Start all streams from `seed`."""
        self._seed = seed
        acts = self._on & {"steering_noise_deg", "speed_noise"}
        sees = self._on & {"observation_noise", "observation_dropout"}
        self._episodes = CarStreams(seed, self._cars, Purpose.EPISODE)
        drawing, width = np.flatnonzero(self._differs), 1 + len(self._measured)
        self._action = self._step_noise(seed, Purpose.ACTION, 2, drawing if acts else drawing[:0])
        self._observation = self._step_noise(seed, Purpose.OBSERVATION, width, drawing) if sees else None

    def state_dict(self) -> dict[str, Any]:
        """Return the values of the episodes, delayed commands, and the position of the noise."""
        return {
            "seed": self._seed,
            "values": self.values.copy(),
            "sent": self._commands.copy(),
            "deaf_until": self._no_command_until.copy(),
            "first_noise": self._first_noise.copy(),
            "action_steps": self._action.steps,
            "observation_steps": 0 if self._observation is None else self._observation.steps,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a `state_dict`, and apply its values to the cars' physics."""
        self.values = checked_array(state, "values", self.values.shape)
        self._commands = checked_array(state, "sent", self._commands.shape)
        self._no_command_until = checked_array(state, "deaf_until", self._no_command_until.shape)
        self._first_noise = checked_array(state, "first_noise", self._first_noise.shape)
        for name, apply in self._varying_physics.items():
            apply(self._rows, self._of(name))
        self.seed(state["seed"])
        self._action.steps = state["action_steps"]
        if self._observation is not None:
            self._observation.steps = state["observation_steps"]

    def begin(self, ids: Ids, episodes: NDArray[np.int64]) -> None:
        """Draw the values of new episodes of the cars `ids`; episodes are numbered per car from 0."""
        self._no_command_until[ids] = 1
        noisy = "observation_noise" in self._on
        if not (self._draws or noisy):
            return
        ids, episodes = ids[self._differs[ids]], episodes[self._differs[ids]]
        uniform = np.empty((len(ids), len(QUANTITIES)))
        for row, (place, episode) in enumerate(zip(ids.tolist(), episodes.tolist(), strict=True)):
            stream = self._episodes.stream(place, episode)
            # All quantities are drawn, so that switching one on does not change the others.
            stream.random(out=uniform[row])
            if noisy:
                stream.standard_normal(out=self._first_noise[place])
        drawn = self._low[ids] + self._span[ids] * uniform
        np.floor(drawn[:, _COLUMN["action_delay_steps"]], out=drawn[:, _COLUMN["action_delay_steps"]])
        self.values[ids] = drawn.astype(np.float32)
        for name, apply in self._varying_physics.items():
            apply(ids, self.values[ids, _COLUMN[name]])

    def disturb_commands(
        self, steering_deg: Floats, speed_mps: Floats, steps: NDArray[np.int64]
    ) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Return the commands that reach the cars after delay, sag, noise and offset.

        Commands and control steps of the episode, the prepare step being 1, are (N,) each.

        Returns:
            Steering, speed, and False for cars that no command has reached yet, each (N,).
        """
        noise, late = self._action.normal(), (self._late_steps, self._no_command_until)
        sent, drawn = (steering_deg, speed_mps), (self.values, _OF_COMMANDS)
        return _disturb_commands(sent, steps, drawn, noise, late, self._commands, self._sag_steps)

    def forget_commands(self, ids: Ids, steps: NDArray[np.int64]) -> None:
        """Drop delayed commands of the cars `ids` up to these steps, (n,); they stand still until a new one arrives."""
        self._no_command_until[ids] = np.maximum(steps, 1)  # the first is the prepare step

    def disturb_observation(
        self, features: NDArray[np.float32], before: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Return the observations for the current features, given those of the step before, each (N, F).

        `dropped` then says which cars see nothing new, (N,); it is None if no observation can be dropped.
        """
        if self._observation is None:
            return features
        observed, self.dropped = _disturb_observation(
            features, before, (self.values, _OF_OBSERVATION), self._measured, self._observation.normal()
        )
        return observed

    def disturb_first_observation(self, ids: Ids, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the first observations of the episodes of the cars `ids`, given their features, (n, F)."""
        if "observation_noise" not in self._on:
            return features
        return features + self._noise(ids, self._first_noise[ids])

    def _noise(self, ids: Ids, normal: Floats) -> NDArray[np.float32]:
        deviation = self.values[ids, _COLUMN["observation_noise"], None] * self._measured
        return np.asarray(deviation * normal, np.float32)

    def _step_noise(self, seed: int, purpose: Purpose, width: int, drawing: Ids) -> StepNoise:
        return StepNoise(CarStreams(seed, self._cars, purpose), len(self._cars), width, drawing)

    def _of(self, name: str) -> Floats:
        return self.values[:, _COLUMN[name]]


@compiled
def _disturb_commands(sent, steps, drawn, noise, late, commands, sag_steps):  # type: ignore[no-untyped-def]
    """Compute what `Randomization.disturb_commands` returns.

    Args:
        sent: steering and speed as sent, (N,) each.
        steps: control steps of the episodes, (N,).
        drawn: values of the episodes, (N, Q), and the columns `_OF_COMMANDS`.
        noise: standard normal numbers, (N, 2).
        late: steps by which steering and speed come later, (2, N), and those up to which commands are void, (N,).
        commands: changed: those of the last steps, (slots, N, 2).
        sag_steps: control steps over which the battery sags.
    """
    (steering_deg, speed_mps), (late_steps, void_until), slots = sent, late, len(commands)
    values, (delay, sag, offset, steering_noise, speed_noise) = drawn
    cars = len(steps)
    sent_deg, sent_mps, moving = np.empty(cars), np.empty(cars), np.empty(cars, np.bool_)
    for car in range(cars):
        step, of_car = steps[car], values[car]
        commands[step % slots, car, 0], commands[step % slots, car, 1] = steering_deg[car], speed_mps[car]
        steering_at = step - int(of_car[delay]) - late_steps[0, car]
        speed_at = step - int(of_car[delay]) - late_steps[1, car]
        # Commands of the last episode are void, and the speed may arrive before the steering.
        moving[car] = speed_at > void_until[car]
        deg = commands[steering_at % slots, car, 0] if steering_at > void_until[car] else 0.0
        mps = commands[speed_at % slots, car, 1]
        mps *= 1.0 - of_car[sag] * min(max((step - 2) / sag_steps, 0.0), 1.0)
        sent_deg[car] = deg + of_car[steering_noise] * noise[car, 0] + of_car[offset]
        sent_mps[car] = mps * (1.0 + of_car[speed_noise] * noise[car, 1])
    return sent_deg, sent_mps, moving


@compiled
def _disturb_observation(features, before, drawn, measured, normal):  # type: ignore[no-untyped-def]
    """Return the observations, (N, F) float32, and whether each car's is the one before, given 1 + F numbers a car.

    `drawn` are the values of the episodes, (N, Q), and the columns `_OF_OBSERVATION`; `measured` is 0 for features
    without noise, else 1, (F,).
    """
    values, (noise, dropout) = drawn
    observed, dropped = np.empty_like(features), np.empty(len(features), np.bool_)
    for car in range(len(features)):
        # The normal distribution's function makes it a number between 0 and 1, all equally likely.
        dropped[car] = 0.5 * math.erfc(-normal[car, 0] / math.sqrt(2.0)) < values[car, dropout]
        for n in range(features.shape[1]):
            added = values[car, noise] * measured[n] * normal[car, 1 + n]
            observed[car, n] = before[car, n] if dropped[car] else features[car, n] + np.float32(added)
    return observed, dropped
