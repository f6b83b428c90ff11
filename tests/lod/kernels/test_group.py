"""Cells split into groups and loners."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.lod.kernels.group import split_cells


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
