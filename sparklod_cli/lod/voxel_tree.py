"""The nodes of the quick builder while its tree grows, and their final order.

Only nodes without a parent are worked on. A node that gets one is written to its place in the final order at once,
which is filled from its end: the last batch of merges, the coarsest one, comes first there. So a node takes memory in
one place at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.lod_tree import LodTree
from ..model.splats import COLUMNS, FloatArray, Splats
from ..system.threads import blocks_of, threads_for
from .kernels.cell_pairs import SPAN, merge_in_cells, split_families
from .kernels.geometry import SplatColumns
from .kernels.node_rows import Space, fill_leaf_rows, fill_leaves, fill_merged_splats, merge_colors
from .kernels.pair_cost import WEIGHT, WIDTH
from .kernels.sort import Keys, Nodes

#: In place of the number of a node that was given, for a node that was made.
MERGED = np.uint32(0xFFFFFFFF)

#: Rows that are moved at a time: their copies stay in a processor's cache.
MOVED = 1 << 14

Offsets = NDArray[np.int64]

#: Fills the node rows of splats, of which it gets the indices and the (n, WIDTH) rows.
FillRows = Callable[[Nodes, FloatArray], None]


@dataclass(frozen=True, eq=False)
class NodeRows:
    """Columns of n nodes without a parent.

    Attributes:
        node: (n, WIDTH) float32 node rows of `kernels/pair_cost.py`.
        number: (n,) uint32 of a node that was given, as the caller counts them; of a node that was made, where its
            children begin, as a distance from the end of the final order.
        count: (n,) uint16 children that it was given here; 0 for a node that was given.
    """

    node: FloatArray
    number: NDArray[np.uint32]
    count: NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.number)

    @classmethod
    def empty(cls, size: int) -> NodeRows:
        """Room for nodes."""
        node = np.empty((size, WIDTH), np.float32)
        return cls(node, np.empty(size, np.uint32), np.empty(size, np.uint16))

    @classmethod
    def concat(cls, parts: list[NodeRows]) -> NodeRows:
        """Return all parts in order."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))

    def take(self, nodes: Nodes | slice) -> NodeRows:
        """Return some of the nodes."""
        return NodeRows(self.node[nodes], self.number[nodes], self.count[nodes])

    def put(self, into: NodeRows, start: int) -> None:
        """Write these rows over others, from `start` on."""
        part = slice(start, start + len(self))
        into.node[part], into.number[part], into.count[part] = self.node, self.number, self.count


@dataclass(frozen=True, eq=False)
class Joining:
    """Splats that join at a level, whose rows are not made before.

    Attributes:
        index: (n,) uint32 the splat of each node.
        number: of the first node; the others follow.
    """

    index: Nodes
    number: int
    fill: FillRows

    def __len__(self) -> int:
        return len(self.index)

    def put(self, into: NodeRows, start: int) -> None:
        """Write their rows over others, from `start` on."""
        part = slice(start, start + len(self))
        self.fill(self.index, into.node[part])
        into.number[part] = np.arange(self.number, self.number + len(self), dtype=np.uint32)
        into.count[part] = 0

    def rows(self) -> NodeRows:
        """Return their rows."""
        rows = NodeRows.empty(len(self))
        self.put(rows, 0)
        return rows


@dataclass(frozen=True, eq=False)
class Batch:
    """Merges that were done together.

    Attributes:
        level: of their cells.
        families: number of nodes that were made.
        members: number of their children.
        keys: (families, words) Morton codes of their cells, the highest word first; empty if nobody wants them.
    """

    level: int
    families: int
    members: int
    keys: Keys


