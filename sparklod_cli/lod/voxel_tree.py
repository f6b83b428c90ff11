"""The nodes of the quick builder while its tree grows, and their final order.

Only nodes without a parent are worked on. A node that gets one is written to its place in the final order at once,
which is filled from its end: the last batch of merges, the coarsest one, comes first there. So a node takes memory in
one place at a time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.lod_tree import MAX_CHILDREN, LodTree
from ..model.splats import FloatArray, Splats
from ..support.jit import threads_for
from ..support.parallel import blocks_of
from .kernels.final_order import fill_geometry, fill_leaves, merge_colors
from .kernels.geometry import WIDTH
from .kernels.group import split_cells
from .kernels.merge import merge_groups
from .kernels.sort import Keys, Nodes

#: Factor for the scales of merged splats: the profile of a splat with D above 1 is wider than its scale, and tails of
#: neighbours add up. Measured: 0.95 gains up to 0.7 dB over 1 (docs/decisions/2026-11-21-fidelity.md).
SHRINK = np.float32(0.95)

#: In place of the number of a node that was given, for a node that was made.
MADE = np.uint32(0xFFFFFFFF)

#: Rows that are moved at a time: their copies stay in a processor's cache.
MOVED = 1 << 14

Offsets = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Rows:
    """What is known of n nodes without a parent.

    Attributes:
        geometry: (n, WIDTH) float32 rows of `kernels/geometry.py`.
        weight: (n,) float64, opacity * area.
        number: (n,) uint32 of a node that was given, as the caller counts them; of a node that was made, where its
            children begin, as a distance from the end of the final order.
        count: (n,) uint16 children that it was given here; 0 for a node that was given.
    """

    geometry: FloatArray
    weight: NDArray[np.float64]
    number: NDArray[np.uint32]
    count: NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.weight)

    @classmethod
    def empty(cls, size: int) -> Rows:
        """Room for nodes."""
        geometry, weight = np.empty((size, WIDTH), np.float32), np.empty(size, np.float64)
        return cls(geometry, weight, np.empty(size, np.uint32), np.empty(size, np.uint16))

    @classmethod
    def concat(cls, parts: list[Rows]) -> Rows:
        """All parts in order."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))

    def take(self, nodes: Nodes | slice) -> Rows:
        """Some of the nodes."""
        return Rows(self.geometry[nodes], self.weight[nodes], self.number[nodes], self.count[nodes])

    def shrink(self, size: int) -> None:
        """Gives memory back but for the first rows. Nobody may have a view of them."""
        for name in self.__dataclass_fields__:
            column = getattr(self, name)
            column.resize((size, *column.shape[1:]), refcheck=False)

    def put(self, start: int, rows: Rows) -> None:
        """Overwrites rows from `start` on."""
        part = slice(start, start + len(rows))
        self.geometry[part], self.weight[part] = rows.geometry, rows.weight
        self.number[part], self.count[part] = rows.number, rows.count


@dataclass(frozen=True, eq=False)
class Batch:
    """Merges that were done together.

    Attributes:
        level: of their cells.
        fold: 0 where a cell has one node afterwards; otherwise the number of the fold, from 1.
        families: number of nodes that were made.
        members: number of their children.
        keys: (families, words) Morton codes of their cells, the highest word first; empty if nobody wants them.
    """

    level: int
    fold: int
    families: int
    members: int
    keys: Keys


