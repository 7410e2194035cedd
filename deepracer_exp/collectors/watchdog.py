"""Detects workers that die, and kills those that hang."""

import contextlib
import logging
import multiprocessing
import threading
import time
from collections.abc import Sequence
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
import psutil

from deepracer_exp.patience import LOOK_EVERY_S, Silence, Use, use_of, use_of_this

# A hang before the first step has no other sign. Building the cars takes 2 s; the first start after an installation
# compiles as well, for half a minute.
_START_TIMEOUT_S = 120.0
_SAY_EVERY_S = 60.0

_log = logging.getLogger(__name__)


class Watchdog:
    """Watches the workers' step counters while the training process waits for them.

    A worker that should be stepping and has not for `timeout_s` is killed, which the collector then reports as a
    lost process; `verdict` says that it hung. The limit is one of CPU time for a worker that computes, and of the clock
    for one that does not (`Silence`). Of workers that die, the first is remembered: TorchRL ends the others before it
    reports.
    """

    def __init__(self, heartbeat: Path, workers: int, timeout_s: float, advice: str = ""):
        """Create the counters' file, one int64 per worker, and start watching.

        Every worker drives one part of each batch, and may rest until all have. `advice` ends each verdict: where to
        read more.
        """
        self._file = heartbeat
        # Another may still have mapped the file that is there: without its bytes it would end by SIGBUS.
        heartbeat.unlink(missing_ok=True)
        np.full(workers, -1, np.int64).tofile(heartbeat)
        self._beats = np.memmap(heartbeat, np.int64, "r")
        self._timeout_s = timeout_s
        self._start_timeout_s = max(_START_TIMEOUT_S, timeout_s)
        self._advice = advice
        self._asked = 0
        self._processes: Sequence[BaseProcess] | None = None
        self._pids: list[int] = []
        self._waiting = threading.Event()
        self._waiting.set()
        self._over = threading.Event()
        self.verdict: dict[int, str] = {}
        """Why workers were ended, by their numbers."""
        self.first_dead: int | None = None
        """The worker whose process ended first; of those that ended together, one that failed."""
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)
        self._thread.start()

    def workers_started(self, processes: Sequence[BaseProcess]) -> None:
        """Watch these processes."""
        self._pids = [process.pid for process in processes if process.pid is not None]
        self._processes = processes
        sentinels = [process.sentinel for process in processes]

        def wait_for_a_death() -> None:
            ended = sorted(sentinels.index(int(sentinel)) for sentinel in wait(sentinels))  # type: ignore[arg-type]
            self.first_dead = next((worker for worker in ended if processes[worker].exitcode), ended[0])

        threading.Thread(target=wait_for_a_death, name="first death", daemon=True).start()

    def expect(self, steps: int) -> None:
        """Start waiting for this many more steps of each worker."""
        self._asked += steps
        self._waiting.set()

    def rest(self) -> None:
        """Stop waiting."""
        self._waiting.clear()

    def close(self) -> None:
        """Stop watching and remove the counters."""
        self._over.set()
        self._thread.join()
        self._file.unlink(missing_ok=True)

    def use(self) -> Use:
        """Return the use of the machine by all workers."""
        return use_of(*self._pids)

    def _watch(self) -> None:
        seen = np.array(self._beats)
        silences, said_s = [Silence() for _ in seen], 0.0
        while not self._over.wait(LOOK_EVERY_S):
            beats = np.array(self._beats)
            # The last step alone is no proof: once all have made it, one of them has hung right after that.
            may_rest = (beats >= self._asked) & (beats < self._asked).any()
            is_silent = (beats == seen) & ~may_rest & self._waiting.is_set()
            seen = beats
            # Starting workers share compiled code, so that some wait for others.
            of_all = use_of_this() if is_silent.any() and self._processes is None else None
            for worker, silence in enumerate(silences):
                if not is_silent[worker]:
                    silence.restart()
                    continue
                silent_s = silence.look(of_all or use_of(self._pids[worker]), time.monotonic())
                if silent_s > (self._timeout_s if beats[worker] > 0 else self._start_timeout_s):
                    self._end(worker, silence, int(beats[worker]))
            longest = max(silences, key=lambda silence: silence.clock_s)
            said_s = min(said_s, longest.clock_s)
            if longest.clock_s >= said_s + _SAY_EVERY_S:
                said_s = longest.clock_s
                worker = silences.index(longest)
                _log.warning(
                    "collector worker %d has taken no step for %.0f s and is waited for: %s",
                    worker,
                    said_s,
                    longest,
                )

    def _end(self, worker: int, silence: Silence, steps: int) -> None:
        is_first = worker in self.verdict
        limit = f"collector.hang_timeout_s={self._timeout_s:g}"
        if steps <= 0:
            limit = f"{_START_TIMEOUT_S:g} s for a start, or {limit} if that is longer"
        # Before the kill: the collector reads the verdict as soon as it sees the death.
        self.verdict[worker] = (
            f"took no step for {silence}, after {max(steps, 0)} steps, and was ended; the limit: {limit}{self._advice}"
        )
        if self._processes is None:
            # They are still being started, and it is not yet known which is which; none of them can continue alone.
            # Repeated at every look, because another one may have been started since.
            for process in multiprocessing.active_children():
                process.kill()
            _end_grandchildren()
        elif not is_first:
            with contextlib.suppress(ValueError):  # a handle that TorchRL has closed
                self._processes[worker].kill()


def _end_grandchildren() -> None:
    """End the workers that the fork server has forked, those included that have not yet read their task.

    Until a worker has read it, `multiprocessing` does not list the worker, and the training process waits for it.
    """
    for child in psutil.Process().children():
        with contextlib.suppress(psutil.NoSuchProcess):
            for process in child.children():
                if process.cmdline() == child.cmdline():  # forked: a program would have another command line
                    process.kill()
