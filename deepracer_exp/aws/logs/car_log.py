"""The log that a physical car writes of a drive: a ROS 2 bag of pictures, what the model made of them, and commands.

Source of topics and messages: deepracer-custom-car 2.1.9.9 (logging_pkg, deepracer_launcher, deepracer_interfaces_pkg,
deepracer_navigation_pkg). A bag may bring message definitions of its own; rosbags would turn them into Python code, so
only those below are used.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.errors import BadInput, reading
from deepracer_exp.files import LOG_BYTES, open_user_file

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

Floats = NDArray[np.float64]

ENDINGS = (".db3", ".mcap")
"""Endings of a bag's files, by the storage that the car uses (sqlite3, its default, or mcap)."""
ACCEPTED = "a bag that deepracer-custom-car wrote: its folder, or its .db3 or .mcap"
RESULTS, COMMANDS = "/inference_pkg/rl_results", "/deepracer_navigation_pkg/auto_drive"
_METADATA = "metadata.yaml"
_PACKAGE = "deepracer_interfaces_pkg/msg/"
_RESULTS_TYPE, _SERVO_TYPE = f"{_PACKAGE}InferResultsArray", f"{_PACKAGE}ServoCtrlMsg"
_STATUS_TYPE = f"{_PACKAGE}DeviceStatusMsg"
_MESSAGES = {
    f"{_PACKAGE}InferResults": "int32 class_label\n"
    + "".join(f"float32 {name}\n" for name in ("class_prob", "x_min", "y_min", "x_max", "y_max")),
    _RESULTS_TYPE: f"{_PACKAGE}InferResults[] results\nsensor_msgs/CompressedImage[] images\n",
    _STATUS_TYPE: "".join(
        f"float32 {name}\n"
        for name in (
            *("cpu_percent", "cpu_temp", "cpu_freq", "cpu_freq_max", "memory_usage", "free_disk"),
            *("latency_mean", "latency_p95", "fps_mean"),
        )
    ),
}
_SERVO = "float32 angle\nfloat32 throttle\n"
_STAMPED_SERVO = f"{_SERVO}builtin_interfaces/Time source_stamp\n"
"""AWS's own messages have no stamp."""
_STAMPED_BYTES = 20
"""Size of a message with a stamp: 4 of its head, two numbers of 4, a time of 8."""
_MOST_OUTPUTS = 1000
_LONGEST_GAP_S = 60.0
"""The car closes a bag after 15 s without a picture; a longer gap is a clock that was set meanwhile."""
_BEFORE_S, _AFTER_S = 0.005, 0.1
"""Around a decision, the time in which the command that follows from it is logged."""


@dataclass(frozen=True, eq=False)
class CarLog:
    """One drive of a physical car, n decisions."""

    name: str
    pictures: tuple[tuple[bytes, ...], ...]
    """The compressed pictures of each decision, one, or the two of a stereo pair."""
    time_s: Floats
    """When each was taken, from the first on, (n,)."""
    outputs: Floats
    """What the network returned: the probability of each action, or the means of steering and speed, (n, k)."""
    steering: Floats
    """Commanded, a share of full lock, -1 to 1, positive to the left, (n,); NaN where it was not logged."""
    throttle: Floats
    """Commanded, 0 to 1, with the maximum speed of the car's console, (n,); NaN where it was not logged."""
    latency_s: Floats
    """From the picture to its command, (n,); NaN where it was not logged."""
    status: dict[str, Floats]
    """What the car says of itself every second or so, by the names of its message, (m,) each; without: empty."""
    problems: tuple[str, ...]
    """What is missing or was mended."""

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def is_discrete(self) -> bool:
        """Whether the outputs are probabilities."""
        return bool(
            (self.outputs >= 0).all() and np.allclose(self.outputs.sum(axis=1), 1.0, rtol=0.0, atol=0.02)
        )


class _Decision(NamedTuple):
    bag_ns: int
    stamp_ns: int
    outputs: Sequence[float]
    pictures: tuple[bytes, ...]


class _Command(NamedTuple):
    bag_ns: int
    stamp_ns: int
    """0: it has none."""
    steering: float
    throttle: float


def is_car_log(path: Path) -> bool:
    """Return whether a path is a bag, or a folder of bags, without reading it."""
    return bool(_bags(path))


