"""The console of all commands: contents of files reach the terminal as text, never as escape sequences."""

import sys
from collections.abc import Iterable
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from typing_extensions import override

from deepracer_exp.streams import shown


class Terminal(Console):
    """A console of Rich that removes control characters from cells and lines, but writes its own styles."""

    def __init__(self, *, stderr: bool = False, **options: Any) -> None:
        """Write to standard output or error; `options` are those of Rich's console."""
        stream = sys.stderr if stderr else sys.stdout
        super().__init__(stderr=stderr, **{"file": getattr(stream, "as_is", stream), **options})

    @override
    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(shown(segment.text), segment.style)
