"""The process that a sweep is begun by: starts workers, looks after them, shows what they do."""

import collections
import contextlib
import multiprocessing
import sys
import time
import uuid
from collections.abc import Callable, Sequence
from multiprocessing.process import BaseProcess

from deepracer_exp.errors import RunFailed
from deepracer_exp.training.signals import Interruption

from . import process
from .ledger import Ledger, Slot
from .plan import Plan
from .storage import Storage, patiently
from .table import SweepView

OnEnded = Callable[[Sequence[Slot]], None]
_LOOK_S = 0.5
_LEAVE_S = 60.0
"""For a worker that was told to end: it writes a checkpoint and tells MLflow."""
_FEW = 3
"""Trials all of which must have failed before a sweep is given up."""


class Driver:
    """Runs the workers of a sweep on this machine."""

    def __init__(self, plan: Plan, storage: Storage, workers: int, view: SweepView, on_ended: OnEnded):
        """Start nothing yet.

        Args:
            plan: of the sweep.
            storage: of the study, which is there.
            workers: processes.
            view: has been entered.
            on_ended: called whenever trials have ended.
        """
        self._plan, self._workers, self._view, self._on_ended = plan, workers, view, on_ended
        self._ledger = Ledger(storage.engine, plan.study)
        # From a server that has imported what workers need, once; see `start_workers_early`.
        forks = sys.platform.startswith("linux")
        self._context = (
            multiprocessing.get_context("forkserver") if forks else multiprocessing.get_context("spawn")
        )
        self._running: dict[str, BaseProcess] = {}
        self._log = plan.folder / "workers.log"
        self._losses = 0
        """Workers that died since a trial was last ended."""
        self._ended = -1

    def run(self, interruption: Interruption) -> int | None:
        """Return when all trials are made: None, or the exit code when interrupted.

        Raises:
            RunFailed: all trials fail, workers die again and again, or the database stays away.
        """
        self._plan.folder.mkdir(parents=True, exist_ok=True)
        # What was killed here needs not wait for the end of its lease.
        for owner in {
            slot.owner for slot in self._slots() if slot.outcome is None and process.is_gone(slot.owner)
        }:
            self._free(owner)
        try:
            for _ in range(self._workers):
                self._start()
            while True:
                slots = self._slots()
                self._view.show(slots)
                if interruption.signum is not None:
                    self._view.stage = "ends: running trials write their checkpoints"
                    self._view.show(slots)
                    self._end()
                    self._view.show(self._slots())
                    return interruption.exit_code
                self._give_up_if_hopeless(slots)
                self._reap()
                if not self._running:
                    return None
                time.sleep(_LOOK_S)
        except BaseException:
            self._kill()
            raise

    def _start(self) -> None:
        token = uuid.uuid4().hex[:8]
        started = self._context.Process(target=process.main, args=(self._plan, token, str(self._log)))
        started.start()
        assert started.pid is not None
        self._running[process.owner_name(started.pid, token)] = started

    def _reap(self) -> None:
        """Look after workers that are gone: their trials are free, and others take their place."""
        for owner, one in list(self._running.items()):
            if one.is_alive():
                continue
            one.join()
            del self._running[owner]
            if one.exitcode == 0:
                continue
            self._free(owner)
            if one.exitcode == RunFailed.exit_code:
                raise RunFailed(f"the study's database does not answer; {self._goes_on()}")
            self._losses += 1
            if self._losses > 2 * self._workers + _FEW:
                raise RunFailed(f"workers die again and again; {self._log} tells why; {self._goes_on()}")
            self._start()

    def _free(self, owner: str) -> None:
        patiently(lambda: self._ledger.release(owner), self._plan.config.patience_s)

    def _slots(self) -> list[Slot]:
        slots = patiently(self._ledger.slots, self._plan.config.patience_s)
        ended = sum(slot.outcome is not None for slot in slots)
        if ended != self._ended:
            self._ended, self._losses = ended, 0
            self._on_ended(slots)
        return slots

    def _give_up_if_hopeless(self, slots: Sequence[Slot]) -> None:
        ended = [slot for slot in slots if slot.outcome is not None]
        if len(ended) < min(_FEW, self._plan.config.trials) or any(slot.outcome != "FAIL" for slot in ended):
            return
        why = collections.Counter(str(slot.attrs.get("reason")) for slot in ended)
        ((reason, count),) = why.most_common(1)
        self._end()
        raise RunFailed(f"all {len(ended)} trials so far failed, {count} of them with: {reason}")

    def _end(self) -> None:
        """Tell the workers to end, and wait for them."""
        for one in self._running.values():
            one.terminate()
        until = time.monotonic() + _LEAVE_S
        for one in self._running.values():
            one.join(max(until - time.monotonic(), 0.1))
        self._kill()

    def _kill(self) -> None:
        for owner, one in self._running.items():
            one.kill()
            one.join()
            # A database that is away frees the trial by itself, once its lease is over.
            with contextlib.suppress(RunFailed):
                patiently(lambda owner=owner: self._ledger.release(owner), 1.0)  # type: ignore[misc]
        self._running.clear()

    def _goes_on(self) -> str:
        return f"`deepracer-exp sweep study={self._plan.study}` goes on"
