"""Leases of trials: workers say that they live, and their driver renews the leases of all of them in one statement.

Only a worker itself can say so: one that hangs or is suspended loses its trial, however well its driver is. And a
worker that its driver does not answer, because that one is suspended or cannot reach the database, renews its lease
itself.
"""

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Protocol, Self

from deepracer_exp.training.callback import TakenOver

from .claims import Claim, Held, TrialClaims
from .storage import DOWN, patiently

_log = logging.getLogger("deepracer_exp")

_BEATS = 24
"""Signs of life of a worker, and renewals by its driver, within one lease; the live view is at most two behind."""
_ALONE = 12
"""Renewals within one lease by a worker without a driver."""
_UNANSWERED = 1 / 3
"""Share of a lease after which a worker that had no answer renews it itself."""


@dataclass(frozen=True)
class Beat:
    """A worker's sign of life."""

    held: Held
    """The claim that it holds."""
    sent_s: float
    """By the monotonic clock of its machine."""
    progress: dict[str, Any] | None
    """How far the trial is, for the live view; None: as before."""


@dataclass(frozen=True)
class Answer:
    """What a driver answers to a sign of life."""

    held: Held
    sent_s: float
    """When the sign of life was sent."""
    is_renewed: bool
    """Whether the lease was renewed; False: the claim is lost, or the database does not answer."""


class Listener(Protocol):
    """A worker as the keeper of its lease sees it."""

    def hear(self) -> Beat | None:
        """Return the newest sign of life since the last call, None if there was none; never waits."""

    def answer(self, answer: Answer) -> None:
        """Answer the last sign of life; an answer to a worker that is gone is dropped."""


class Lease:
    """Keeps a claim while its trial is made: a context that renews it from a thread and checks it before each write.

    A process that was suspended for longer than its lease, and whose trial was taken over meanwhile, finds out by
    `confirm`, which precedes everything that is written.
    """

    def __init__(
        self,
        claims: TrialClaims,
        claim: Claim,
        lease_s: float,
        patience_s: float,
        driver: Connection | None = None,
    ):
        """Hold a fresh claim, valid for `lease_s` seconds without renewal; a database may be away for `patience_s`.

        `driver` leads to a `LeaseKeeper`; None: this process alone renews the lease.
        """
        self.claim = claim
        self._claims, self._lease_s, self._patience_s = claims, lease_s, patience_s
        self.progress: Mapping[str, Any] = {}
        """How far the trial is; the next renewal stores it."""
        self._driver = driver
        self._is_waiting = False
        """Whether the driver has not answered the last sign of life."""
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
        while not self._over.wait(self._lease_s / (_ALONE if self._driver is None else _BEATS)):
            if self._driver is not None and self._is_kept_by(self._driver):
                continue
            try:
                if not self._renew():
                    self._lost = True
                    return
            except DOWN as error:
                # `confirm` waits for the database before anything is written.
                _log.warning("lease of trial %d: %s", self.claim.trial.number, type(error).__name__)

    def _is_kept_by(self, driver: Connection) -> bool:
        """Read the driver's answers, send it a sign of life, and return whether it still renews the lease."""
        is_renewed = True
        try:
            while driver.poll():
                answer: Answer = driver.recv()
                self._is_waiting = False
                if answer.held == self.claim.held:
                    is_renewed = answer.is_renewed
                if is_renewed and answer.held == self.claim.held:
                    self._renewed_at = max(self._renewed_at, answer.sent_s)
            # One that is suspended reads nothing: more would fill the pipe, and this thread would wait for it.
            if not self._is_waiting:
                driver.send(Beat(self.claim.held, time.monotonic(), dict(self.progress) or None))
                self._is_waiting = True
        except (EOFError, OSError):  # it is gone, and this process ends with it
            self._driver = None
            return False
        return is_renewed and time.monotonic() < self._renewed_at + _UNANSWERED * self._lease_s


class LeaseKeeper:
    """Renews the leases of all workers of a driver that live; a context with a thread of its own."""

    def __init__(self, claims: TrialClaims, lease_s: float, workers: Callable[[], Sequence[Listener]]):
        """Renew for `lease_s` seconds; `workers` returns those that run now."""
        self._claims, self._lease_s, self._workers = claims, lease_s, workers
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="leases", daemon=True)

    def __enter__(self) -> Self:
        """Start to renew."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        # It may wait for a database that does not answer; a lease that was released stays so.
        self._thread.join(1.0)

    def renew(self) -> None:
        """Renew, by one statement, the leases of the workers that have given a sign of life, and answer them."""
        newest = [(worker, worker.hear()) for worker in self._workers()]
        beats = [(worker, beat) for worker, beat in newest if beat is not None]
        if not beats:
            return
        try:
            renewed = self._claims.renew_all({beat.held: beat.progress for _, beat in beats}, self._lease_s)
        except DOWN as error:
            _log.debug("leases: %s", type(error).__name__)  # the workers find out and say so
            renewed = set()
        for worker, beat in beats:
            worker.answer(Answer(beat.held, beat.sent_s, beat.held in renewed))

    def _keep(self) -> None:
        while not self._over.wait(self._lease_s / _BEATS):
            self.renew()
