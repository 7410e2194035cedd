"""How a run ended."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Outcome:
    """How a run ended."""

    status: str
    """`finished`, `hopeless` (ended by a stopping rule that expects nothing of it), `interrupted` or `failed`."""
    reason: str
    exit_code: int
    folder: Path
    summary: dict[str, Any]
    error: BaseException | None = None
    """What a failed run failed of."""
    note: str | None = None
    """A line on what is missing from its results."""
