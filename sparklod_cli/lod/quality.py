"""The quality builder: a binary tree made by merging the cheapest pairs, pruned to its most useful nodes.

1. Leaves join level by level, from small to large. The active nodes are sorted along a Morton curve, and each finds its
   cheapest partner among its neighbours on it. Of the pairs that chose each other, the cheaper half are merged, all at
   once (`kernels/pair_merge.py`). The curve is shifted from round to round, and its seams with it.
2. A merged node covers the union of its two nodes, and is drawn with the opacity profile that has this coverage
   (`kernels/geometry.py`).
3. The binary tree's least useful nodes are dropped (`kernels/prune.py`).
4. The other nodes are put into their final order, with their geometry and colours.

benchmarks/notes/quality-builder.md has the reasons, and the alternatives that were tried. `quality_stages` builds trees
in stages.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..model.lod_tree import MAX_CHILDREN, LodTree
from ..model.sh import degree_of
from ..model.splats import COLUMNS, FloatArray, Splats
from ..system.progress import Progress, silent
from ..system.threads import blocks_of, for_blocks, threads_for, threads_in_use
from .bounds import Bounds, check
from .kernels import node_rows, pair_merge, prune
from .kernels.geometry import SplatColumns
from .kernels.node_rows import fill_leaves, merge_colors
from .kernels.sort import Keys, Nodes, sort_by_key
from .tree_settings import DEFAULT_GROWTH, MAX_GROWTH, MIN_GROWTH

if TYPE_CHECKING:
    from .stages import Region

#: Sample size for the scene's middle, unit and box. Chosen.
SAMPLE = 1 << 14

#: Share of the leaves outside the curve's box on either side of an axis, as scenes have a few far away. Chosen.
OUTSIDE = 0.005

#: How much wider the curve's box is than the scene, as a share of its edge, which leaves room to shift it. From round
#: to round it is shifted by the golden section, so that no two rounds have the same seams. Chosen.
SLACK, GOLDEN = 0.3, 0.6180339887

#: Largest coordinate and size, units: float32 holds its square. Chosen.
FARTHEST = 1e15

#: Growth, from level to level, of the size up to which leaves join and nodes merge. Chosen.
BASE = 2.0

#: Largest distance on the curve of two nodes that merge. Measured: 8 loses 0.1 to 0.2 dB to 16; 16 and 24 gain nothing
#: over 12 (benchmarks/notes/quality-builder.md).
WINDOW = 12

#: Width of the strip along the border of a region, as a multiple of the size of a level, in which nodes do not merge.
#: Measured: with 0.5 cuts lose 0.1 to 0.2 dB more, with 0 up to 1 dB (benchmarks/notes/quality-builder.md).
MARGIN = 1.0

#: Quantile of the costs up to which pairs merge in a round: close to merging the cheapest first.
#: Measured: gains up to 0.6 dB over merging all (benchmarks/notes/quality-builder.md).
CHEAP = 0.5

#: With at most this many costs in the sample, all pairs merge. Chosen.
FEW = 1000

#: A level ends when a round merges no more than this share of its nodes, or after this many rounds. Chosen; 8 rounds
#: were measured against 12 that merge all pairs.
LEAST, MOST_ROUNDS = 0.02, 8

#: Quantile of the leaves' levels that is the first level: the few smaller leaves, down to any size, would only add
#: rounds. Chosen.
SMALLEST = 0.01

#: Columns of merged splats that are computed from their node rows, and columns that are merged from their children.
GEOMETRY = ("center", "scale", "quat_xyzw", "opacity")
COLORS = tuple(name for name in COLUMNS if name not in GEOMETRY)

Levels = NDArray[np.int32]


def build(splats: Splats, growth: float = DEFAULT_GROWTH, *, progress: Progress = silent) -> tuple[Splats, LodTree]:
    """Build a Level-of-Detail tree whose cuts are close to full detail.

    The result does not depend on the number of threads. Each input splat is one leaf, bit for bit.
    The root is node 0, siblings are consecutive and come after their parent. Any prefix of the nodes is a coarser
    scene: the children of larger nodes come first, and along a Morton curve within a step of size.

    Args:
        splats: N splats, finite, with positive opacity and at least one positive scale each.
        growth: maximum ratio of nodes to leaves, 1.05 to 2.

    Returns:
        M >= N splats and their tree.

    Raises:
        InvalidSplatsError: there are no splats, or one is invisible.
        ValueError: the growth is out of range.
    """
    check_growth(growth)
    bounds = check(splats)
    n = len(splats)
    if n == 1:
        return splats, LodTree(np.zeros(1, np.uint16), np.zeros(1, np.uint32))
    curve = Curve.of(splats, bounds)
    with threads_for(n) as threads:
        index = curve.order(splats.center, threads)
        binary = BinaryTree.of_leaves(*curve.leaf_rows(splats, index))
        levels = levels_of(binary.size[:n])
        np.maximum(levels, lowest_level(levels), out=levels)
        merge_levels(binary, levels, curve, None, progress)
        goal = PruningGoal(max(int(growth * n) - n, 1), n)
        columns = dict(vars(splats))
        del splats
        final = in_final_order(binary, index, columns, goal, curve, progress)
        return final.splats, final.tree


def check_growth(growth: float) -> None:
    """Raise `ValueError` if the growth is out of range."""
    if not MIN_GROWTH <= growth <= MAX_GROWTH:
        raise ValueError(f"growth {growth} is not within {MIN_GROWTH} to {MAX_GROWTH}")


@dataclass(frozen=True)
class Curve:
    """The coordinates of node rows, and the box of the Morton curve.

    Attributes:
        middle: (3,) origin, near the middle of the scene, world units.
        unit: length of a unit, world units.
        low: (3,) lowest corner of the box, in units.
        extent: edge of the box, in units.
    """

    middle: NDArray[np.float64]
    unit: float
    low: NDArray[np.float64]
    extent: float

    @classmethod
    def of(cls, splats: Splats, bounds: Bounds) -> Curve:
        """Return a curve around most of the splats.

        The unit is a power of two near their median scale, or larger, so that no coordinate or size exceeds FARTHEST.
        """
        some = slice(None, None, max(1, len(splats) // SAMPLE))
        center = splats.center[some].astype(np.float64)
        middle = np.median(center, axis=0)
        reach = max(float((bounds.high - bounds.low).max()), bounds.largest) / FARTHEST
        unit = 2.0 ** round(math.log2(max(float(np.median(splats.scale[some].max(axis=1).astype(np.float64))), reach)))
        return cls(middle, unit, middle, 1.0).around(center)

    def around(self, center: FloatArray) -> Curve:
        """Return a curve in the same coordinates, with a box around most of (n, 3) centres in world units."""
        some = slice(None, None, max(1, len(center) // SAMPLE))
        units = (center[some].astype(np.float64) - self.middle) / self.unit
        low, high = np.quantile(units, [OUTSIDE, 1 - OUTSIDE], axis=0)
        return replace(self, low=low, extent=float(max((high - low).max(), 1.0)))

    @property
    def space(self) -> node_rows.Space:
        """Coordinates, for kernels."""
        return node_rows.Space(self.middle, self.unit)

    def order(self, center: FloatArray, threads: int) -> Nodes:
        """Return the (n,) order of (n, 3) centres, in world units, along the curve of the first round."""
        units = np.empty((len(center), 3), np.float32)

        def fill(part: slice) -> None:
            units[part] = np.subtract(center[part], self.middle, dtype=np.float64) / self.unit

        for_blocks(fill, len(center), threads)
        return self.sort(units, np.arange(len(center), dtype=np.uint32), 0, threads)

    def leaf_rows(self, splats: Splats, index: Nodes) -> tuple[FloatArray, FloatArray]:
        """Return the (n, WIDTH) node rows and (n,) feature sizes, in units, of the splats of an index."""
        rows, size = np.empty((len(index), pair_merge.WIDTH), np.float32), np.empty(len(index), np.float32)
        columns = SplatColumns(splats.center, splats.scale, splats.quat_xyzw, splats.opacity)
        node_rows.fill_leaf_rows(len(index), index, columns, splats.rgb, self.space, rows, size)
        return rows, size

    def sort(self, rows: FloatArray, at: Nodes, turn: int, threads: int) -> Nodes:
        """Return the stable order, (n,) uint32, of the rows at (n,) places along the curve of round `turn`.

        `rows` are node rows, or any rows whose first columns are the centre, in units.
        """
        bits = 3 * node_rows.CURVE_BITS
        return sort_by_key(self.keys(rows, at, turn), np.arange(len(at), dtype=np.uint32), bits, threads)[1]

    def keys(self, rows: FloatArray, at: Nodes, turn: int) -> Keys:
        """Return the (n,) Morton codes of the rows at (n,) places on the curve of round `turn`."""
        keys = np.empty(len(at), np.uint64)
        shift = np.modf(np.array([1, 2, 3]) * GOLDEN * turn)[0] * SLACK * self.extent
        cell = (1 + SLACK) * self.extent / (1 << node_rows.CURVE_BITS)
        node_rows.fill_morton_keys(len(at), rows, at, self.low - shift, cell, keys)
        return keys


@dataclass
class BinaryTree:
    """A binary tree of N leaves under construction: leaves first, then merged nodes in the order of their merges.

    A merge frees the rows of two leaves; the merged node takes over one of them. So each tree of the forest has one
    unused row, which the next merge of its root takes over, and N rows are enough for all 2N - 1 nodes.

    Attributes:
        rows: (N, WIDTH) float32 node rows, see `kernels/pair_merge.py`; leaf k has row k until it is merged. The only
            reference to its memory, so that it can shrink in place.
        weight: (N,) float32 weights of the leaves, which outlive their rows.
        row: (N,) uint32 row of each merged node.
        spare: (N,) uint32 unused row in the tree of each merged root.
        children: (N, 2) uint32 children of merged nodes.
        size: (2N,) float32 feature sizes of leaves and merged nodes, units.
        error: (N,) float32 `kernels.pair_merge.picture_error` of merged nodes.
        used: number of nodes so far.
        rounds: number of rounds of merging so far.
    """

    rows: FloatArray
    weight: FloatArray
    row: Nodes
    spare: Nodes
    children: NDArray[np.uint32]
    size: FloatArray
    error: FloatArray
    used: int
    rounds: int = 0

    @classmethod
    def of_leaves(cls, rows: FloatArray, size: FloatArray) -> BinaryTree:
        """Return a forest of unmerged leaves; it takes over their rows, and copies their feature sizes in units."""
        count = len(rows)
        sizes = np.empty(2 * count, np.float32)
        sizes[:count] = size
        row, spare = np.empty(count, np.uint32), np.empty(count, np.uint32)
        children, error = np.empty((count, 2), np.uint32), np.empty(count, np.float32)
        return cls(rows, rows[:, pair_merge.WEIGHT].copy(), row, spare, children, sizes, error, count)

    @property
    def leaves(self) -> int:
        """Number of leaves."""
        return len(self.row)

    def rows_of(self, nodes: Nodes) -> Nodes:
        """Return the (n,) rows of nodes without a parent; other nodes may have lost theirs."""
        found = np.empty(len(nodes), np.uint32)
        node_rows.fill_rows_of(len(nodes), nodes, self.row, self.leaves, found)
        return found

    def keep_rows(self, slots: Nodes) -> None:
        """Drop all rows but those of merged nodes, given by their places among the merged nodes.

        In place: a copy would be a large part of the memory of a build.
        """
        rows = self.row[slots]
        is_kept = np.zeros(len(self.rows), np.bool_)
        is_kept[rows] = True
        self.row[slots] = (np.cumsum(is_kept, dtype=np.uint32) - np.uint32(1))[rows]
        end = 0
        for part in blocks_of(len(self.rows)):
            kept = self.rows[part][is_kept[part]]
            self.rows[end : end + len(kept)] = kept
            end += len(kept)
        self.rows.resize((end, pair_merge.WIDTH), refcheck=False)


def levels_of(size: FloatArray) -> Levels:
    """Return the (n,) levels at which leaves of these feature sizes, in units, join."""
    levels: Levels = np.ceil(np.log(size.astype(np.float64)) / math.log(BASE)).astype(np.int32)
    return levels


def lowest_level(levels: Levels) -> int:
    """Return the first level of merging, at which all smaller leaves join, too."""
    return int(np.quantile(levels, SMALLEST))


def merge_levels(
    binary: BinaryTree, levels: Levels, curve: Curve, region: Region | None, progress: Progress
) -> tuple[Nodes, Levels]:
    """Merge pairs, level by level: up to the root, or in a region except nodes whose partners may be outside.

    Args:
        levels: (N,) level at which each leaf joins.
        region: None for the whole scene.

    Returns:
        (n,) uint32 roots, and (n,) levels at which they would have merged next.
    """
    lowest = int(levels.min())
    keys = (levels - np.int32(lowest)).astype(np.uint64)
    ends = np.cumsum(np.bincount(levels - np.int32(lowest)))
    del levels
    with threads_for(len(keys)) as threads:
        leaves = np.arange(len(keys), dtype=np.uint32)
        by_level = sort_by_key(keys, leaves, len(ends).bit_length(), threads)[1]
    del keys, leaves
    corners = (region.low, region.high) if region else ((-math.inf,) * 3, (math.inf,) * 3)
    low, high = ((np.array(corner) - curve.middle) / curve.unit for corner in corners)
    active = np.empty(0, np.uint32)
    waiting: list[tuple[Nodes, Levels]] = []
    joined = level = 0
    while level < len(ends) or (region is not None and len(active) > 1 and BASE ** (lowest + level) < FARTHEST):
        end = int(ends[min(level, len(ends) - 1)])
        active, joined = np.concatenate([active, by_level[joined:end]]), end
        # A node's size is about 2 * sqrt(trace of its covariance / 3).
        size = BASE ** (lowest + level + 1)
        if region is not None:
            center, margin = binary.rows[binary.rows_of(active), : pair_merge.COVARIANCE], MARGIN * size
            near = np.any((center < low + margin) | (center > high - margin), axis=1)
            waiting.append((active[near], np.full(np.count_nonzero(near), lowest + level, np.int32)))
            active = active[~near]
        active = _merge(binary, active, curve, 3 * size * size / 4, MOST_ROUNDS, progress)
        level += 1
    del by_level
    if region is None:
        active = _merge(binary, active, curve, math.inf, None, progress)
    waiting.append((active, np.full(len(active), lowest + level, np.int32)))
    return np.concatenate([nodes for nodes, _ in waiting]), np.concatenate([at for _, at in waiting])


def _merge(
    binary: BinaryTree, active: Nodes, curve: Curve, largest: float, rounds: int | None, progress: Progress
) -> Nodes:
    """Merge roots in at most `rounds` rounds; return the remaining roots: a single one if `rounds` is None.

    `largest` is the largest trace of the covariance of a merged node, units squared.
    """
    done, leaves = 0, binary.leaves
    while len(active) > 1 and (rounds is None or done < rounds):
        with threads_for(len(active)) as threads:
            at = binary.rows_of(active)
            order = curve.sort(binary.rows, at, binary.rounds, threads)
            active, at = active[order], at[order]
            partner, cost = partners(binary.rows, at, WINDOW, np.float32(largest))
            del at
            before = len(active)
            some = cost[:: max(1, len(cost) // SAMPLE)]
            some = some[np.isfinite(some)]
            limit = np.float32(np.quantile(some, CHEAP)) if len(some) > FEW else np.float32(np.inf)
            pairs, rest = matched(active, partner, cost, limit, binary.used, threads)
            if rounds is None and not len(pairs):  # no finite cost: too far apart for float32; merge neighbours
                partner = np.arange(before, dtype=np.int32) ^ 1
                partner[partner >= before] = -1
                free = np.zeros_like(cost)
                pairs, rest = matched(active, partner, free, np.float32(0), binary.used, threads)
            active = rest
            columns = binary.rows, binary.row, binary.spare, binary.children, binary.size, binary.error
            pair_merge.merge_pairs(len(pairs), pairs, binary.used, leaves, *columns)
        binary.used += len(pairs)
        binary.rounds += 1
        progress("building", binary.used - leaves, leaves - 1, "node")
        done += 1
        if rounds is not None and len(pairs) <= LEAST * before:
            break
    return active


def partners(rows: FloatArray, nodes: Nodes, window: int, largest: np.float32) -> tuple[NDArray[np.int32], FloatArray]:
    """Return (n,) places of the nodes' cheapest partners, -1 for none, and costs; see `pair_merge.find_partners`."""
    partner, cost = np.empty(len(nodes), np.int32), np.empty(len(nodes), np.float32)
    pair_merge.find_partners(len(nodes), rows, nodes, window, largest, partner, cost)
    return partner, cost


