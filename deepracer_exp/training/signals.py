"""Ctrl-C and SIGTERM: they end a run after the iteration in progress, or abandon that if it takes long."""

import signal
import threading
import time
from collections.abc import Callable
from types import FrameType

PATIENCE_S = 4.0
"""Seconds after a signal at which the iteration in progress is abandoned, if it may be; ending workers takes longer."""
_LOOK_EVERY_S = 0.1


class Interruption:
    """Records a request to end and answers it; a second signal ends at once.

    After `PATIENCE_S`, the iteration in progress is abandoned if that loses nothing else.

    Attributes:
        may_leave_out: whether all but the iteration in progress is stored.
        left_out: whether the iteration in progress was left out.

    Nested ones, as of a training within a worker of a sweep, share the same request.
    """

    def __init__(self, answer: Callable[[str], None] | None = None) -> None:
        """Set up, without listening yet.

        `answer` is called with a line when the first signal comes; None: nothing is shown.
        """
        self._answer = answer
        self.signum: int | None = None
        self.may_leave_out = self.left_out = False
        self._asked, self._over = threading.Event(), threading.Event()
        self._patience = threading.Thread(target=self._lose_patience, name="patience", daemon=True)
        self._before: dict[int, object] = {}
        self._outer: Interruption | None = None

    def __enter__(self) -> "Interruption":
        """Begin to listen."""
        for signum in (signal.SIGINT, signal.SIGTERM):
            self._before[signum] = before = signal.signal(signum, self._on_signal)
            outer = getattr(before, "__self__", None)
            if isinstance(outer, Interruption):
                self._outer, self.signum = outer, outer.signum
        self._patience.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._asked.set()
        self._patience.join()
        for signum, handler in self._before.items():
            signal.signal(signum, handler)  # type: ignore[arg-type]

    @property
    def exit_code(self) -> int | None:
        """Return 128 + the signal's number, None if none came."""
        return None if self.signum is None else 128 + self.signum

    def _on_signal(self, signum: int, _: FrameType | None) -> None:
        if self.signum is not None:
            raise KeyboardInterrupt
        self.signum = signum
        self._asked.set()
        if self._outer is not None:
            self._outer.signum = signum
        if self._answer is not None:
            self._answer(
                "stopping: this iteration is finished and its policy evaluated, or, if it takes more than "
                f"{PATIENCE_S:.0f} s and the one before is stored, left out; Ctrl-C again ends at once"
            )

    def _lose_patience(self) -> None:
        """Send the main thread a second signal when it is time to."""
        self._asked.wait()
        at_s = time.monotonic() + PATIENCE_S
        while not self._over.wait(_LOOK_EVERY_S):
            if self.may_leave_out and time.monotonic() >= at_s:
                self.left_out = True
                # To that thread, so that a call in which it waits returns.
                signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
                return
