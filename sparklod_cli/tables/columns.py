"""`Column`, name, type, precision, unit and meaning of the cells of a table, and `Table`, rows of such cells."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, overload

from ..system.optional import optional_import

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
        """Return a value rounded to the digits of this column.

        A number that is not finite, of splats that are not, is an empty cell.
        """
        if not self.digits or value is None:
            return value
        if not math.isfinite(float(value)):
            return None
        return float(format(value, self.digits)) + 0.0  # adding 0 turns -0 into 0

    def text(self, value: Cell) -> str:
        """Return the text of a cell in a CSV file."""
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


#: Rows that are shown of a table in a notebook, half from its beginning and half from its end.
SHOWN = 20


@dataclass(frozen=True, eq=False, repr=False)
class Table(Sequence[Row]):
    """Rows, each a dictionary of cells by the names of the columns.

    Attributes:
        rows: in order.
        columns: name, type, unit and meaning of the cells.
    """

    rows: Sequence[Row]
    columns: Sequence[Column]

    def __len__(self) -> int:
        return len(self.rows)

    @overload
    def __getitem__(self, index: int) -> Row: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[Row]: ...

    def __getitem__(self, index: int | slice) -> Row | Sequence[Row]:
        return self.rows[index]

    def __iter__(self) -> Iterator[Row]:
        return iter(self.rows)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self.rows):,} rows of {len(self.columns)} columns)"

    def column(self, name: str) -> list[Cell]:
        """Return the cells of a column, None where one is empty.

        Raises:
            KeyError: there is no such column; the text names those that there are.
        """
        names = [column.name for column in self.columns]
        if name not in names:
            raise KeyError(f"there is no column {name!r}, only {', '.join(names)}")
        return [row[name] for row in self.rows]

    def to_pandas(self) -> Any:
        """Return a pandas DataFrame with the same columns; empty cells are missing values.

        Raises:
            SparklodError: pandas is not installed.
        """
        with optional_import("to_pandas needs pandas", package="pandas"):
            import pandas
        kinds = {int: "Int64", float: "float64", str: "string"}
        cells = {column.name: self.column(column.name) for column in self.columns}
        return pandas.DataFrame(
            {column.name: pandas.Series(cells[column.name], dtype=kinds[column.kind]) for column in self.columns}
        )

    def _repr_html_(self) -> str:
        """For Jupyter."""
        half = SHOWN // 2
        rows = list(self.rows)
        parts = [rows] if len(rows) <= SHOWN else [rows[:half], rows[-half:]]
        head = "".join(f'<th title="{escape(column.meaning)}">{escape(column.name)}</th>' for column in self.columns)
        bodies = [
            "".join(
                "<tr>"
                + "".join(f"<td>{escape(column.text(row[column.name]))}</td>" for column in self.columns)
                + "</tr>"
                for row in part
            )
            for part in parts
        ]
        gap = f'<tr><td colspan="{len(self.columns)}">…</td></tr>'
        return (
            f"<table><thead><tr>{head}</tr></thead><tbody>{gap.join(bodies)}</tbody></table><p>{escape(repr(self))}</p>"
        )
