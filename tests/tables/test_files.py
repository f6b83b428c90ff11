"""Tables as files, and their columns."""

from __future__ import annotations

import csv
import io
import itertools
import json
import re
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.simulation.results import COLUMNS
from sparklod_cli.system.errors import SparklodError
from sparklod_cli.system.packages import install_hint
from sparklod_cli.tables.columns import FORMS, TYPES, Cell, Column, Row
from tests.tables.rows import flight, row

pytestmark = pytest.mark.slow

NAMES = st.none() | st.text(min_size=1, max_size=20)
INTS = st.none() | st.integers(-(2**53), 2**53)
FLOATS = st.none() | st.floats(-1e9, 1e9)


def named(names: list[str]) -> list[Column]:
    """The columns of these names, in this order."""
    return [next(column for column in COLUMNS if column.name == name) for name in names]


def encoded(rows: Sequence[Row], form: str, columns: Sequence[Column] = COLUMNS) -> bytes:
    if form == "parquet":
        pytest.importorskip("pyarrow", reason="Parquet needs the extra `parquet`")
    return b"".join(FORMS[form](rows, columns))


def from_csv(data: bytes) -> list[dict[str, Cell]]:
    """Rows of a CSV file, by the module csv; a cell is empty, or of its column's type."""
    kinds = {column.name: column.kind for column in COLUMNS}
    read = csv.DictReader(io.StringIO(data.decode("utf-8"), newline=""), strict=True)
    return [{name: kinds[name](text) if text else None for name, text in each.items()} for each in read]


def from_parquet(data: bytes) -> list[dict[str, Cell]]:
    parquet = pytest.importorskip("pyarrow.parquet", reason="Parquet needs the extra `parquet`")
    rows: list[dict[str, Cell]] = parquet.read_table(io.BytesIO(data)).to_pylist()
    return rows


def clean(text: str) -> str:
    return text.encode("utf-8", "replace").decode()


def harmless(cell: Cell) -> Cell:
    """As CSV has it: a text that a spreadsheet would run is marked as one."""
    return f"'{cell}" if isinstance(cell, str) and cell[:1] in tuple("=+-@\t\r\n") else cell


@st.composite
def random_rows(draw: st.DrawFn) -> list[Row]:
    strategies = {int: INTS, float: FLOATS, str: NAMES}
    rows = []
    for _ in range(draw(st.integers(0, 4))):
        cells = {column.name: draw(strategies[column.kind]) for column in COLUMNS[1::3]}
        rows.append(row(0, **cells))
    return rows


def test_csv_gives_the_rows_back() -> None:
    rows = flight(40)
    assert from_csv(encoded(rows, "csv")) == rows


def test_json_gives_the_rows_back() -> None:
    rows = flight(40)
    assert json.loads(encoded(rows, "json"))["data"] == rows


def test_parquet_gives_the_rows_back() -> None:
    rows = flight(40)
    assert from_parquet(encoded(rows, "parquet")) == rows


@given(random_rows())
def test_csv_and_json_have_the_same_rows(rows: list[Row]) -> None:
    expected = [{n: clean(c) if isinstance(c, str) else c for n, c in each.items()} for each in rows]
    # NUL ends a line for the module csv of Python 3.10.
    if not any("\0" in cell for each in rows for cell in each.values() if isinstance(cell, str)):
        assert from_csv(encoded(rows, "csv")) == [{n: harmless(c) for n, c in each.items()} for each in expected]
    assert json.loads(encoded(rows, "json"))["data"] == expected


@given(random_rows())
def test_parquet_has_the_rows_of_the_other_formats(rows: list[Row]) -> None:
    assert from_parquet(encoded(rows, "parquet")) == json.loads(encoded(rows, "json"))["data"]


@pytest.mark.parametrize("form", FORMS)
def test_the_same_rows_give_the_same_bytes(form: str) -> None:
    assert encoded(flight(20), form) == encoded(flight(20), form)