def read_car_log(path: Path) -> CarLog:
    """Read the bag of a drive: a file, its folder, or a folder with one such folder.

    A bag without its metadata.yaml, which the car writes last, is read as far as it goes.

    Raises:
        BadInput: there is no bag or more than one, it is corrupt or no log of a car, or rosbags is missing.
    """
    bags = _bags(path)
    if len(bags) != 1:
        names = ", ".join(sorted(bag.name for bag in bags)[:5])
        more = f"{len(bags)} drives ({names}{', ...' * (len(bags) > 5)})" if bags else "no drive of a car"
        raise BadInput(path, f"holds {more}", "one of them" if bags else ACCEPTED)
    (bag,) = bags
    decisions: list[_Decision] = []
    commands: dict[str, list[_Command]] = {}
    status: list[Any] = []
    with reading(path, ACCEPTED, "damaged"):
        for topic, kind, bag_ns, message in _messages(bag):
            if kind == _RESULTS_TYPE:
                decisions.append(_decision(bag_ns, message, len(decisions)))
            elif kind == _SERVO_TYPE:
                commands.setdefault(topic, []).append(_command(bag_ns, message))
            else:
                status.append(message)
    if not decisions:
        raise BadInput(path, f"no inference results (topic {RESULTS})", ACCEPTED)
    if len({len(decision.outputs) for decision in decisions}) > 1:
        raise BadInput(path, "results of models with different numbers of actions", "one drive of one model")
    # Those of the navigation node are what the model asked for; later ones, on the way to the servo, come second.
    topics = sorted(commands, key=lambda topic: (topic != COMMANDS, topic))
    return _log(bag, decisions, commands[topics[0]] if topics else [], status)


def _bags(path: Path) -> list[Path]:
    """Return the bags that a path means: files, or folders with a bag's files."""
    with reading(path, ACCEPTED):
        if path.is_file():
            return [path] if path.suffix in ENDINGS else []
        if not path.is_dir():
            return []
        return [path] if _is_bag(path) else [child for child in path.iterdir() if _is_bag(child)]


def _is_bag(folder: Path) -> bool:
    try:
        if not folder.is_dir():
            return False
        if any(child.suffix in ENDINGS for child in folder.iterdir()):
            return True
        with (folder / _METADATA).open("rb") as file:
            return file.read(40).startswith(b"rosbag2_bagfile_information")
    except OSError:  # no such file, or a folder that may not be read
        return False


def _messages(bag: Path) -> Iterator[tuple[str, str, int, Any]]:
    """Return topic, type, time (ns) and content of the messages that matter, in the order in which they came."""
    try:
        from rosbags.rosbag2 import Reader
    except ModuleNotFoundError as error:
        raise BadInput(
            bag,
            f"needs the package {error.name}; install the project with its extra: pip install 'deepracer-exp[car]'",
        ) from None
    stamped, plain = _types(_STAMPED_SERVO), _types(_SERVO)
    for place in _storages(bag):
        with Reader(place) as reader:
            connections = [
                connection
                for connection in reader.connections
                if connection.msgtype in (_RESULTS_TYPE, _SERVO_TYPE, _STATUS_TYPE)
            ]
            for connection in connections:
                hashes = {types.hash_rihs01(connection.msgtype) for types in (stamped, plain)}
                if connection.digest and connection.digest not in hashes:
                    raise BadInput(
                        bag,
                        f"{connection.topic}: its messages are not those of this version of the car",
                        ACCEPTED,
                    )
            for connection, bag_ns, data in reader.messages(connections):
                types = plain if len(data) < _STAMPED_BYTES else stamped
                yield (
                    connection.topic,
                    connection.msgtype,
                    bag_ns,
                    types.deserialize_cdr(data, connection.msgtype),
                )


def _storages(bag: Path) -> list[Path]:
    """Return what the library opens: the folder, or, where it was cut off and has no metadata, its files."""
    if bag.is_dir() and not (bag / _METADATA).is_file():
        files = sorted(child for child in bag.iterdir() if child.suffix in ENDINGS)
    else:
        files = [bag]
    for file in files if bag.is_file() else (child for child in bag.iterdir() if child.suffix in ENDINGS):
        open_user_file(file, ACCEPTED, LOG_BYTES).close()
    return files


