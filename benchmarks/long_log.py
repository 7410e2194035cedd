"""A text log of any length, made of a real one: the same drives again and again, later each time."""

import re
from pathlib import Path

_STEP = re.compile(rb"(.*?SIM_TRACE_LOG:)(\d+),(.*)", re.DOTALL)
_TIME = 13
"""Place of the time stamp among the values behind the episode's number."""


def write_long_log(source: Path, target: Path, size_bytes: int) -> int:
    """Write the log again and again, whole, until the target has the size; return the number of trace lines.

    Lines that number episodes themselves are left out: they would tell other numbers than the steps.

    Raises:
        SystemExit: there is no trace line.
    """
    lines = [_taken_apart(line) for line in source.read_bytes().splitlines(keepends=True)]
    if not any(isinstance(line, tuple) for line in lines):
        raise SystemExit(f"{source}: no control step to be repeated")
    episodes = 1 + max(line[1] for line in lines if isinstance(line, tuple))
    times = [float(line[2][_TIME]) for line in lines if isinstance(line, tuple)]
    lasting_s = max(times) - min(times) + 1.0
    written = steps = 0
    with target.open("wb") as file:
        turn = 0
        while written < size_bytes:
            for line in lines:
                if isinstance(line, bytes):
                    written += file.write(line)
                    continue
                prefix, episode, values = line
                time = values[_TIME]
                later = b"%.3f%b" % (float(time) + turn * lasting_s, time[len(time.rstrip()) :])
                told = [*values[:_TIME], later, *values[_TIME + 1 :]]
                written += file.write(b"%b%d,%b" % (prefix, episode + turn * episodes, b",".join(told)))
                steps += 1
            turn += 1
    return steps


def _taken_apart(line: bytes) -> bytes | tuple[bytes, int, list[bytes]]:
    step = _STEP.fullmatch(line)
    if step is not None and step[3].count(b",") >= _TIME:
        return step[1], int(step[2]), step[3].split(b",")
    return b"" if b"Training> Name" in line else line
