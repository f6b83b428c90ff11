"""`Column`, what a table says of one of its columns: name, type, precision, unit and meaning."""

from __future__ import annotations

import math
from dataclasses import dataclass

#: The value of a cell; None for an empty one, such as the churn of the first frame.
Cell = int | float | str | None


@dataclass(frozen=True)
class Column:
    """One column of a table.

    Attributes:
        name: as the header has it.
        kind: type of the cells that are not empty: int, float or str.
        digits: format of a float (".6f": six decimals, ".6g": six significant digits); empty otherwise.
        unit: as people read it; empty for a plain number or a text.
        meaning: what the cells say, in one phrase.
    """

    name: str
    kind: type
    digits: str
    unit: str
    meaning: str

    def rounded(self, value: Cell) -> Cell:
        """A value rounded to the digits of this column. Rows hold rounded values, so that all file formats agree.

        A number that is not finite, of splats that are not, is an empty cell.
        """
        if not self.digits or value is None:
            return value
        if not math.isfinite(float(value)):
            return None
        return float(format(value, self.digits)) + 0.0  # adding 0 turns -0 into 0

    def text(self, value: Cell) -> str:
        """The text of a cell in a CSV file."""
        if value is None:
            return ""
        return format(value, self.digits) if self.digits else str(value)


#: The cells of a row, by the names of their columns.
Row = dict[str, Cell]

#: Which frame a row is of: the columns that every table with a row for each frame begins with.
FRAME = (
    Column("frame", int, "", "", "number of the frame on the path, from 0; with `--every` some are left out"),
    Column("time_s", float, ".6f", "s", "time on the path"),
    Column("name", str, "", "", "name of the frame, where the path's file has names"),
)
