"""`Table`: rows by number, columns by name, pandas, and HTML in a notebook."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, overload

from ..system.errors import optional_import
from .columns import Cell, Column, Row

#: Rows that are shown of a table in a notebook, half from its beginning and half from its end.
SHOWN = 20


@dataclass(frozen=True, eq=False, repr=False)
class Table(Sequence[Row]):
    """Rows, each a dictionary of cells by the names of the columns.

    Attributes:
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
        half, rows = SHOWN // 2, list(self.rows)
        parts = [rows] if len(rows) <= SHOWN else [rows[:half], rows[-half:]]
        head = "".join(f'<th title="{escape(column.meaning)}">{escape(column.name)}</th>' for column in self.columns)

        def line(row: Row) -> str:
            cells = ((row[column.name], column.digits) for column in self.columns)
            texts = ("" if cell is None else escape(format(cell, digits)) for cell, digits in cells)
            return f"<tr>{''.join(f'<td>{text}</td>' for text in texts)}</tr>"

        bodies = ["".join(map(line, part)) for part in parts]
        gap = f'<tr><td colspan="{len(self.columns)}">…</td></tr>'
        return (
            f"<table><thead><tr>{head}</tr></thead><tbody>{gap.join(bodies)}</tbody></table><p>{escape(repr(self))}</p>"
        )
