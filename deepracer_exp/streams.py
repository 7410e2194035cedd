"""The standard streams of a command: safe characters, and streams that cannot be written."""

import errno
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

_CONTROLS = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters, bidirectional marks, and surrogates, which no stream can encode."""
_ACCOUNT = re.compile(
    # In an ARN; and in a bucket's name: aws-deepracer-ACCOUNT, sagemaker-us-east-1-ACCOUNT, s3://ACCOUNT-logs.
    r"(?<=:)\d{12}(?=:)|((?<=[A-Za-z]-)|(?<=[a-z]-\d-)|(?<=s3://))"
    # Minutes of a log's name, 202611281530, are none.
    r"(?!(?:19|20)\d\d(?:0[1-9]|1[0-2])(?:0[1-9]|[12]\d|3[01])(?:[01]\d|2[0-3])[0-5]\d)\d{12}(?!\d)"
)
_CLOSED_PIPE = 141
"""Exit code of a program whose output is no longer read: 128 and the number of SIGPIPE."""


def without_accounts(text: str) -> str:
    """Return a text without the numbers of AWS accounts, which logs hold in ARNs and names of buckets."""
    return _ACCOUNT.sub("*" * 12, text)


def shown(text: str) -> str:
    """Return a text of unknown origin, such as a file's, in a form that is safe in a terminal."""
    return without_accounts(_CONTROLS.sub("\N{REPLACEMENT CHARACTER}", text))


class Output:
    """A standard stream that never fails: once it cannot be written, further text is discarded.

    So no command ends halfway, and no part of it is blamed, because its reader has left (`| head`) or a disk is full.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.failure: OSError | None = None
        """Why the stream cannot be written; None: it can."""

    def write(self, text: str) -> int:
        """Write a text as it is."""
        try:
            self._stream.write(text)
        except OSError as error:
            self._fail(error)
        return len(text)

    def flush(self) -> None:
        """Flush the stream."""
        try:
            self._stream.flush()
        except OSError as error:
            self._fail(error)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _fail(self, error: OSError) -> None:
        self.failure = self.failure or error
        with suppress(OSError):  # what waits is written to nowhere, too, at the latest when Python ends
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)


class ShownOutput:
    """An `Output` for `print` that writes texts in their safe form."""

    def __init__(self, stream: TextIO) -> None:
        self.as_is = Output(stream)
        """Writes escape sequences, for a console that makes its own."""

    def write(self, text: str) -> int:
        """Write a text as `shown` returns it."""
        self.as_is.write(shown(text))
        return len(text)

    def writelines(self, lines: Iterator[str]) -> None:
        """Write texts one after the other."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.as_is, name)


@contextmanager
def standard_streams() -> Iterator[Output]:
    """Make both standard streams a `ShownOutput` within the block; yield that of the output."""
    for number in range(3):  # a file that is opened later must not become the output
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    before = {name: getattr(sys, name) for name in ("stdout", "stderr", "__stdout__", "__stderr__")}
    outputs = {name: ShownOutput(before[name] or _null_stream()) for name in ("stdout", "stderr")}
    for name, output in outputs.items():
        if before[f"__{name}__"] is before[name]:
            setattr(sys, f"__{name}__", output)
        setattr(sys, name, output)
    try:
        yield outputs["stdout"].as_is
    finally:
        for name, stream in before.items():
            setattr(sys, name, stream)


def exit_code(output: Output, code: int) -> int:
    """Return the exit code of a command that ended with `code`, once its output is written, or could not be."""
    output.flush()
    if code or output.failure is None:
        return code
    if output.failure.errno == errno.EPIPE:
        return _CLOSED_PIPE
    print(f"deepracer-exp: standard output: cannot be written: {output.failure.strerror}", file=sys.stderr)
    return 3


def _null_stream() -> TextIO:
    return open(os.devnull, "w", encoding="utf-8")
