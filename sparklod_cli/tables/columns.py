"""Tables: columns and rows, their files, statistics of columns, and tables in notebooks."""

from __future__ import annotations

import collections
import io
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from types import ModuleType
from typing import Any, overload

from ..model import TOTAL
from ..system.errors import optional_import
from ..system.output import check_writable, write_file
from ..system.stdio import DASH

#: The value of a cell; None for an empty one, such as the churn of the first frame.
Cell = int | float | str | None


@dataclass(frozen=True)
class Column:
    """One column of a table.

    Attributes:
        kind: type of the cells that are not empty: int, float or str.
        digits: format of a float (".6f": six decimals, ".6g": six significant digits); empty otherwise.
        unit: for display; empty for a plain number or a text.
        meaning: a phrase that describes the cells.
    """

    name: str
    kind: type
    digits: str
    unit: str
    meaning: str

    def rounded(self, value: Cell) -> Cell:
        """Return a value rounded to the digits of this column; a number that is not finite becomes an empty cell."""
        if not self.digits or value is None:
            return value
        if not math.isfinite(float(value)):
            return None
        return float(format(value, self.digits)) + 0.0  # adding 0 turns -0 into 0


#: The cells of a row, by the names of their columns.
Row = dict[str, Cell]

#: Columns that identify a frame; every table with a row for each frame begins with them.
FRAME = (
    Column("frame", int, "", "", "number of the frame on the path, from 0; with `--every` some are left out"),
    Column("time_s", float, ".6f", "s", "time on the path"),
    Column("name", str, "", "", "name of the frame, where the path's file has names"),
)


#: Version of the schema: counts up when a column changes its meaning or is removed, not when one is added.
SCHEMA_VERSION = 1

#: Names of the types of columns in Table Schema (specs.frictionlessdata.io/table-schema).
TYPES = {int: "integer", float: "number", str: "string"}

#: Characters that make CSV quote a text (RFC 4180).
QUOTED = ',"\r\n'

#: First characters of texts that spreadsheets take for formulas, and white space that they skip before one.
FORMULAS = ("=", "+", "-", "@", "\t", "\r", "\n")


def load_pyarrow() -> ModuleType:
    """Import pyarrow, or raise a `SparklodError` that says how to install it."""
    with optional_import("Parquet needs pyarrow", "parquet"):
        import pyarrow
        import pyarrow.parquet
    return pyarrow


def _cell(column: Column, row: Row) -> Cell:
    value = row[column.name]
    if isinstance(value, str):
        return value.encode("utf-8", "replace").decode("utf-8") or None
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{column.name} is {value}")
    return value


def _csv(rows: Iterable[Row], columns: Sequence[Column]) -> Iterator[bytes]:
    yield (",".join(column.name for column in columns) + "\n").encode()
    for row in rows:
        fields = []
        for column in columns:
            cell = _cell(column, row)
            text = "" if cell is None else format(cell, column.digits)
            text = "'" + text if column.kind is str and text.startswith(FORMULAS) else text
            # The module csv quotes carriage returns in some versions of Python only.
            quotes = any(mark in text for mark in QUOTED)
            fields.append('"' + text.replace('"', '""') + '"' if quotes else text)
        yield (",".join(fields) + "\n").encode()


def _json(rows: Iterable[Row], columns: Sequence[Column]) -> Iterator[bytes]:
    fields = [
        {"name": column.name, "type": TYPES[column.kind], "unit": column.unit, "description": column.meaning}
        for column in columns
    ]
    yield f'{{"schema_version": {SCHEMA_VERSION}, "schema": {{"fields": [\n'.encode()
    yield ",\n".join(map(_dumped, fields)).encode()
    yield b'\n]}, "data": ['
    start = "\n"
    for row in rows:
        yield (start + _dumped({column.name: _cell(column, row) for column in columns})).encode()
        start = ",\n"
    yield b"\n]}\n"


