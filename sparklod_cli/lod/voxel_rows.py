"""Rows of the splats that the quick builder merges, sorted so that neighbours in space are neighbours in memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..model.splats import FloatArray
from .kernels.geometry import SplatColumns, gather_rows
from .kernels.sort import Nodes, sort_by_key
from .voxel_grid import VoxelGrid
from .voxel_tree import Offsets, Rows


def sorted_leaves(
    center: FloatArray, scale: FloatArray, grid: VoxelGrid, threads: int, order: Nodes | None = None
) -> tuple[Nodes, Offsets]:
    """The splats by level and then along a curve, and where each level ends.

    Args:
        center, scale: (n, 3) of the splats.
        grid: of the scene.
        threads: to work on.
        order: (n,) the splats in the order of the scene; by default they are in it.
    """
    keys, levels, bits = grid.leaf_keys(center, scale)
    ends = np.cumsum(np.bincount(levels))
    del levels
    if order is None:
        order = np.arange(len(center), dtype=np.uint32)
    else:
        keys = keys[order]
    return sort_by_key(keys, order, bits, threads)[1], ends


def joining(index: Nodes, ends: Offsets, columns: SplatColumns) -> dict[int, Rows]:
    """Rows of splats by level.

    Args:
        index: (n,) the splat of each row; rows are numbered in this order.
        ends: where each level ends.
        columns: of the splats.
    """
    found, begin = {}, 0
    for level, end in enumerate(ends.tolist()):
        if end > begin:
            found[level] = rows_of(index[begin:end], begin, columns)
        begin = end
    return found


def rows_of(index: Nodes, number: int, columns: SplatColumns) -> Rows:
    """Rows of some splats, numbered from `number` on."""
    rows = Rows.empty(len(index))
    gather_rows(index, columns, rows.geometry, rows.weight)
    rows.number[:] = np.arange(number, number + len(index), dtype=np.uint32)
    rows.count[:] = 0
    return rows


def by_level(levels: NDArray[np.int32]) -> list[tuple[int, Nodes]]:
    """Each level that occurs, and where."""
    order = np.argsort(levels, kind="stable").astype(np.uint32)
    found, begins = np.unique(levels[order], return_index=True)
    return list(zip(found.tolist(), np.split(order, begins[1:]), strict=True)) if len(found) else []
