"""A summary has the statistics of all frames, and names the worst ones."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from sparklod_cli.commands.console import WIDTH
from sparklod_cli.commands.traverse import lines
from sparklod_cli.simulation.results import COLUMNS, IN_FRUSTUM, MOMENTS, QUANTITIES, summarize
from sparklod_cli.tables.assertions import check, parse
from tests.tables.rows import flight, row


def test_statistics_of_a_summary_are_those_of_assertions_and_numpy() -> None:
    rows = flight()
    for quantity in summarize(rows).quantities:
        if quantity.name == IN_FRUSTUM:
            shares: Any = [row["in_frustum"] / row["selected"] for row in rows]  # type: ignore[operator]
            assert quantity.p95 == pytest.approx(np.percentile(shares, 95), rel=1e-8)
            continue
        for name in ("min", "p50", "p95", "max"):
            (outcome,) = check([parse(f"{quantity.name}_{name}<0", COLUMNS)], rows)
            assert getattr(quantity, name) == pytest.approx(outcome.value, rel=1e-8)


def test_totals_are_sums_over_all_frames_but_not_over_instances() -> None:
    rows = flight()
    summary = summarize(rows)
    assert summary.frames == 300
    assert summary.seconds == pytest.approx(299 / 30, abs=1e-5)
    assert summary.bytes == sum(row["bytes_new"] for row in rows)  # type: ignore[misc]
    assert summary.bytes_first == rows[0]["bytes_new"]
    assert sum(summary.stop_reasons.values()) == pytest.approx(1, abs=1e-5)
    assert list(summary.stop_reasons.values()) == sorted(summary.stop_reasons.values(), reverse=True)
    assert summarize([*rows, *(each | {"instance": "tree"} for each in rows)]) == summary
    plain = summary.as_dict()
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert set(plain["quantities"]) == set(QUANTITIES)
    assert set(QUANTITIES) - {IN_FRUSTUM} <= {column.name for column in COLUMNS}
    assert plain["quantities"]["churn"]["unit"] == "share"
    assert plain["moments"]["churn"]["frame"] == 219


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
    rows = [row(frame, churn=0.5 if frame in (2, 4) else 0.1) for frame in range(6)]
    assert [moment.frame for moment in summarize(rows).moments] == [2]  # the first of equal ones


def test_columns_without_values_are_omitted() -> None:
    rows = [row(frame, selected=5, missing=0, pixel_scale_min=1.0, pixel_scale_limit=1.0) for frame in range(3)]
    summary = summarize(rows)
    assert [quantity.name for quantity in summary.quantities] == ["selected", "pixel_scale_min", "missing"]
    assert summary.moments == ()
    assert summary.stop_reasons == {}
    text = "\n".join(lines(summarize(flight(bandwidth=False, timing=False))))
    assert "complete" not in text
    assert "traversal" not in text


def test_a_summary_of_no_frames_is_empty() -> None:
    summary = summarize([])
    assert (summary.frames, summary.seconds, summary.quantities, summary.moments) == (0, 0, (), ())
    assert list(lines(summary)) == ["  path       0 frames, 0.000 s"]


def test_the_lines_of_a_summary_fit_the_width_of_a_terminal() -> None:
    text = list(lines(summarize(flight())))
    assert max(map(len, text)) <= WIDTH
    assert len(text) == 3 + 1 + len(QUANTITIES) + 1 + len(MOMENTS)
    assert all(line == line.rstrip() for line in text)
    for figures in (
        "300 frames, 9.967 s",
        "67.3 % at the pixel limit, 32.7 % at the budget",
        "45.5 MB in 56 chunks, 11.4 MB in 14 chunks for the first frame",
        "219     7.300 s  39.9 % of the splats pop",
    ):
        assert figures in "\n".join(text)
    rows = flight(40, budget=900_000_000)
    for each in rows:
        each |= {"name": "a long\nname " * 20, "bytes_new": 10**13, "frame": 9_999_999, "time_s": 123456.789}
    text = list(lines(summarize(rows)))
    assert max(map(len, text)) <= WIDTH
    assert not any("\n" in line for line in text)
