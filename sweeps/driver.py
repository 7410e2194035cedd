"""The process that a sweep is begun by: starts workers, looks after them, shows what they do."""

import collections
import contextlib
import re
import time
import uuid
from collections.abc import Callable, Sequence

from deepracer_exp.errors import RunFailed
from deepracer_exp.training.signals import Interruption

from . import process
from .launch import Launched, Launcher
from .ledger import Ledger, Slot
from .plan import Plan
from .storage import Storage, patiently
from .table import SweepView

OnEnded = Callable[[Sequence[Slot]], None]
_LOOK_S = 0.5
_LEAVE_S = 6.0
"""For a worker that was told to end: it writes a checkpoint and tells MLflow. What it has not done by then is done when
its trial resumes; with what comes after, the whole sweep is gone within ten seconds."""
_FEW = 3
"""Trials all of which must have failed before a sweep is given up."""


class Driver:
    """Runs the workers of a sweep."""

    def __init__(
        self,
        plan: Plan,
        storage: Storage,
        launcher: Launcher,
        view: SweepView,
        on_ended: OnEnded,
    ):
        """Start nothing yet.

        Args:
            plan: of the sweep.
            storage: of the study, which is there.
            launcher: starts them.
            view: has been entered.
            on_ended: called whenever trials have ended.
        """
        self._plan, self._launcher, self._view, self._on_ended = plan, launcher, view, on_ended
        self._ledger = Ledger(storage.engine, plan.study)
        self._running: list[Launched] = []
        self._all_made = False
        """A worker has found nothing left to do."""
        self._losses = 0
        """Workers that died since a trial was last ended."""
        self._ended = -1

    def run(self, interruption: Interruption) -> int | None:
        """Return when all trials are made: None, or the exit code when interrupted.

        Raises:
            RunFailed: all trials fail, workers die again and again, or the database stays away.
        """
        self._plan.folder.mkdir(parents=True, exist_ok=True)
        # What was killed here, mostly with its driver, need not wait for the end of its lease.
        for owner in {
            slot.owner for slot in self._slots() if slot.outcome is None and process.is_gone(slot.owner)
        }:
            self._release(owner)
        try:
            for _ in range(self._launcher.workers):
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
        self._running.append(self._launcher.start(self._plan, uuid.uuid4().hex[:8]))

    def _reap(self) -> None:
        """Look after workers that are gone: their trials are free, and others take their place."""
        for one in [one for one in self._running if one.exitcode is not None]:
            self._running.remove(one)
            if one.exitcode == 0:
                self._all_made = True
                continue
            if one.owner is not None and one.is_seen:
                self._release(one.owner, is_lost=True)
            if one.exitcode == RunFailed.exit_code:
                raise RunFailed(f"the study's database does not answer; {self._goes_on()}")
            if self._all_made:
                continue
            self._losses += 1
            if self._losses > 2 * self._launcher.workers + _FEW:
                raise RunFailed(
                    f"workers die again and again; {self._plan.folder}/workers*.log tell why; {self._goes_on()}"
                )
            self._start()
        if self._all_made:
            # Whoever still waits for its place on a cluster is not needed.
            for one in [one for one in self._running if one.owner is None]:
                self._running.remove(one)
                one.kill()

    def _release(self, owner: str, *, is_lost: bool = False, patience_s: float | None = None) -> None:
        patiently(
            lambda: self._ledger.release(owner, is_lost=is_lost), patience_s or self._plan.config.patience_s
        )

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
        # The same error names the file of another run in each.
        folder = re.escape(str(self._plan.folder.resolve())) + r"/[^/\s:]+"
        why = collections.Counter(re.sub(folder, "RUN", str(slot.attrs.get("reason"))) for slot in ended)
        ((reason, count),) = why.most_common(1)
        self._end()
        raise RunFailed(f"all {len(ended)} trials so far failed, {count} of them with: {reason}")

    def _end(self) -> None:
        """Tell the workers to end, and wait for them."""
        for one in self._running:
            one.terminate()
        until = time.monotonic() + _LEAVE_S
        for one in self._running:
            one.join(max(until - time.monotonic(), 0.1))
        self._kill()

    def _kill(self) -> None:
        for one in self._running:
            one.kill()
            if one.owner is None or not one.is_seen:
                continue
            # A database that is away frees the trial by itself, once its lease is over.
            with contextlib.suppress(RunFailed):
                self._release(one.owner, patience_s=1.0)
        self._running.clear()

    def _goes_on(self) -> str:
        return f"`deepracer-exp sweep study={self._plan.study}` resumes it"