def _dumped(value: dict[str, Any]) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def _parquet(rows: Iterable[Row], columns: Sequence[Column]) -> Iterator[bytes]:
    pyarrow = load_pyarrow()
    types = {int: pyarrow.int64(), float: pyarrow.float64(), str: pyarrow.string()}
    fields = [
        pyarrow.field(column.name, types[column.kind], metadata={"unit": column.unit, "description": column.meaning})
        for column in columns
    ]
    schema = pyarrow.schema(fields, metadata={"schema_version": str(SCHEMA_VERSION)})
    cells: list[list[Cell]] = [[] for _ in columns]
    for row in rows:
        for column, values in zip(columns, cells, strict=True):
            values.append(_cell(column, row))
    table = pyarrow.Table.from_arrays(
        [pyarrow.array(values, field.type) for values, field in zip(cells, fields, strict=True)], schema=schema
    )
    file = io.BytesIO()
    pyarrow.parquet.write_table(table, file)
    yield file.getvalue()


#: Formats of tables by name, which is also the suffix, with functions that yield the bytes of a file with a cell for
#: each row and column; the first format is the default. CSV and JSON are encoded row by row, so that long paths take no
#: memory. An empty text becomes an empty cell, since CSV cannot tell them apart; lone surrogates become "?". CSV puts
#: a ' before a text that a spreadsheet would take for a formula. Numbers that are not finite are a `ValueError`.
FORMS: dict[str, Callable[[Iterable[Row], Sequence[Column]], Iterator[bytes]]] = {
    "csv": _csv,
    "json": _json,
    "parquet": _parquet,
}


#: Wraps the bytes of a table on their way to standard output.
Filter = Callable[[Iterable[bytes]], Iterable[bytes]]


@dataclass(frozen=True)
class TableOutput:
    """Destination of a table.

    Attributes:
        path: of its file; None for standard output, or without a `form`.
        form: a key of `FORMS`; None to compute the rows without writing them.
    """

    path: Path | None
    form: str | None
    columns: Sequence[Column]
    overwrite: bool = False

    def check(self) -> None:
        if self.path is not None:
            check_writable(self.path, overwrite=self.overwrite)
        if self.form == "parquet":
            load_pyarrow()

    def write(self, rows: Iterable[Row], *, passed: Filter | None = None) -> None:
        """Compute all rows and write each at once; `passed` filters the bytes on their way to standard output."""
        if self.form is None:
            collections.deque(rows, maxlen=0)
            return
        data: Iterable[bytes] = FORMS[self.form](iter(rows), self.columns)
        if self.path is None and passed is not None:
            data = passed(data)
        write_file(self.path or DASH, data, overwrite=self.overwrite, may_end=self.form != "parquet")


Number = int | float

#: Statistics by name, besides the percentiles p0 to p100.
STATISTICS: dict[str, Callable[[Sequence[Number]], Number]] = {
    "min": min,
    "mean": lambda values: math.fsum(values) / len(values),
    "max": max,
    "sum": lambda values: math.fsum(values) if any(isinstance(value, float) for value in values) else sum(values),
    "first": lambda values: values[0],
    "last": lambda values: values[-1],
    "count": len,
}

PERCENTILE = re.compile(r"p(100|[1-9]?[0-9])")


def is_statistic(name: str) -> bool:
    """Return whether a name is one of `STATISTICS` or a percentile such as p95."""
    return name in STATISTICS or PERCENTILE.fullmatch(name) is not None


def statistic(name: str, values: Sequence[Number]) -> Number:
    """Return one of `STATISTICS`, or a linearly interpolated percentile such as p95, of a column's numbers in order.

    Only "count" takes an empty column.
    """
    if name in STATISTICS:
        return STATISTICS[name](values)
    import numpy as np  # --help does not need it

    return float(np.percentile(np.array(values, np.float64), int(name[1:])))


def totals(rows: Iterable[Row]) -> list[Row]:
    """Return the rows of all instances together, one per frame; all rows if there is no column for instances."""
    return [row for row in rows if row.get("instance", TOTAL) == TOTAL]


def numbers(rows: Iterable[Row], name: str) -> list[Number]:
    """Return the cells of a numeric column that are not empty, in order."""
    return [cell for row in rows if isinstance(cell := row[name], (int, float))]


#: Maximum number of rows that a notebook shows, half from the beginning and half from the end of a table.
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
            KeyError: there is no such column; the message lists the columns.
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
