"""Polynomials against numpy's functions."""

from __future__ import annotations

import numpy as np

from sparklod_cli.system import fast_math


def test_exp2_is_that_of_numpy_to_six_digits() -> None:
    t = -np.concatenate([np.linspace(0, 20, 20_001), np.arange(126), [1e-7, 125.999]]).astype(np.float32)
    got = np.array([fast_math.exp2(value) for value in t], np.float64)
    np.testing.assert_allclose(got, np.exp2(t.astype(np.float64)), rtol=5e-7)


def test_log2_is_that_of_numpy_to_six_digits_also_near_1() -> None:
    """Near 1 it must be exact relative to what little it is there: it is multiplied by up to 6,836."""
    v = np.concatenate([np.linspace(0, 1, 20_001)[1:], 1 - np.geomspace(1e-7, 0.5, 500), np.geomspace(1e-30, 1, 2_000)])
    v = v.astype(np.float32)
    got = np.array([fast_math.log2(value) for value in v], np.float64)
    np.testing.assert_allclose(got, np.log2(v.astype(np.float64)), rtol=4e-7)