class VoxelTree:
    """Nodes without a parent, and those with one in their final order.

    Attributes:
        rows: of the nodes without a parent; views of them do not outlive the next call.
        leaves: nodes that are given with a number from here on are merged ones.
        batches: in the order of the merges.
        total: number of nodes that have been written.
    """

    def __init__(
        self, given: int, leaves: int, space: Space, keys: Callable[[int, FloatArray], Keys] | None = None
    ) -> None:
        """Make a tree without nodes.

        Args:
            given: number of nodes that will be given.
            keys: returns the keys of a batch, by the level and the rows of the nodes made; None if nobody wants them.
        """
        self.leaves, self.batches, self.total, self._space, self._keys = leaves, list[Batch](), 0, space, keys
        # Twice the nodes are the most that there will be; memory that is not written to is not taken. So much room is
        # enough for the rows, too: half of them for what the others are merged into.
        size = 2 * given
        self.rows, self._used, self._awaited = NodeRows.empty(size), 0, given
        self._center, self._scale = np.empty((size, 3), np.float32), np.empty((size, 3), np.float32)
        self._quat, self._opacity = np.empty((size, 4), np.float32), np.empty(size, np.float32)
        self._weight, self._number = np.empty(size, np.float64), np.empty(size, np.uint32)
        self._count = np.empty(size, np.uint16)

    def join(self, active: Nodes, rows: NodeRows | Joining) -> Nodes:
        """Add nodes; returns where the active ones and they are. Others may be forgotten."""
        active = self.tidy(active, len(rows))
        rows.put(self.rows, self._used)
        self._awaited -= len(rows)
        added = np.arange(self._used, self._used + len(rows), dtype=np.uint32)
        self._used += len(rows)
        return np.concatenate([active, added])

    def tidy(self, active: Nodes, more: int = 0) -> Nodes:
        """Make room for so many more nodes, and for what all of them are merged into; returns where the active are."""
        need, size = len(active) + 2 * more, len(self.rows)
        if self._used + need <= size and self._used <= 2 * len(active) + more:
            return active
        # The active nodes move together, in place.
        kept = np.zeros(self._used, np.bool_)
        kept[active] = True
        order = np.flatnonzero(kept).astype(np.uint32)
        place = np.empty(self._used, np.uint32)
        place[order] = np.arange(len(order), dtype=np.uint32)
        for part in blocks_of(len(order), MOVED):
            if order[part][-1] >= part.stop:  # else they are there
                self.rows.take(order[part]).put(self.rows, part.start)
        self._used = len(order)
        enough = 2 * (len(active) + self._awaited)
        if size > 2 * enough:  # give memory back
            for column in vars(self.rows).values():
                column.resize((enough, *column.shape[1:]), refcheck=False)
        return place[active]

    def merge_cells(self, level: int, nodes: Nodes, is_first: NDArray[np.bool_], largest: np.float32) -> Nodes:
        """Merge the nodes of each cell, as `kernels.cell_pairs.merge_in_cells`; returns the nodes without a parent."""
        owner, row = np.empty(len(nodes), np.int64), np.empty(len(nodes), np.uint32)
        merge_in_cells(-(-len(nodes) // SPAN), nodes, is_first, self.rows.node, largest, self._used, owner, row)
        members, first, made, survivors = split_families(nodes, owner, row)
        del owner, row
        if len(made):
            self.write(members)
            self.rows.number[made] = self.total - first[:-1]
            self.rows.count[made] = np.diff(first)
            keys = self._keys(level, self.rows.node[made]) if self._keys else np.empty((0, 0), np.uint64)
            self.batches.append(Batch(level, len(made), len(members), keys))
            self._used += len(nodes) // 2
        return survivors

    def write(self, nodes: Nodes) -> None:
        """Put nodes before all that have been written."""
        end = len(self._weight) - self.total
        part = slice(end - len(nodes), end)
        rows, count = self.rows, len(nodes)
        self._weight[part] = rows.node[nodes, WEIGHT]
        self._number[part], self._count[part] = rows.number[nodes], rows.count[nodes]
        is_merged = (self._count[part] > 0) | (self._number[part] >= self.leaves)
        at = np.where(is_merged, np.arange(1, count + 1, dtype=np.uint32), np.uint32(0))
        columns = self._center[part], self._scale[part], self._quat[part], self._opacity[part]
        fill_merged_splats(count, at, 1, nodes, rows.node, self._space, *columns)
        self.total += count

    def finish(self, tops: NodeRows, index: Nodes, given: Splats) -> Final:
        """Return the nodes as they are drawn: those without a parent, then children of the batches, the last first.

        Colours are merged here, where those of siblings are adjacent. The tree is of no use afterwards.

        Args:
            tops: the nodes without a parent.
            index: (given,) which of the splats each node that was given is.
            given: splats, as they are drawn.
        """
        self.rows = tops
        self.write(np.arange(len(tops), dtype=np.uint32))
        self.rows = NodeRows.empty(0)
        total, part = self.total, slice(len(self._weight) - self.total, None)
        weight, number, count = self._weight[part], self._number[part], self._count[part]
        inner = np.flatnonzero(count).astype(np.uint32)
        start = np.zeros(total, np.uint32)
        start[inner] = np.uint32(total) - number[inner]
        number[inner] = MERGED
        owner = np.zeros(total + 1, np.uint32)  # of a family, by its first child
        owner[start[inner]] = inner + np.uint32(1)
        parents = owner[owner > 0] - np.uint32(1)
        del owner, inner
        geometry = self._center[part], self._scale[part], self._quat[part], self._opacity[part]
        sh = given.sh.shape[1:]
        out = Splats(*geometry, np.empty((total, 3), np.float32), np.empty((total, *sh), np.float32))
        for name in COLUMNS:
            column, filled = getattr(given, name), getattr(out, name)
            width = math.prod(filled.shape[1:])
            fill_leaves(total, number, index, column.reshape(len(column), width), filled.reshape(total, width))
        del index, given, column  # frees memory if the caller has no reference
        same, end = np.arange(total, dtype=np.uint32), len(parents)
        for batch in self.batches:
            with threads_for(batch.members):
                for color in (out.rgb, out.sh.reshape(total, math.prod(sh))):
                    family = parents[end - batch.families : end]
                    merge_colors(len(family), family, start, count, same, weight, color)
            end -= batch.families
        return Final(out, LodTree(count, start), number, parents)


@dataclass(frozen=True, eq=False)
class Final:
    """Nodes in their final order.

    Attributes:
        nodes: M nodes, as they are drawn.
        tree: the children that they were given here.
        number: (M,) uint32 of the nodes that were given, `MERGED` for the others.
        parents: (F,) uint32 the nodes with children, in the order of these.
    """

    nodes: Splats
    tree: LodTree
    number: NDArray[np.uint32]
    parents: NDArray[np.uint32]


def joining(index: Nodes, ends: Offsets, fill: FillRows) -> dict[int, Joining]:
    """Return the splats of each level that has some.

    Args:
        index: (n,) the splat of each node; nodes are numbered in this order.
        ends: where each level ends.
    """
    found, begin = {}, 0
    for level, end in enumerate(ends.tolist()):
        if end > begin:
            found[level] = Joining(index[begin:end], begin, fill)
        begin = end
    return found


def fill_rows(index: Nodes, splats: Splats, space: Space, rows: FloatArray) -> None:
    """Fill the node rows of some splats."""
    columns = SplatColumns(splats.center, splats.scale, splats.quat_xyzw, splats.opacity)
    fill_leaf_rows(len(index), index, columns, splats.rgb, space, rows, np.empty(len(index), np.float32))
