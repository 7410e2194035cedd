"""model_metadata.json: the action space and sensors of a DeepRacer model."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

from deepracer_exp.errors import nearest

from .json_object import JsonObject

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
"""The service has no upper bound; a larger number is a mistake."""
MAX_ACTIONS = 1000
"""The console accepts 30; a larger number is a mistake."""
KEYS = (
    "action_space",
    "action_space_type",
    "training_algorithm",
    "sensor",
    "neural_network",
    "version",
    "lidar_config",
)


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
    given: tuple[str, ...] = field(compare=False)
    """Keys of the file, in its order; the service ignores those not in KEYS."""
    renumbered: bool = field(compare=False)
    """Whether the `index` of an action differs from its position; the position counts."""


def read_model_metadata(path: str | Path, raw: bytes | None = None) -> ModelMetadata:
    """Read a model_metadata.json of any version from 1 to 6.

    Missing keys get the service's defaults, numbers may be written as strings, unknown keys are ignored.

    Args:
        path: the file.
        raw: the file's content if known.

    Raises:
        BadInput: the file cannot be read or holds something the service would not accept; one line with
            file, key, value and what would be accepted.

    Source of the rules: deepracer-simapp, markov/boto/s3/files/model_metadata.py.
    """
    return _Reader(path, raw).read()


class _Reader:
    """Turns the JSON of one file into a `ModelMetadata`; every error names the file."""

    def __init__(self, path: str | Path, raw: bytes | None) -> None:
        self.json = JsonObject(path, "a model_metadata.json", "a JSON object with action_space", raw)

    def read(self) -> ModelMetadata:
        data = self.json.data
        kind = self._choice("action_space_type", ("discrete", "continuous"))
        algorithm = self._choice("training_algorithm", ("clipped_ppo", "sac"))
        if algorithm == "sac" and kind == "discrete":
            raise self.json.bad(
                "training_algorithm",
                "sac",
                'clipped_ppo, or action_space_type "continuous": SAC has no discrete actions',
            )
        if "action_space" not in data:
            raise self.json.bad("action_space", None, 'a list of {"steering_angle": deg, "speed": m/s}')
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
            # The service lower-cases only the two keys above; names of networks are upper case.
            neural_network=self._choice("neural_network", NEURAL_NETWORKS, lower=False),
            version=version,
            training_algorithm=algorithm,
            lidar_config=self._lidar_config(data),
            given=tuple(data),
            renumbered=kind == "discrete"
            and any(str(item.get("index", number)) != str(number) for number, item in enumerate(space)),
        )

    def _choice(self, key: str, known: tuple[str, ...], lower: bool = True) -> str:
        """Return the file's choice, or the first one by default."""
        value = self.json.data.get(key)
        return known[0] if value is None else self.json.choice(key, value, known, lower)

    def _steering(self, key: str, value: object) -> float:
        return self.json.number(key, value, -MAX_STEERING_DEG, MAX_STEERING_DEG, " degrees")

    def _speed(self, key: str, value: object) -> float:
        return self.json.number(key, value, 0.0, MAX_SPEED_MPS, " m/s")

    def _actions(self, space: object) -> tuple[Action, ...]:
        accepted = 'a list of {"steering_angle": deg, "speed": m/s} for a discrete space'
        if not isinstance(space, list) or not space:
            raise self.json.bad("action_space", space, accepted)
        if len(space) > MAX_ACTIONS:
            raise self.json.bad("action_space", f"{len(space)} actions", f"at most {MAX_ACTIONS}")
        actions = []
        for number, item in enumerate(space):
            key = f"action_space[{number}]"
            if not isinstance(item, dict):
                raise self.json.bad(key, item, '{"steering_angle": deg, "speed": m/s}')
            steering = self._steering(f"{key}.steering_angle", item.get("steering_angle"))
            actions.append(Action(steering, self._speed(f"{key}.speed", item.get("speed"))))
        return tuple(actions)

    def _ranges(self, space: object) -> tuple[Action, Action]:
        if not isinstance(space, dict):
            raise self.json.bad(
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
            raise self.json.bad(name, bounds, '{"low": number, "high": number}')
        low = number(f"{name}.low", bounds.get("low"))
        high = number(f"{name}.high", bounds.get("high"))
        if low > high:
            raise self.json.bad(name, bounds, f"low {low:g} not above high {high:g}")
        return low, high

    def _version_and_sensor(self, data: Mapping[str, Any]) -> tuple[int, tuple[str, ...]]:
        default = 1 if data.get("sensor") is None else 2
        version = default
        if data.get("version") is not None:
            version = self.json.whole("version", data["version"], VERSIONS[0], VERSIONS[-1])
        if version == 1 or data.get("sensor") is None:
            return version, ("observation",)
        sensor = data["sensor"]
        known = (*CAMERAS, *LIDARS)
        accepted = f"a list with one of {', '.join(CAMERAS)} and at most one of {', '.join(LIDARS)}"
        if not isinstance(sensor, list) or not all(isinstance(name, str) for name in sensor):
            raise self.json.bad("sensor", sensor, accepted)
        for name in sensor:
            if name not in known:
                raise self.json.bad("sensor", name, accepted + nearest(name, known))
        if sum(name in CAMERAS for name in sensor) != 1 or sum(name in LIDARS for name in sensor) > 1:
            raise self.json.bad("sensor", sensor, accepted)
        return version, tuple(sensor)

    def _lidar_config(self, data: Mapping[str, Any]) -> LidarConfig:
        given = data.get("lidar_config")
        default = LidarConfig()
        if given is None:
            return default
        if not isinstance(given, dict):
            raise self.json.bad(
                "lidar_config", given, '{"num_sectors", "num_values_per_sector", "clipping_dist"}'
            )
        sectors = self.json.whole(
            "lidar_config.num_sectors", given.get("num_sectors", default.num_sectors), 1, LIDAR_SAMPLES
        )
        if LIDAR_SAMPLES % sectors:
            raise self.json.bad("lidar_config.num_sectors", sectors, f"a divisor of {LIDAR_SAMPLES}")
        values = self.json.whole(
            "lidar_config.num_values_per_sector",
            given.get("num_values_per_sector", default.num_values_per_sector),
            1,
            MAX_LIDAR_VALUES,
        )
        distance_m = self.json.number(
            "lidar_config.clipping_dist",
            given.get("clipping_dist", default.clipping_dist_m),
            0.15,
            12.0,
            " m",
        )
        return LidarConfig(num_sectors=sectors, num_values_per_sector=values, clipping_dist_m=distance_m)


def model_metadata_text(metadata: ModelMetadata) -> str:
    """Return the text of a model_metadata.json; `read_model_metadata` gives the same again."""
    if metadata.low is not None and metadata.high is not None:
        bounds = zip(("steering_angle", "speed"), metadata.low, metadata.high, strict=True)
        space: Any = {key: {"low": low, "high": high} for key, low, high in bounds}
    else:
        space = [
            {"steering_angle": action.steering_deg, "speed": action.speed_mps, "index": number}
            for number, action in enumerate(metadata.actions)
        ]
    values: dict[str, Any] = {
        "action_space": space,
        "sensor": list(metadata.sensor),
        "neural_network": metadata.neural_network,
        "training_algorithm": metadata.training_algorithm,
        "action_space_type": metadata.action_space_type,
        "version": str(metadata.version),
    }
    if any(sensor in LIDARS for sensor in metadata.sensor):
        lidar = metadata.lidar_config
        values["lidar_config"] = {
            "num_sectors": lidar.num_sectors,
            "num_values_per_sector": lidar.num_values_per_sector,
            "clipping_dist": lidar.clipping_dist_m,
        }
    return json.dumps(values, indent=2) + "\n"
