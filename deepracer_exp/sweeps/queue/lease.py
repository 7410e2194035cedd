"""Leases of trials: each worker renews its own, so that a worker that hangs or is suspended loses its trial."""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Self

from deepracer_exp.training.train_result import TakenOver

from .claims import Claim, TrialClaims
from .storage import DOWN, patiently

_log = logging.getLogger("deepracer_exp")

_RENEWALS = 12
"""Renewals within one lease; the live view is at most one behind."""


class Lease:
    """Keeps a claim while its trial is made: a context that renews it from a thread and checks it before each write.

    A process that was suspended for longer than its lease, and whose trial was taken over meanwhile, notices that in
    `confirm`, which precedes every write.
    """

    def __init__(
        self,
        claims: TrialClaims,
        claim: Claim,
        lease_s: float,
        patience_s: float,
    ):
        """Hold a fresh claim, valid for `lease_s` seconds without renewal; a database may be away for `patience_s`."""
        self.claim = claim
        self._claims, self._lease_s, self._patience_s = claims, lease_s, patience_s
        self.progress: Mapping[str, Any] = {}
        """Progress of the trial; the next renewal stores it."""
        self._renewed_at = time.monotonic()
        self._lost = False
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="lease", daemon=True)

    def __enter__(self) -> Self:
        """Start to renew."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def confirm(self) -> None:
        """Return while the claim is held.

        Raises:
            TakenOver: it is lost.
            RunFailed: the database has not answered for too long.
        """
        if not self._lost and time.monotonic() > self._renewed_at + self._lease_s / 2:
            self._lost = not patiently(self._renew, self._patience_s)
        if self._lost:
            raise TakenOver(f"trial {self.claim.trial.number} was taken over")

    def held(self, write: Callable[[], bool]) -> None:
        """Make a write that returns False if the claim is lost; raise as `confirm` does."""
        if not patiently(write, self._patience_s):
            self._lost = True
        self.confirm()

    def _renew(self) -> bool:
        began = time.monotonic()
        held = self._claims.renew(self.claim, self._lease_s, dict(self.progress) or None)
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
                # `confirm` waits for the database before anything is written.
                _log.warning("lease of trial %d: %s", self.claim.trial.number, type(error).__name__)
