"""model_metadata.json: what a DeepRacer model may do and what it sees."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from deepracer_exp.errors import BadInput, nearest

CAMERAS = ("observation", "FRONT_FACING_CAMERA", "LEFT_CAMERA", "STEREO_CAMERAS")
LIDARS = ("LIDAR", "SECTOR_LIDAR", "DISCRETIZED_SECTOR_LIDAR")
NEURAL_NETWORKS = (
    "DEEP_CONVOLUTIONAL_NETWORK_SHALLOW",
    "DEEP_CONVOLUTIONAL_NETWORK",
    "DEEP_CONVOLUTIONAL_NETWORK_DEEP",
)
VERSIONS = range(1, 7)
MAX_STEERING_DEG = 60.0
MAX_SPEED_MPS = 10.0
LIDAR_SAMPLES = 64
"""Rays of the service's lidar; its sectors divide them evenly."""
MAX_LIDAR_VALUES = 1000
"""The service names no upper bound; beyond this a file is a mistake."""


class Action(NamedTuple):
    """A steering angle in degrees, positive to the left, and a speed in metres per second."""

    steering_deg: float
    speed_mps: float


@dataclass(frozen=True, kw_only=True)
class LidarConfig:
    """Resolution and reach of the discretised sector lidar."""

    num_sectors: int = 8
    num_values_per_sector: int = 8
    clipping_dist_m: float = 2.0


@dataclass(frozen=True, kw_only=True)
class ModelMetadata:
    """One model_metadata.json with every default filled in.

    `actions` lists the choices of a discrete space (the position is the action's number; `index` keys
    are ignored, as the service does) and is empty for a continuous one, whose `low` and `high` are set.
    """

    action_space_type: Literal["discrete", "continuous"]
    actions: tuple[Action, ...]
    low: Action | None
    high: Action | None
    sensor: tuple[str, ...]
    neural_network: str
    version: int
    training_algorithm: str
    lidar_config: LidarConfig


def read_model_metadata(path: str | Path) -> ModelMetadata:
    """Read a model_metadata.json of any version from 1 to 6.

    Missing keys get the service's defaults, numbers may be written as strings, unknown keys are ignored.

    Raises:
        BadInput: the file cannot be read or holds something the service would not accept; one line with
            file, key, value and what would be accepted.

    Source of the rules: deepracer-simapp, markov/boto/s3/files/model_metadata.py.
    """
    return _Reader(Path(path)).read()


