"""The control steps of one file, of which the last are held."""

from collections import deque
from collections.abc import Iterable, Sequence

import pyarrow as pa

from .sim_trace import SCHEMA

MOST_STEPS = 4_000_000
"""Control steps of a recording that are held in memory: 74 hours of driving at 15 a second. A report of so many takes
about 2.5 GB."""


def left_out(steps: int) -> str:
    """Return why so many steps are not read."""
    return f"{steps:,} steps of it are left out: of a recording the last {MOST_STEPS:,} are held"


class StepTables:
    """Tables of `sim_trace.SCHEMA` in the order of reading; when there are too many rows the first tables go."""

    def __init__(self, tables: Iterable[pa.Table] = (), left_out: int = 0) -> None:
        self._tables = deque(tables)
        self.rows = sum(table.num_rows for table in self._tables)
        """Rows held."""
        self.left_out = left_out
        """Rows that are gone."""

    @classmethod
    def joined(cls, pieces: Sequence["StepTables"]) -> "StepTables":
        """Return the tables of several files, one after the other."""
        return cls(
            (table for piece in pieces for table in piece._tables), sum(piece.left_out for piece in pieces)
        )

    def add(self, table: pa.Table) -> None:
        """Add rows that stand behind the others; let go of the first tables if there are too many."""
        self._tables.append(table)
        self.rows += table.num_rows
        while self.rows > MOST_STEPS and len(self._tables) > 1:
            self.leave_out_first()

    def leave_out_first(self) -> None:
        """Let go of the first table; its memory is free then, as it would not be of a part of it."""
        gone = self._tables.popleft().num_rows
        self.rows -= gone
        self.left_out += gone

    @property
    def told(self) -> bool:
        """Whether there were rows or lines that should have been some."""
        return bool(self._tables) or self.left_out > 0

    @property
    def whole(self) -> pa.Table:
        """All rows held."""
        return pa.concat_tables(self._tables) if self._tables else SCHEMA.empty_table()