def matched(
    nodes: Nodes, partner: NDArray[np.int32], cost: FloatArray, limit: np.float32, made: int, blocks: int
) -> tuple[Nodes, Nodes]:
    """Pair the nodes that are each other's cheapest partner, and replace each pair by its merged node.

    Args:
        limit: largest cost of a pair.
        made: number of the merged node of the first pair; the following pairs count up.
        blocks: number of parallel ranges of nodes; the result does not depend on it.

    Returns:
        pairs: (P, 2) uint32.
        rest: (n - P,) uint32 nodes in their order; a merged node replaces the first of its pair.
    """
    counts = np.empty((blocks, 2), np.int64)
    pair_merge.count_pairs(blocks, partner, cost, limit, counts)
    ends = np.cumsum(counts, axis=0)
    found = int(ends[-1, 0])
    pairs, rest = np.empty((found, 2), np.uint32), np.empty(len(nodes) - found, np.uint32)
    pair_merge.list_pairs(blocks, nodes, partner, cost, limit, made, ends - counts, pairs, rest)
    return pairs, rest


@dataclass(frozen=True)
class PruningGoal:
    """Size of a pruned tree, and ranks in its order.

    Attributes:
        most: maximum number of merged nodes.
        splats: number of splats of the scene under the tree's leaves.
        is_whole: whether the last node is the root of the scene. Otherwise a later stage gives the roots a parent, and
            the children of a dropped root become roots.
        highest: ln(size) of rank 0, in units; None for that of the root.
        latest: (N,) upper bounds, exclusive, of the ranks of leaves' parents; empty for no bounds.
    """

    most: int
    splats: int
    is_whole: bool = True
    highest: float | None = None
    latest: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))


