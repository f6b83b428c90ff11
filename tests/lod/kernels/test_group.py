"""Cells split into groups and loners."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.lod.kernels.geometry import CENTER, WIDTH
from sparklod_cli.lod.kernels.group import split_box, split_cells


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
