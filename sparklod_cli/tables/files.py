"""Tables as CSV, JSON and Parquet files, with the same cells in each, and the same bytes for the same rows."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from types import ModuleType
from typing import Any

from ..system.optional import optional_import
from .columns import Cell, Column, Row

#: Version of the schema: counts up when a column changes its meaning or is removed, not when one is added.
SCHEMA_VERSION = 1

#: Names of the types of columns in Table Schema (specs.frictionlessdata.io/table-schema).
TYPES = {int: "integer", float: "number", str: "string"}

#: Characters that make CSV quote a text (RFC 4180).
QUOTED = ',"\r\n'

#: First characters of texts that spreadsheets take for formulas, or skip before one.
FORMULAS = ("=", "+", "-", "@", "\t", "\r", "\n")


def encode(rows: Iterable[Row], columns: Sequence[Column], form: str) -> Iterator[bytes]:
    """Return the pieces of a file of rows. CSV and JSON are made row by row, so that long paths take no memory.

    An empty text is written as an empty cell, since CSV cannot tell them apart; what UTF-8 cannot hold becomes "?". In
    CSV a ' is put before a text that a spreadsheet would take for a formula.

    Args:
        rows: with a cell for each column; other cells are ignored.

    Raises:
        SparklodError: pyarrow is not installed, for Parquet; raised by the call itself, before the first row.
        ValueError: a number is not finite; raised while the pieces are taken.
    """
    if form not in FORMS:
        raise ValueError(f"form is {form}, not one of {', '.join(FORMS)}")
    return FORMS[form](rows, columns)


def load_pyarrow() -> ModuleType:
    """Import pyarrow.

    Raises:
        SparklodError: it is not installed.
    """
    with optional_import("Parquet needs pyarrow", "parquet"):
        import pyarrow
        import pyarrow.parquet
    return pyarrow


def _cell(column: Column, row: Row) -> Cell:
    """Return the value of a cell in every format."""
    value = row[column.name]
    if isinstance(value, str):
        return value.encode("utf-8", "replace").decode("utf-8") or None
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{column.name} is {value}")
    return value


def _csv(rows: Iterable[Row], columns: Sequence[Column]) -> Iterator[bytes]:
    yield (",".join(column.name for column in columns) + "\n").encode()
    for row in rows:
        yield (",".join(_field(column, row) for column in columns) + "\n").encode()


def _field(column: Column, row: Row) -> str:
    """Return a field of CSV; a ' before a formula makes it a text."""
    text = column.text(_cell(column, row))
    return _quoted("'" + text if column.kind is str and text.startswith(FORMULAS) else text)


def _quoted(text: str) -> str:
    """Return a quoted field of CSV. The module csv quotes carriage returns in some versions of Python only."""
    return '"' + text.replace('"', '""') + '"' if any(mark in text for mark in QUOTED) else text


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
    return _parquet_pieces(rows, columns, load_pyarrow())  # a missing pyarrow is an error at once, not at the first row


def _parquet_pieces(rows: Iterable[Row], columns: Sequence[Column], pyarrow: ModuleType) -> Iterator[bytes]:
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


#: The formats of tables by name, which is the suffix too, and the function that writes each; the first is the default.
FORMS: dict[str, Callable[[Iterable[Row], Sequence[Column]], Iterator[bytes]]] = {
    "csv": _csv,
    "json": _json,
    "parquet": _parquet,
}
