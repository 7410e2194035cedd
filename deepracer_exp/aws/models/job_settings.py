"""run.env and training_params.yaml: track, starts and opponents of a training on the service."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from deepracer_exp.errors import BadInput, nearest
from deepracer_exp.files import read_text, read_yaml

ENV_KEYS = {
    "WORLD_NAME": "DR_WORLD_NAME",
    "RACE_TYPE": "DR_RACE_TYPE",
    "REVERSE_DIR": "DR_TRAIN_REVERSE_DIRECTION",
    "ALTERNATE_DRIVING_DIRECTION": "DR_TRAIN_ALTERNATE_DRIVING_DIRECTION",
    "CHANGE_START_POSITION": "DR_TRAIN_CHANGE_START_POSITION",
    "ROUND_ROBIN_ADVANCE_DIST": "DR_TRAIN_ROUND_ROBIN_ADVANCE_DIST",
    "START_POSITION_OFFSET": "DR_TRAIN_START_POSITION_OFFSET",
    "ENABLE_DOMAIN_RANDOMIZATION": "DR_ENABLE_DOMAIN_RANDOMIZATION",
    "MULTI_CONFIG": "DR_TRAIN_MULTI_CONFIG",
    "PRETRAINED": "DR_LOCAL_S3_PRETRAINED",
}
"""Keys of training_params.yaml that decide a training, and deepracer-for-cloud's for the same values.

The last two are of run.env alone.
"""
_OLD_ENV_KEYS = {
    "DR_CHANGE_START_POSITION": "DR_TRAIN_CHANGE_START_POSITION",
    "DR_ALTERNATE_DRIVING_DIRECTION": "DR_TRAIN_ALTERNATE_DRIVING_DIRECTION",
}
"""Keys of earlier versions of deepracer-for-cloud, which it still reads, and those that took their place."""
OA_KEYS = {
    "NUMBER_OF_OBSTACLES": "DR_OA_NUMBER_OF_OBSTACLES",
    "MIN_DISTANCE_BETWEEN_OBSTACLES": "DR_OA_MIN_DISTANCE_BETWEEN_OBSTACLES",
    "RANDOMIZE_OBSTACLE_LOCATIONS": "DR_OA_RANDOMIZE_OBSTACLE_LOCATIONS",
    "IS_OBSTACLE_BOT_CAR": "DR_OA_IS_OBSTACLE_BOT_CAR",
    "OBSTACLE_TYPE": "DR_OA_OBSTACLE_TYPE",
    "OBJECT_POSITIONS": "DR_OA_OBJECT_POSITIONS",
}
H2B_KEYS = {
    "NUMBER_OF_BOT_CARS": "DR_H2B_NUMBER_OF_BOT_CARS",
    "MIN_DISTANCE_BETWEEN_BOT_CARS": "DR_H2B_MIN_DISTANCE_BETWEEN_BOT_CARS",
    "RANDOMIZE_BOT_CAR_LOCATIONS": "DR_H2B_RANDOMIZE_BOT_CAR_LOCATIONS",
    "BOT_CAR_SPEED": "DR_H2B_BOT_CAR_SPEED",
    "IS_LANE_CHANGE": "DR_H2B_IS_LANE_CHANGE",
    "LOWER_LANE_CHANGE_TIME": "DR_H2B_LOWER_LANE_CHANGE_TIME",
    "UPPER_LANE_CHANGE_TIME": "DR_H2B_UPPER_LANE_CHANGE_TIME",
    "LANE_CHANGE_DISTANCE": "DR_H2B_LANE_CHANGE_DISTANCE",
    "PENALTY_SECONDS": "DR_H2B_BOT_CAR_PENALTY",
}
"""Keys of training_params.yaml about boxes and bots, and deepracer-for-cloud's for the same values."""
RACE_TYPES = ("TIME_TRIAL", "OBJECT_AVOIDANCE", "HEAD_TO_BOT", "HEAD_TO_MODEL", "HEAD_TO_HEAD_RACING", "F1")
FILE_KEYS = {
    "reward_function.py": "DR_LOCAL_S3_REWARD_KEY",
    "model_metadata.json": "DR_LOCAL_S3_MODEL_METADATA_KEY",
    "hyperparameters.json": "DR_LOCAL_S3_HYPERPARAMETERS_KEY",
}
"""Keys of run.env that choose the three files of a model."""
_LINE = re.compile(r"(?:export\s+)?([A-Za-z_]\w*)=(.*)")
_TRUE, _FALSE = ("true", "t", "yes", "y", "on", "1"), ("false", "f", "no", "n", "off", "0", "")


@dataclass(frozen=True, kw_only=True)
class JobSettings:
    """The task of the first simulation worker of the service; None where the file does not say."""

    file: str
    """Path of the file."""
    keys: Mapping[str, str]
    """The file's names for the keys of training_params.yaml."""
    set_keys: tuple[str, ...]
    """The file's own keys, in its order."""
    world: str | None
    is_clockwise: bool | None
    """Direction whose world is used, where a track has one for each direction (deepracer-on-aws)."""
    race_type: str
    reverse: bool | None
    alternate: bool | None
    changes_start: bool | None
    start_advance: float | None
    """Share of the lap by which the start advances after an episode."""
    start_offset: float | None
    """Share of the lap at which the first episode starts."""
    randomizes: bool
    has_several: bool
    """Whether further workers have settings of their own."""
    is_pretrained: bool
    """Whether the training continues that of another model (run.env)."""
    is_env: bool
    """Whether the file is of deepracer-for-cloud, which reads keys about boxes and bots by the type of the race."""
    race: Mapping[str, str]
    """Values about boxes and bots, by the keys `OA_KEYS` and `H2B_KEYS`, as they stand there."""
    files: Mapping[str, str]
    """Names of the three files of a model where run.env chooses others than the usual ones."""

    @property
    def name(self) -> str:
        """Return the file's name."""
        return Path(self.file).name