@dataclass(frozen=True, eq=False)
class FinalTree:
    """Pruned tree in final order.

    If the tree is not whole, node 0 is a placeholder for the future parents of the roots, and is not drawn.

    Attributes:
        splats: M nodes as they are drawn.
        order: (M,) uint32 node of the binary tree.
        parents: (F,) uint32 final indices of the merged nodes, in the order of their children.
        ranks: (F,) int32, ascending.
        keys: (F,) uint64 places on the curve, ascending within a rank.
        rows: (F, WIDTH) float32 node rows of `parents`; empty if the tree is whole.
    """

    splats: Splats
    tree: LodTree
    order: Nodes
    parents: Nodes
    ranks: NDArray[np.int32]
    keys: Keys
    rows: FloatArray

    @property
    def first_child(self) -> int:
        """Index of the first node with a parent."""
        return len(self.order) - int(self.tree.child_count[self.parents].sum(dtype=np.int64))


def in_final_order(
    binary: BinaryTree,
    index: Nodes,
    columns: dict[str, FloatArray],
    goal: PruningGoal,
    curve: Curve,
    progress: Progress,
) -> FinalTree:
    """Prune a binary tree, and return its nodes in final order, with merged colours. Empties the binary tree.

    Args:
        index: (N,) splat of each leaf.
        columns: columns of the splats; emptied, which frees those without another reference.
    """
    n, hidden = binary.leaves, 0 if goal.is_whole else 1
    parent, saved, rank = _prune(binary, goal, progress)
    inner, ranks, keys = _by_rank(binary, rank[: len(rank) - hidden], curve)
    del rank
    slots = inner - np.uint32(n)
    binary.spare = np.empty(0, np.uint32)
    binary.keep_rows(slots)
    total = n + len(inner) + hidden
    progress("ordering", 0, total, "node")
    order = np.empty(total, np.uint32)
    tree = LodTree(np.zeros(total, np.uint16), np.zeros(total, np.uint32))
    root = np.full(hidden, len(parent) - 1, np.uint32)
    links = order, tree.child_start, tree.child_count
    final = np.empty(hidden + len(inner), np.uint32)
    prune.lay_out_children(np.concatenate([root, inner]), n, parent, saved, *links, final)
    parents = final[hidden:]
    del parent, saved
    out = Splats.empty(total, degree_of(columns["sh"].shape[1]))

    def fill(name: str) -> None:
        fill_leaves(total, order, index, columns.pop(name).reshape(n, -1), getattr(out, name).reshape(total, -1))

    for name in GEOMETRY:
        fill(name)
    places = (getattr(out, name)[hidden:] for name in GEOMETRY)
    shown = order[hidden:]
    node_rows.fill_merged_splats(len(shown), shown, n, binary.row, binary.rows, curve.space, *places)
    weight = binary.rows[binary.row[slots], pair_merge.WEIGHT]
    binary.rows = rows = binary.rows[binary.row[slots[:0] if goal.is_whole else slots]]  # frees the rest
    weights = np.empty(binary.used, np.float32)
    weights[:n], weights[inner] = binary.weight, weight
    for name in COLORS:
        fill(name)
    ends = np.concatenate([np.flatnonzero(np.diff(ranks, prepend=ranks[:1] - 1)), [len(inner)]])
    for begin, end in zip(ends[-2::-1], ends[:0:-1], strict=True):
        with threads_for(int(end - begin)):
            for color in (out.rgb, out.sh.reshape(total, -1)):
                family = parents[begin:end]
                merge_colors(len(family), family, tree.child_start, tree.child_count, order, weights, color)
        progress("ordering", total - int(begin), total, "node")
    return FinalTree(out, tree, order, parents, ranks, keys, rows)


