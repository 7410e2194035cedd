"""Text logs of simulations and trainers: trace lines, policy updates, settings; whole, rolled or of several workers."""

import ast
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import IO, Any, NamedTuple

from .blocks import Blocks
from .log_files import LogFile
from .sim_trace import LOG_LAYOUTS, StepTables, read_rows, step_keys, with_plain_commas

MARKER = b"SIM_TRACE_LOG:"
"""Precedes the values of a control step; anything may stand before it."""
# What may follow the values: a tab, a colour code, the rest of a JSON string in Docker's own logs.
_TRACE = re.compile(rb'SIM_TRACE_LOG:([^\t\r\n\x1b"\\]*)[^\n]*')
_NUMBER = rb"([-+\w.]+)"
_UPDATE = re.compile(
    rb"Policy training> Surrogate loss=%b, KL divergence=%b, Entropy=%b, training epoch=(\d{1,9}), "
    rb"learning_rate=%b" % (_NUMBER, _NUMBER, _NUMBER, _NUMBER)
)
_EPISODE = re.compile(rb"Training> Name=[^\n]*?Episode=(\d{1,9}),[^\n]*?Training iteration=(\d{1,9})")
_WORLD = re.compile(rb"WORLD_NAME['\"]?\s*[=:]\s*\[?u?['\"]?([\w-]+(?:\.\.\.)?)")
_SETTING = re.compile(rb'"(\w+)"\s*:\s*("[^"\n]*"|[-+.\deE]+|true|false)')
_SENSORS = re.compile(
    rb"Sensor list (\[[^\]\n]*\]), network (\w+), simapp_version ([\d.]+)"
    rb"(?:, training_algorithm (\w+), action_space_type (\w+))?(?: lidar_config (\{[^}\n]*\}))?"
)
# Settings that only evaluations have, and of these only races.
_TRIALS = (
    *(b"NUMBER_OF_TRIALS", b"JOB_TYPE: EVALUATION", b"JOB_TYPE: 'EVALUATION"),
    *(b"JOB_TYPE': EVALUATION", b"JOB_TYPE': 'EVALUATION"),
)
_RACE = b"LEADERBOARD_TYPE"
_WORKER = re.compile(rb"--rollout_idx (\d{1,3})")
_JOB = re.compile(rb"S3 prefix: ([^\s\x1b]+)")
_RESTORED = re.compile(rb"Restoring from path[^\n]*?(\d{1,9}_Step-\d{1,12})\.ckpt")
_SAVED = re.compile(rb"Saving in path=\[[^\n]*?(\d{1,9}_Step-\d{1,12})\.ckpt")
_NUMBERED = re.compile(r"[-_]\d{1,3}(?=\.(?:log|txt)$)")
# The prefix docker puts before the lines of each of several containers.
_TAG = re.compile(rb"(?m)^([^\s|]+) +\| [^\n]*SIM_TRACE_LOG:")
_LONGEST_SETTINGS = 10_000


class Update(NamedTuple):
    """One line of a policy update."""

    logged_iteration: int | None
    """The iteration of the episodes before it in the log."""
    epoch: int
    policy_loss: float
    kl: float
    entropy: float
    lr: float


