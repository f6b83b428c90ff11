"""Quick-LoD: a tree of merged splats from voxel grids that grow by a constant factor.

The levels are those of Spark's method ("Quick LoD algorithm"): a splat of size s = 2 * max(scale) belongs to level
ceil(log_base(s)), and from the finest level up, the splats of a level join the survivors of the level below. Spark
merges all nodes of a cell into one. Here, cells are wider, and in each the cheapest pairs of neighbours merge for a few
rounds, up to a size that grows with the level; the nodes merged into one are a family (`kernels/cell_pairs.py`).
benchmarks/notes/quick-builder.md has the reasons, and the alternatives that were tried.

For speed, leaves are sorted once, by level and Morton code, into rows with all data that a merge reads, so that each
level reads neighbouring memory. A level is a radix sort of its cells and one parallel merge. The nodes of a level are
made in Morton order; levels written in reverse give the final order, coarse before fine.

`quick_stages` builds the same tree in stages, bit for bit.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..model.lod_tree import LodTree
from ..model.splats import COLUMNS, FloatArray, Splats
from ..system.progress import Progress, silent
from ..system.threads import blocks_of, threads_for
from .bounds import Bounds, check
from .kernels.cell_pairs import SPAN, merge_in_cells, split_families
from .kernels.geometry import SplatColumns
from .kernels.node_rows import Space, fill_leaf_rows, fill_leaves, fill_merged_splats, merge_colors
from .kernels.pair_merge import WEIGHT, WIDTH
from .kernels.sort import (
    AXIS_BITS,
    PART_BITS,
    Keys,
    Nodes,
    Parts,
    cell_words,
    fill_level_keys,
    sort_by_cell,
    sort_by_key,
)
from .tree_settings import DEFAULT_BASE, MAX_BASE, MIN_BASE

#: Largest coordinate in steps of a level, which bounds the finest level: parts are half a step wide, and their
#: coordinates and the differences of these are int64.
MAX_STEPS = 2.0**59

#: Edge of a cell in steps of its level. Chosen; 8 is no better (benchmarks/notes/quick-builder.md).
CELL = 4

#: Parts of a cell on an axis.
PARTS = 1 << PART_BITS

#: The grid is shifted from level to level by these shares of a cell on the three axes: powers of the golden section,
#: so that seams hardly ever recur.
SHIFT = (0.38196601, 0.76393202, 0.14589803)

#: Largest size of a merged node, in steps of its level; a node's size is about 2 * sqrt(trace of its covariance / 3).
#: Chosen; the number of rounds matters more (`kernels/cell_pairs.py`).
LIMIT = 0.7

#: Largest coordinate and size, units: float32 holds its square. Chosen.
FARTHEST = 1e15

#: Bits per axis of the Morton codes that leaves are sorted by: 51 bits, and at most 11 for the level (sizes are
#: float32, the base is at least 1.1), fit a uint64.
CURVE_BITS = 17

#: Number of the nodes merged here; only given nodes have numbers of their own.
MERGED = np.uint32(0xFFFFFFFF)

#: Rows moved at a time: their copies stay in a processor's cache.
MOVED = 1 << 14

Offsets = NDArray[np.int64]


def build(splats: Splats, base: float = DEFAULT_BASE, *, progress: Progress = silent) -> tuple[Splats, LodTree]:
    """Build a Level-of-Detail tree.

    The result does not depend on the number of threads. Each input splat is one leaf, bit for bit.
    The root is node 0, siblings are consecutive and come after their parent. Any prefix of the nodes is a coarser
    scene: nodes whose parents were made at a coarser level come first, and along a Morton curve within a level.

    Args:
        splats: N splats, finite, with positive opacity and at least one positive scale each.
        base: growth of the cells from level to level, 1.1 to 2.0.

    Returns:
        M >= N splats and their tree; merged ones have linear opacities up to 1000.

    Raises:
        InvalidSplatsError: there are no splats, or one is invisible.
        ValueError: the base is out of range.
    """
    n = len(splats)
    grid = plan(check(splats), splats, base)
    with threads_for(n) as threads:
        index, ends = grid.sorted_leaves(splats.center, splats.scale, threads)
        tree = VoxelTree(grid, n, index, ends, splats)
        ((_, root),) = tree.grow(None, progress)
        nodes, links, *_ = tree.finish(root, splats)
    return nodes, links


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """The cells of all levels, level 0 the finest; the same grid for each region of a scene.

    Nodes of a level are about base ** level large. A cell is wider, so that it has several nodes to choose pairs from,
    and is divided into parts, along which its nodes are sorted. Each level shifts the grid, and with it the seams.

    Attributes:
        base: growth of the cells from level to level.
        finest: power of the base that is the edge of the cells of level 0.
        steps: (L,) edges of the cells of all levels that a splat can belong to, world units.
        low, high: (3,) float64 corners of the box of all centres, world units.
        box: (2, 3) float64 the same corners in units, as rows hold them.
        largest: size of the largest splat, world units.
        space: coordinates of node rows; the unit is a power of two, so that centres are divided by it exactly.
    """

    base: float
    finest: int
    steps: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    box: NDArray[np.float64]
    largest: float
    space: Space

    def parts(self, level: int) -> Parts:
        """Return the parts of the cells of any level; their `low` is that of a cell.

        The scene's box bounds merged nodes, too: a mean lies in the box of its terms.
        """
        step = np.float64(self.base) ** (self.finest + level) / self.space.unit
        edge = np.float64(step) * np.float64(CELL / PARTS)
        shift = np.floor(np.array(SHIFT) * level % 1 * PARTS).astype(np.int64)
        low, high = (np.floor(corner / edge).astype(np.int64) for corner in self.box)
        lowest = (low - shift) // PARTS * PARTS + shift
        bits = int((high - lowest).max()).bit_length()
        return Parts(edge, lowest, bits, max(1, -(-bits // AXIS_BITS)))

    def sorted_leaves(
        self, center: FloatArray, scale: FloatArray, threads: int, order: Nodes | None = None
    ) -> tuple[Nodes, Offsets]:
        """Sort splats by level and then along a curve; return them, and the end of each level in this order.

        Args:
            center, scale: (n, 3) of the splats.
            order: (n,) the splats in the order of the scene; None if they are in this order.
        """
        # One cell to spare at either end.
        edge = max(float((self.high - self.low).max()) / (2**CURVE_BITS - 2), float(self.steps[0]))
        low_cell = np.floor(self.low / edge).astype(np.int64)
        keys, levels = np.empty(len(scale), np.uint64), np.empty(len(scale), np.int32)
        fill_level_keys(len(scale), center, scale, self.steps, edge, low_cell, 3 * CURVE_BITS, keys, levels)
        ends = np.cumsum(np.bincount(levels))
        del levels
        if order is None:
            order = np.arange(len(center), dtype=np.uint32)
        else:
            keys = keys[order]
        return sort_by_key(keys, order, 3 * CURVE_BITS + len(self.steps).bit_length(), threads)[1], ends

    def keys(self, level: int, rows: FloatArray) -> Keys:
        """Return (n, words) Morton codes of the cells of a level that node rows are in, the highest word first."""
        parts, nodes = self.parts(level), np.arange(len(rows), dtype=np.uint32)
        words = [cell_words(rows, nodes, parts, word) for word in range(self.parts(0).words)]
        words[0] &= ~np.uint64((1 << 3 * PART_BITS) - 1)
        return np.stack(words[::-1], axis=1)


class NodeRows(NamedTuple):
    """Columns of n nodes without a parent.

    Attributes:
        node: (n, WIDTH) float32 node rows of `kernels/pair_merge.py`.
        number: (n,) uint32 place of a given node among the given ones; of a merged node, the place of its first child
            as a distance from the end of the final order.
        children: (n,) uint16 number of children merged in this build; 0 for a given node.
    """

    node: FloatArray
    number: NDArray[np.uint32]
    children: NDArray[np.uint16]

    def take(self, nodes: Nodes | slice) -> NodeRows:
        """Return nodes by index or slice."""
        return NodeRows(self.node[nodes], self.number[nodes], self.children[nodes])


class VoxelTree:
    """A forest that grows to a tree: rows of its roots, and its other nodes in their final order.

    A node that gets a parent moves from its row to its place in the final order. This order is filled from its end, as
    the last batch of merges, the coarsest, comes first.

    Attributes:
        rows: rows of the roots; a method call may move them, so views of them do not outlive it.
        batches: merges of one level each, in their order: level of the cells; numbers of merged nodes and of their
            children; (families, words) `VoxelGrid.keys` of the merged nodes in a build in stages, else empty.
    """

    def __init__(
        self,
        grid: VoxelGrid,
        leaves: int,
        index: Nodes,
        ends: Offsets,
        source: Splats | FloatArray,
        waiting: dict[int, NodeRows] | None = None,
    ) -> None:
        """Prepare a forest without nodes.

        Args:
            leaves: number of given leaves; given nodes with this number or a higher one are merged ones.
            index: (given,) splat of each given node; first the splats that join at the level of their size, level by
                level and along the curve.
            ends: end of each level in `index`.
            source: the joining splats, or their (n, WIDTH) node rows, freed once all have joined.
            waiting: rows of all other nodes by the level at which they join; all nodes in a cell of the level below
                come from one stage, in their order. Emptied, to free memory. None for a build in memory.
        """
        self.batches = list[tuple[int, int, int, Keys]]()
        self._grid, self._leaves, self._index = grid, leaves, index
        self._in_stages, self._waiting = waiting is not None, waiting or {}
        self._joining = {
            level: slice(begin, end)
            for level, (begin, end) in enumerate(itertools.pairwise([0, *ends.tolist()]))
            if begin < end
        }
        self._source = source if self._joining else None
        # A tree has at most twice as many nodes as leaves, and untouched memory costs nothing. The rows need as much:
        # half of them for merged nodes.
        size = 2 * len(index)
        self.rows = NodeRows(np.empty((size, WIDTH), np.float32), np.empty(size, np.uint32), np.empty(size, np.uint16))
        self._used, self._awaited, self._total = 0, len(index), 0
        shapes = (size, 3), (size, 3), (size, 4), (size,)  # centre, scale, rotation, opacity
        self._geometry = tuple(np.empty(shape, np.float32) for shape in shapes)
        self._weight, self._number = np.empty(size, np.float64), np.empty(size, np.uint32)
        self._count = np.empty(size, np.uint16)

    def grow(self, margins: Any, progress: Progress) -> list[tuple[int, NodeRows]]:
        """Merge the nodes of each cell, level by level.

        Args:
            margins: `quick_stages.Margins` of the region, at level 0; None to merge all nodes into one root.

        Returns:
            the roots, by the level at which they join next.
        """
        grid, active, level = self._grid, np.empty(0, np.uint32), 0
        splats = max((numbers.stop for numbers in self._joining.values()), default=0)
        last = max(0, int(np.searchsorted(grid.steps, grid.largest)))  # a splat joins at its level at most
        left: list[tuple[int, NodeRows]] = []
        while True:
            if level in self._waiting:
                waiting = self._waiting.pop(level)
                active, part = self._join(active, len(waiting.number))
                added = self.rows.take(part)
                added.node[:], added.number[:], added.children[:] = waiting
                del waiting, added
                with threads_for(len(active)) as threads:
                    active, _ = sort_by_cell(self.rows.node, active, grid.parts(level - 1), threads, within=False)
            if level > last and not self._waiting and len(active) <= 1:
                break
            if margins is not None:
                margins.widen(grid.parts(level))
                if margins.are_closed:
                    break
            if level in self._joining:
                numbers = self._joining[level]
                active, part = self._join(active, numbers.stop - numbers.start)
                self._fill(level, self.rows.take(part))
                progress("building", numbers.stop, splats, "splat")
            if margins is not None:
                active, outside = margins.split(active, self.rows.node)
                left.append((level, self.rows.take(outside)))
            if len(active) > 1:
                active = self._merge_cells(level, active)
            level += 1
        left.append((level, self.rows.take(active)))
        for unjoined, numbers in list(self._joining.items()):
            n = numbers.stop - numbers.start
            rows = NodeRows(np.empty((n, WIDTH), np.float32), np.empty(n, np.uint32), np.empty(n, np.uint16))
            self._fill(unjoined, rows)
            left.append((unjoined, rows))
        return left + list(self._waiting.items())

    def _join(self, active: Nodes, more: int) -> tuple[Nodes, slice]:
        """Make room for the rows of more nodes; return the places of all active nodes, and those of the new ones."""
        active = self._tidy(active, more)
        part = slice(self._used, self._used + more)
        self._used, self._awaited = part.stop, self._awaited - more
        return np.concatenate([active, np.arange(part.start, part.stop, dtype=np.uint32)]), part

    def _fill(self, level: int, rows: NodeRows) -> None:
        """Fill the rows of the splats that join at a level."""
        numbers, source = self._joining.pop(level), self._source
        if not self._joining:
            self._source = None
        index = self._index[numbers]
        if isinstance(source, Splats):
            columns = SplatColumns(source.center, source.scale, source.quat_xyzw, source.opacity)
            sizes = np.empty(len(index), np.float32)
            fill_leaf_rows(len(index), index, columns, source.rgb, self._grid.space, rows.node, sizes)
        elif source is not None:
            np.take(source, index, axis=0, out=rows.node, mode="clip")
        rows.number[:] = np.arange(numbers.start, numbers.stop, dtype=np.uint32)
        rows.children[:] = 0

    def _tidy(self, active: Nodes, more: int = 0) -> Nodes:
        """Make room for more nodes and for the nodes that all merge into; return the new places of the active nodes."""
        need, size = len(active) + 2 * more, len(self.rows.number)
        if self._used + need <= size and self._used <= 2 * len(active) + more:
            return active
        # The active nodes move to the front, in place.
        kept = np.zeros(self._used, np.bool_)
        kept[active] = True
        order = np.flatnonzero(kept).astype(np.uint32)
        place = np.empty(self._used, np.uint32)
        place[order] = np.arange(len(order), dtype=np.uint32)
        for part in blocks_of(len(order), MOVED):
            if order[part][-1] >= part.stop:  # else they are in place
                for column in self.rows:
                    column[part] = column[order[part]]
        self._used = len(order)
        enough = 2 * (len(active) + self._awaited)
        if size > 2 * enough:  # give memory back
            for column in self.rows:
                column.resize((enough, *column.shape[1:]), refcheck=False)
        return place[active]

    def _merge_cells(self, level: int, nodes: Nodes) -> Nodes:
        """Merge the nodes of each cell by `kernels.cell_pairs.merge_in_cells`; return the roots."""
        parts = self._grid.parts(level)
        size = LIMIT * (float(parts.step) * (PARTS / CELL))
        largest = np.float32(0.75 * size * size if size < FARTHEST**1.2 else math.inf)  # trace of a covariance
        with threads_for(len(nodes)) as threads:
            nodes, is_first = sort_by_cell(self.rows.node, self._tidy(nodes), parts, threads)
            owner, row = np.empty(len(nodes), np.int64), np.empty(len(nodes), np.uint32)
            merge_in_cells(-(-len(nodes) // SPAN), nodes, is_first, self.rows.node, largest, self._used, owner, row)
            members, first, merged, survivors = split_families(nodes, owner, row)
            del owner, row
            if len(merged):
                self._write(members)
                self.rows.number[merged] = self._total - first[:-1]
                self.rows.children[merged] = np.diff(first)
                no_keys = np.empty((0, 0), np.uint64)
                keys = self._grid.keys(level, self.rows.node[merged]) if self._in_stages else no_keys
                self.batches.append((level, len(merged), len(members), keys))
                self._used += len(nodes) // 2
        return survivors

    def _write(self, nodes: Nodes) -> None:
        """Write nodes to the final order, before all written so far."""
        end = len(self._weight) - self._total
        part = slice(end - len(nodes), end)
        rows, count = self.rows, len(nodes)
        self._weight[part] = rows.node[nodes, WEIGHT]
        self._number[part], self._count[part] = rows.number[nodes], rows.children[nodes]
        is_merged = (self._count[part] > 0) | (self._number[part] >= self._leaves)
        at = np.where(is_merged, np.arange(1, count + 1, dtype=np.uint32), np.uint32(0))
        columns = (column[part] for column in self._geometry)
        fill_merged_splats(count, at, 1, nodes, rows.node, self._grid.space, *columns)
        self._total += count

    def finish(self, tops: NodeRows, given: Splats) -> tuple[Splats, LodTree, Nodes, Nodes]:
        """Return the nodes as they are drawn: the roots, then the children of each batch, the last batch first.

        Merges the colours, as siblings are adjacent only now. Leaves the forest empty.

        Args:
            tops: the roots.
            given: splats, as they are drawn.

        Returns:
            M nodes; their children in this build; (M,) uint32 numbers of the given nodes, `MERGED` for others; and (F,)
            uint32 nodes with children, in the order of their children.
        """
        self.rows = tops
        self._write(np.arange(len(tops.number), dtype=np.uint32))
        self.rows = tops.take(slice(0))
        total, part = self._total, slice(len(self._weight) - self._total, None)
        weight, number, count = self._weight[part], self._number[part], self._count[part]
        inner = np.flatnonzero(count).astype(np.uint32)
        start = np.zeros(total, np.uint32)
        start[inner] = np.uint32(total) - number[inner]
        number[inner] = MERGED
        owner = np.zeros(total + 1, np.uint32)  # of a family, by its first child
        owner[start[inner]] = inner + np.uint32(1)
        parents = owner[owner > 0] - np.uint32(1)
        del owner, inner
        sh = given.sh.shape[1:]
        center, scale, quat, opacity = (column[part] for column in self._geometry)
        rgb, coefficients = np.empty((total, 3), np.float32), np.empty((total, *sh), np.float32)
        out = Splats(center, scale, quat, opacity, rgb, coefficients)
        for name in COLUMNS:
            column, filled = getattr(given, name), getattr(out, name)
            width = math.prod(filled.shape[1:])
            fill_leaves(total, number, self._index, column.reshape(len(column), width), filled.reshape(total, width))
        del given, column  # frees memory unless the caller has a reference
        same, end = np.arange(total, dtype=np.uint32), len(parents)
        for _, families, members, _ in self.batches:
            with threads_for(members):
                for color in (out.rgb, out.sh.reshape(total, math.prod(sh))):
                    family = parents[end - families : end]
                    merge_colors(len(family), family, start, count, same, weight, color)
            end -= families
        return out, LodTree(count, start), number, parents


def plan(bounds: Bounds, sample: Splats, setting: float) -> VoxelGrid:
    """Return the grid of a scene; see `stages.StagedBuilder.plan`. The setting is the base."""
    if not MIN_BASE <= setting <= MAX_BASE:
        raise ValueError(f"base {setting} is not within {MIN_BASE} to {MAX_BASE}")
    corners = np.array([bounds.low, bounds.high])
    farthest = float(np.abs(corners).max())
    finest = math.floor(math.log(max(bounds.smallest, farthest / MAX_STEPS), setting))
    coarsest = max(finest + 1, math.ceil(math.log(bounds.largest, setting)) + 1)
    steps = setting ** np.arange(finest, coarsest + 1, dtype=np.float64)
    middle = math.sqrt(bounds.smallest) * math.sqrt(bounds.largest)
    unit = 2.0 ** round(math.log2(max(middle, farthest / FARTHEST, bounds.largest / FARTHEST)))
    box = (corners / unit).astype(np.float32).astype(np.float64)
    space = Space(np.zeros(3), np.float64(unit))
    return VoxelGrid(setting, finest, steps, bounds.low, bounds.high, box, bounds.largest, space)
