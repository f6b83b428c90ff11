"""Sorting of keys and cells, against numpy's."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sparklod_cli.lod.kernels.pair_merge import CENTER, WIDTH
from sparklod_cli.lod.kernels.sort import AXIS_BITS, PART_BITS, Parts, sort_by_cell, sort_by_key, split_box, spread_bits


@given(
    arrays(np.uint64, st.integers(1, 300), elements=st.integers(0, 2**64 - 1)), st.integers(1, 64), st.integers(1, 5)
)
def test_sorting_is_stable_and_the_same_in_any_number_of_pieces(keys: np.ndarray, bits: int, chunks: int) -> None:
    keys = (keys >> np.uint64(64 - bits)) // np.uint64(3) * np.uint64(3)  # with ties
    expected = np.argsort(keys, kind="stable")
    got_keys, got = sort_by_key(keys.copy(), np.arange(len(keys), dtype=np.uint32), bits, chunks)
    assert np.array_equal(got, expected)
    assert np.array_equal(got_keys, keys[expected])


def morton(cell: tuple[int, int, int]) -> int:
    return sum(((axis >> bit) & 1) << (3 * bit + k) for k, axis in enumerate(cell) for bit in range(64))


@given(st.integers(0, 2**21 - 1))
def test_bits_are_spread_by_three(x: int) -> None:
    assert spread_bits(np.uint64(x)) == morton((x, 0, 0))


@pytest.mark.parametrize("within", [True, False])
@pytest.mark.parametrize("span", [3, 1000, 2**20, 2**23])  # up to two words of 21 bits
def test_cells_come_in_morton_order_and_are_told_apart(span: int, within: bool) -> None:
    rng = np.random.default_rng(span)
    step = 2.0**-6
    parts = rng.integers(0, span, (40, 3))[rng.integers(40, size=300)]
    geometry = np.zeros((300, WIDTH), np.float32)
    geometry[:, CENTER : CENTER + 3] = (parts - span // 2 + 0.5) * step
    nodes = rng.permutation(300).astype(np.uint32)
    bits = int(span - 1).bit_length()
    grid = Parts(np.float64(step), np.array([-(span // 2)] * 3), bits, -(-bits // AXIS_BITS))
    got, is_first = sort_by_cell(geometry, nodes, grid, 2, within=within)
    cells = parts >> PART_BITS
    codes = [morton(tuple(int(axis) for axis in (parts if within else cells)[node])) for node in nodes]
    expected = nodes[np.array(sorted(range(300), key=lambda i: codes[i]))]
    assert np.array_equal(got, expected)
    changes = (cells[got][1:] != cells[got][:-1]).any(axis=1)
    assert np.array_equal(is_first, np.concatenate([[True], changes]))


def test_nodes_are_split_by_a_box_without_its_faces() -> None:
    axis = np.float32([-1, 0, 1, 2])
    geometry = np.zeros((64, WIDTH), np.float32)
    geometry[:, CENTER : CENTER + 3] = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    nodes = np.random.default_rng(0).permutation(64).astype(np.uint32)
    below, above = np.float32([-1, -np.inf, 0]), np.float32([2, 1, np.inf])
    inside, outside = split_box(nodes, geometry, below, above)
    center = geometry[nodes, CENTER : CENTER + 3]
    expected = ((center > below) & (center < above)).all(axis=1)
    assert inside.tolist() == nodes[expected].tolist()
    assert outside.tolist() == nodes[~expected].tolist()
    assert 0 < len(inside) < 64
