"""Profiles of merged splats: their density, variance and size."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.lod.kernels import geometry
from sparklod_cli.model import falloff
from sparklod_cli.model.gaussian import MIN_OPACITY, lod_opacity, spark_size
from tests.references import quality as twin
from tests.scenes import random_splats


@pytest.mark.parametrize("a", [1, 2, 3, 10, 100, 5000])
def test_harmonic_numbers_of_integers_are_sums(a: int) -> None:
    first, second = falloff.harmonic(np.array([float(a)]))
    assert first[0] == pytest.approx(math.fsum(1 / k for k in range(1, a + 1)), rel=1e-5)
    assert second[0] == pytest.approx(math.fsum(1 / k**2 for k in range(1, a + 1)), rel=1e-5)


#: Whether it is of needles; D and density of the sharpest geometry.
SHARPEST = [
    pytest.param(False, geometry.MAX_D, float(geometry.MAX_DENSITY), id="splat"),
    pytest.param(True, geometry.NEEDLE_D, geometry.NEEDLE_DENSITY, id="needle"),
]


@pytest.mark.parametrize(("needle", "d", "densest"), SHARPEST)
@pytest.mark.parametrize("share", [0.01, 0.3, 0.8, 0.9, 0.9999])
def test_a_profile_has_the_density_and_the_variance_that_are_asked_for(
    share: float, needle: bool, d: float, densest: float
) -> None:
    density = share * densest
    opacity, spread = geometry.profile_of(density, needle)
    coverage, variance = twin.moments_of_profile(opacity)
    assert coverage / spread == pytest.approx(density, rel=1e-4)
    assert variance == pytest.approx(spread, rel=1e-4)


@pytest.mark.parametrize(("needle", "d", "densest"), SHARPEST)
@pytest.mark.parametrize("density", [1.0, 1.2, 1.9, 2.5, 40.0])
def test_what_is_denser_than_a_profile_can_be_is_larger_and_covers_as_much(
    density: float, needle: bool, d: float, densest: float
) -> None:
    density = max(density, densest)
    opacity, spread = geometry.profile_of(density, needle)
    assert lod_opacity(np.float32([opacity]))[0] == pytest.approx(d, rel=1e-5)
    assert twin.moments_of_profile(opacity)[0] / spread == pytest.approx(density, rel=1e-4)


@given(st.floats(0, 1), st.booleans())
def test_up_to_one_the_density_is_the_opacity(density: float, needle: bool) -> None:
    assert geometry.profile_of(density, needle) == (max(density, MIN_OPACITY), 1)


@given(st.floats(0, 10), st.floats(0, 10), st.booleans())
def test_what_is_denser_is_no_less_opaque(one: float, other: float, needle: bool) -> None:
    less, more = (geometry.profile_of(density, needle)[0] for density in sorted([one, other]))
    assert less <= more * (1 + 1e-5)


@given(st.permutations([1.0, 0.999, 0.2]), st.permutations([1.0, 1.001, 0.2]), st.floats(1e-20, 1e20))
def test_needles_have_a_second_axis_below_a_share_of_the_longest(
    below: list[float], above: list[float], size: float
) -> None:
    """Lengths along the axes; the middle one as a multiple of the limit, the shortest as a share of it."""
    for axes, expected in ((below, True), (above, False)):
        lengths = [size * (1 if axis == 1 else axis * geometry.NEEDLE) for axis in axes]
        assert geometry.is_needle(*(length * length for length in lengths)) == expected


def test_the_size_factor_is_that_of_sparks_size() -> None:
    splats = random_splats(50)
    splats.opacity[:] = np.geomspace(0.1, 1000, 50)
    expected = spark_size(splats) / (2 * splats.scale.mean(axis=1))
    np.testing.assert_allclose([geometry.size_factor(float(a)) for a in splats.opacity], expected, rtol=1e-5)
