"""The log of what reward functions print."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


class RewardPrints:
    """Appends what reward functions print to one file, at a limited rate and up to a limited size.

    Several processes may share the file: each line is one write to a file opened for appending. The rate
    (a bucket of one second's lines) is kept per process, the size per file. A print never fails a run: lines
    beyond a limit are dropped and counted in `dropped`, as are all lines after a disk error, which is kept in
    `error`. Dropped lines are reported in the log before the next line, and by `close`.
    """

    def __init__(self, path: Path, lines_per_s: float = 100.0, max_bytes: int = 10_000_000) -> None:
        self.path = path
        self.lines_per_s = lines_per_s
        self.max_bytes = max_bytes
        self.written = 0
        self.dropped = 0
        self.error: OSError | None = None
        self._reported = 0
        self._credit = lines_per_s
        self._filled_at = time.monotonic()
        self._file: int | None = None
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
                self._write("".join(f"{prefix}{line}\n" for line in text.split("\n")))

        return reward_print

    def close(self) -> None:
        """Report what was dropped since the last line and close the file."""
        if self._file is None:
            return
        self._full = False
        self._report()
        if self._file is not None:
            os.close(self._file)
        self._file = None

    def _may_write(self) -> bool:
        now = time.monotonic()
        self._credit = min(self.lines_per_s, self._credit + (now - self._filled_at) * self.lines_per_s)
        self._filled_at = now
        if self._credit < 1.0 or self._full or self.error is not None:
            self.dropped += 1
            return False
        self._credit -= 1.0
        return True

    def _write(self, text: str) -> None:
        data = text.encode("utf-8", errors="backslashreplace")
        try:
            if self._file is None:
                flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_CLOEXEC", 0)
                self._file = os.open(self.path, flags, 0o644)
            if os.fstat(self._file).st_size + len(data) > self.max_bytes:
                self.dropped += 1
                self._full = True
                return
            self._report()
            os.write(self._file, data)
            self.written += 1
        except OSError as error:
            self._give_up(error)

    def _report(self) -> None:
        left_out = self.dropped - self._reported
        if left_out and self._file is not None:
            self._reported = self.dropped
            try:
                os.write(self._file, f"[{left_out} prints left out]\n".encode())
            except OSError as error:
                self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        self.error = error
        self.dropped += 1
        if self._file is not None:
            os.close(self._file)
            self._file = None