def _prune(
    binary: BinaryTree, goal: PruningGoal, progress: Progress
) -> tuple[Nodes, NDArray[np.int32], NDArray[np.int32]]:
    """Drop nodes; return all parents, `saved` of `drop_nodes`, and ranks. Frees the data that only pruning needs."""
    n, top, blocks = binary.leaves, binary.used - goal.is_whole, threads_in_use()
    progress("pruning", 0, binary.used, "node")
    log_size, lost, weight = binary.size[: top + 1], binary.error[: top + 1 - n], np.empty(top + 1 - n, np.float32)
    children = binary.children[: binary.used - n]
    parent = fill_usefulness_terms(children, n, goal.splats, top, log_size, lost, weight, blocks)
    binary.children = children = np.empty((0, 2), np.uint32)
    saved = np.ones(top + 1 - n, np.int32)
    if not goal.is_whole:
        saved[-1] = np.count_nonzero(parent[:-1] == top) - 1 - prune.ROOM
    # The placeholder of the root is one node more.
    drop_nodes(n, goal.most + (not goal.is_whole), parent, log_size, lost, weight, saved, blocks)
    if not goal.is_whole:
        saved[-1] += prune.ROOM
    highest = log_size[top] if goal.highest is None else np.float32(goal.highest)
    rank = np.empty(len(parent) - n, np.int32)
    prune.fill_size_ranks(n, highest, parent, log_size, saved, goal.latest, rank)
    binary.size = binary.error = np.empty(0, np.float32)
    return parent, saved, rank


