"""Places of a course that steps are gathered in: square cells of a grid, and waypoints."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from deepracer_exp.tracks.track import Track

from .chart import Cells, Values

SIDES_M = (0.04, 0.05, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.75, 1.0)
"""Sides of a cell, of which the smallest is taken that keeps the number of cells within bounds."""
RIM_M = 0.4
"""How much of the ground around the road belongs to a grid."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Square cells over the bounding box of a road."""

    low_x: float
    low_y: float
    side_m: float
    columns: int
    rows: int

    @classmethod
    def over(cls, course: Track, most: int = 20_000) -> "Grid":
        """Lay cells over a course, at most `most` and as small as `SIDES_M` lets them be."""
        borders = np.concatenate([course.inner, course.outer])
        low, high = borders.min(axis=0) - RIM_M, borders.max(axis=0) + RIM_M
        for side_m in (*SIDES_M, float((high - low).max() / most**0.5)):
            columns, rows = (int(np.ceil(length / side_m)) for length in high - low)
            if columns * rows <= most or side_m > SIDES_M[-1]:
                break
        return cls(low_x=float(low[0]), low_y=float(low[1]), side_m=side_m, columns=columns, rows=rows)

    def of(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.intp]:
        """Return the cell of each point (n,): row by row from the lower left; -1 where it is outside."""
        column = np.floor((np.asarray(x, np.float64) - self.low_x) / self.side_m)
        row = np.floor((np.asarray(y, np.float64) - self.low_y) / self.side_m)
        inside = (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        return np.where(inside, row * self.columns + column, -1).astype(np.intp)

    @property
    def x(self) -> Values:
        """Return the centres of the columns, m."""
        return self.low_x + self.side_m * (np.arange(self.columns, dtype=np.float64) + 0.5)

    @property
    def y(self) -> Values:
        """Return the centres of the rows, m."""
        return self.low_y + self.side_m * (np.arange(self.rows, dtype=np.float64) + 0.5)

    @property
    def count(self) -> int:
        """Return the number of cells."""
        return self.columns * self.rows

    def cells(
        self,
        values: Values,
        scale: str,
        *,
        diverging: bool = False,
        value_range: tuple[float, float] | None = None,
    ) -> Cells:
        """Return values (count,) as the layer of a map; float32 is precise enough for colours."""
        return Cells(
            x=self.x,
            y=self.y,
            values=np.asarray(values, np.float32).reshape(self.rows, self.columns),  # type: ignore[arg-type]
            scale=scale,
            diverging=diverging,
            value_range=value_range,
        )

    def table(self, values: dict[str, Values]) -> pd.DataFrame:
        """Return the cells that anything is known of: centre `x_m`, `y_m` and `values`, each (count,)."""
        row, column = np.divmod(np.arange(self.count), self.columns)
        table = pd.DataFrame({"x_m": self.x[column], "y_m": self.y[row], **values})
        return table[table[list(values)].notna().any(axis=1)].reset_index(drop=True)


def totals(place: NDArray[np.intp], values: ArrayLike | None, n: int) -> Values:
    """Return the sum of values (or the number of rows) at each of n places; -1 is no place, NaN no value."""
    known = place >= 0
    if values is None:
        return np.bincount(place[known], minlength=n).astype(np.float64)
    numbers = np.asarray(values, np.float64)
    known &= np.isfinite(numbers)
    return np.bincount(place[known], numbers[known], minlength=n).astype(np.float64)


def means(place: NDArray[np.intp], values: ArrayLike, n: int, least: int = 1) -> Values:
    """Return the mean of values at each of n places; NaN where fewer than `least` are known."""
    values = np.asarray(values, np.float64)
    known = totals(np.where(np.isfinite(values), place, -1), None, n)
    return totals(place, values, n) / np.where(known >= least, known, np.nan)


def quantiles(place: NDArray[np.intp], values: ArrayLike, n: int, shares: tuple[float, ...]) -> Values:
    """Return quantiles (len(shares), n) of the values at each of n places, between two values the lower one."""
    numbers = np.asarray(values, np.float64)
    known = (place >= 0) & np.isfinite(numbers)
    place, numbers = place[known], numbers[known]
    order = np.argsort(numbers)
    # Stable, so that the values of each place stay in order.
    numbers = numbers[order][
        np.argsort(place[order].astype(np.int16 if n < 2**15 else np.int32), kind="stable")
    ]
    count = np.bincount(place, minlength=n)
    first = np.r_[0, np.cumsum(count)[:-1]]
    if not len(numbers):
        return np.full((len(shares), n), np.nan)
    found = [
        numbers[np.minimum(first + ((count - 1) * share).astype(int), len(numbers) - 1)] for share in shares
    ]
    return np.where(count > 0, np.stack(found), np.nan)


def wilson(hits: Values, tries: Values, z: float = 1.96) -> tuple[Values, Values]:
    """Return the ends of the Wilson score interval of hits / tries (z 1.96: 95 per cent); NaN where never tried.

    Source: E. B. Wilson, Probable inference, the law of succession, and statistical inference (1927).
    """
    tries = np.where(tries > 0, tries, np.nan)
    share = hits / tries
    middle = share + z**2 / (2 * tries)
    reach = z * np.sqrt(share * (1 - share) / tries + z**2 / (4 * tries**2))
    scale = 1 + z**2 / tries
    return np.maximum((middle - reach) / scale, 0.0), np.minimum((middle + reach) / scale, 1.0)
