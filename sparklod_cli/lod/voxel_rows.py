"""Rows of the splats that the quick builder merges, sorted so that neighbours in space are neighbours in memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..model.splats import FloatArray, Splats
from .kernels.geometry import SplatColumns
from .kernels.node_rows import Space, fill_leaf_rows
from .kernels.pair_cost import WIDTH
from .kernels.sort import Nodes, sort_by_key
from .voxel_grid import VoxelGrid
from .voxel_tree import FillRows, Joining, Offsets, Rows


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


def joining(index: Nodes, ends: Offsets, fill: FillRows) -> dict[int, Joining]:
    """The splats of each level that has some.

    Args:
        index: (n,) the splat of each node; nodes are numbered in this order.
        ends: where each level ends.
        fill: fills the node rows of splats.
    """
    found, begin = {}, 0
    for level, end in enumerate(ends.tolist()):
        if end > begin:
            found[level] = Joining(index[begin:end], begin, fill)
        begin = end
    return found


def numbered(nodes: FloatArray, number: int) -> Rows:
    """Rows of nodes that are given, numbered from `number` on."""
    numbers = np.arange(number, number + len(nodes), dtype=np.uint32)
    return Rows(nodes, numbers, np.zeros(len(nodes), np.uint16))


def leaf_rows(index: Nodes, splats: Splats, space: Space) -> FloatArray:
    """(n, WIDTH) node rows of some splats."""
    rows = np.empty((len(index), WIDTH), np.float32)
    fill_rows(index, splats, space, rows)
    return rows


def fill_rows(index: Nodes, splats: Splats, space: Space, rows: FloatArray) -> None:
    """Fills the node rows of some splats."""
    columns = SplatColumns(splats.center, splats.scale, splats.quat_xyzw, splats.opacity)
    fill_leaf_rows(index, columns, splats.rgb, space, rows, np.empty(len(index), np.float32))


def by_level(levels: NDArray[np.int32]) -> list[tuple[int, Nodes]]:
    """Each level that occurs, and where."""
    order = np.argsort(levels, kind="stable").astype(np.uint32)
    found, begins = np.unique(levels[order], return_index=True)
    return list(zip(found.tolist(), np.split(order, begins[1:]), strict=True)) if len(found) else []
