"""A thread that records one run in an MLflow store, so that nothing else waits for the store."""

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tenacity import RetryCallState, Retrying, retry_if_exception_type
from tenacity.wait import wait_exponential_jitter

from .calls import FileGoneError, StoreRefusedError, StoreUnavailableError
from .store import Store

if TYPE_CHECKING:
    from .mlflow_run import MLflowRun

_log = logging.getLogger(__name__)

PAUSES = wait_exponential_jitter(multiplier=0.1, max=10.0, jitter=0.1)
"""Between calls of a store or a database that does not answer: longer and longer, with jitter, so that processes that
began to wait together do not return together."""
_LAST_PAUSE_S = 0.5
"""The same once there is a deadline."""


@dataclass(frozen=True)
class _Call:
    what: str
    """For the log."""
    do: "Callable[[MLflowRun, bool], object]"
    vital: bool
    """Without it nothing else can be recorded."""


class StoreThread:
    """Makes calls to one run in order, each repeated until it succeeds.

    The store may be down, slow or come back later: calls wait, without a limit until `finish` sets a deadline, where
    MLflow's own asynchronous logging would drop them. What the store refuses is skipped; after a vital call nothing
    more is recorded. The first failure and each kind of refusal are logged.

    Attributes:
        run: the run, once MLflow is loaded.
        is_rejected: whether the store refused a vital call.
        outage: why the store does not answer; None while it does.
        refusal: why it refused a call, the first time; None if it refused none.
    """

    def __init__(self, store: Store, meanwhile: str, on_rejected: Callable[[], None] = lambda: None) -> None:
        """Start the thread, which opens the store.

        `meanwhile` says what continues while the store does not answer; the thread calls `on_rejected` when it ends
        because a vital call was refused.
        """
        self.run: MLflowRun | None = None
        self.is_rejected = False
        self.outage: str | None = None
        self.refusal: str | None = None
        self._store, self._meanwhile, self._on_rejected = store, meanwhile, on_rejected
        self._calls: deque[_Call] = deque()
        self._changed = threading.Condition()
        self._last: _Call | None = None
        self._is_complete = False
        self._refused: set[str] = set()
        self._is_outage_logged = False
        self._end_by = math.inf
        self._has_deadline = threading.Event()
        # Daemon: a hanging store must not keep the process of a finished training alive.
        self._thread = threading.Thread(target=self._work, name="mlflow", daemon=True)
        self._thread.start()

    def put(self, what: str, do: "Callable[[MLflowRun, bool], object]", vital: bool = False) -> None:
        """Make a call later; its bool says whether it is a repetition, `what` names in the log what it writes."""
        with self._changed:
            self._calls.append(_Call(what, do, vital))
            self._changed.notify()

    def finish(self, do: "Callable[[MLflowRun, bool], object]", deadline_s: float) -> bool:
        """Make the remaining calls and a last one for at most `deadline_s`; return whether the last one succeeded."""
        with self._changed:
            self._last = _Call("the end", do, vital=False)
            self._calls.append(self._last)
            self._end_by = time.monotonic() + deadline_s
            self._has_deadline.set()
            self._changed.notify()
        self._thread.join(deadline_s)
        return self._is_complete

    def _work(self) -> None:
        from .mlflow_run import MLflowRun

        self.run = run = MLflowRun(self._store)
        call = _Call("the store", lambda run, _: run.connect(), vital=True)
        while True:
            succeeded = self._attempt(run, call)
            if call is self._last:
                self._is_complete = succeeded
                return
            if call.vital and not succeeded:
                return
            with self._changed:
                self._changed.wait_for(lambda: self._calls)
                call = self._calls.popleft()

    def _attempt(self, run: "MLflowRun", call: _Call) -> bool:
        """Repeat a call until it succeeds, the store refuses it, or time is up; return whether it succeeded."""
        if time.monotonic() >= self._end_by:
            return False
        is_repetition = False

        def once() -> bool:
            nonlocal is_repetition
            again, is_repetition = is_repetition, True
            call.do(run, again)
            self.outage = None
            return True

        retrying = Retrying(
            retry=retry_if_exception_type(StoreUnavailableError),
            wait=PAUSES,
            stop=lambda _: time.monotonic() >= self._end_by,
            sleep=self._pause,
            before_sleep=self._log_outage,
            retry_error_callback=self._give_up,
        )
        try:
            return retrying(once)
        except StoreRefusedError as error:
            if not isinstance(error, FileGoneError):
                self.refusal = self.refusal or str(error)
            self._refuse(call, str(error))
            return False

    def _refuse(self, call: _Call, reason: str) -> None:
        if call.vital:
            self.is_rejected = True
            _log.warning(
                "MLflow (%s) refused %s, so nothing is recorded there; the run folder has everything: %s",
                self._store.shown, call.what, reason,
            )  # fmt: skip
            self._on_rejected()
        elif not self._refused & {call.what, reason}:  # a run deleted in the UI refuses every call
            _log.warning("MLflow (%s) refused %s: %s", self._store.shown, call.what, reason)
        self._refused |= {call.what, reason}

    def _pause(self, seconds: float) -> None:
        if self._has_deadline.is_set():
            time.sleep(_LAST_PAUSE_S)
        else:
            self._has_deadline.wait(seconds)

    def _give_up(self, state: RetryCallState) -> bool:
        self.outage = str(state.outcome and state.outcome.exception())
        return False

    def _log_outage(self, state: RetryCallState) -> None:
        error = state.outcome.exception() if state.outcome is not None else None
        self.outage = str(error)
        if not self._is_outage_logged:
            self._is_outage_logged = True
            _log.warning(
                "MLflow (%s) does not answer; %s and recording is retried: %s",
                self._store.shown, self._meanwhile, error,
            )  # fmt: skip
