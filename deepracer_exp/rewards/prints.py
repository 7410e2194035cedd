"""The log of reward functions' prints."""

import time
from collections.abc import Callable
from os import SEEK_END
from pathlib import Path
from typing import Any, BinaryIO


class RewardPrints:
    """Appends reward functions' prints to one file, at a limited rate and up to a limited size.

    Several processes may share the file: each line is one write to a file opened for appending. The rate
    (a bucket of one second's lines) is kept per process, the size per file. A print never fails a run: lines
    beyond a limit are dropped and counted in `dropped`, as are all lines after a disk error, which is kept in
    `error`. Dropped lines are reported in the log before the next line.
    """

    def __init__(self, path: Path, lines_per_s: float = 100.0, max_bytes: int = 10_000_000) -> None:
        self.path = path
        self.lines_per_s = lines_per_s
        self.max_bytes = max_bytes
        self.dropped = 0
        self.error: OSError | None = None
        self._reported = 0
        self._credit = lines_per_s
        self._filled_at = time.monotonic()
        self._file: BinaryIO | None = None
        self._full = False

    def printer(self, car: int | None) -> Callable[..., None]:
        """Return the `print` for the module of one car (None: the module of `reward_batch`).

        It has the arguments of the built-in one; `end`, `file` and `flush` have no effect, every call is
        one line.
        """
        prefix = "all cars: " if car is None else f"car {car}: "

        def reward_print(
            *values: object, sep: str | None = " ", end: object = None, file: Any = None, flush: bool = False
        ) -> None:
            # The rate is checked first: a dropped print must be cheap.
            if self._may_write():
                text = (" " if sep is None else sep).join(map(str, values))
                self.write("".join(f"{prefix}{line}\n" for line in text.split("\n")))

        return reward_print

    def _may_write(self) -> bool:
        now = time.monotonic()
        self._credit = min(self.lines_per_s, self._credit + (now - self._filled_at) * self.lines_per_s)
        self._filled_at = now
        if self._credit < 1.0 or self._full or self.error is not None:
            self.dropped += 1
            return False
        self._credit -= 1.0
        return True

    def write(self, text: str) -> None:
        """Append whole lines, unless the log is full or cannot be written."""
        left_out = self.dropped - self._reported
        note = f"[{left_out} prints left out]\n" if left_out else ""
        data = (note + text).encode("utf-8", errors="backslashreplace")
        try:
            if self._file is None:
                # Unbuffered: each call is one write, and the file is closed with its owner.
                self._file = self.path.open("ab", buffering=0)
            if self._file.seek(0, SEEK_END) + len(data) > self.max_bytes:
                self.dropped += 1
                self._full = True
                return
            self._file.write(data)
            self._reported = self.dropped
        except OSError as error:
            self.error, self._file = error, None
            self.dropped += 1
