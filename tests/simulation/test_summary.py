"""A summary has the statistics of all frames, and leads to those that are worth a look."""

from __future__ import annotations

import json

import numpy as np
import pytest

from sparklod_cli.commands.console import WIDTH
from sparklod_cli.commands.traverse import lines
from sparklod_cli.simulation.results import COLUMNS, IN_FRUSTUM, MOMENTS, QUANTITIES, summarize
from sparklod_cli.tables.assertions import check, parse
from tests.tables.rows import flight, row


def test_statistics_of_a_summary_are_those_of_assertions() -> None:
    rows = flight()
    for quantity in summarize(rows).quantities:
        if quantity.name == IN_FRUSTUM:
            continue
        for name in ("min", "p50", "p95", "max"):
            (outcome,) = check([parse(f"{quantity.name}_{name}<0", COLUMNS)], rows)
            assert getattr(quantity, name) == pytest.approx(outcome.value, rel=1e-8)


def test_the_share_in_the_frustum_is_that_of_numpy() -> None:
    rows = flight()
    shares = [row["in_frustum"] / row["selected"] for row in rows]  # type: ignore[operator]
    (quantity,) = [each for each in summarize(rows).quantities if each.name == IN_FRUSTUM]
    assert quantity.p95 == pytest.approx(np.percentile(shares, 95), rel=1e-8)


def test_totals_are_sums_over_all_frames() -> None:
    rows = flight()
    summary = summarize(rows)
    assert summary.frames == 300
    assert summary.seconds == pytest.approx(299 / 30, abs=1e-5)
    assert summary.bytes == sum(row["bytes_new"] for row in rows)  # type: ignore[misc]
    assert summary.bytes_first == rows[0]["bytes_new"]
    assert sum(summary.stop_reasons.values()) == pytest.approx(1, abs=1e-5)
    assert list(summary.stop_reasons.values()) == sorted(summary.stop_reasons.values(), reverse=True)


def test_the_worst_frames_are_named() -> None:
    rows = flight()
    moments = {moment.criterion: moment for moment in summarize(rows).moments}
    assert set(moments) == set(MOMENTS)
    for criterion, column in (("churn", "churn"), ("missing", "missing"), ("overdraw", "overdraw_estimate")):
        moment = moments[criterion]
        assert moment.value == max(row[column] for row in rows if row[column] is not None)  # type: ignore[type-var]
        assert rows[moment.frame][column] == moment.value
        assert rows[moment.frame]["time_s"] == moment.time_s
    assert moments["bytes"].frame == int(0.73 * 300)  # not the first, which fetches more
    assert moments["coarsest"].value > 1


def test_the_first_of_equally_bad_frames_is_named() -> None:
    rows = [row(frame, churn=0.5 if frame in (2, 4) else 0.1) for frame in range(6)]
    assert [moment.frame for moment in summarize(rows).moments] == [2]


def test_columns_without_values_are_left_out() -> None:
    rows = [row(frame, selected=5, missing=0, pixel_scale_min=1.0, pixel_scale_limit=1.0) for frame in range(3)]
    summary = summarize(rows)
    assert [quantity.name for quantity in summary.quantities] == ["selected", "pixel_scale_min", "missing"]
    assert summary.moments == ()
    assert summary.stop_reasons == {}


def test_a_summary_leaves_single_instances_out() -> None:
    rows = flight(20)
    assert summarize([*rows, *(each | {"instance": "tree"} for each in rows)]) == summarize(rows)


def test_a_summary_of_no_frames_is_empty() -> None:
    summary = summarize([])
    assert (summary.frames, summary.seconds, summary.quantities, summary.moments) == (0, 0, (), ())
    assert list(lines(summary)) == ["  path       0 frames, 0.000 s"]


def test_a_summary_survives_json() -> None:
    plain = summarize(flight()).as_dict()
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert set(plain["quantities"]) == set(QUANTITIES)
    assert plain["quantities"]["churn"]["unit"] == "share"
    assert plain["moments"]["churn"]["frame"] == 219


def test_every_quantity_of_a_summary_is_a_column() -> None:
    assert set(QUANTITIES) - {IN_FRUSTUM} <= {column.name for column in COLUMNS}


class TestText:
    def test_a_summary_fits_the_width_of_a_terminal(self) -> None:
        text = list(lines(summarize(flight())))
        assert max(map(len, text)) <= WIDTH
        assert len(text) == 3 + 1 + len(QUANTITIES) + 1 + len(MOMENTS)
        assert all(line == line.rstrip() for line in text)

    def test_large_numbers_and_long_names_fit(self) -> None:
        rows = flight(40, budget=900_000_000)
        for each in rows:
            each |= {"name": "a long\nname " * 20, "bytes_new": 10**13, "frame": 9_999_999, "time_s": 123456.789}
        text = list(lines(summarize(rows)))
        assert max(map(len, text)) <= WIDTH
        assert not any("\n" in line for line in text)

    def test_the_lines_of_a_summary_have_its_figures(self) -> None:
        text = "\n".join(lines(summarize(flight())))
        assert "300 frames, 9.967 s" in text
        assert "67.3 % at the pixel limit, 32.7 % at the budget" in text
        assert "45.5 MB in 56 chunks, 11.4 MB in 14 chunks for the first frame" in text
        assert "219     7.300 s  39.9 % of the splats pop" in text

    def test_columns_without_values_have_no_line(self) -> None:
        text = "\n".join(lines(summarize(flight(bandwidth=False, timing=False))))
        assert "complete" not in text
        assert "traversal" not in text
