"""Detects worker processes that die, and detects and ends those that hang."""

import contextlib
import multiprocessing
import threading
import time
from collections.abc import Sequence
from multiprocessing import forkserver
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
import psutil

_LOOK_EVERY_S = 0.5
# A hang before the first step has no other sign. Building the cars takes 2 s on a quiet machine; the first start after
# an installation compiles as well, which took a minute on a busy one.
_START_TIMEOUT_S = 120.0


class Watchdog:
    """Watches the workers' step counters while the training process waits for them.

    A worker that should be stepping and has not for `timeout_s` is killed, which the collector then reports as a
    lost process; `verdict` says that it hung. Of workers that die, the first is remembered: TorchRL ends the others
    before it reports.
    """

    def __init__(self, heartbeat: Path, workers: int, timeout_s: float):
        """Create the counters' file, one int64 per worker, and start watching.

        Every worker delivers one part of each batch, and may rest until the next is asked for.
        """
        self._file = heartbeat
        np.full(workers, -1, np.int64).tofile(heartbeat)
        self._beats = np.memmap(heartbeat, np.int64, "r")
        self._timeout_s = timeout_s
        self._start_timeout_s = max(_START_TIMEOUT_S, timeout_s)
        self._delivered = np.zeros(workers, bool)
        self._processes: Sequence[BaseProcess] | None = None
        self._waiting = threading.Event()
        self._waiting.set()
        self._over = threading.Event()
        self.verdict: dict[int, str] = {}
        """Why workers were ended, by their numbers."""
        self.first_dead: int | None = None
        """The worker whose process ended first."""
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)
        self._thread.start()

    def workers_started(self, processes: Sequence[BaseProcess]) -> None:
        """Watch these processes."""
        self._processes = processes
        sentinels = [process.sentinel for process in processes]

        def wait_for_a_death() -> None:
            self.first_dead = min(sentinels.index(int(ended)) for ended in wait(sentinels))  # type: ignore[arg-type]

        threading.Thread(target=wait_for_a_death, name="first death", daemon=True).start()

    def expect(self) -> None:
        """Note that each worker has been asked for its part of a batch, and that we wait for it."""
        self._delivered[:] = False
        self._waiting.set()

    def delivered(self, worker: int) -> None:
        """Note that a worker's part has arrived: its last step alone is no proof, it may hang right after that."""
        self._delivered[worker] = True

    def rest(self) -> None:
        """Note that nothing is waited for."""
        self._waiting.clear()

    def close(self) -> None:
        """Stop watching and remove the counters."""
        self._over.set()
        self._thread.join()
        self._file.unlink(missing_ok=True)

    def _watch(self) -> None:
        seen = np.array(self._beats)
        idle_s = np.zeros(len(seen))
        looked = time.monotonic()
        while not self._over.wait(_LOOK_EVERY_S):
            now = time.monotonic()
            beats = np.array(self._beats)
            # A longer pause was ours: the whole run stopped with Ctrl-Z, or the machine asleep.
            idle_s += min(now - looked, 2 * _LOOK_EVERY_S) if self._waiting.is_set() else 0.0
            idle_s[(beats != seen) | self._delivered] = 0.0
            seen, looked = beats, now
            for worker in np.flatnonzero(
                idle_s > np.where(beats > 0, self._timeout_s, self._start_timeout_s)
            ):
                self._end(int(worker), float(idle_s[worker]), int(beats[worker]))

    def _end(self, worker: int, idle_s: float, steps: int) -> None:
        is_first = worker in self.verdict
        # Before the kill: the collector reads the verdict as soon as it sees the death.
        self.verdict[worker] = f"took no step for {idle_s:.0f} s (after {max(steps, 0)} steps) and was ended"
        if self._processes is None:
            # They are still being started, and it is not yet known which is which; none of them can continue alone.
            # Repeated at every look, because another one may have been started since.
            for process in multiprocessing.active_children():
                process.kill()
            _end_fork_servers_children()
        elif not is_first:
            with contextlib.suppress(ValueError):  # a handle that TorchRL has closed
                self._processes[worker].kill()


def _end_fork_servers_children() -> None:
    """End the workers that the fork server has forked, those included that have not yet read their task.

    Until a worker has read it, `multiprocessing` does not list the worker, and the training process waits for it.
    """
    server = forkserver._forkserver._forkserver_pid  # type: ignore[attr-defined]
    if server is None:
        return
    with contextlib.suppress(psutil.NoSuchProcess):
        for process in psutil.Process(server).children():
            process.kill()
