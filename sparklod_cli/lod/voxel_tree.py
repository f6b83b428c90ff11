"""The nodes of the quick builder while its tree grows: merges, and the final order."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..model.lod_tree import MAX_CHILDREN, LodTree
from ..model.sh import degree_of
from ..model.splats import FloatArray, Splats
from ..support.jit import threads_for
from .kernels.final_order import fill_geometry, fill_leaves, final_indices, merge_colors
from .kernels.geometry import WIDTH
from .kernels.group import split_cells
from .kernels.merge import merge_groups
from .kernels.sort import Nodes

#: Factor for the scales of merged splats: the profile of a splat with D above 1 is wider than its scale, and tails of
#: neighbours add up. Measured: 0.95 gains up to 0.7 dB over 1 (docs/decisions/2026-11-21-fidelity.md).
SHRINK = np.float32(0.95)

Offsets = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Batch:
    """Merges that were done together.

    Attributes:
        level: of their cells.
        fold: 0 where a cell has one node afterwards; otherwise the number of the fold, from 1.
        row: the first new node.
        members: (C,) the members of all new nodes: leaves, or nodes of earlier batches.
        first: (G + 1,) where the members of each new node begin.
    """

    level: int
    fold: int
    row: int
    members: Nodes
    first: Offsets


@dataclass
class VoxelTree:
    """Node rows, and batches of merges.

    Attributes:
        geometry: (capacity, WIDTH) float32 rows of `kernels/geometry.py`: first leaves, then other nodes that were
            given, then those that were made.
        weight: (capacity,) float64, opacity * area.
        leaves: number of leaves.
        given: number of nodes that were given, leaves included.
        used: number of nodes so far.
        batches: in the order of the merges.
    """

    geometry: FloatArray
    weight: NDArray[np.float64]
    leaves: int
    given: int
    used: int
    batches: list[Batch] = field(default_factory=list)

    def merge(self, level: int, fold: int, members: Nodes, first: Offsets) -> None:
        """Merges each group of members into one node."""
        if len(first) > 1:
            merge_groups(members, first, self.geometry, self.weight, self.used)
            self.batches.append(Batch(level, fold, self.used, members, first))
            self.used += len(first) - 1

    def merge_cells(self, level: int, nodes: Nodes, is_first: NDArray[np.bool_]) -> Nodes:
        """Merges the nodes of each cell with more than one; returns the node that each cell then has."""
        members, first, survivors = split_cells(nodes, is_first, self.used)
        fold = 0
        while len(first) > 1 and np.diff(first).max() > MAX_CHILDREN:
            before, fold = self.used, fold + 1
            members, first = self._fold_oversized(level, fold, members, first)
            survivors[survivors >= before] += self.used - before
        self.merge(level, 0, members, first)
        return survivors

    def _fold_oversized(self, level: int, fold: int, members: Nodes, first: Offsets) -> tuple[Nodes, Offsets]:
        """Groups members of oversized groups into intermediate nodes of equal shares, at most MAX_CHILDREN each."""
        count = np.diff(first)
        big = np.flatnonzero(count > MAX_CHILDREN)
        shares = [np.linspace(0, count[g], -(-count[g] // MAX_CHILDREN) + 1).astype(np.int64) for g in big]
        made = np.arange(sum(len(share) - 1 for share in shares), dtype=np.uint32) + np.uint32(self.used)
        starts, parts, at, done = [np.zeros(1, np.int64)], [], 0, 0
        for g, share in zip(big, shares, strict=True):
            starts.append(starts[-1][-1] + share[1:])
            parts += [members[at : first[g]], made[done : done + len(share) - 1]]
            at, done = first[g + 1], done + len(share) - 1
        whole = np.concatenate([members[first[g] : first[g + 1]] for g in big])
        self.merge(level, fold, whole, np.concatenate(starts))
        count[big] = [len(share) - 1 for share in shares]
        return np.concatenate([*parts, members[at:]]), np.concatenate([[0], np.cumsum(count)])


def final_order(tree: VoxelTree, tops: Nodes) -> Nodes:
    """The nodes in their final order: those without a parent, then the members of the batches, last batch first."""
    order = np.empty(len(tops) + sum(len(batch.members) for batch in tree.batches), np.uint32)
    order[: len(tops)] = tops
    end = len(order)
    for batch in tree.batches:
        order[end - len(batch.members) : end] = batch.members
        end -= len(batch.members)
    return order


def in_order(tree: VoxelTree, order: Nodes, index: Nodes, rgb: FloatArray, sh: FloatArray) -> tuple[Splats, LodTree]:
    """The nodes as they are drawn, in this order.

    Colours are merged here, where those of siblings are adjacent.

    Args:
        tree: loses its geometry.
        order: of `final_order`.
        index: (given,) row of the colours of each node that was given.
        rgb, sh: their colours.
    """
    total = len(order)
    final = final_indices(order, tree.given)
    links = LodTree(np.zeros(total, np.uint16), np.zeros(total, np.uint32))
    out = Splats.empty(total, degree_of(sh.shape[1]))
    geometry = out.center, out.scale, out.quat_xyzw, out.opacity
    fill_geometry(order, tree.geometry, tree.leaves, SHRINK, *geometry)
    tree.geometry = np.empty((0, WIDTH), np.float32)  # frees memory for the colours
    columns = 3 * sh.shape[1]
    flat_sh = out.sh.reshape(total, columns)
    fill_leaves(order, index, rgb, out.rgb)
    fill_leaves(order, index, sh.reshape(len(sh), columns), flat_sh)
    end = total
    for batch in tree.batches:
        parents = final[batch.row - tree.given :][: len(batch.first) - 1]
        end -= len(batch.members)
        links.child_start[parents] = end + batch.first[:-1]
        links.child_count[parents] = np.diff(batch.first)
        with threads_for(len(batch.members)) as threads:
            for color in (out.rgb, flat_sh):
                merge_colors(parents, links.child_start, links.child_count, order, tree.weight, color, threads)
    return out, links