def _by_rank(binary: BinaryTree, rank: NDArray[np.int32], curve: Curve) -> tuple[Nodes, NDArray[np.int32], Keys]:
    """Return the remaining merged nodes, sorted by rank and then along the curve, their ranks, and their curve keys."""
    slots = np.flatnonzero(rank != prune.NO_RANK).astype(np.uint32)
    own = rank[slots].astype(np.int64)
    first = int(own.min(initial=0))
    bits = 3 * node_rows.CURVE_BITS
    keys = curve.keys(binary.rows, binary.row[slots], 0) | ((own - first).astype(np.uint64) << np.uint64(bits))
    with threads_for(len(slots)) as threads:
        keys, slots = sort_by_key(keys, slots, bits + int(own.max(initial=first) - first).bit_length(), threads)
    ranks = ((keys >> np.uint64(bits)).astype(np.int64) + first).astype(np.int32)
    return slots + np.uint32(binary.leaves), ranks, keys & np.uint64((1 << bits) - 1)


def fill_usefulness_terms(
    children: NDArray[np.uint32],
    leaves: int,
    drawn_leaves: int,
    top: int,
    log_size: FloatArray,
    lost: FloatArray,
    weight: FloatArray,
    blocks: int,
) -> Nodes:
    """Fill the terms of `prune.usefulness`.

    Args:
        children: (T - leaves, 2) uint32 of merged nodes; parents come after their children, and the root is last.
        leaves: number of leaves, which come first; arrays of merged nodes leave them out.
        drawn_leaves: number of splats of the scene under them.
        top: the root, T - 1; or T, a placeholder for the future parent of several roots.
        log_size: (top + 1,) float32 feature sizes, replaced by ln(size), limited by the parent's: the threshold above
            which the traversal does not refine the node.
        lost: (top + 1 - leaves,) float32 `picture_error`, replaced by the error cost of merged nodes, in splats.
        weight: (top + 1 - leaves,) float32, filled with the rarity weight of merged nodes.
        blocks: number of parallel ranges of nodes; the result does not depend on it.

    Returns:
        (top + 1,) uint32 parents; that of the root is itself.
    """
    parent = np.full(top + 1, top, np.uint32)
    steps = prune.STEPS * prune.OCTAVES
    step_of, inner, sums = np.empty(len(children), np.uint16), np.zeros(steps, np.int64), np.zeros(steps)
    prune.link(children, leaves, lost, parent, log_size, step_of, inner, sums)
    counts = np.zeros((blocks, steps), np.int64)
    prune.count_leaves(blocks, leaves, parent, log_size, counts)
    # Approximate number of splats of the cut whose threshold is the step.
    drawn = np.cumsum((counts.sum(axis=0) + inner)[::-1])[::-1]
    # Python's powers, because numpy rounds differently on some processors.
    common = np.array([max(min(count, drawn_leaves), 1) ** -prune.RARITY for count in drawn.tolist()])
    rare = np.minimum(drawn / (prune.FEW * drawn_leaves), 1)
    mean = np.divide(sums, inner, out=np.zeros(steps), where=inner > 0)
    prune.fill_terms(len(children), step_of, common, rare, mean, lost, weight)
    return parent


