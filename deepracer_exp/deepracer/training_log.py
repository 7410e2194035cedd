"""Text logs of simulations and trainers: trace lines, policy updates, settings."""

import ast
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import IO, Any, NamedTuple

from .log_archive import LogFile
from .sim_trace import Blocks, Refused, StepTables, columns_of, read_rows

MARKER = b"SIM_TRACE_LOG:"
"""Precedes the values of a control step; anything may stand before it."""
# What may follow the values: a tab, a colour code, the rest of a JSON string in Docker's own logs.
_TRACE = re.compile(rb'SIM_TRACE_LOG:([^\t\r\n\x1b"\\]*)[^\n]*')
_NUMBER = rb"([-+\w.]+)"
_UPDATE = re.compile(
    rb"Policy training> Surrogate loss=%b, KL divergence=%b, Entropy=%b, training epoch=(\d{1,9}), "
    rb"learning_rate=%b" % (_NUMBER, _NUMBER, _NUMBER, _NUMBER)
)
_EPISODE = re.compile(rb"Training> Name=[^\n]*?Episode=\d{1,9},[^\n]*?Training iteration=(\d{1,9})")
_WORLD = re.compile(rb"WORLD_NAME['\"]?\s*[=:]\s*\[?u?['\"]?([\w-]+(?:\.\.\.)?)")
_SETTING = re.compile(rb'"(\w+)"\s*:\s*("[^"\n]*"|[-+.\deE]+|true|false)')
_SENSORS = re.compile(
    rb"Sensor list (\[[^\]\n]*\]), network (\w+), simapp_version ([\d.]+)"
    rb"(?:, training_algorithm (\w+), action_space_type (\w+))?"
)
_WORKER = re.compile(rb"--rollout_idx (\d{1,3})")
_JOB = re.compile(rb"S3 prefix: ([^\s\x1b]+)")
_RESTORED = re.compile(rb"Restoring from path[^\n]*?(\d{1,9}_Step-\d{1,12})\.ckpt")
_SAVED = re.compile(rb"Saving in path=\[[^\n]*?(\d{1,9}_Step-\d{1,12})\.ckpt")
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
    hyperparameters: dict[str, Any] | None = None
    action_space: Any = None
    sensors: dict[str, Any] | None = None
    """Keys of a model_metadata.json, without the action space."""
    world: str | None = None
    worker: int | None = None
    """Number of the simulation worker that wrote it, from 0."""
    job: str | None = None
    """Where the training's files are stored; all its workers have the same."""
    checkpoints: list[tuple[int | None, str]] = field(default_factory=list)
    """First episode driven with each checkpoint (None: not driven yet) and its name, `309_Step-8349`."""
    saved: list[str] = field(default_factory=list)
    """Names of the checkpoints that a trainer wrote; the first one drives the first episodes."""
    refused: Refused = field(default_factory=list)
    last_iteration: int | None = None
    """Iteration of the last episode that a trainer logged."""
    columns: Sequence[str] | None = None
    """Names of the values of a trace line."""

    def extend(self, later: "TrainingLog") -> None:
        """Append the next piece of a rolled log."""
        self.steps.extend(later.steps)
        self.updates += later.updates
        self.checkpoints += later.checkpoints
        self.saved += later.saved
        for name in ("hyperparameters", "world", "worker", "job"):
            if getattr(self, name) is None:
                setattr(self, name, getattr(later, name))

    @property
    def recognised(self) -> bool:
        """Whether it is a log of the service at all."""
        found = (self.updates, self.hyperparameters, self.sensors, self.world, self.saved)
        return self.steps.found or self.last_iteration is not None or any(map(bool, found))

    @property
    def metadata(self) -> dict[str, Any] | None:
        """The content of a model_metadata.json; None where the log has no action space."""
        return (
            None if self.action_space is None else {"action_space": self.action_space, **(self.sensors or {})}
        )


def read_training_log(stream: IO[bytes]) -> TrainingLog:
    """Read a text block by block; lines of other programs are ignored."""
    blocks, log = Blocks(stream), TrainingLog()
    for block in blocks:
        _read_checkpoints(log, block)
        _read_trace(log, block, blocks.lines)
        _read_updates(log, block, blocks.lines)
        _read_job(log, block)
    log.refused += blocks.refused
    return log


