"""Places on the Earth, against other formulas and places that are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.model.transforms import FLATTENING, RADIUS, earth_matrix, place_of

DEGREES = st.floats(-89.9, 89.9)


def matrix_of(*place: float) -> np.ndarray:
    return np.array(earth_matrix(*place)).reshape(4, 4).T


def position(latitude: float, longitude: float, height: float) -> np.ndarray:
    """A point above the ellipsoid x^2/a^2 + y^2/a^2 + z^2/b^2 = 1, by the parametric latitude of its foot."""
    a, b = RADIUS, RADIUS * (1 - FLATTENING)
    phi, lam = math.radians(latitude), math.radians(longitude)
    beta = math.atan2(b * math.sin(phi), a * math.cos(phi))
    foot = np.array([a * math.cos(beta) * math.cos(lam), a * math.cos(beta) * math.sin(lam), b * math.sin(beta)])
    normal = foot / [a * a, a * a, b * b]
    return foot + height * normal / np.linalg.norm(normal)


@given(DEGREES, st.floats(-180, 180), st.floats(-1000, 1e5), st.floats(0, 360))
def test_the_axes_are_east_north_and_up_turned_by_the_heading(
    latitude: float, longitude: float, height: float, heading: float
) -> None:
    matrix = matrix_of(latitude, longitude, height, heading)
    np.testing.assert_allclose(matrix[:3, 3], position(latitude, longitude, height), atol=1e-6)
    axes = matrix[:3, :3]
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    step = 1e-4  # degrees; differences of positions point to where numbers grow
    here = position(latitude, longitude, height)
    north = position(latitude + step, longitude, height) - here
    east = position(latitude, longitude + step, height) - here
    north, east = north / np.linalg.norm(north), east / np.linalg.norm(east)
    turn = math.radians(heading)
    np.testing.assert_allclose(axes[:, 1], math.cos(turn) * north + math.sin(turn) * east, atol=1e-5)
    np.testing.assert_allclose(axes[:, 2], np.cross(east, north), atol=1e-5)


@given(DEGREES, st.floats(-179.9, 179.9), st.floats(-1000, 1e6), st.floats(0.1, 359.9))
def test_a_place_is_found_again(latitude: float, longitude: float, height: float, heading: float) -> None:
    found = place_of(earth_matrix(latitude, longitude, height, heading))
    assert (found.latitude, found.longitude) == pytest.approx((latitude, longitude), abs=1e-9)
    assert (found.height, found.heading) == pytest.approx((height, heading), abs=1e-5)


def test_known_places() -> None:
    np.testing.assert_allclose(matrix_of(0, 0)[:3, 3], [RADIUS, 0, 0])
    np.testing.assert_allclose(matrix_of(90, 0)[:3, 3], [0, 0, 6_356_752.314245], atol=1e-6)
    np.testing.assert_allclose(matrix_of(0, 90)[:3, :3], [[-1, 0, 0], [0, 0, 1], [0, 1, 0]], atol=1e-15)
    # Heading 90: the scene's forward axis, y, points east, and its right one south.
    np.testing.assert_allclose(matrix_of(0, 0, 0, 90)[:3, :3], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], atol=1e-15)
