"""The data model and its mathematics."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sparklod_cli.lod.kernels.geometry import ellipsoid_area
from sparklod_cli.model.gaussian import linear_opacity, lod_opacity, normalized_quat
from sparklod_cli.model.sh import COEFFICIENTS, degree_of
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.errors import FormatError
from tests.references import gaussians
from tests.scenes import random_splats


@pytest.mark.parametrize("degree", range(4))
def test_columns_have_their_shapes(degree: int) -> None:
    splats = random_splats(7, sh_degree=degree)
    assert len(splats) == 7
    assert splats.sh_degree == degree
    assert Splats.empty(3, degree).sh.shape == (3, COEFFICIENTS[degree], 3)


@pytest.mark.parametrize("name", COLUMNS)
def test_a_column_of_another_kind_is_refused(name: str) -> None:
    splats = random_splats(4, sh_degree=1)
    column = getattr(splats, name)
    wrong = [
        column[:3],
        column.astype(np.float64),
        np.asfortranarray(np.repeat(column, 2, axis=0))[::2],
        column[..., None],
    ]
    for bad in wrong:
        with pytest.raises(ValueError, match="expected"):
            dataclasses.replace(splats, **{name: bad})


def test_take_filters_permutes_and_slices_all_columns() -> None:
    splats = random_splats(10, sh_degree=2)
    mask = np.arange(10) % 3 == 0
    for name in COLUMNS:
        column = getattr(splats, name)
        assert np.array_equal(getattr(splats.take(mask), name), column[mask])
        assert np.array_equal(getattr(splats.take(np.array([4, 4, 0])), name), column[[4, 4, 0]])
        assert np.array_equal(getattr(splats.take(slice(2, 5)), name), column[2:5])
        both = Splats.concat([splats.take(slice(0, 3)), splats.take(slice(3, 10))])
        assert np.array_equal(getattr(both, name), column)


def test_sh_above_a_degree_is_left_out() -> None:
    splats = random_splats(5, sh_degree=3)
    for degree in range(4):
        cut = splats.with_max_sh(degree)
        assert cut.sh_degree == degree
        assert np.array_equal(cut.sh, splats.sh[:, : COEFFICIENTS[degree]])
    assert random_splats(5, sh_degree=1).with_max_sh(3).sh_degree == 1


def test_a_wrong_number_of_coefficients_is_an_error() -> None:
    with pytest.raises(FormatError, match="4 SH coefficients"):
        degree_of(4)


@given(arrays(np.float32, st.tuples(st.integers(1, 20)), elements=st.floats(np.float32(1e-6), 1000, width=32)))
def test_lod_opacity_can_be_inverted(opacity: np.ndarray) -> None:
    coded = lod_opacity(opacity)
    assert coded.dtype == np.float32
    assert np.array_equal(coded[opacity <= 1], opacity[opacity <= 1])
    assert ((coded > 1) == (opacity > 1))[np.abs(opacity - 1) > 1e-6].all()
    assert np.allclose(linear_opacity(coded), opacity, rtol=2e-5)


def test_lod_opacity_of_a_thousand_is_what_sparks_design_says() -> None:
    assert lod_opacity(np.float32([1000.0]))[0] == pytest.approx(4.45, abs=0.005)


@given(
    arrays(np.float32, (5, 4), elements=st.floats(-1, 1, width=32).filter(lambda x: x == 0 or abs(x) > 1e-6)),
    st.sampled_from([1e-30, 1.0, 1e30]),
)
def test_quaternions_of_any_length_become_units(quat: np.ndarray, length: float) -> None:
    scaled = quat * np.float32(length)
    unit = normalized_quat(scaled)
    zero = ~scaled.any(axis=1)
    assert np.isnan(unit[zero]).all()
    assert np.allclose(np.linalg.norm(unit[~zero], axis=1), 1, atol=1e-6)
    assert (np.sign(unit[~zero]) == np.sign(scaled[~zero])).all()


@given(arrays(np.float32, (3,), elements=st.floats(np.float32(1e-10), np.float32(1e10), width=32)))
def test_the_area_of_an_ellipsoid_is_thomsens_formula(scale: np.ndarray) -> None:
    assert ellipsoid_area(*scale) == pytest.approx(gaussians.ellipsoid_area(scale), rel=1e-5)


def test_area_of_a_sphere_and_of_flat_and_needle_like_splats() -> None:
    f32 = np.float32
    assert ellipsoid_area(f32(2), f32(2), f32(2)) == pytest.approx(16 * np.pi)
    # A disc has two faces; the formula is within 1.061 % of the truth, and at its worst on discs.
    assert ellipsoid_area(f32(1), f32(0), f32(1)) == pytest.approx(2 * np.pi, rel=0.0107)
    assert 0 < ellipsoid_area(f32(0), f32(0), f32(1)) < 1e-15
    assert ellipsoid_area(f32(1e18), f32(1e18), f32(1e18)) == pytest.approx(4e36 * np.pi)