def _read_checkpoints(log: TrainingLog, block: bytes) -> None:
    if log.checkpoints and log.checkpoints[-1][0] is None:
        _drive_with(log, log.checkpoints.pop()[1], block, 0)
    for found in _RESTORED.finditer(block):
        _drive_with(log, found[1].decode(), block, found.start())
    log.saved += [found[1].decode() for found in _SAVED.finditer(block)]


def _drive_with(log: TrainingLog, checkpoint: str, block: bytes, start: int) -> None:
    """Record from which episode on a checkpoint drives; of several that are restored before it, the last one does."""
    at = block.find(MARKER, start) + len(MARKER)
    episode = block[at : at + 12].partition(b",")[0] if at >= len(MARKER) else b""
    first = int(episode) if episode.isdigit() else None
    if log.checkpoints and log.checkpoints[-1][0] in (first, None):
        log.checkpoints.pop()
    log.checkpoints.append((first, checkpoint))


def _read_trace(log: TrainingLog, block: bytes, lines_before: int) -> None:
    lines = _TRACE.findall(block)
    if not lines:
        return
    log.columns = log.columns or columns_of(lines)
    table, refused = read_rows(lines, log.columns)
    log.steps.add(table)
    if refused:
        starts = [found.start() for found in _TRACE.finditer(block)]
        log.refused += [(_line(block, starts[at], lines_before), reason) for at, reason in refused]


def _read_updates(log: TrainingLog, block: bytes, lines_before: int) -> None:
    marks = (b"Policy training>", b"Training> Name=")
    for start, line in sorted(place for mark in marks for place in _find(block, mark)):
        if episode := _EPISODE.match(line):
            log.last_iteration = int(episode[1])
        elif update := _UPDATE.match(line):
            try:
                loss, kl, entropy, rate = (float(update[group]) for group in (1, 2, 3, 5))
            except ValueError:
                log.refused.append((_line(block, start, lines_before), "a policy update that cannot be read"))
            else:
                log.updates.append(Update(log.last_iteration, int(update[4]), loss, kl, entropy, rate))
        elif line.startswith(b"Policy"):
            log.refused.append((_line(block, start, lines_before), "a policy update that cannot be read"))


def _read_job(log: TrainingLog, block: bytes) -> None:
    for worker in map(int, _WORKER.findall(block)):
        log.worker = worker if log.worker is None else log.worker
        if worker != log.worker:
            log.refused.append(
                (None, f"holds the steps of worker {worker}, too; give each worker a log of its own")
            )
    if log.job is None and (job := _JOB.search(block)):
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
        names = [found[1] for _, line in _find(block, b"WORLD_NAME") if (found := _WORLD.match(line))]
        # ROS shortens what it prints; the whole name may stand elsewhere.
        log.world = next((name.decode() for name in names if not name.endswith(b"...")), None)


def _sensors(line: bytes) -> dict[str, Any] | None:
    found = _SENSORS.match(line)
    if found is None:
        return None
    sensor, network, version, algorithm, kind = found.groups()
    values = {
        "sensor": _parsed(ast.literal_eval, sensor),
        "neural_network": network.decode(),
        "version": version.decode().partition(".")[0],
        "training_algorithm": None if algorithm is None else algorithm.decode(),
        "action_space_type": None if kind is None else kind.decode(),
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


def join_rolled(logs: Sequence[tuple[LogFile, TrainingLog]]) -> list[tuple[LogFile, TrainingLog]]:
    """Join the pieces of rolled logs, the earliest first."""
    groups: dict[tuple[str, ...], list[tuple[LogFile, TrainingLog]]] = {}
    for file, log in logs:
        groups.setdefault(file.piece[0], []).append((file, log))
    for pieces in groups.values():
        pieces.sort(key=lambda one: one[0].piece[1])
        for _, later in pieces[1:]:
            pieces[0][1].extend(later)
    return [pieces[0] for pieces in groups.values()]
