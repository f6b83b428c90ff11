"""The falloff: approximations against the formulas in float64."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sparklod_cli.render.kernels import falloff

DISTANCES = np.linspace(0, 5, 101, dtype=np.float32)


def alpha(z2: float, d: float, design: bool) -> float:
    """In float64, as the pages on Spark's shader and its LoD design have it."""
    if d <= 1:
        return d * math.exp(-z2 / 2)
    if design:
        return math.exp(-d / 2 * max(0.0, math.sqrt(z2) - (d - 1)) ** 2)
    return 1 - (1 - math.exp(-z2 / 2)) ** math.exp((d * d - 1) / math.e)


@pytest.mark.parametrize("design", [False, True])
@pytest.mark.parametrize("d", [0.01, 0.5, 1.0, 1.2, 2.0, 4.0, 5.0])
def test_both_falloffs_are_those_of_spark(d: float, design: bool) -> None:
    opacity, power = np.float32(d), np.float32(math.exp((np.float32(d) ** 2 - 1) / math.e) if d > 1 else 1)
    for z in DISTANCES:
        z2 = z * z
        expected = alpha(float(z2), float(opacity), design)
        exact = falloff.alpha_at(z2, opacity, power, design)
        if d <= 1:
            fast = falloff.plain(z2, opacity)
        else:
            fast = falloff.shifted(z2, opacity) if design else falloff.merged(z2, power)
        # The power multiplies the rounding of 1 - exp(-z^2 / 2).
        tolerance = 2e-6 + (0 if design else 1e-7 * float(power))
        assert exact == pytest.approx(expected, abs=tolerance)
        assert fast == pytest.approx(expected, abs=tolerance)


@pytest.mark.parametrize("d", [0.5, 2.0, 5.0])
def test_a_squared_distance_that_is_rounded_below_0_is_the_centre(d: float) -> None:
    opacity, power = np.float32(d), np.float32(max(1.0, d) ** 2)
    for design in (False, True):
        expected = falloff.alpha_at(np.float32(0), opacity, power, design)
        assert falloff.alpha_at(np.float32(-1e-9), opacity, power, design) == pytest.approx(expected, abs=1e-6)
    assert falloff.merged(np.float32(-1e-9), power) == pytest.approx(1, abs=1e-6)
    assert falloff.shifted(np.float32(-1e-9), np.float32(2)) == pytest.approx(1, abs=1e-6)
