"""`Column`, what a table says of one of its columns: name, type, precision, unit and meaning."""

from __future__ import annotations

from dataclasses import dataclass

#: What a cell holds; None where there is nothing to say, such as the churn of the first frame.
Cell = int | float | str | None


@dataclass(frozen=True)
class Column:
    """One column.

    Attributes:
        name: as in the header.
        kind: the type of its cells, where they are not empty: int, float or str.
        digits: format of a float (".6f" is fixed, ".6g" significant digits); empty otherwise.
        unit: for people; empty for a plain number, count or text.
        meaning: one phrase.
    """

    name: str
    kind: type
    digits: str
    unit: str
    meaning: str

    def rounded(self, value: Cell) -> Cell:
        """A value as precise as this column is: rows hold these, so every format tells the same numbers."""
        if not self.digits or value is None:
            return value
        return float(format(value, self.digits)) + 0.0  # which makes -0 a 0

    def text(self, value: Cell) -> str:
        """A cell of a CSV file."""
        if value is None:
            return ""
        return format(value, self.digits) if self.digits else str(value)


#: The cells of a row, by the names of their columns.
Row = dict[str, Cell]

#: Which frame a row is of: the columns that every table with a row for each frame begins with.
FRAME = (
    Column("frame", int, "", "", "number of the frame on the path, from 0; `--every` leaves gaps"),
    Column("time_s", float, ".6f", "s", "time on the path"),
    Column("name", str, "", "", "of the frame, where the path's file has names"),
)