@dataclass
class TrainingLog:
    """The content of one log."""

    steps: StepTables = field(default_factory=StepTables)
    updates: list[Update] = field(default_factory=list)
    iteration_of: dict[int, int] = field(default_factory=dict)
    """Iteration of an episode, both counted from 0. A simulation logs 0 for all of them, a trainer the right one."""
    evaluated_after: list[int] = field(default_factory=list)
    """Number of episodes driven before each evaluation; there is one after every iteration."""
    hyperparameters: dict[str, Any] | None = None
    action_space: Any = None
    sensors: dict[str, Any] | None = None
    """Keys of a model_metadata.json, without the action space."""
    world: str | None = None
    kind: str | None = None
    """`evaluation` or `leaderboard`, as the settings in the log have it; None: they do not name such a job."""
    worker: int | None = None
    """Number of the simulation worker that wrote it, from 0."""
    job: str | None = None
    """Folder in which the training's files are stored, the same for all its workers."""
    checkpoints: list[tuple[int | None, str]] = field(default_factory=list)
    """First episode driven with each checkpoint (None: not driven yet) and its name, `309_Step-8349`."""
    saved: list[str] = field(default_factory=list)
    """Names of the checkpoints that a trainer wrote; the first one drives the first episodes."""
    refused: list[tuple[int | None, str]] = field(default_factory=list)
    """Line (None: from an unknown line on) and reason of each unreadable part."""

    @property
    def recognised(self) -> bool:
        """Whether it is a log of the service at all."""
        read = (self.updates, self.iteration_of, self.hyperparameters, self.sensors, self.world, self.saved)
        return self.steps.has_lines or any(map(bool, read))

    @property
    def metadata(self) -> dict[str, Any] | None:
        """The content of a model_metadata.json; None where the log has no action space."""
        return (
            None if self.action_space is None else {"action_space": self.action_space, **(self.sensors or {})}
        )


def read_training_logs(stream: IO[bytes]) -> list[TrainingLog]:
    """Read a text block by block; lines of other programs are ignored.

    Returns:
        The log in it, or the logs of several workers that share the text: mixed line by line, each line with the
        container's name before it, or one after the other.
    """
    blocks = Blocks(stream)
    logs: dict[bytes, TrainingLog] = {b"": TrainingLog()}
    before: dict[bytes, int | None] = {}
    last = b""
    for block in blocks:
        for key, part, lines in _parts(block, blocks.lines, last, logs):
            last = key
            log = logs.setdefault(key, TrainingLog())
            _read_checkpoints(log, part)
            if MARKER in part:
                before[key] = _read_trace(log, part, lines, before.get(key))
            _read_updates(log, part, lines)
            _read_job(log, part)
    recognised = [log for log in logs.values() if log.recognised or log.refused] or [logs[b""]]
    recognised[0].refused += blocks.refused
    return recognised


def _parts(
    block: bytes, lines: int, key: bytes, logs: dict[bytes, TrainingLog]
) -> Iterator[tuple[bytes, bytes, int]]:
    """Yield the parts of a block by the log they belong to, each with the number of lines before it."""
    # Most logs are of a single container, and are searched for a bar in a thousandth of the pattern's time.
    tags = list(dict.fromkeys(_TAG.findall(block))) if b" |" in block else []
    if tags:
        rows = block.split(b"\n")
        for tag in tags:
            begins = tag + b" "
            yield tag, b"\n".join(row if row.startswith(begins) else b"" for row in rows), lines
        return
    start = 0
    for match in _WORKER.finditer(block):
        worker, begin = match[1], block.rfind(b"\n", 0, match.start()) + 1
        earlier = logs[key].worker if key in logs else None
        # A worker logs its number once, at its beginning.
        if (earlier is not None or start) and str(earlier).encode() != worker and begin > start:
            yield key, block[start:begin], lines + block.count(b"\n", 0, start)
            key, start = b"worker " + worker, begin
        elif earlier is None and key in logs:
            logs[key].worker = int(worker)
    yield key, block[start:], lines + block.count(b"\n", 0, start)


def _read_checkpoints(log: TrainingLog, block: bytes) -> None:
    """Record the first episode of each checkpoint."""
    marks = sorted(
        [(match.start(), match[1].decode()) for match in _RESTORED.finditer(block)]
        + ([(0, "")] if log.checkpoints and log.checkpoints[-1][0] is None else [])
    )
    for start, name in marks:
        begin = block.find(MARKER, start) + len(MARKER)
        episode = block[begin : begin + 12].partition(b",")[0] if begin >= len(MARKER) else b""
        first = int(episode) if episode.isdigit() else None
        if not name:
            name = log.checkpoints.pop()[1]
        if log.checkpoints and log.checkpoints[-1][0] in (first, None):
            log.checkpoints.pop()
        log.checkpoints.append((first, name))
    log.saved += [match[1].decode() for match in _SAVED.finditer(block)]


