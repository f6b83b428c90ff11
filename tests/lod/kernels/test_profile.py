"""Profiles of merged splats: their density, variance and size."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.lod.kernels import profile
from sparklod_cli.model.gaussian import MIN_OPACITY, lod_opacity, spark_size
from tests.references import quality as twin
from tests.scenes import random_splats


@pytest.mark.parametrize("a", [1, 2, 3, 10, 100, 5000])
def test_harmonic_numbers_of_integers_are_sums(a: int) -> None:
    first, second = profile.harmonic(np.array([float(a)]))
    assert first[0] == pytest.approx(math.fsum(1 / k for k in range(1, a + 1)), rel=1e-5)
    assert second[0] == pytest.approx(math.fsum(1 / k**2 for k in range(1, a + 1)), rel=1e-5)


@pytest.mark.parametrize("density", [0.01, 0.3, 1.0, 1.0001, 1.1, 1.3, 1.5, float(profile.MAX_DENSITY) * 0.9999])
def test_a_profile_has_the_density_and_the_variance_that_are_asked_for(density: float) -> None:
    opacity, spread = profile.profile_of(density)
    coverage, variance = twin.moments_of_profile(opacity)
    assert coverage / spread == pytest.approx(density, rel=1e-4)
    assert variance == pytest.approx(spread, rel=1e-4)


@pytest.mark.parametrize("density", [1.0, 1.2, 1.9, 2.5, 40.0])
def test_what_is_denser_than_a_profile_can_be_is_larger_and_covers_as_much(density: float) -> None:
    density = max(density, float(profile.MAX_DENSITY))
    opacity, spread = profile.profile_of(density)
    assert lod_opacity(np.float32([opacity]))[0] == pytest.approx(profile.MAX_D, rel=1e-5)
    assert twin.moments_of_profile(opacity)[0] / spread == pytest.approx(density, rel=1e-4)


@given(st.floats(0, 1))
def test_up_to_one_the_density_is_the_opacity(density: float) -> None:
    assert profile.profile_of(density) == (max(density, MIN_OPACITY), 1)


@given(st.floats(0, 10), st.floats(0, 10))
def test_what_is_denser_is_no_less_opaque(one: float, other: float) -> None:
    assert profile.profile_of(min(one, other))[0] <= profile.profile_of(max(one, other))[0] * (1 + 1e-12)


def test_the_size_factor_is_that_of_sparks_size() -> None:
    splats = random_splats(50)
    splats.opacity[:] = np.geomspace(0.1, 1000, 50)
    expected = spark_size(splats) / (2 * splats.scale.mean(axis=1))
    np.testing.assert_allclose([profile.size_factor(float(a)) for a in splats.opacity], expected, rtol=1e-5)
