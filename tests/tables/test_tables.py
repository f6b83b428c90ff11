"""Tables as CSV, JSON and Parquet, assertions about their columns, and histograms of their numbers."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
import re
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from sparklod_cli.simulation.results import COLUMNS, EMPTY
from sparklod_cli.system.errors import SparklodError
from sparklod_cli.system.machine import install_hint
from sparklod_cli.tables import assertions
from sparklod_cli.tables.assertions import SIGNS, BadAssertionError, Outcome, parse
from sparklod_cli.tables.columns import FORMS, STATISTICS, TYPES, Cell, Column, Row
from sparklod_cli.tables.histograms import Histogram, as_text, histogram
from tests.tables.rows import flight, row

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


def decoded(data: bytes, form: str) -> list[Any]:
    if form == "json":
        rows: list[Any] = json.loads(data)["data"]
        return rows
    return from_csv(data) if form == "csv" else from_parquet(data)


# --- Files ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("count", [0, 40])
def test_every_format_gives_the_rows_back(count: int, form: str) -> None:
    rows = flight(40)[:count]
    assert decoded(encoded(rows, form), form) == rows
    assert encoded(rows, form) == encoded(rows, form)


@given(random_rows())
def test_csv_and_json_have_the_same_rows(rows: list[Row]) -> None:
    expected = [{n: clean(c) if isinstance(c, str) else c for n, c in each.items()} for each in rows]
    # NUL ends a line for the module csv of Python 3.10.
    if not any("\0" in cell for each in rows for cell in each.values() if isinstance(cell, str)):
        assert from_csv(encoded(rows, "csv")) == [{n: harmless(c) for n, c in each.items()} for each in expected]
    assert json.loads(encoded(rows, "json"))["data"] == expected


@pytest.mark.slow
@given(random_rows())
def test_parquet_has_the_rows_of_the_other_formats(rows: list[Row]) -> None:
    assert from_parquet(encoded(rows, "parquet")) == json.loads(encoded(rows, "json"))["data"]


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


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_empty_names_and_numbers_that_are_not_finite_are_empty_cells(form: str) -> None:
    for name, value in (("name", ""), ("churn", math.nan), ("churn", math.inf), ("churn", -math.inf)):
        assert encoded([row(0, **{name: value})], form) == encoded([row(0, **{name: None})], form)


def test_json_says_what_its_columns_are() -> None:
    document = json.loads(encoded([], "json"))
    fields = document["schema"]["fields"]
    assert document["schema_version"] == 1
    assert [(field["name"], field["unit"], field["type"]) for field in fields] == [
        (column.name, column.unit, TYPES[column.kind]) for column in COLUMNS
    ]


@pytest.mark.slow
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
        list(FORMS["parquet"]([], COLUMNS))
    assert "\n" not in str(caught.value)


# --- Assertions -------------------------------------------------------------------------------------------------------

NUMERIC = [column.name for column in COLUMNS if column.kind is not str]
NAMED = st.sampled_from(sorted(STATISTICS)) | st.integers(0, 100).map(lambda percent: f"p{percent}")


def outcome_of(text: str, rows: list[Row]) -> Outcome:
    (outcome,) = assertions.check([parse(text, COLUMNS)], rows, empty=EMPTY)
    return outcome


def churns(*values: float | None) -> list[Row]:
    return [row(frame, churn=value) for frame, value in enumerate(values)]


@given(st.sampled_from(NUMERIC), st.none() | NAMED, st.sampled_from(sorted(SIGNS)), st.floats(-1e12, 1e12))
def test_every_assertion_is_understood(name: str, statistic: str | None, sign: str, bound: float) -> None:
    left = name if statistic is None else f"{name}_{statistic}"
    for text in (f"{left}{sign}{bound!r}", f" {left} {sign}  {bound!r} "):
        assertion = parse(text, COLUMNS)
        # A column of that name is meant, where there is one, and not a statistic of a shorter one.
        assert (assertion.name, assertion.statistic) == ((left, "") if left in NUMERIC else (name, statistic or ""))
        assert (assertion.sign, assertion.bound) == (sign, bound)


@given(st.text(max_size=30))
def test_any_other_text_is_refused_in_a_line(text: str) -> None:
    try:
        parse(text, COLUMNS)
    except BadAssertionError as error:
        assert "\n" not in str(error)
    else:
        assert any(sign in text for sign in SIGNS)


@given(st.lists(st.floats(0, 1), min_size=1, max_size=30), NAMED, st.sampled_from(sorted(SIGNS)))
def test_statistics_are_those_of_numpy(values: list[float], statistic: str, sign: str) -> None:
    rows = churns(*values)
    cells = [each["churn"] for each in rows]
    column = np.array(cells, np.float64)
    of_numpy = {
        "min": column.min(), "max": column.max(), "mean": column.mean(), "sum": column.sum(), "count": len(column),
        "first": column[0], "last": column[-1],
    }  # fmt: skip
    expected = of_numpy.get(statistic)
    if expected is None:
        expected = np.percentile(column, int(statistic[1:]))
    outcome = outcome_of(f"churn_{statistic}{sign}0.5", rows)
    assert math.isclose(outcome.value, float(expected), rel_tol=1e-12, abs_tol=1e-15)
    assert outcome.held == SIGNS[sign](outcome.value, 0.5)


@given(st.lists(st.none() | st.floats(0, 1), min_size=1, max_size=30), st.sampled_from(sorted(SIGNS)))
def test_without_a_statistic_every_frame_must_hold(values: list[float | None], sign: str) -> None:
    rows = churns(*values)
    cells = [each["churn"] for each in rows if each["churn"] is not None]
    assume(cells)
    outcome = outcome_of(f"churn{sign}0.5", rows)
    failed = [cell for cell in cells if not SIGNS[sign](cell, 0.5)]
    assert (outcome.held, outcome.failed, outcome.frames) == (not failed, len(failed), len(cells))
    assert outcome.worst is not None
    assert outcome.worst["churn"] == outcome.value
    if failed:
        assert outcome.value in failed


@pytest.mark.parametrize(
    ("text", "bound"),
    [
        ("selected<500k", 500_000), ("selected<0.5M", 500_000), ("bytes_new_sum<2G", 2_000_000_000),
        ("budget_used>=20%", 0.2), ("selected<1.1k", 1100), ("selected<1.1 K", 1100), ("churn<7%", 0.07),
        ("position_x>-1.5e-2", -0.015), ("churn<.5", 0.5), ("churn<1.", 1), ("churn<+1", 1),
    ],
)  # fmt: skip
def test_bounds_may_have_units_and_shares(text: str, bound: float) -> None:
    assert parse(text, COLUMNS).bound == bound


@pytest.mark.parametrize(
    ("text", "column", "statistic"),
    [
        ("projected_px_p95<40", "projected_px_p95", ""),
        ("projected_px_p95_max<40", "projected_px_p95", "max"),
        ("projected_px_p95_p95<40", "projected_px_p95", "p95"),
        ("pixel_scale_min<40", "pixel_scale_min", ""),
        ("pixel_scale_min_min<40", "pixel_scale_min", "min"),
        ("level_max<40", "level_max", ""),
        ("level_max_max<40", "level_max", "max"),
        ("budget_max<40", "budget", "max"),
        ("budget_used_max<40", "budget_used", "max"),
    ],
)
def test_the_longest_column_name_is_taken(text: str, column: str, statistic: str) -> None:
    assertion = parse(text, COLUMNS)
    assert (assertion.name, assertion.statistic) == (column, statistic)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is not an assertion like"),
        ("churn", "is not an assertion like"),
        ("churn<", "is not an assertion like"),
        ("<1", "is not an assertion like"),
        ("0<churn<1", "is not an assertion like"),
        ("churn=1", "= is not one of <= >= == != < >"),
        ("churn=<1", "=< is not one of"),
        ("churn<one", "'one' is not a number such as"),
        ("churn<nan", "'nan' is not a number"),
        ("churn<1e999", "1e999 is too large"),
        ("churn<__import__('os')", "is not a number"),
        ("chrun<1", "there is no column 'chrun', did you mean churn"),
        ("chrun_p95<1", "there is no column 'chrun', did you mean churn"),
        ("budget_usd_max<1", "there is no column 'budget_usd', did you mean budget_used"),
        ("pixel_scale_mni<1", "did you mean pixel_scale_min or pixel_scale_limit"),
        ("churn_p101<1", "'p101' is not a statistic of churn: min, mean, max"),
        ("churn_average<1", "'average' is not a statistic of churn: .* or a percentile such as p95"),
        ("zzz<1", "there is no column 'zzz'$"),
        ("stop_reason==1", "stop_reason is a text"),
        ("name_max==1", "name is a text"),
    ],
)
def test_wrong_assertions_are_refused_with_the_reason(text: str, message: str) -> None:
    with pytest.raises(BadAssertionError, match=message) as caught:
        parse(text, COLUMNS)
    assert "\n" not in str(caught.value)


def test_the_worst_frame_is_the_one_farthest_from_the_bound() -> None:
    rows = churns(None, 0.1, 0.9, 0.5)
    assert [outcome_of(text, rows).worst for text in ("churn<0.2", "churn_max<0.2", "churn_p50<0.2")] == [rows[2]] * 3
    assert [outcome_of(text, rows).worst for text in ("churn>0.2", "churn_mean>=3")] == [rows[1]] * 2
    assert outcome_of("churn==0.1", rows).worst == rows[2]
    assert outcome_of("churn!=0.5", rows).worst == rows[3]
    assert outcome_of("churn_last<1", rows).worst == rows[3]
    assert outcome_of("churn_first<1", rows).worst == rows[1]
    assert outcome_of("churn_count==3", rows).worst is None


def test_a_message_names_the_frames_and_the_worst_one() -> None:
    rows = churns(None, 0.1, 0.9, 0.5)
    rows[2]["name"] = "the\ndoor"
    worst = "the worst is frame 2 at 0.067 s (the\\ndoor) with 0.9"
    assert outcome_of("churn<0.2", rows).message() == f"churn<0.2: fails in 2 of 3 frames; {worst}"
    assert outcome_of("churn<1", rows).message() == f"churn<1: holds in all 3 frames; {worst}"
    assert outcome_of("churn_p50<20%", rows).message() == f"churn_p50<20%: churn_p50 is 0.5; {worst}"
    assert outcome_of("churn_last<1", rows).message() == "churn_last<1: churn_last is 0.5, in frame 3 at 0.100 s"
    assert outcome_of("churn_count>3", rows).message() == "churn_count>3: churn_count is 3"


def test_assertions_leave_single_instances_out() -> None:
    rows = [*churns(0.1, 0.2), row(0, instance="tree", churn=0.9)]
    assert outcome_of("churn<0.5", rows).held
    assert outcome_of("churn_count==2", rows).held


@pytest.mark.parametrize(
    ("text", "rows", "why"),
    [
        ("complete_in_s<3", flight(5, bandwidth=False), "complete_in_s is empty: it needs --bandwidth"),
        ("complete_in_s_max<3", flight(5, bandwidth=False), "complete_in_s is empty: it needs --bandwidth"),
        ("traverse_ms_p95<16", flight(5, timing=False), "traverse_ms is empty: --no-timing leaves it out"),
        ("churn<1", flight(1), "there is only one frame"),
        ("churn<1", [], "no frames"),
    ],
)
def test_a_column_without_values_cannot_be_asserted(text: str, rows: list[Row], why: str) -> None:
    with pytest.raises(BadAssertionError, match=why):
        outcome_of(text, rows)


# --- Histograms -------------------------------------------------------------------------------------------------------

ARRAYS = arrays.arrays(np.float32, st.integers(0, 300), elements=st.floats(width=32))


def check(counted: Histogram, values: np.ndarray) -> None:
    assert int(counted.counts.sum()) + counted.below + counted.above + counted.not_finite == len(values)
    assert counted.not_finite == np.count_nonzero(~np.isfinite(values))
    if len(counted.counts):
        assert len(counted.edges) == len(counted.counts) + 1
        assert (np.diff(counted.edges) > 0).all()
        assert np.isfinite(counted.edges).all()
    else:
        assert not np.isfinite(values).any()
    for line in as_text(counted).splitlines():
        assert len(line) < 100


@given(ARRAYS, st.integers(1, 60))
def test_every_number_is_counted_once(values: np.ndarray, bins: int) -> None:
    counted = histogram(values, bins=bins)
    check(counted, values)
    assert len(counted.counts) in (0, 1, bins)


@given(ARRAYS)
def test_bins_of_a_logarithmic_histogram_have_one_ratio(values: np.ndarray) -> None:
    values = np.abs(values) + np.float32(1e-30)
    counted = histogram(values)
    check(counted, values)
    if counted.log and len(counted.counts) > 1:
        ratios = counted.edges[1:] / counted.edges[:-1]
        assert np.allclose(ratios, ratios[0], rtol=1e-5)


def test_a_bin_has_its_lower_edge_and_the_last_one_both() -> None:
    counted = histogram(np.array([0, 1, 1.5, 2, 2.9, 3, np.nan], np.float32), bins=3)
    assert counted.edges.tolist() == [0, 1, 2, 3]
    assert counted.counts.tolist() == [1, 2, 3]
    assert not counted.log
    assert counted.not_finite == 1


def test_wide_spans_of_positive_numbers_have_bins_of_equal_ratios() -> None:
    values = np.logspace(-3, 1, 100).astype(np.float32)
    assert histogram(values).log
    assert not histogram(values, linear=True).log
    assert not histogram(values + 1).log
    assert not histogram(np.append(values, 0)).log
    assert np.allclose(histogram(values, bins=4).edges, [0.001, 0.01, 0.1, 1, 10])


def test_few_numbers_far_out_do_not_make_all_others_one_bar() -> None:
    values = np.concatenate([np.linspace(-1, 1, 1000), [1e6, -1e6, -2e6]]).astype(np.float32)
    counted = histogram(values)
    assert counted.edges[0] >= -1
    assert counted.edges[-1] <= 1
    assert counted.above < 10
    assert np.count_nonzero(counted.counts) == 40
    text = as_text(counted).splitlines()
    assert text[0].lstrip().startswith("below")
    assert text[-1].lstrip().startswith("above")
    assert len(text) == 22


def test_the_same_number_over_and_over_is_one_bin() -> None:
    counted = histogram(np.full(7, 3.5, np.float32))
    assert counted.counts.tolist() == [7]
    assert counted.edges[0] < 3.5 < counted.edges[1]
    assert as_text(counted, width=10) == "3.5  7  ██████████"


@pytest.mark.parametrize("values", [[], [np.nan, np.inf]])
def test_a_histogram_of_no_finite_number_has_no_bins(values: list[float]) -> None:
    counted = histogram(np.array(values, np.float32))
    assert len(counted.counts) == 0
    assert as_text(counted) == (f"not finite  {len(values)}" if values else "no numbers")


def test_bars_of_text_are_as_long_as_their_counts() -> None:
    values = np.repeat(np.arange(4), [1, 0, 1000, 500]).astype(np.float32)
    assert as_text(histogram(values, bins=4), width=8).splitlines() == [
        "   0      1  ▏",
        "0.75      0",
        " 1.5  1,000  ████████",
        "2.25    500  ████",
    ]


def test_text_puts_bins_together() -> None:
    counted = histogram(np.arange(100, dtype=np.float32), bins=50)
    lines = as_text(counted, rows=10).splitlines()
    assert len(lines) == 10
    assert sum(int(line.split()[1]) for line in lines) == 100
