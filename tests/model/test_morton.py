"""The Morton curve, beside a slow twin that takes bits one by one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sparklod_cli.model import morton


def place(cell: list[int]) -> int:
    """The place along the curve of a cell: its bits in turns, z first."""
    places = [(bit, axis) for bit in range(morton.BITS) for axis in range(3)]
    return sum((cell[axis] >> bit & 1) << 3 * bit + axis for bit, axis in places)


@given(arrays(np.uint32, st.tuples(st.integers(0, 30), st.just(3)), elements=st.integers(0, 2**morton.BITS - 1)))
def test_cells_are_ordered_by_their_bits_in_turns(cells: np.ndarray) -> None:
    expected = sorted(range(len(cells)), key=lambda row: place(cells[row].tolist()))  # stable
    np.testing.assert_array_equal(morton.order_of_cells(cells), expected)


FINITE = st.floats(-(2.0**127), 2.0**127, width=32)


@given(arrays(np.float32, st.tuples(st.integers(0, 30), st.just(3)), elements=FINITE))
def test_any_finite_points_get_an_order(center: np.ndarray) -> None:
    order = morton.order(center)
    np.testing.assert_array_equal(np.sort(order), np.arange(len(center)))


def test_corners_of_a_box_come_in_the_order_of_their_bits() -> None:
    corners = np.array([[x, y, z] for z in (-5, 7) for y in (0, 1e-3) for x in (-1e6, 1e6)], np.float32)
    shuffled = np.random.default_rng(0).permutation(8)
    np.testing.assert_array_equal(shuffled[morton.order(corners[shuffled])], np.arange(8))


@pytest.mark.parametrize("value", [0.0, -3.5])
def test_equal_points_keep_their_order(value: float) -> None:
    np.testing.assert_array_equal(morton.order(np.full((100, 3), value, np.float32)), np.arange(100))
