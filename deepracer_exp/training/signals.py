"""Ctrl-C and SIGTERM, acted on at the end of an iteration."""

import signal
from collections.abc import Callable
from types import FrameType

from deepracer_exp.rewards.guard import CtrlC


class Interruption:
    """Records a request to end and answers it; a second signal ends at once.

    Where one is entered within another, as a training within a worker of a sweep, both have the same request.
    """

    def __init__(self, answer: Callable[[str], None] | None = None) -> None:
        """Set up, without listening yet.

        `answer` is called with a line when the first signal comes; None: nothing is shown.
        """
        self._answer = answer
        self.signum: int | None = None
        self._before: dict[int, object] = {}
        self._outer: Interruption | None = None

    def __enter__(self) -> "Interruption":
        """Begin to listen."""
        for signum in (signal.SIGINT, signal.SIGTERM):
            self._before[signum] = before = signal.signal(signum, self._hear)
            outer = getattr(before, "__self__", None)
            if isinstance(outer, Interruption):
                self._outer, self.signum = outer, outer.signum
        return self

    def __exit__(self, *_: object) -> None:
        for signum, handler in self._before.items():
            signal.signal(signum, handler)  # type: ignore[arg-type]

    @property
    def exit_code(self) -> int | None:
        """Return 128 + the signal's number, None if none came."""
        return None if self.signum is None else 128 + self.signum

    def _hear(self, signum: int, _: FrameType | None) -> None:
        if self.signum is not None:
            raise CtrlC
        self.signum = signum
        if self._outer is not None:
            self._outer.signum = signum
        if self._answer is not None:
            self._answer(
                "stopping: this iteration is finished and its policy evaluated; Ctrl-C again ends at once"
            )