@pytest.mark.parametrize("form", FORMS)
def test_a_table_of_no_rows_is_read_as_none(form: str) -> None:
    data = encoded([], form)
    read = {"csv": from_csv, "json": lambda data: json.loads(data)["data"], "parquet": from_parquet}[form](data)
    assert read == []


@pytest.mark.parametrize("start", ["=", "+", "-", "@", "\t", "\r", "\n"])
def test_csv_names_are_no_formulas_and_numbers_stay_numbers(start: str) -> None:
    name = f"{start}cmd|' /C calc'!A0"
    rows = [row(0, name=name, churn=-0.25)]
    columns = named(["name", "churn"])
    (read,) = csv.reader(io.StringIO(encoded(rows, "csv", columns).decode().partition("\n")[2], newline=""))
    assert read == [f"'{name}", "-0.2500"]
    assert json.loads(encoded(rows, "json", columns))["data"] == [{"name": name, "churn": -0.25}]


def test_csv_quotes_names_and_leaves_empty_cells() -> None:
    rows = [
        row(0, name='the "red", door', churn=None, selected=12, budget_used=1 / 3),
        row(1, name="two\r\nlines", churn=0.25, selected=13, budget_used=0.0),
    ]
    columns = named(["frame", "time_s", "name", "selected", "budget_used", "churn"])
    assert encoded(rows, "csv", columns).decode() == (
        "frame,time_s,name,selected,budget_used,churn\n"
        '0,0.000000,"the ""red"", door",12,0.3333,\n'
        '1,0.033333,"two\r\nlines",13,0.0000,0.2500\n'
    )


@pytest.mark.parametrize("form", ["csv", "json"])
def test_rows_are_written_before_all_are_known(form: str) -> None:
    """Also when they never end."""
    taken = 0

    def endless() -> Iterator[Row]:
        nonlocal taken
        for frame in itertools.count():
            taken += 1
            yield row(frame)

    pieces = FORMS[form](endless(), COLUMNS)
    while taken < 1:
        next(pieces)
    for frame in range(1, 5):
        start = {"csv": f"{frame},", "json": f',\n{{"frame": {frame}, '}[form]
        assert next(pieces).startswith(start.encode())
        assert taken == frame + 1


@pytest.mark.parametrize("form", FORMS)
def test_an_empty_name_is_no_name(form: str) -> None:
    columns = named(["frame", "name"])
    assert encoded([row(0, name="")], form, columns) == encoded([row(0, name=None)], form, columns)


@pytest.mark.parametrize("form", FORMS)
def test_numbers_that_are_not_finite_are_empty_cells(form: str) -> None:
    for value in (float("nan"), float("inf")):
        assert encoded([row(0, churn=value)], form) == encoded([row(0, churn=None)], form)


def test_json_says_what_its_columns_are() -> None:
    document = json.loads(encoded([], "json"))
    fields = document["schema"]["fields"]
    assert document["schema_version"] == 1
    assert [(field["name"], field["unit"], field["type"]) for field in fields] == [
        (column.name, column.unit, TYPES[column.kind]) for column in COLUMNS
    ]


def test_parquet_has_types_and_units() -> None:
    parquet: Any = pytest.importorskip("pyarrow.parquet", reason="Parquet needs the extra `parquet`")
    schema = parquet.read_schema(io.BytesIO(encoded([row(0)], "parquet")))
    types = {int: "int64", float: "double", str: "string"}
    for column, field in zip(COLUMNS, schema, strict=True):
        assert (field.name, str(field.type), field.nullable) == (column.name, types[column.kind], True)
        assert field.metadata[b"unit"].decode() == column.unit
        assert field.metadata[b"description"].decode() == column.meaning


def test_the_extra_that_brings_pyarrow_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(SparklodError, match=re.escape(install_hint("parquet"))) as caught:
        FORMS["parquet"]([], COLUMNS)
    assert "\n" not in str(caught.value)
