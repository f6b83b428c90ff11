"""Columns of a table as series of numbers along time, and the colours that charts draw them in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..tables.columns import Row
from ..tables.statistics import numbers

#: Colours of the series: stops of the colour scales of `render.color_scales`, and pink for marks.
GREEN, BLUE, INDIGO, ORANGE, YELLOW, PINK = "#44bf70", "#2a788e", "#414487", "#ed7953", "#fde725", "#ff5c8a"

#: (N,) numbers, one for each row.
Series = NDArray[np.float64]


class Frames:
    """Columns of rows as arrays, along an axis of time or of frame numbers.

    Attributes:
        x: (N,) seconds; frame numbers where the rows have no times.
    """

    def __init__(self, rows: Sequence[Row]) -> None:
        times = numbers(rows, "time_s")
        timed = len(times) == len(rows) and len(set(times)) > 1
        self.rows, self._timed = rows, timed
        self.x = np.array(times if timed else numbers(rows, "frame"), np.float64)
        if len(rows) == 1:  # two points, one frame apart, so that a line can be seen
            self.rows, self.x = [rows[0], rows[0]], self.x + np.array([-0.5, 0.5])

    def tick(self, value: float, place: int) -> str:
        """The label of a tick of the axis."""
        if self._timed:
            return f"{value:g} s"
        return f"frame {value:,.0f}" if value == round(value) else ""

    def has(self, *names: str) -> bool:
        """Whether each of these columns has a number in some row."""
        return all(numbers(self.rows, name) for name in names)

    def column(self, name: str) -> Series:
        """(N,) values of a column; NaN for empty cells."""
        return np.array([np.nan if row[name] is None else row[name] for row in self.rows], np.float64)

    def ratio(self, name: str, of: str) -> Series:
        """(N,) one column over another; NaN where a cell is empty, or the other is 0."""
        above, below = self.column(name), self.column(of)
        return np.divide(above, below, out=np.full(len(above), np.nan), where=below != 0)
