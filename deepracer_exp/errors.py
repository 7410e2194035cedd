"""The two ways a command ends badly, and their exit codes."""

import difflib
from collections.abc import Iterable


class BadInput(ValueError):  # noqa: N818 - reads as what it is at the raise site
    """Something the user gave cannot be used; the message is one line that says what would be accepted."""

    exit_code = 2


class RunFailed(RuntimeError):  # noqa: N818 - reads as what it is at the raise site
    """A run that had begun cannot go on: reward error, non-finite value, lost worker, full disk."""

    exit_code = 3


def nearest(word: str, known: Iterable[str]) -> str:
    """Return `` (did you mean X?)`` for the known word nearest to `word`, or an empty string."""
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.5)
    return f" (did you mean {close[0]}?)" if close else ""