def _read_trace(log: TrainingLog, block: bytes, lines_before: int, before: int | None) -> int:
    if log.steps.give_up(log.refused):
        return 0
    rows = with_plain_commas(b"\n".join(_TRACE.findall(block)) + b"\n")
    table, refused = read_rows(rows, LOG_LAYOUTS, before)
    log.steps.add(table)
    if refused:
        starts = [match.start() for match in _TRACE.finditer(block)]
        log.refused += [(_line(block, starts[index], lines_before), reason) for index, reason in refused]
    return rows.count(b",", rows.rfind(b"\n", 0, -1) + 1) + 1


def _read_updates(log: TrainingLog, block: bytes, lines_before: int) -> None:
    marks = (b"Policy training>", b"Training> Name=", b"Starting evaluation phase")
    places = [place for mark in marks for place in _find(block, mark)]
    for start, line in sorted(places):
        episode = _EPISODE.match(line)
        if episode is not None:
            log.iteration_of[int(episode[1]) - 1] = int(episode[2])
            continue
        if line.startswith(b"Starting"):
            driven = next(reversed(log.iteration_of), -1) + 1
            if driven > (log.evaluated_after[-1] if log.evaluated_after else 0):
                log.evaluated_after.append(driven)
            continue
        try:
            update = _UPDATE.match(line)
            if update is not None:
                loss, kl, entropy, rate = (float(update[group]) for group in (1, 2, 3, 5))
                iteration = next(reversed(log.iteration_of.values()), None)
                log.updates.append(Update(iteration, int(update[4]), loss, kl, entropy, rate))
                continue
        except ValueError:
            pass
        if line.startswith(b"Policy"):
            log.refused.append((_line(block, start, lines_before), "a policy update that cannot be read"))


def _read_job(log: TrainingLog, block: bytes) -> None:
    # Plain words are found in a tenth of the time that a pattern takes, and few blocks have them.
    if log.worker is None and b"--rollout_idx " in block and (worker := _WORKER.search(block)):
        log.worker = int(worker[1])
    if log.kind is None and any(word in block for word in _TRIALS):
        log.kind = "leaderboard" if _RACE in block else "evaluation"
    if log.job is None and b"S3 prefix: " in block and (job := _JOB.search(block)):
        log.job = job[1].decode("utf-8", "replace").strip("/")
    if log.hyperparameters is None:
        for start, _ in _find(block, b"Using the following hyper-parameters"):
            text = block[start : start + _LONGEST_SETTINGS].partition(b"}")[0]
            pairs = b", ".join(b'"%b": %b' % pair for pair in _SETTING.findall(text))
            value = _parsed(json.loads, b"{" + pairs + b"}")
            log.hyperparameters = value or None
    if log.action_space is None:
        for _, line in _find(block, b"ction space from file: "):
            log.action_space = _parsed(ast.literal_eval, line.partition(b": ")[2].strip())
    if log.sensors is None:
        for _, line in _find(block, b"Sensor list ["):
            log.sensors = log.sensors or _sensors(line)
    if log.world is None:
        names = [match[1] for _, line in _find(block, b"WORLD_NAME") if (match := _WORLD.match(line))]
        # ROS shortens what it prints; the whole name may stand elsewhere.
        log.world = next((name.decode() for name in names if not name.endswith(b"...")), None)


def _sensors(line: bytes) -> dict[str, Any] | None:
    match = _SENSORS.match(line)
    if match is None:
        return None
    sensor, network, version, algorithm, kind, lidar = match.groups()
    values = {
        "sensor": _parsed(ast.literal_eval, sensor),
        "neural_network": network.decode(),
        "version": version.decode().partition(".")[0],
        "training_algorithm": None if algorithm is None else algorithm.decode(),
        "action_space_type": None if kind is None else kind.decode(),
        "lidar_config": None if lidar is None else _parsed(ast.literal_eval, lidar),
    }
    return {key: value for key, value in values.items() if value is not None}


