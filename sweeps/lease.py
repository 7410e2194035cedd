"""A claim kept alive: renewed from a thread of its own, and asked for before anything is written."""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from deepracer_exp.training.watching import TakenOver

from .ledger import Claim, Ledger
from .storage import DOWN, patiently

Result = TypeVar("Result")

_log = logging.getLogger("deepracer_exp")
_RENEWALS = 12
"""In the time of a lease: the live table is as old as one of them."""


class Lease:
    """Holds a claim while its trial is made; a context.

    A process that was stopped for longer than its lease, and whose trial somebody else has taken over meanwhile,
    learns it from `confirm`, which stands before everything that is written.
    """

    def __init__(self, ledger: Ledger, claim: Claim, lease_s: float, patience_s: float):
        """Take over a fresh claim.

        Args:
            ledger: where it stands.
            claim: just made.
            lease_s: how long it holds without being renewed.
            patience_s: how long a database that does not answer is waited for.
        """
        self.claim = claim
        self._ledger, self._lease_s, self._patience_s = ledger, lease_s, patience_s
        self._progress: Mapping[str, Any] = {}
        self._renewed_at = time.monotonic()
        self._lost = False
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="lease", daemon=True)

    def __enter__(self) -> "Lease":
        """Begin to renew."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def show(self, progress: Mapping[str, Any]) -> None:
        """Say how far the trial is; the next renewal takes it along."""
        self._progress = progress

    def confirm(self) -> None:
        """Return while the claim is held.

        Raises:
            TakenOver: it is not any more.
            RunFailed: the database has not answered for too long.
        """
        if not self._lost and time.monotonic() > self._renewed_at + self._lease_s / 2:
            self._lost = not patiently(self._renew, self._patience_s)
        if self._lost:
            raise TakenOver(f"trial {self.claim.slot} was taken over")

    def held(self, write: Callable[[], bool]) -> None:
        """Make a write that the ledger refuses to whoever does not hold the claim.

        Raises:
            TakenOver: it refused.
            RunFailed: the database has not answered for too long.
        """
        if not patiently(write, self._patience_s):
            self._lost = True
        self.confirm()

    def _renew(self) -> bool:
        began = time.monotonic()
        held = self._ledger.renew(self.claim, self._lease_s, dict(self._progress) or None)
        if held:
            self._renewed_at = began
        return held

    def _keep(self) -> None:
        while not self._over.wait(self._lease_s / _RENEWALS):
            try:
                if not self._renew():
                    self._lost = True
                    return
            except DOWN as error:
                # `confirm` waits for it before anything is written.
                _log.warning("lease of trial %d: %s", self.claim.slot, type(error).__name__)
