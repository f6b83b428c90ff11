"""The falloff: approximations against the formulas in float64."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sparklod_cli.model import falloff

DISTANCES = np.linspace(0, 5, 101, dtype=np.float32)


def alpha(z2: float, d: float, design: bool) -> float:
    """In float64, as the pages on Spark's shader and its LoD design have it."""
    if d <= 1:
        return d * math.exp(-z2 / 2)
    if design:
        return math.exp(-d / 2 * max(0.0, math.sqrt(z2) - (d - 1)) ** 2)
    return 1 - (1 - math.exp(-z2 / 2)) ** math.exp((d * d - 1) / math.e)


def exponent(z2: float, d: float) -> np.float32:
    """What falloffs take: its power of two is alpha up to D = 1, and exp(-z^2 / 2) above."""
    return np.float32(math.log2(min(d, 1)) - z2 / 2 * math.log2(math.e))


@pytest.mark.parametrize("design", [False, True])
@pytest.mark.parametrize("d", [0.01, 0.5, 1.0, 1.2, 2.0, 4.0, 5.0])
def test_both_falloffs_are_those_of_spark(d: float, design: bool) -> None:
    opacity, power = np.float32(d), np.float32(math.exp((np.float32(d) ** 2 - 1) / math.e) if d > 1 else 1)
    for z in DISTANCES:
        z2 = float(z) ** 2
        t = exponent(z2, d)
        expected = alpha(z2, float(opacity), design)
        exact = falloff.alpha_at(t, opacity, power, design)
        merged = falloff.shifted(t, opacity) if design else falloff.merged(t, power)
        fast = falloff.plain(t) if d <= 1 else merged
        assert exact == pytest.approx(expected, abs=2e-6)
        assert fast == pytest.approx(expected, abs=3e-6)


@pytest.mark.parametrize("d", [1.2, 5.0])
def test_the_power_of_a_merged_splat_does_not_enlarge_rounding(d: float) -> None:
    """Where 1 - exp(-z^2 / 2) is nearly 1 and the power is thousands."""
    power = np.float32(math.exp((d * d - 1) / math.e))
    for z in np.linspace(3, 5.6, 50):
        expected = -math.expm1(float(power) * math.log1p(-math.exp(-z * z / 2)))
        assert falloff.merged(exponent(z * z, d), power) == pytest.approx(expected, abs=2e-6)


@pytest.mark.parametrize("d", [2.0, 5.0])
def test_a_squared_distance_that_is_rounded_below_0_is_the_centre(d: float) -> None:
    opacity, power = np.float32(d), np.float32(d**2)
    for design in (False, True):
        expected = falloff.alpha_at(np.float32(0), opacity, power, design)
        assert falloff.alpha_at(np.float32(1e-9), opacity, power, design) == pytest.approx(expected, abs=1e-6)
    assert falloff.merged(np.float32(1e-9), power) == pytest.approx(1, abs=1e-6)
    assert falloff.shifted(np.float32(1e-9), opacity) == pytest.approx(1, abs=1e-6)
