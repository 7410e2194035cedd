"""model_metadata.json: the action space and sensors of a DeepRacer model."""

import json
from collections.abc import Callable
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
MAX_STEERING_DEG = 60.0
MAX_SPEED_MPS = 10.0
MAX_ACTIONS = 1000
"""The console accepts 30; a larger number is a mistake."""
KEYS = (
    *("action_space", "action_space_type", "training_algorithm", "sensor"),
    *("neural_network", "version", "lidar_config"),
)


class Action(NamedTuple):
    """A steering angle in degrees, positive to the left, and a speed in metres per second."""

    steering_deg: float
    speed_mps: float


class LidarSectors(NamedTuple):
    """The sectors of a DISCRETIZED_SECTOR_LIDAR; `clipping_dist` in metres."""

    num_sectors: int = 8
    num_values_per_sector: int = 8
    clipping_dist: float = 2.0


SERVICES_SECTORS = LidarSectors()


@dataclass(frozen=True, kw_only=True)
class ModelMetadata:
    """One model_metadata.json with every default filled in.

    `actions` lists the choices of a discrete space (the position is the action's number; `index` keys
    are ignored, as the service does) and is empty for a continuous one, whose `low` and `high` are set.
    """

    actions: tuple[Action, ...] = ()
    low: Action | None = None
    high: Action | None = None
    sensor: tuple[str, ...] = ("FRONT_FACING_CAMERA",)
    neural_network: str = NEURAL_NETWORKS[0]
    version: int = 5
    """Version of the simulator; 5 is the newest that deepracer-for-cloud writes."""
    training_algorithm: str = "clipped_ppo"
    lidar_config: LidarSectors = SERVICES_SECTORS
    set_keys: tuple[str, ...] = field(default=(), compare=False)
    """Keys of the file, in its order; the service ignores those not in KEYS."""
    renumbered: bool = field(default=False, compare=False)
    """Whether the `index` of an action differs from its position; the position counts."""

    @property
    def action_space_type(self) -> Literal["discrete", "continuous"]:
        """Return the service's word for the kind of action space."""
        return "discrete" if self.low is None else "continuous"


def read_model_metadata(path: str | Path, raw: bytes | None = None) -> ModelMetadata:
    """Read a model_metadata.json of any version from 1 to 6.

    `raw` is the file's content if known.

    Missing keys get the service's defaults, numbers may be written as strings, unknown keys are ignored.

    Raises:
        BadInput: the file cannot be read or holds something the service would not accept; one line with file, key,
            value and accepted values.

    Source of the rules: deepracer-simapp, markov/boto/s3/files/model_metadata.py.
    """
    file = JsonObject(path, "a model_metadata.json", "a JSON object with action_space", raw)
    data = file.data

    def choice(key: str, options: tuple[str, ...], lower: bool = True) -> str:
        value = data.get(key)
        return options[0] if value is None else file.choice(key, value, options, lower)

    kind = choice("action_space_type", ("discrete", "continuous"))
    algorithm = choice("training_algorithm", ("clipped_ppo", "sac"))
    if algorithm == "sac" and kind == "discrete":
        accepted = 'clipped_ppo, or action_space_type "continuous": SAC has no discrete actions'
        raise file.bad("training_algorithm", "sac", accepted)
    space = data.get("action_space")
    actions: tuple[Action, ...] = ()
    low = high = None
    if kind == "discrete":
        actions = _actions(file, space)
    else:
        low, high = _ranges(file, space)
    version, sensor = _version_and_sensor(file)
    return ModelMetadata(
        actions=actions,
        low=low,
        high=high,
        sensor=sensor,
        # The service lower-cases only the two keys above; names of networks are upper case.
        neural_network=choice("neural_network", NEURAL_NETWORKS, lower=False),
        version=version,
        training_algorithm=algorithm,
        lidar_config=_lidar_config(file) if set(sensor) & set(LIDARS) else SERVICES_SECTORS,
        set_keys=tuple(data),
        renumbered=isinstance(space, list)
        and any(str(item.get("index", number)) != str(number) for number, item in enumerate(space)),
    )


def _steering(file: JsonObject, key: str, value: object) -> float:
    return file.number(key, value, -MAX_STEERING_DEG, MAX_STEERING_DEG, " degrees")


def _speed(file: JsonObject, key: str, value: object) -> float:
    return file.number(key, value, 0.0, MAX_SPEED_MPS, " m/s")