def _parsed(read: Any, text: bytes) -> Any:
    """Return the value of a text in Python or JSON, None if it cannot be parsed."""
    try:
        return read(text.decode("utf-8", "replace"))
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        return None


def _find(block: bytes, mark: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the offset of each mark and the rest of the line from there."""
    start = block.find(mark)
    while start >= 0:
        end = block.find(b"\n", start)
        end = len(block) if end < 0 else end
        yield start, block[start:end]
        start = block.find(mark, end)


def _line(block: bytes, start: int, lines_before: int) -> int:
    return lines_before + block.count(b"\n", 0, start) + 1


def piece_of(name: str) -> tuple[str, int]:
    """Return the name of the whole log and a key that sorts its pieces (`robomaker.log.1`) from the oldest.

    The highest number is the oldest piece; the one without a number is still being written.
    """
    stem, _, number = name.rpartition(".")
    return (stem, -int(number)) if number.isdigit() else (name, 1)


def join_rolled(logs: Sequence[tuple[LogFile, TrainingLog]]) -> list[tuple[list[LogFile], TrainingLog]]:
    """Join the pieces of rolled logs, the earliest first: by their episodes, or else by their numbers."""
    groups: dict[tuple[str | int, ...], list[tuple[LogFile, TrainingLog]]] = {}
    of_file: dict[LogFile, int] = {}
    for file, log in logs:
        name, _ = piece_of(file.name)
        # One text may hold the logs of several workers.
        of_file[file] = of_file.get(file, -1) + 1
        groups.setdefault((*file.parts[:-1], name, of_file[file]), []).append((file, log))
    joined = []
    for pieces in _with_numbered(groups):
        pieces.sort(key=_time_of_piece)
        whole = TrainingLog(
            steps=StepTables.joined([log.steps for _, log in pieces]),
            updates=[update for _, log in pieces for update in log.updates],
            evaluated_after=[count for _, log in pieces for count in log.evaluated_after],
            iteration_of={key: value for _, log in pieces for key, value in log.iteration_of.items()},
            hyperparameters=next((log.hyperparameters for _, log in pieces if log.hyperparameters), None),
            world=next((log.world for _, log in pieces if log.world), None),
            kind=next((log.kind for _, log in pieces if log.kind), None),
            worker=next((log.worker for _, log in pieces if log.worker is not None), None),
            job=next((log.job for _, log in pieces if log.job), None),
            checkpoints=[checkpoint for _, log in pieces for checkpoint in log.checkpoints],
            saved=[name for _, log in pieces for name in log.saved],
        )
        joined.append(([file for file, _ in pieces], whole))
    return joined


def _with_numbered(
    groups: dict[tuple[str | int, ...], list[tuple[LogFile, TrainingLog]]],
) -> list[list[tuple[LogFile, TrainingLog]]]:
    """Join groups whose names differ by a number alone (`sim-trace-log-2.log`) if their episodes continue."""
    alike: dict[tuple[str | int, ...], list[list[tuple[LogFile, TrainingLog]]]] = {}
    for (*folders, name, place), pieces in groups.items():
        alike.setdefault((*folders, _NUMBERED.sub("", str(name)), place), []).append(pieces)
    joined = []
    for similar in alike.values():
        whole = sorted((piece for pieces in similar for piece in pieces), key=_time_of_piece)
        places = [step_keys(log.steps.whole) for _, log in whole]
        continues = all(map(len, places)) and all(
            later[0] > earlier.max() for earlier, later in pairwise(places)
        )
        joined += [whole] if len(similar) > 1 and continues else similar
    return joined


def _time_of_piece(piece: tuple[LogFile, TrainingLog]) -> tuple[int, int, int]:
    file, log = piece
    _, age = piece_of(file.name)
    if log.steps.rows:
        first = log.steps.whole.slice(0, 1)
        return first["episode"][0].as_py(), first["steps"][0].as_py(), age
    return (next(iter(log.iteration_of), -1), 0, age)