class VoxelTree:
    """Nodes without a parent, and those with one in their final order.

    Attributes:
        leaves: nodes that are given with a number from here on are merged ones.
        batches: in the order of the merges.
        total: number of nodes that have been written.
    """

    def __init__(self, given: int, leaves: int, keys: Callable[[int, FloatArray], Keys] | None = None) -> None:
        """A tree without nodes.

        Args:
            given: number of nodes that will be given.
            leaves: see above.
            keys: returns the keys of a batch, by the level and the rows of the nodes made; None if nobody wants them.
        """
        self.leaves, self.batches, self.total, self._keys = leaves, list[Batch](), 0, keys
        self._rows, self._used = Rows.empty(0), 0
        # Twice the nodes are the most that there will be; memory that is not written to is not taken.
        size = 2 * given
        self._center, self._scale = np.empty((size, 3), np.float32), np.empty((size, 3), np.float32)
        self._quat, self._opacity = np.empty((size, 4), np.float32), np.empty(size, np.float32)
        self._weight, self._number = np.empty(size, np.float64), np.empty(size, np.uint32)
        self._count = np.empty(size, np.uint16)

    @property
    def geometry(self) -> FloatArray:
        """Rows of the nodes without a parent."""
        return self._rows.geometry

    def take(self, nodes: Nodes) -> Rows:
        """Copies of some of them."""
        return self._rows.take(nodes)

    def join(self, active: Nodes, rows: Rows) -> Nodes:
        """Adds nodes; returns where the active ones and they are. Others may be forgotten."""
        active = self.tidy(active, len(rows))
        self._rows.put(self._used, rows)
        added = np.arange(self._used, self._used + len(rows), dtype=np.uint32)
        self._used += len(rows)
        return np.concatenate([active, added])

    def tidy(self, active: Nodes, more: int = 0) -> Nodes:
        """Makes room for so many more nodes, and for what all of them are merged into; returns where the active are."""
        need, size = len(active) + 2 * more, len(self._rows)
        if self._used + need <= size and self._used <= 2 * len(active) + more:
            return active
        if len(active) + need <= size:
            active = self._forget(active)
            if size > 2 * (self._used + need):
                self._rows.shrink(self._used + need)
            return active
        kept = Rows.empty(2 * (len(active) + need))
        for name in Rows.__dataclass_fields__:
            np.take(getattr(self._rows, name), active, axis=0, out=getattr(kept, name)[: len(active)], mode="clip")
        self._rows, self._used = kept, len(active)
        return np.arange(len(active), dtype=np.uint32)

    def _forget(self, active: Nodes) -> Nodes:
        """Moves the active nodes together, where there is no memory for two copies; returns where they are."""
        kept = np.zeros(self._used, np.bool_)
        kept[active] = True
        order = np.flatnonzero(kept).astype(np.uint32)
        place = np.empty(self._used, np.uint32)
        place[order] = np.arange(len(order), dtype=np.uint32)
        for part in blocks_of(len(order), MOVED):
            self._rows.put(part.start, self._rows.take(order[part]))  # from there or from further behind
        self._used = len(order)
        return place[active]

    def merge(self, level: int, fold: int, members: Nodes, first: Offsets) -> Nodes:
        """Merges each group of members into one node; returns the new nodes."""
        count = len(first) - 1
        made = slice(self._used, self._used + count)
        if count:
            merge_groups(members, first, self._rows.geometry, self._rows.weight, self._used)
            self.write(members)
            self._rows.number[made] = self.total - first[:-1]
            self._rows.count[made] = np.diff(first)
            keys = self._keys(level, self._rows.geometry[made]) if self._keys else np.empty((0, 0), np.uint64)
            self.batches.append(Batch(level, fold, count, len(members), keys))
            self._used += count
        return np.arange(made.start, made.stop, dtype=np.uint32)

    def write(self, nodes: Nodes) -> None:
        """Puts nodes before all that have been written."""
        end = len(self._weight) - self.total
        part = slice(end - len(nodes), end)
        scale, rows = self._scale[part], self._rows
        fill_geometry(
            *(nodes, rows.geometry, 1 << 32, SHRINK),
            *(self._center[part], scale, self._quat[part], self._opacity[part]),
        )
        self._weight[part] = rows.weight[nodes]
        self._number[part], self._count[part] = rows.number[nodes], rows.count[nodes]
        scale[(self._count[part] > 0) | (self._number[part] >= self.leaves)] *= SHRINK
        self.total += len(nodes)

    def merge_cells(self, level: int, nodes: Nodes, is_first: NDArray[np.bool_]) -> Nodes:
        """Merges the nodes of each cell with more than one; returns the node that each cell then has."""
        before = self._used
        members, first, survivors = split_cells(nodes, is_first, before)
        fold = 0
        while len(first) > 1 and np.diff(first).max() > MAX_CHILDREN:
            fold += 1
            members, first = self._fold_oversized(level, fold, members, first)
        if fold:
            survivors[survivors >= before] += self._used - before
        self.merge(level, 0, members, first)
        return survivors

    def _fold_oversized(self, level: int, fold: int, members: Nodes, first: Offsets) -> tuple[Nodes, Offsets]:
        """Groups members of oversized groups into intermediate nodes of equal shares, at most MAX_CHILDREN each."""
        count = np.diff(first)
        big = np.flatnonzero(count > MAX_CHILDREN)
        shares = [np.linspace(0, count[g], -(-count[g] // MAX_CHILDREN) + 1).astype(np.int64) for g in big]
        starts = [np.zeros(1, np.int64)]
        for share in shares:
            starts.append(starts[-1][-1] + share[1:])
        whole = np.concatenate([members[first[g] : first[g + 1]] for g in big])
        made = self.merge(level, fold, whole, np.concatenate(starts))
        parts, at, done = [], 0, 0
        for g, share in zip(big, shares, strict=True):
            parts += [members[at : first[g]], made[done : done + len(share) - 1]]
            at, done = first[g + 1], done + len(share) - 1
        count[big] = [len(share) - 1 for share in shares]
        return np.concatenate([*parts, members[at:]]), np.concatenate([[0], np.cumsum(count)])

    def finish(self, tops: Rows, index: Nodes, rgb: FloatArray, sh: FloatArray) -> Final:
        """The nodes as they are drawn: those without a parent, then the children of the batches, last batch first.

        Colours are merged here, where those of siblings are adjacent. The tree is of no use afterwards.

        Args:
            tops: the nodes without a parent.
            index: (given,) row of the colours of each node that was given.
            rgb, sh: colours.
        """
        self._rows = tops
        self.write(np.arange(len(tops), dtype=np.uint32))
        self._rows = Rows.empty(0)
        total, part = self.total, slice(len(self._weight) - self.total, None)
        weight, number, count = self._weight[part], self._number[part], self._count[part]
        inner = np.flatnonzero(count).astype(np.uint32)
        start = np.zeros(total, np.uint32)
        start[inner] = np.uint32(total) - number[inner]
        number[inner] = MADE
        owner = np.zeros(total + 1, np.uint32)  # of a family, by its first child
        owner[start[inner]] = inner + np.uint32(1)
        parents = owner[owner > 0] - np.uint32(1)
        del owner, inner
        columns = 3 * sh.shape[1]
        geometry = self._center[part], self._scale[part], self._quat[part], self._opacity[part]
        out = Splats(*geometry, np.empty((total, 3), np.float32), np.empty((total, *sh.shape[1:]), np.float32))
        flat_sh = out.sh.reshape(total, columns)
        fill_leaves(number, index, rgb, out.rgb)
        fill_leaves(number, index, sh.reshape(len(sh), columns), flat_sh)
        del index, rgb, sh  # frees memory if the caller has no reference
        same, end = np.arange(total, dtype=np.uint32), len(parents)
        for batch in self.batches:
            with threads_for(batch.members) as threads:
                for color in (out.rgb, flat_sh):
                    family = parents[end - batch.families : end]
                    merge_colors(family, start, count, same, weight, color, threads)
            end -= batch.families
        return Final(out, LodTree(count, start), number, parents)


@dataclass(frozen=True, eq=False)
class Final:
    """Nodes in their final order.

    Attributes:
        nodes: M nodes, as they are drawn.
        tree: the children that they were given here.
        number: (M,) uint32 of the nodes that were given, `MADE` for the others.
        parents: (F,) uint32 the nodes with children, in the order of these.
    """

    nodes: Splats
    tree: LodTree
    number: NDArray[np.uint32]
    parents: NDArray[np.uint32]