def drop_nodes(
    leaves: int,
    most: int,
    parent: Nodes,
    log_size: FloatArray,
    lost: FloatArray,
    weight: FloatArray,
    saved: NDArray[np.int32],
    blocks: int,
) -> None:
    """Drop the least useful merged nodes until `most` are left, or none can be dropped.

    Args:
        most: number of merged nodes to keep, at least 1, the root.
        parent: (T,) uint32, replaced by the nearest ancestor that is kept.
        leaves, log_size, lost, weight, blocks: of `fill_usefulness_terms`; `lost` of a dropped node is added to that of
            its parent.
        saved: (T - leaves,) int32, on entry 1 for each merged node; a lower value of the root allows it as many more
            children. Replaced by the number of children minus 1 of kept nodes, -1 of dropped nodes.
    """
    slots = len(saved) - 1
    # Merged nodes but the root, less `leaves`, parents first.
    kept = np.arange(slots - 1, -1, -1, dtype=np.uint32)
    keys = np.empty(slots, np.uint16)
    turn, children = prune.ROUNDS, prune.MOST_CHILDREN
    while len(kept) + 1 > most:  # also after ROUNDS, if nodes gained usefulness when their children were dropped
        counts = np.zeros((blocks, 1 << prune.KEY_BITS), np.int32)
        prune.count_by_key(blocks, kept, leaves, children, log_size, lost, weight, saved, parent, keys, counts)
        below = np.cumsum(counts.sum(axis=0))
        if below[-1] == 0:
            if children == MAX_CHILDREN:
                break
            children = min(2 * children, MAX_CHILDREN)
            continue
        spare = len(kept) + 1 - most
        threshold = int(np.searchsorted(below, min(max(spare // turn, 1), below[-1])))
        dropped = prune.drop_below(
            threshold, spare, leaves, children, parent, log_size, weight, kept, keys, lost, saved
        )
        kept = kept[dropped:]
        turn = max(turn - 1, 1)
    prune.skip_dropped(len(parent), leaves, saved, parent)
