"""Binades against numpy's quantiles: the power of two below is the same."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sparklod_cli.codecs.binades import Binades
from sparklod_cli.codecs.steps import ALL_BITS, SMALL_QUANTILE, STEPS_A_SPLAT, fine_bits


def bits_of(values: np.ndarray) -> int:
    """Fractional bits by the quantile itself."""
    small = float(np.quantile(values.astype(np.float64), SMALL_QUANTILE)) if len(values) else 0.0
    return math.ceil(math.log2(STEPS_A_SPLAT / small)) if small > 0 else ALL_BITS


@pytest.mark.parametrize("seed", range(40))
def test_bits_are_those_of_the_quantile(seed: int) -> None:
    """Few values, so that the quantile lies between two of them that are far apart."""
    rng = np.random.default_rng(seed)
    spread = rng.uniform(0, 4)
    values = np.exp(rng.normal(rng.uniform(-40, 40), spread, size=rng.integers(1, 400))).astype(np.float32)
    values[rng.random(len(values)) < rng.choice([0, 0.01, 0.02])] = 0
    assert fine_bits(Binades.of(values)) == bits_of(values)


def test_a_quantile_between_two_binades_is_exact() -> None:
    values = np.array([1.5, 1.75, 200, 300], np.float32)
    found = Binades.of(values)
    assert found.quantile(0.5) == np.quantile(values, 0.5) == 100.875
    assert found.quantile(0) == found.quantile(0.2) == 1.5
    assert found.quantile(1) == 300


@pytest.mark.parametrize("small", [1.0, 2.0**-149, 2.0**-126, 2.0**127, np.nextafter(np.float32(2), np.float32(0))])
def test_powers_of_two_and_the_ends_of_float32_have_their_own_binade(small: float) -> None:
    values = np.full(7, small, np.float32)
    assert fine_bits(Binades.of(values)) == bits_of(values)


@pytest.mark.parametrize("values", [[], [0, 0, 5], [1, math.nan], [math.inf, math.inf]])
def test_without_a_size_nothing_is_rounded(values: list[float]) -> None:
    assert fine_bits(Binades.of(np.array(values, np.float32))) == ALL_BITS