def _types(servo: str) -> "Typestore":
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in {**_MESSAGES, _SERVO_TYPE: servo}.items():
        types.register(get_types_from_msg(text, name))
    return types


def _decision(bag_ns: int, message: Any, number: int) -> _Decision:
    outputs = {int(result.class_label): float(result.class_prob) for result in message.results}
    if not 1 <= len(outputs) <= _MOST_OUTPUTS or sorted(outputs) != list(range(len(outputs))):
        raise ValueError(f"the results of picture {number} are not those of actions")
    values = [outputs[label] for label in range(len(outputs))]
    if not np.isfinite(values).all():
        raise ValueError(f"the results of picture {number} are not finite")
    if not message.images:
        raise ValueError(f"decision {number} has no picture")
    stamp_ns = _nanoseconds(message.images[0].header.stamp)
    return _Decision(bag_ns, stamp_ns, values, tuple(image.data.tobytes() for image in message.images))


def _command(bag_ns: int, message: Any) -> _Command:
    stamp = getattr(message, "source_stamp", None)
    stamp_ns = 0 if stamp is None else _nanoseconds(stamp)
    return _Command(bag_ns, stamp_ns, float(message.angle), float(message.throttle))


def _nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _log(
    bag: Path, decisions: Sequence[_Decision], commands: Sequence[_Command], status: Sequence[Any]
) -> CarLog:
    from .recording import readable  # imports pandas, which commands that only ask `is_car_log` do not need

    problems = []
    if bag.is_dir() and not (bag / _METADATA).is_file():
        problems.append(f"{_METADATA} is missing: the log was cut off; what is there was read")
    bag_ns = np.array([decision.bag_ns for decision in decisions])
    stamp_ns = np.array([decision.stamp_ns for decision in decisions])
    taken_ns = stamp_ns if stamp_ns.all() else bag_ns
    apart_s = np.diff(taken_ns) / 1e9
    jumps = (apart_s < 0) | (apart_s > _LONGEST_GAP_S)
    if jumps.any():
        problems.append(f"the car's clock was set {jumps.sum()} times during the drive")
        apart_s[jumps] = np.median(apart_s[~jumps]) if (~jumps).any() else 0.0
    following = _following(decisions, commands)
    if not commands:
        problems.append(f"no commands (topic {COMMANDS}): steering and throttle are not known")
    logged = [None if place < 0 else commands[place] for place in following]
    latency_s = np.array(
        [
            np.nan if command is None else (command.bag_ns - taken) / 1e9
            for command, taken in zip(logged, taken_ns.tolist(), strict=True)
        ]
    )
    if not stamp_ns.all():
        latency_s[:] = np.nan
    fields = [name for name in vars(status[0]) if not name.startswith("_")] if status else []
    return CarLog(
        name=readable(bag.stem if bag.is_file() else bag.resolve().name),
        pictures=tuple(decision.pictures for decision in decisions),
        time_s=np.concatenate([[0.0], np.cumsum(apart_s)]),
        outputs=np.array([decision.outputs for decision in decisions]),
        steering=np.array([np.nan if command is None else command.steering for command in logged]),
        throttle=np.array([np.nan if command is None else command.throttle for command in logged]),
        latency_s=np.where((latency_s >= 0) & (latency_s < _LONGEST_GAP_S), latency_s, np.nan),
        status={name: np.array([getattr(message, name) for message in status], float) for name in fields},
        problems=tuple(problems),
    )


def _following(decisions: Sequence[_Decision], commands: Sequence[_Command]) -> list[int]:
    """Return the place of the command that follows from each decision, by its stamp or else by time; -1: none."""
    by_stamp = {command.stamp_ns: place for place, command in enumerate(commands) if command.stamp_ns}
    times_ns = np.array([command.bag_ns for command in commands], np.int64)
    order = np.argsort(times_ns, kind="stable")
    places = []
    for decision in decisions:
        place = by_stamp.get(decision.stamp_ns, -1)
        if place < 0 and not by_stamp and len(commands):
            next_one = int(np.searchsorted(times_ns[order], decision.bag_ns - int(_BEFORE_S * 1e9)))
            if next_one < len(order) and times_ns[order[next_one]] <= decision.bag_ns + int(_AFTER_S * 1e9):
                place = int(order[next_one])
        places.append(place)
    return places
