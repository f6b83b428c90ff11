"""The binary tree of the quality builder: the cheapest pairs of neighbours on a Morton curve merge, level by level."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..model.splats import FloatArray, Splats
from ..system.progress import Progress
from ..system.threads import blocks_of, for_blocks, threads_for
from .check import Bounds
from .kernels import node_rows, pair_cost, pair_merge
from .kernels.geometry import SplatColumns
from .kernels.sort import Keys, Nodes, sort_by_key
from .stage_records import Region

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

#: Width of the strip along a border, as a multiple of the size of a level, in which nodes wait. Measured: with 0.5 cuts
#: lose 0.1 to 0.2 dB more, with 0 up to 1 dB (benchmarks/notes/quality-builder.md).
MARGIN = 1.0

#: Quantile of the costs of pairs up to which pairs merge in a round, which comes close to merging the cheapest first.
#: Measured: gains up to 0.6 dB over merging all (benchmarks/notes/quality-builder.md).
CHEAP = 0.5

#: With no more costs than this in the sample, all pairs merge. Chosen.
FEW = 1000

#: A level ends when a round merges no more than this share of its nodes, or after this many rounds. Chosen; 8 rounds
#: were measured against 12 that merge all pairs.
LEAST, MOST_ROUNDS = 0.02, 8

#: Quantile of the leaves' log sizes at which the first level is: the few smaller leaves, down to any size, would only
#: add rounds. Chosen.
SMALLEST = 0.01
Levels = NDArray[np.int32]


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
        """Around most of the splats; the unit is a power of two near their median scale, or as FARTHEST requires."""
        some = slice(None, None, max(1, len(splats) // SAMPLE))
        center = splats.center[some].astype(np.float64)
        middle = np.median(center, axis=0)
        reach = max(float((bounds.high - bounds.low).max()), bounds.largest) / FARTHEST
        unit = 2.0 ** round(math.log2(max(float(np.median(splats.scale[some].max(axis=1).astype(np.float64))), reach)))
        return cls(middle, unit, middle, 1.0).around(center)

    def around(self, center: FloatArray) -> Curve:
        """Return the same coordinates, with a box around most of (n, 3) centres in world units."""
        some = slice(None, None, max(1, len(center) // SAMPLE))
        units = (center[some].astype(np.float64) - self.middle) / self.unit
        low, high = np.quantile(units, [OUTSIDE, 1 - OUTSIDE], axis=0)
        return replace(self, low=low, extent=float(max((high - low).max(), 1.0)))

    @property
    def space(self) -> node_rows.Space:
        """Coordinates, for kernels."""
        return node_rows.Space(self.middle, self.unit)

    def order(self, center: FloatArray, threads: int) -> Nodes:
        """Return the (n,) places of (n, 3) centres, in world units, along the curve of the first round."""
        units = np.empty((len(center), 3), np.float32)

        def fill(part: slice) -> None:
            units[part] = np.subtract(center[part], self.middle, dtype=np.float64) / self.unit

        for_blocks(fill, len(center), threads)
        return self.sort(units, np.arange(len(center), dtype=np.uint32), 0, threads)

    def leaf_rows(self, splats: Splats, index: Nodes) -> tuple[FloatArray, FloatArray]:
        """Return the (n, WIDTH) node rows and (n,) feature sizes, in units, of some splats."""
        rows, size = np.empty((len(index), pair_cost.WIDTH), np.float32), np.empty(len(index), np.float32)
        columns = SplatColumns(splats.center, splats.scale, splats.quat_xyzw, splats.opacity)
        node_rows.fill_leaf_rows(len(index), index, columns, splats.rgb, self.space, rows, size)
        return rows, size

    def sort(self, rows: FloatArray, at: Nodes, turn: int, threads: int) -> Nodes:
        """Return the order, (n,) uint32, of (n,) rows along the curve of round `turn`; rows of one cell keep theirs.

        `rows` are node rows, or any whose first columns are the centre, in units.
        """
        bits = 3 * node_rows.CURVE_BITS
        return sort_by_key(self.keys(rows, at, turn), np.arange(len(at), dtype=np.uint32), bits, threads)[1]

    def keys(self, rows: FloatArray, at: Nodes, turn: int) -> Keys:
        """Return the (n,) Morton codes of rows on the curve of a round."""
        keys = np.empty(len(at), np.uint64)
        shift = np.modf(np.array([1, 2, 3]) * GOLDEN * turn)[0] * SLACK * self.extent
        cell = (1 + SLACK) * self.extent / (1 << node_rows.CURVE_BITS)
        node_rows.fill_morton_keys(len(at), rows, at, self.low - shift, cell, keys)
        return keys


@dataclass
class BinaryTree:
    """The binary tree of N leaves while it is built; leaves come first, then merged nodes in the order they are made.

    A merge leaves two rows of leaves without use; the merged node takes over one of them. So each tree of the forest
    has one row to spare, the next merge takes that of its first node, and N rows are enough for all 2N - 1 nodes.

    Attributes:
        rows: (N, WIDTH) float32 node rows, see `kernels/pair_cost.py`; leaf k has row k until it is merged. The array
            owns its memory, and no other refers to it.
        weight: (N,) float32 weights of the leaves, which outlast their rows.
        row: (N,) uint32 row of each merged node.
        spare: (N,) uint32 row that is to spare in the tree of each merged node without a parent.
        children: (N, 2) uint32, of merged nodes.
        size: (2N,) float32 feature sizes of leaves and merged nodes, units.
        error: (N,) float32, `kernels.pair_merge.picture_error` of merged nodes.
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
        """Return a tree of leaves alone, from their rows, which it takes over, and their feature sizes in units."""
        count = len(rows)
        sizes = np.empty(2 * count, np.float32)
        sizes[:count] = size
        row, spare = np.empty(count, np.uint32), np.empty(count, np.uint32)
        children, error = np.empty((count, 2), np.uint32), np.empty(count, np.float32)
        return cls(rows, rows[:, pair_cost.WEIGHT].copy(), row, spare, children, sizes, error, count)

    @property
    def leaves(self) -> int:
        """N."""
        return len(self.row)

    def rows_of(self, nodes: Nodes) -> Nodes:
        """Return the (n,) rows of nodes; those of leaves that are merged have other content by now."""
        found = np.empty(len(nodes), np.uint32)
        node_rows.fill_rows_of(len(nodes), nodes, self.row, self.leaves, found)
        return found

    def keep_rows(self, slots: Nodes) -> None:
        """Drop all rows but those of some merged nodes, which are numbered from the first.

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
        self.rows.resize((end, pair_cost.WIDTH), refcheck=False)


def levels_of(size: FloatArray) -> Levels:
    """Return the (n,) levels that leaves of a size, in units, join at."""
    levels: Levels = np.ceil(np.log(size.astype(np.float64)) / math.log(BASE)).astype(np.int32)
    return levels


def lowest_level(levels: Levels) -> int:
    """Return the first level that nodes merge at; smaller leaves join there."""
    return int(np.quantile(levels, SMALLEST))


def merge_levels(
    binary: BinaryTree, levels: Levels, curve: Curve, region: Region | None, progress: Progress
) -> tuple[Nodes, Levels]:
    """Merge pairs, level by level, but for nodes whose partners may be beyond a border; without one up to the root.

    Args:
        levels: (N,) that its leaves join at.
        region: of the leaves; None for the whole scene.

    Returns:
        (n,) uint32 nodes without a parent, and (n,) levels at which they would have merged next.
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
            center, margin = binary.rows[binary.rows_of(active), : pair_cost.COVARIANCE], MARGIN * size
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
    """Merge nodes without a parent in at most `rounds` rounds; return the remaining ones, the root if it is None.

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
            pairs, rest = matched(active, partner, cost, _largest_cost(cost), binary.used, threads)
            if rounds is None and not len(pairs):  # no finite cost: too far apart for float32
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
    """Return (n,) places of the cheapest partners of nodes, -1 for none, and costs; see `pair_cost.find_partners`."""
    partner, cost = np.empty(len(nodes), np.int32), np.empty(len(nodes), np.float32)
    pair_cost.find_partners(len(nodes), rows, nodes, window, largest, partner, cost)
    return partner, cost


def matched(
    nodes: Nodes, partner: NDArray[np.int32], cost: FloatArray, limit: np.float32, made: int, blocks: int
) -> tuple[Nodes, Nodes]:
    """Return pairs of nodes that are each other's cheapest partner, and the list in which merged nodes replace them.

    Args:
        limit: largest cost of a pair.
        made: the node that the first pair is merged into; the next pair's is one more.
        blocks: ranges of nodes to process in parallel; the result does not depend on it.

    Returns:
        pairs: (P, 2) uint32.
        rest: (n - P,) uint32, the list in its order; a merged node replaces the first of its pair.
    """
    counts = np.empty((blocks, 2), np.int64)
    pair_cost.count_pairs(blocks, partner, cost, limit, counts)
    ends = np.cumsum(counts, axis=0)
    found = int(ends[-1, 0])
    pairs, rest = np.empty((found, 2), np.uint32), np.empty(len(nodes) - found, np.uint32)
    pair_cost.list_pairs(blocks, nodes, partner, cost, limit, made, ends - counts, pairs, rest)
    return pairs, rest


def _largest_cost(cost: FloatArray) -> np.float32:
    """Return the largest cost of a pair that merges this round."""
    some = cost[:: max(1, len(cost) // SAMPLE)]
    some = some[np.isfinite(some)]
    return np.float32(np.quantile(some, CHEAP)) if len(some) > FEW else np.float32(np.inf)