def read_run_env(path: str) -> JobSettings:
    """Read deepracer-for-cloud's run.env.

    Raises:
        BadInput: the file cannot be read or has a value that the service does not accept.

    Source of the rules: deepracer-for-cloud, scripts/training/prepare-config.py.
    """
    values = _read_env(path)
    for old, key in _OLD_ENV_KEYS.items():
        if old in values:
            values.setdefault(key, values.pop(old))
    return _settings(path, values, ENV_KEYS, tuple(values))


def read_training_params(path: str) -> JobSettings:
    """Read the training_params.yaml of a trained model; of a list with a value for each worker the first counts.

    Raises:
        BadInput: as for `read_run_env`.
    """
    accepted = "parameters of a training, KEY: VALUE"
    data = read_yaml(path, accepted)
    if not isinstance(data, dict):
        raise BadInput(path, "holds no keys", accepted)
    lists = {str(key): value if isinstance(value, list) else [value] for key, value in data.items()}
    values = {key: str(value[0]) for key, value in lists.items() if value and value[0] is not None}
    several = any(len(lists.get(key, ())) > 1 for key in ENV_KEYS)
    settings = _settings(path, values | race_values(data), {key: key for key in ENV_KEYS}, tuple(lists))
    return replace(settings, has_several=several)


def race_values(params: Mapping[object, object]) -> dict[str, str]:
    """Return the values about boxes and bots of the first worker of a training_params.yaml, as they stand there."""
    values = {}
    for key in (*OA_KEYS, *H2B_KEYS):
        value = params.get(key)
        if isinstance(value, list):
            many = key == "OBJECT_POSITIONS" and not any(isinstance(part, list) for part in value)
            value = value if many else next(iter(value), None)
        if value is not None:
            values[key] = ";".join(map(str, value)) if isinstance(value, list) else str(value)
    return values


def _read_env(path: str) -> dict[str, str]:
    accepted = "lines KEY=VALUE and comments (#)"
    values = {}
    for number, line in enumerate(read_text(path, accepted).splitlines(), 1):
        if not (text := line.strip()) or text.startswith("#"):
            continue
        if (match := _LINE.fullmatch(text)) is None:
            raise BadInput(path, f"line {number}: {text[:80]}", accepted)
        value = match[2].strip()
        quoted = re.match(r"""(["'])(.*?)\1""", value)
        # A shell ends an unquoted value at a blank.
        values[match[1]] = quoted[2] if quoted else (value.split() or [""])[0]
    return values


def _settings(
    path: str, values: Mapping[str, str], keys: Mapping[str, str], set_keys: tuple[str, ...]
) -> JobSettings:
    def truth(key: str) -> bool | None:
        if (word := values.get(keys.get(key, key))) is None:
            return None
        if word.lower() not in (*_TRUE, *_FALSE):
            raise BadInput(path, f"{keys.get(key, key)}={word[:80]}", "True, False")
        return word.lower() in _TRUE

    def share(key: str) -> float | None:
        if (word := values.get(keys[key])) is None:
            return None
        try:
            number = float(word)
        except ValueError:
            number = -1.0
        if not 0.0 <= number <= 1.0:
            raise BadInput(path, f"{keys[key]}={word[:80]}", "a share of the lap, 0 to 1")
        return number

    race_type = values.get(keys["RACE_TYPE"], RACE_TYPES[0]).upper()
    if race_type not in RACE_TYPES:
        accepted = ", ".join(RACE_TYPES)
        raise BadInput(
            path, f"{keys['RACE_TYPE']}={race_type[:80]}", f"{accepted}{nearest(race_type, RACE_TYPES)}"
        )
    return JobSettings(
        file=path,
        keys=keys,
        set_keys=set_keys,
        world=values.get(keys["WORLD_NAME"]) or None,
        is_clockwise=truth("TRACK_DIRECTION_CLOCKWISE"),
        race_type=race_type,
        reverse=truth("REVERSE_DIR"),
        alternate=truth("ALTERNATE_DRIVING_DIRECTION"),
        changes_start=truth("CHANGE_START_POSITION"),
        start_advance=share("ROUND_ROBIN_ADVANCE_DIST"),
        start_offset=share("START_POSITION_OFFSET"),
        randomizes=bool(truth("ENABLE_DOMAIN_RANDOMIZATION")),
        has_several=bool(truth("MULTI_CONFIG")),
        is_pretrained=bool(truth("PRETRAINED")),
        is_env=keys is ENV_KEYS,
        race={
            name: values[key]
            for name, env_key in (OA_KEYS | H2B_KEYS).items()
            if (key := env_key if keys is ENV_KEYS else name) in values
        },
        # A key in an S3 bucket, often with a variable in front: $DR_LOCAL_S3_CUSTOM_FILES_PREFIX/reward_function.py.
        files={
            name: match[0]
            for name, key in FILE_KEYS.items()
            if (match := re.search(r"[A-Za-z0-9][\w.-]*\.(py|json)$", values.get(key, "")))
        },
    )
