"""Assertions say what they mean, hold when they should, and tell what was found."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from sparklod_cli.simulation.results import COLUMNS, EMPTY
from sparklod_cli.tables.assertions import SIGNS, BadAssertionError, Outcome, check, parse
from sparklod_cli.tables.columns import STATISTICS, Row
from tests.tables.rows import flight, row

NUMERIC = [column.name for column in COLUMNS if column.kind is not str]
NAMED = st.sampled_from(sorted(STATISTICS)) | st.integers(0, 100).map(lambda percent: f"p{percent}")


def asked(text: str, rows: list[Row]) -> Outcome:
    (outcome,) = check([parse(text, COLUMNS)], rows, empty=EMPTY)
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
    outcome = asked(f"churn_{statistic}{sign}0.5", rows)
    assert math.isclose(outcome.value, float(expected), rel_tol=1e-12, abs_tol=1e-15)
    assert outcome.held == SIGNS[sign](outcome.value, 0.5)


@given(st.lists(st.none() | st.floats(0, 1), min_size=1, max_size=30), st.sampled_from(sorted(SIGNS)))
def test_without_a_statistic_every_frame_must_hold(values: list[float | None], sign: str) -> None:
    rows = churns(*values)
    cells = [each["churn"] for each in rows if each["churn"] is not None]
    assume(cells)
    outcome = asked(f"churn{sign}0.5", rows)
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


def test_a_long_run_of_blanks_is_refused_at_once() -> None:
    with pytest.raises(BadAssertionError, match="is not an assertion like"):
        parse(" " * 40_000, COLUMNS)


def test_the_worst_frame_is_the_one_farthest_from_the_bound() -> None:
    rows = churns(None, 0.1, 0.9, 0.5)
    assert [asked(text, rows).worst for text in ("churn<0.2", "churn_max<0.2", "churn_p50<0.2")] == [rows[2]] * 3
    assert [asked(text, rows).worst for text in ("churn>0.2", "churn_mean>=3")] == [rows[1]] * 2
    assert asked("churn==0.1", rows).worst == rows[2]
    assert asked("churn!=0.5", rows).worst == rows[3]
    assert asked("churn_last<1", rows).worst == rows[3]
    assert asked("churn_first<1", rows).worst == rows[1]
    assert asked("churn_count==3", rows).worst is None


def test_a_message_names_the_frames_and_the_worst_one() -> None:
    rows = churns(None, 0.1, 0.9, 0.5)
    rows[2]["name"] = "the\ndoor"
    worst = "the worst is frame 2 at 0.067 s (the\\ndoor) with 0.9"
    assert asked("churn<0.2", rows).message() == f"churn<0.2: fails in 2 of 3 frames; {worst}"
    assert asked("churn<1", rows).message() == f"churn<1: holds in all 3 frames; {worst}"
    assert asked("churn_p50<20%", rows).message() == f"churn_p50<20%: churn_p50 is 0.5; {worst}"
    assert asked("churn_last<1", rows).message() == "churn_last<1: churn_last is 0.5, in frame 3 at 0.100 s"
    assert asked("churn_count>3", rows).message() == "churn_count>3: churn_count is 3"


def test_assertions_leave_single_instances_out() -> None:
    rows = [*churns(0.1, 0.2), row(0, instance="tree", churn=0.9)]
    assert asked("churn<0.5", rows).held
    assert asked("churn_count==2", rows).held


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("complete_in_s<3", "complete_in_s is empty: it needs --bandwidth"),
        ("complete_in_s_max<3", "complete_in_s is empty: it needs --bandwidth"),
        ("traverse_ms_p95<16", "traverse_ms is empty: --no-timing leaves it out"),
    ],
)
def test_a_column_without_values_cannot_be_asserted(text: str, why: str) -> None:
    with pytest.raises(BadAssertionError, match=why):
        asked(text, flight(5, bandwidth=False, timing=False))


def test_churn_cannot_be_asserted_of_one_frame() -> None:
    with pytest.raises(BadAssertionError, match="there is only one frame"):
        asked("churn<1", flight(1))
    assert asked("churn_count==0", flight(1)).held


def test_no_frames_satisfy_no_assertion() -> None:
    with pytest.raises(BadAssertionError, match="no frames"):
        asked("churn<1", [])
