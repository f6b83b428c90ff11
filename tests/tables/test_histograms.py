"""Histograms count everything once, and can be read."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from sparklod_cli.tables.histograms import Histogram, as_text, histogram

FLOATS = arrays.arrays(np.float32, st.integers(0, 300), elements=st.floats(width=32))


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


@given(FLOATS, st.integers(1, 60))
def test_every_number_is_counted_once(values: np.ndarray, bins: int) -> None:
    counted = histogram(values, bins=bins)
    check(counted, values)
    assert len(counted.counts) in (0, 1, bins)


@given(FLOATS)
def test_bins_of_a_logarithmic_histogram_have_one_ratio(values: np.ndarray) -> None:
    values = np.abs(values) + np.float32(1e-30)
    counted = histogram(values, log=True)
    check(counted, values)
    if len(counted.counts) > 1:
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
    assert not histogram(values, log=False).log
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


def test_no_bins_and_logarithms_of_zero_are_errors() -> None:
    with pytest.raises(ValueError, match="0 bins"):
        histogram(np.ones(3, np.float32), bins=0)
    with pytest.raises(ValueError, match="has no logarithm"):
        histogram(np.array([0, 1], np.float32), log=True)


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
