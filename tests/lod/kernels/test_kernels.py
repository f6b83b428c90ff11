"""Kernels against slow, obvious twins."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sparklod_cli.lod.kernels.eigen import CONVERGED, ROWS, decompose
from sparklod_cli.lod.kernels.geometry import CENTER, WIDTH
from sparklod_cli.lod.kernels.group import split_cells
from sparklod_cli.lod.kernels.order import merge_colors, places_of_merged
from sparklod_cli.lod.kernels.sort import sort_by_cell, sort_by_key, spread_bits
from tests.references import reference


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


@pytest.mark.parametrize("span", [3, 1000, 2**20, 2**23])  # up to two words of 21 bits
def test_cells_come_in_morton_order_and_are_told_apart(span: int) -> None:
    rng = np.random.default_rng(span)
    step = 2.0**-6
    cells = rng.integers(0, span, (40, 3))[rng.integers(40, size=300)]
    geometry = np.zeros((300, WIDTH), np.float32)
    geometry[:, CENTER : CENTER + 3] = (cells - span // 2 + 0.5) * step
    nodes = rng.permutation(300).astype(np.uint32)
    low = np.array([-(span // 2)] * 3)
    got, is_first = sort_by_cell(geometry, nodes, step, low, int(span - 1).bit_length(), 2)
    codes = [morton(tuple(int(axis) for axis in cells[node])) for node in nodes]
    expected = nodes[np.array(sorted(range(300), key=lambda i: codes[i]))]
    assert np.array_equal(got, expected)
    changes = (cells[got][1:] != cells[got][:-1]).any(axis=1)
    assert np.array_equal(is_first, np.concatenate([[True], changes]))


@given(st.lists(st.integers(1, 4), min_size=1, max_size=50))
def test_cells_are_split_into_groups_and_loners(sizes: list[int]) -> None:
    nodes = np.random.default_rng(0).permutation(sum(sizes)).astype(np.uint32)
    is_first = np.zeros(len(nodes), np.bool_)
    starts = np.cumsum([0, *sizes[:-1]])
    is_first[starts] = True
    members, first, survivors = split_cells(nodes, is_first, 1000)
    cells = [nodes[start : start + size].tolist() for start, size in zip(starts, sizes, strict=True)]
    groups = [cell for cell in cells if len(cell) > 1]
    assert [members[a:b].tolist() for a, b in itertools.pairwise(first)] == groups
    made = iter(range(1000, 2000))
    assert survivors.tolist() == [next(made) if len(cell) > 1 else cell[0] for cell in cells]


def matrices() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    turn = np.linalg.qr(rng.normal(size=(200, 3, 3)))[0]

    def of(*values: object) -> np.ndarray:
        diagonal = np.stack([np.broadcast_to(value, 200) for value in values], axis=1)
        return np.einsum("nij,nj,nkj->nik", turn, diagonal, turn)

    return {
        "any": of(*np.exp(rng.normal(-8, 3, (3, 200)))),
        "spherical": of(1, 1, 1),
        "almost spherical": of(1, 1 + 1e-9, 1 - 1e-9),
        "flat": of(1, 0.5, 0),
        "disc": of(1, 1, 1e-12),
        "needle": of(1, 0, 0),
        "tiny": of(1e-60, 2e-60, 3e-60),
        "huge": of(1e70, 1e69, 1e60),
        "diagonal": np.tile(np.diag([3.0, 1.0, 2.0]), (200, 1, 1)),
        "nothing": np.zeros((200, 3, 3)),
    }


@pytest.mark.parametrize("name", matrices())
def test_eigenvalues_and_axes_make_the_matrix_again(name: str) -> None:
    matrix = matrices()[name]
    work = np.full((ROWS, len(matrix) + 3), np.nan)
    for row, (i, j) in enumerate([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]):
        work[row, : len(matrix)] = matrix[:, i, j]
    decompose(work, len(matrix))
    values, quat = work[:3, : len(matrix)].T, work[6:10, : len(matrix)].T
    assert np.allclose(np.linalg.norm(quat, axis=1), 1)
    rotation = reference.rotation_matrix(quat)
    assert np.allclose(np.linalg.det(rotation), 1)
    size = np.abs(matrix).max()
    bound = 3 * CONVERGED**0.5  # what is left beside the diagonal, in the worst case of equal eigenvalues
    again = np.einsum("nij,nj,nkj->nik", rotation, values, rotation)
    assert np.abs(again - matrix).max() <= bound * size
    assert np.abs(np.sort(values) - np.linalg.eigvalsh(matrix)).max() <= bound * size
    assert np.isnan(work[:, len(matrix) :]).all()  # columns beyond the count are left alone


def test_merged_nodes_are_found_in_the_final_order() -> None:
    order = np.random.default_rng(2).permutation(500).astype(np.uint32)
    assert np.array_equal(order[places_of_merged(order, 300)], np.arange(300, 500))


def test_colours_are_weighted_means_of_children() -> None:
    rng = np.random.default_rng(3)
    color, weight = rng.normal(size=(9, 5)).astype(np.float32), rng.uniform(0.1, 2, 9)
    order = rng.permutation(9).astype(np.uint32)
    start, count = np.array([1, 4, 0, 6, 0, 0, 0, 0, 0], np.uint32), np.array([3, 2, 0, 3, 0, 0, 0, 0, 0], np.uint16)
    expected = color.copy()
    for node in (1, 3):
        part = slice(start[node], start[node] + count[node])
        expected[node] = np.average(color[part].astype(np.float64), axis=0, weights=weight[order[part]])
    merge_colors(np.array([1, 3], np.uint32), start, count, order, weight, color, 2)
    assert np.allclose(color, expected, atol=1e-6)