def _actions(file: JsonObject, space: object) -> tuple[Action, ...]:
    accepted = '{"steering_angle": deg, "speed": m/s}'
    if not isinstance(space, list) or not space:
        raise file.bad("action_space", space, f"a list of {accepted} for a discrete space")
    if len(space) > MAX_ACTIONS:
        raise file.bad("action_space", f"{len(space)} actions", f"at most {MAX_ACTIONS}")
    actions = []
    for number, item in enumerate(space):
        key = f"action_space[{number}]"
        if not isinstance(item, dict):
            raise file.bad(key, item, accepted)
        steering = _steering(file, f"{key}.steering_angle", item.get("steering_angle"))
        actions.append(Action(steering, _speed(file, f"{key}.speed", item.get("speed"))))
    return tuple(actions)


def _ranges(file: JsonObject, space: object) -> tuple[Action, Action]:
    accepted = '{"steering_angle": {"low", "high"}, "speed": {"low", "high"}} for a continuous space'
    if not isinstance(space, dict):
        raise file.bad("action_space", space, accepted)

    def bounds(key: str, number: Callable[[JsonObject, str, object], float]) -> tuple[float, float]:
        name, value = f"action_space.{key}", space.get(key)
        if not isinstance(value, dict):
            raise file.bad(name, value, '{"low": number, "high": number}')
        low = number(file, f"{name}.low", value.get("low"))
        high = number(file, f"{name}.high", value.get("high"))
        if low > high:
            raise file.bad(name, value, f"low {low:g} not above high {high:g}")
        return low, high

    steering, speed = bounds("steering_angle", _steering), bounds("speed", _speed)
    return Action(steering[0], speed[0]), Action(steering[1], speed[1])


def _version_and_sensor(file: JsonObject) -> tuple[int, tuple[str, ...]]:
    sensor, version = file.data.get("sensor"), file.data.get("version")
    if version is None:
        version = 1 if sensor is None else 2
    version = file.whole("version", version, 1, 6)
    if version == 1 or sensor is None:
        return version, ("observation",)
    sensors_accepted = (*CAMERAS, *LIDARS)
    accepted = f"a list with one of {', '.join(CAMERAS)} and at most one of {', '.join(LIDARS)}"
    if not isinstance(sensor, list) or not all(isinstance(name, str) for name in sensor):
        raise file.bad("sensor", sensor, accepted)
    for name in sensor:
        if name not in sensors_accepted:
            raise file.bad("sensor", name, accepted + nearest(name, sensors_accepted))
    if sum(name in CAMERAS for name in sensor) != 1 or sum(name in LIDARS for name in sensor) > 1:
        raise file.bad("sensor", sensor, accepted)
    return version, tuple(sensor)


def _lidar_config(file: JsonObject) -> LidarSectors:
    config = file.data.get("lidar_config", {})
    if not isinstance(config, dict):
        raise file.bad("lidar_config", config, "an object with " + ", ".join(LidarSectors._fields))
    values = SERVICES_SECTORS._asdict() | config
    sectors, many, clip_m = (values[key] for key in LidarSectors._fields)
    sectors = file.whole("lidar_config.num_sectors", sectors, 1, 64)
    if 64 % sectors:
        raise file.bad("lidar_config.num_sectors", sectors, "a number that divides the 64 rays")
    many = file.whole("lidar_config.num_values_per_sector", many, 1, 64)
    return LidarSectors(sectors, many, file.number("lidar_config.clipping_dist", clip_m, 0.15, 12.0, " m"))


def model_metadata_text(metadata: ModelMetadata) -> str:
    """Return the text of a model_metadata.json, which `read_model_metadata` reads back unchanged."""
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
    if "DISCRETIZED_SECTOR_LIDAR" in metadata.sensor:
        values["lidar_config"] = metadata.lidar_config._asdict()
    return json.dumps(values, indent=2) + "\n"


CONSOLE_ACTIONS = (2, 30)
CONSOLE_STEERING_DEG = (-30.0, 30.0)
CONSOLE_SPEED_MPS = {"discrete": (0.1, 4.0), "continuous": (0.5, 4.0)}


def beyond_console(metadata: ModelMetadata) -> list[str]:
    """Return a line on each property of an action space that the AWS console does not accept."""
    ends = (*metadata.actions, *(end for end in (metadata.low, metadata.high) if end is not None))
    notes = []
    fewest, most = CONSOLE_ACTIONS
    if metadata.actions and not fewest <= len(metadata.actions) <= most:
        notes.append(
            f"model_metadata.json: {len(metadata.actions)} actions; the AWS console accepts {fewest} to {most}"
        )
    for name, values, (low, high) in (
        ("steering_angle", [end.steering_deg for end in ends], CONSOLE_STEERING_DEG),
        ("speed", [end.speed_mps for end in ends], CONSOLE_SPEED_MPS[metadata.action_space_type]),
    ):
        if min(values) < low or max(values) > high:
            notes.append(
                f"model_metadata.json: {name} from {min(values):g} to {max(values):g}; the AWS console accepts "
                f"{low:g} to {high:g}"
            )
    return notes
