"""The two errors that end a command, their exit codes, guards around user input, and helpers for messages."""

import difflib
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

_LONGEST_LINE = 4000
"""Longest message in characters; the longest lists of options are shorter."""
_LONGEST_READ = 100_000
"""Characters of a message beyond which it is cut before processing: megabytes would take seconds."""
_HEAD, _TAIL = 120, 60
_LONG_VALUE = re.compile(r"\S{400,}|(?<!\w)('|\")(?:(?!\1).){400,}\1(?!\w)")
"""A value that a message repeats: one word, or quoted. Accepted values are neither."""

NO_MEMORY = "needs more memory than there is"


class BadInput(ValueError):  # noqa: N818 - reads as what it is at the raise site
    """A value or file of the user cannot be used; its line is ``what: why; accepted: accepted``.

    Attributes:
        what: the file, key or value; None where `why` is a sentence that names it.
        why: the reason.
        accepted: what would be accepted; empty where the reason says it.
    """

    exit_code = 2

    def __init__(self, what: object, why: object = None, accepted: object = "") -> None:
        """Take the parts of the line, or `what` alone as the whole sentence."""
        self.what = None if why is None else str(what)
        self.why = str(what if why is None else why)
        self.accepted = str(accepted)
        super().__init__(_one_line(self._reason() if self.what is None else f"{self.what}: {self._reason()}"))

    def without(self, what: object) -> str:
        """Return the line without `what`, for a place that names it already; a line about something else is whole."""
        return _one_line(self._reason()) if self.what == str(what) else str(self)

    def _reason(self) -> str:
        return "; ".join(filter(None, (self.why, self.accepted and f"accepted: {self.accepted}")))


class Unknown(BadInput):
    """A key, an option or another name that does not exist."""


class RunFailed(RuntimeError):  # noqa: N818 - reads as what it is at the raise site
    """A run that had started cannot continue: reward error, non-finite value, lost worker, full disk."""

    exit_code = 3

    def __init__(self, reason: object) -> None:
        """Take the line with the reason."""
        super().__init__(_one_line(str(reason)))


@contextmanager
def reading(what: object, accepted: str = "", why: str = "") -> Iterator[None]:
    """Turn any error while a user's value or file is read, composed or built into `BadInput`.

    Args:
        what: the key with its value, or the file.
        accepted: what would be accepted, for the message.
        why: the kind of error, ahead of the error itself: ``not JSON``.

    Raises:
        BadInput: one line with `what`, the reason and what would be accepted.
    """
    try:
        yield
    except (BadInput, RunFailed):
        raise
    except Exception as error:  # libraries raise any type of error for a bad value or file
        raise BadInput(what, f"{why}: {_reason(error)}" if why else _reason(error), accepted) from error


@contextmanager
def naming(what: object) -> Iterator[None]:
    """Put the key or file in front of the line of `BadInput`."""
    try:
        yield
    except BadInput as error:
        raise BadInput(what, error) from None


@contextmanager
def writing(
    what: object, accepted: str = "", failure: type[Exception] = BadInput, also: type[Exception] = OSError
) -> Iterator[None]:
    """Turn an OSError while a file is written into `BadInput` or another failure.

    `what` and `accepted` are as for `reading`; `failure` is raised in its place, and `also` is another type of error to
    turn.
    """
    try:
        yield
    except (OSError, also) as error:
        why = f"cannot be written: {getattr(error, 'strerror', None) or error}"
        problem = BadInput(what, why, accepted)
        raise (problem if failure is BadInput else failure(str(problem))) from error


def is_refused_memory(error: BaseException) -> bool:
    """Return whether an allocation was refused, for which torch raises a RuntimeError."""
    return isinstance(error, MemoryError) or "can't allocate memory" in str(error)


def _reason(error: Exception) -> str:
    if isinstance(error, RecursionError):
        return "nested too deeply"
    if is_refused_memory(error):
        return NO_MEMORY
    if isinstance(error, UnicodeDecodeError):
        return f"is not UTF-8 text (byte {error.start} is 0x{error.object[error.start]:02x})"
    if isinstance(error, OSError) and error.strerror:
        return f"cannot be read: {error.strerror}"
    mark = getattr(error, "problem_mark", None)
    if mark is not None:  # a YAML error has several lines, most of them about the position
        return f"{getattr(error, 'problem', None)} in line {mark.line + 1}"
    if type(error).__module__ != "builtins" or isinstance(error, ValueError | OSError | RuntimeError):
        return str(error) or type(error).__name__
    return f"{type(error).__name__}: {error}"


def _one_line(text: str) -> str:
    """Return a text without line breaks and control characters, and without the middle of a very long text."""
    text = _without_middle(text, _LONGEST_READ)
    line = "".join(
        letter if letter.isprintable() else repr(letter)[1:-1] for letter in " ".join(text.split())
    )
    line = _LONG_VALUE.sub(lambda value: f"{value[0][:_HEAD]} … {value[0][-_TAIL:]}", line)
    return _without_middle(line, _LONGEST_LINE)


def _without_middle(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[: most // 2]} … {text[-(most // 2) :]}"


def count(number: int, what: str) -> str:
    """Return a number of things: ``1 lap``, ``2,000 laps``."""
    return f"{number:,} {what}{'s' * (number != 1)}"


def nearest(word: str, candidates: Iterable[str]) -> str:
    """Return `` (did you mean X?)`` for the known word nearest to `word`, or an empty string.

    A word that begins with it is nearest, then one that looks like it, then one that contains it.
    """
    words, lower = list(candidates), word.casefold()
    long = len(word) > 2
    close = (
        [candidate for candidate in words if long and candidate.startswith(word)]
        or [candidate for candidate in words if long and candidate.casefold().startswith(lower)]
        or difflib.get_close_matches(word, words, n=1, cutoff=0.5)
        or [candidate for candidate in words if long and lower in candidate.casefold()]
    )
    return f" (did you mean {close[0]}?)" if close else ""
