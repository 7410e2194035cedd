"""A thread that keeps an MLflow store up to date, so that nothing else waits for the store."""

import logging
import random
import threading
from collections.abc import Callable, Mapping

from deepracer_exp.errors import BadInput
from deepracer_exp.patience import ends, wait_patiently

from .calls import StoreRefusedError, StoreUnavailableError

_log = logging.getLogger(__name__)

UPDATE_S = 5.0
"""Pause between two updates of a store that answers; what has come up meanwhile is one request."""
_LONGEST_PAUSE_S = 10.0
"""Longest pause while the store does not answer; pauses grow until then."""
_LAST_PAUSE_S = 0.5
"""Longest pause once the store has a deadline."""


class StoreThread:
    """Calls a function every few seconds that brings a store up to date.

    The store may be down, slow or come back later: updates are repeated, without a limit until `finish` sets a
    deadline. The first outage and each kind of refusal are logged.

    Attributes:
        outage: why the store does not answer; None while it does.
        refusal: why it refused something, the first time; None if it refused nothing.
    """

    def __init__(self, update: Callable[[], Mapping[str, str]], shown: str, meanwhile: str) -> None:
        """Start the thread, which waits for `begin`, but not longer than until the second update would be due.

        `update` brings the store up to date and returns what the store refused, with the reasons; it raises
        StoreUnavailableError. `shown` is the address of the store, without password, and `meanwhile` says what
        continues while the store does not answer.
        """
        self.outage: str | None = None
        self.refusal: str | None = None
        self._update, self._shown, self._meanwhile = update, shown, meanwhile
        self._is_complete = False
        self._logged: set[str] = set()
        self._is_outage_logged = False
        self._is_over = threading.Event()
        self._may_begin = threading.Event()
        self._is_ending = threading.Event()
        # Daemon: a hanging store must not keep the process of a finished training alive.
        self._thread = threading.Thread(target=self._work, name="mlflow", daemon=True)
        self._thread.start()

    def begin(self) -> None:
        """Let the first update begin: it imports MLflow, for two seconds of a core that a start needs itself."""
        self._may_begin.set()

    def finish(self, deadline_s: float) -> bool:
        """Update a last time, for at most `deadline_s`; return whether the store answered.

        The limit is the store's: of a process that writes there and has not enough of a core, its CPU time counts.
        """
        self._is_ending.set()
        self._may_begin.set()
        wait_patiently(ends(self._thread), deadline_s)
        self._is_over.set()
        return self._is_complete

    @property
    def has_ended(self) -> bool:
        """Whether no update is under way, and none will be."""
        return not self._thread.is_alive()

    def _work(self) -> None:
        # Jitter, so that processes that began to wait together do not return together.
        pause_s, dice = 0.1, random.Random()
        self._may_begin.wait(UPDATE_S)
        while not self._is_over.is_set():
            is_last = self._is_ending.is_set()
            try:
                refused = self._update()
            except StoreUnavailableError as error:
                self._log_outage(str(error))
                if is_last:
                    self._is_over.wait(_LAST_PAUSE_S)
                else:
                    self._is_ending.wait(pause_s + dice.uniform(0.0, 0.1))
                    pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
                continue
            self.outage, pause_s = None, 0.1
            self._log_refusals(refused)
            if is_last:
                self._is_complete = True
                return
            self._is_ending.wait(UPDATE_S)

    def _log_outage(self, reason: str) -> None:
        self.outage = reason
        if not self._is_outage_logged:
            self._is_outage_logged = True
            _log.warning(
                "MLflow (%s) does not answer; %s and recording is retried: %s",
                self._shown, self._meanwhile, reason,
            )  # fmt: skip

    def _log_refusals(self, refused: Mapping[str, str]) -> None:
        for what, reason in refused.items():
            self.refusal = self.refusal or reason
            if not self._logged & {what, reason}:  # a run deleted in the UI refuses every call
                _log.warning(
                    "MLflow (%s) refused %s; the run folder has everything: %s", self._shown, what, reason
                )
            self._logged |= {what, reason}


def refused_of(writes: Mapping[str, Callable[[], object]]) -> dict[str, str]:
    """Call every function; return the names of those that a store refuses, or that cannot read a file, with reasons."""
    refused = {}
    for what, write in writes.items():
        try:
            write()
        except (BadInput, StoreRefusedError) as error:
            refused[what] = str(error)
    return refused