class _Reader:
    """Turns the JSON of one file into a `ModelMetadata`, naming the file in every complaint."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> ModelMetadata:
        data = self._load()
        kind = self._choice(data, "action_space_type", ("discrete", "continuous"), "discrete")
        algorithm = self._choice(data, "training_algorithm", ("clipped_ppo", "sac"), "clipped_ppo")
        if algorithm == "sac" and kind == "discrete":
            raise self._bad(
                "training_algorithm",
                "sac",
                'clipped_ppo, or action_space_type "continuous": SAC cannot choose among discrete actions',
            )
        if "action_space" not in data:
            raise self._bad("action_space", None, 'a list of {"steering_angle": deg, "speed": m/s}')
        space = data["action_space"]
        actions: tuple[Action, ...] = ()
        low = high = None
        if kind == "discrete":
            actions = self._actions(space)
        else:
            low, high = self._ranges(space)
        version, sensor = self._version_and_sensor(data)
        return ModelMetadata(
            action_space_type="discrete" if kind == "discrete" else "continuous",
            actions=actions,
            low=low,
            high=high,
            sensor=sensor,
            neural_network=self._choice(data, "neural_network", NEURAL_NETWORKS, NEURAL_NETWORKS[0]),
            version=version,
            training_algorithm=algorithm,
            lidar_config=self._lidar_config(data),
        )

    def _bad(self, key: str, value: object, accepted: str) -> BadInput:
        shown = "missing" if value is None else json.dumps(value, ensure_ascii=False, default=repr)
        shown = shown if len(shown) <= 80 else shown[:79] + "…"
        return BadInput(f"{self.path}: {key}: {shown}; accepted: {accepted}")

    def _load(self) -> Mapping[str, Any]:
        try:
            # Editors on Windows put a byte order mark before the JSON.
            data = json.loads(self.path.read_text(encoding="utf-8-sig"))
        except OSError as error:
            raise BadInput(
                f"{self.path}: cannot be read ({error.strerror}); accepted: a model_metadata.json"
            ) from error
        except (ValueError, RecursionError) as error:
            reason = " ".join(str(error).split())
            raise BadInput(f"{self.path}: not JSON ({reason}); accepted: a model_metadata.json") from error
        if not isinstance(data, dict):
            raise BadInput(
                f"{self.path}: holds a {type(data).__name__}; accepted: a JSON object with action_space"
            )
        return data

    def _choice(self, data: Mapping[str, Any], key: str, known: Sequence[str], default: str) -> str:
        value = data.get(key)
        if value is None:
            return default
        accepted = ", ".join(known)
        if not isinstance(value, str):
            raise self._bad(key, value, accepted)
        # Only the two lower-case keys are normalised by the service; networks are upper case there.
        word = value.strip() if key == "neural_network" else value.strip().lower()
        if word not in known:
            raise self._bad(key, value, accepted + nearest(word, known))
        return word

    def _number(self, key: str, value: object, low: float, high: float, unit: str = "") -> float:
        accepted = f"a number from {low:g} to {high:g}{unit}"
        if isinstance(value, bool) or not isinstance(value, (int, float, str)):
            raise self._bad(key, value, accepted)
        try:
            number = float(value)
        except (ValueError, OverflowError) as error:
            raise self._bad(key, value, accepted) from error
        if not math.isfinite(number) or not low <= number <= high:
            raise self._bad(key, value, accepted)
        return number

    def _whole(self, key: str, value: object, low: int, high: int) -> int:
        number = self._number(key, value, low, high)
        if number != int(number):
            raise self._bad(key, value, f"a whole number from {low} to {high}")
        return int(number)

    def _steering(self, key: str, value: object) -> float:
        return self._number(key, value, -MAX_STEERING_DEG, MAX_STEERING_DEG, " degrees")

    def _speed(self, key: str, value: object) -> float:
        return self._number(key, value, 0.0, MAX_SPEED_MPS, " m/s")

    def _actions(self, space: object) -> tuple[Action, ...]:
        accepted = 'a list of {"steering_angle": deg, "speed": m/s} for a discrete space'
        if not isinstance(space, list) or not space:
            raise self._bad("action_space", space, accepted)
        actions = []
        for number, item in enumerate(space):
            key = f"action_space[{number}]"
            if not isinstance(item, dict):
                raise self._bad(key, item, '{"steering_angle": deg, "speed": m/s}')
            steering = self._steering(f"{key}.steering_angle", item.get("steering_angle"))
            actions.append(Action(steering, self._speed(f"{key}.speed", item.get("speed"))))
        return tuple(actions)

    def _ranges(self, space: object) -> tuple[Action, Action]:
        if not isinstance(space, dict):
            raise self._bad(
                "action_space",
                space,
                '{"steering_angle": {"low", "high"}, "speed": {"low", "high"}} for a continuous space',
            )
        low_deg, high_deg = self._range(space, "steering_angle", self._steering)
        low_mps, high_mps = self._range(space, "speed", self._speed)
        return Action(low_deg, low_mps), Action(high_deg, high_mps)

    def _range(self, space: Mapping[str, Any], key: str, number: Any) -> tuple[float, float]:
        name = f"action_space.{key}"
        bounds = space.get(key)
        if not isinstance(bounds, dict):
            raise self._bad(name, bounds, '{"low": number, "high": number}')
        low = number(f"{name}.low", bounds.get("low"))
        high = number(f"{name}.high", bounds.get("high"))
        if low > high:
            raise self._bad(name, bounds, f"low {low:g} not above high {high:g}")
        return low, high

    def _version_and_sensor(self, data: Mapping[str, Any]) -> tuple[int, tuple[str, ...]]:
        default = 1 if data.get("sensor") is None else 2
        version = default
        if data.get("version") is not None:
            version = self._whole("version", data["version"], VERSIONS[0], VERSIONS[-1])
        if version == 1 or data.get("sensor") is None:
            return version, ("observation",)
        sensor = data["sensor"]
        known = (*CAMERAS, *LIDARS)
        accepted = f"a list with one of {', '.join(CAMERAS)} and at most one of {', '.join(LIDARS)}"
        if not isinstance(sensor, list) or not all(isinstance(name, str) for name in sensor):
            raise self._bad("sensor", sensor, accepted)
        for name in sensor:
            if name not in known:
                raise self._bad("sensor", name, accepted + nearest(name, known))
        if sum(name in CAMERAS for name in sensor) != 1 or sum(name in LIDARS for name in sensor) > 1:
            raise self._bad("sensor", sensor, accepted)
        return version, tuple(sensor)

    def _lidar_config(self, data: Mapping[str, Any]) -> LidarConfig:
        given = data.get("lidar_config")
        default = LidarConfig()
        if given is None:
            return default
        if not isinstance(given, dict):
            raise self._bad(
                "lidar_config", given, '{"num_sectors", "num_values_per_sector", "clipping_dist"}'
            )
        sectors = self._whole(
            "lidar_config.num_sectors", given.get("num_sectors", default.num_sectors), 1, LIDAR_SAMPLES
        )
        if LIDAR_SAMPLES % sectors:
            raise self._bad("lidar_config.num_sectors", sectors, f"a divisor of {LIDAR_SAMPLES}")
        values = self._whole(
            "lidar_config.num_values_per_sector",
            given.get("num_values_per_sector", default.num_values_per_sector),
            1,
            MAX_LIDAR_VALUES,
        )
        distance_m = self._number(
            "lidar_config.clipping_dist",
            given.get("clipping_dist", default.clipping_dist_m),
            0.15,
            12.0,
            " m",
        )
        return LidarConfig(num_sectors=sectors, num_values_per_sector=values, clipping_dist_m=distance_m)
