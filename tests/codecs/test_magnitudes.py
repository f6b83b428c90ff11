"""Magnitudes against numpy's own quantiles, whatever the numbers."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.codecs.magnitudes import LOWER, UPPER, Magnitudes, tops


@pytest.mark.parametrize("seed", range(3))
def test_tops_are_above_quantiles_by_less_than_a_hundredth(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = (rng.normal(size=(20_001, 3)) * np.exp(rng.normal(0, 3, size=(20_001, 1)))).astype(np.float32)
    found = Magnitudes.of(values)
    assert (found.count, found.lowest, found.highest) == (values.size, values.min(), values.max())
    size = np.abs(values).reshape(-1)
    for share in (0.0, 1e-3, 1e-2, 0.5):
        (top,) = tops(found.positive + found.negative, size.size, float(size.max()), np.array([share]))
        assert np.count_nonzero(size > top) <= share * size.size
        exact = np.sort(size)[::-1][int(share * size.size)]
        assert exact * (1 - 1e-6) <= top <= exact * 1.009


def test_signs_and_ends_are_kept_apart() -> None:
    found = Magnitudes.of(np.array([[-2.5, 0.0, 0.75], [1e-30, 4e30, -1e-42]], np.float32))
    assert (found.positive.sum(), found.negative.sum()) == (4, 2)
    for counts, values in ((found.positive, [0, 1e-30, 0.75, 4e30]), (found.negative, [1e-42, 2.5])):
        bins = np.flatnonzero(counts)
        assert (LOWER[bins] <= values).all() and (values < UPPER[bins]).all()
    assert tops(found.negative, 6, 2.5, np.array([0.0])) == [2.5]


def test_no_values_have_no_ends() -> None:
    found = Magnitudes.of(np.empty((0, 3), np.float32))
    assert (found.count, found.lowest, found.highest) == (0, 0, 0)
    assert tops(found.positive, 1, 0, np.array([0.0, 0.5])).tolist() == [0, 0]
