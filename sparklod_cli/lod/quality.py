"""The quality builder: a binary tree made by merging the cheapest pairs, pruned to its most useful nodes.

1. Leaves join level by level, from small to large. The active nodes are sorted along a Morton curve, and each finds its
   cheapest partner among its neighbours on it (`kernels/pair_cost.py`). Of the pairs that chose each other, the cheaper
   half are merged, all at once. The curve is shifted from round to round, and its seams with it.
2. A merged node covers the union of its two nodes (`kernels/pair_merge.py`), and is drawn with the opacity profile that
   has this coverage (`kernels/profile.py`).
3. The binary tree's least useful nodes are dropped (`kernels/prune.py`).

docs/decisions/2026-11-21-fidelity.md has the reasons, and the alternatives that were tried.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.lod_tree import LodTree
from ..model.sh import degree_of
from ..model.splats import COLUMNS, FloatArray, Splats
from ..support.defaults import DEFAULT_GROWTH, MAX_GROWTH, MIN_GROWTH
from ..support.jit import threads_for
from ..support.progress import Progress, silent
from .check import Bounds, check, check_setting
from .kernels import node_rows, pair_cost, pair_merge, prune
from .kernels.final_order import fill_leaves, merge_colors
from .kernels.geometry import SplatColumns
from .kernels.sort import Nodes, sort_by_key

#: Growth, from level to level, of the size up to which leaves join and nodes merge. Chosen.
BASE = 2.0

#: Largest distance on the curve of two nodes that merge. Measured: 8 loses 0.1 to 0.2 dB to 16; 16 and 24 gain nothing
#: over 12 (docs/decisions/2026-11-21-fidelity.md).
WINDOW = 12

#: Quantile of the costs of pairs up to which pairs merge in a round, which comes close to merging the cheapest first.
#: Measured: gains up to 0.6 dB over merging all (docs/decisions/2026-11-21-fidelity.md).
CHEAP = 0.5

#: Sample size for the quantile of pair costs, and for the scene's middle, unit and box. Chosen.
SAMPLE = 1 << 14

#: With no more costs than this in the sample, all pairs merge. Chosen.
FEW = 1000

#: A level ends when a round merges no more than this share of its nodes, or after this many rounds. Chosen; 8 rounds
#: were measured against 12 that merge all pairs.
LEAST, MOST_ROUNDS = 0.02, 8

#: Quantile of the leaves' log sizes at which the first level is: the few smaller leaves, down to any size, would only
#: add rounds. Chosen.
SMALLEST = 0.01

#: Share of the leaves outside the curve's box on either side of an axis, as scenes have a few far away. Chosen.
OUTSIDE = 0.005

#: How much wider the curve's box is than the scene, as a share of its edge, which leaves room to shift it. From round
#: to round it is shifted by the golden section, so that no two rounds have the same seams. Chosen.
SLACK, GOLDEN = 0.3, 0.6180339887

#: Largest coordinate and size, units: float32 holds its square. Chosen.
FARTHEST = 1e15


@dataclass
class _BinaryTree:
    """The binary tree of N leaves while it is built; leaves come first, then merged nodes in the order they are made.

    Attributes:
        rows: (2N - 1, WIDTH) float32 node rows, see `kernels/pair_cost.py`.
        children: (2N - 1, 2) uint32.
        size: (2N - 1,) float32 feature sizes, units.
        error: (2N - 1,) float32, `kernels.pair_merge.picture_error`.
        used: number of nodes so far.
        rounds: number of rounds of merging so far.
    """

    rows: FloatArray
    children: NDArray[np.uint32]
    size: FloatArray
    error: FloatArray
    used: int
    rounds: int = 0


@dataclass(frozen=True)
class _Curve:
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
    def of(cls, splats: Splats, bounds: Bounds) -> _Curve:
        """Around most of the splats; the unit is a power of two near their median scale, or as FARTHEST requires."""
        some = slice(None, None, max(1, len(splats) // SAMPLE))
        center = splats.center[some].astype(np.float64)
        middle = np.median(center, axis=0)
        reach = max(float((bounds.high - bounds.low).max()), bounds.largest) / FARTHEST
        unit = 2.0 ** round(math.log2(max(float(np.median(splats.scale[some].max(axis=1).astype(np.float64))), reach)))
        low, high = np.quantile((center - middle) / unit, [OUTSIDE, 1 - OUTSIDE], axis=0)
        return cls(middle, unit, low, float(max((high - low).max(), 1.0)))

    @property
    def space(self) -> node_rows.Space:
        """The coordinates, for kernels."""
        return node_rows.Space(self.middle, self.unit)

    def centers(self, splats: Splats) -> FloatArray:
        """(N, 3) float32 centres in units from the middle: the first columns of node rows."""
        return ((splats.center.astype(np.float64) - self.middle) / self.unit).astype(np.float32)

    def sort(self, rows: FloatArray, nodes: Nodes, turn: int, threads: int) -> Nodes:
        """Sorts nodes along the curve of a round."""
        _, nodes = sort_by_key(self.keys(rows, nodes, turn), nodes.copy(), 3 * node_rows.CURVE_BITS, threads)
        return nodes

    def keys(self, rows: FloatArray, nodes: Nodes, turn: int) -> NDArray[np.uint64]:
        """(n,) Morton codes of nodes on the curve of a round."""
        shift = np.modf(np.array([1, 2, 3]) * GOLDEN * turn)[0] * SLACK * self.extent
        step = (1 + SLACK) * self.extent / (1 << node_rows.CURVE_BITS)
        return node_rows.morton_keys(rows, nodes, self.low - shift, step)


def build(splats: Splats, growth: float = DEFAULT_GROWTH, *, progress: Progress = silent) -> tuple[Splats, LodTree]:
    """Builds a Level-of-Detail tree whose cuts are close to full detail.

    The result does not depend on the number of threads (`support.threads`). Each input splat is one leaf, bit for bit.
    The root is node 0, siblings are consecutive and come after their parent. Any prefix of the nodes is a coarser
    scene: the children of larger nodes come first, and along a Morton curve within a step of size.

    Args:
        splats: N splats, finite, with positive opacity and at least one positive scale each.
        growth: maximum ratio of nodes to leaves, 1.05 to 2.
        progress: called with the number of nodes done in each of the stages building, pruning and ordering.

    Returns:
        M >= N splats and their tree.

    Raises:
        InvalidSplatsError: there are no splats, or one is invalid or invisible.
        ValueError: the growth is out of range.
    """
    check_setting("growth", growth, MIN_GROWTH, MAX_GROWTH)
    bounds = check(splats)
    n = len(splats)
    if n == 1:
        return splats, LodTree(np.zeros(1, np.uint16), np.zeros(1, np.uint32))
    curve = _Curve.of(splats, bounds)
    with threads_for(n) as threads:
        binary, index = _leaves(splats, curve, threads)
        _merge_all(binary, n, curve, progress)
        return _in_final_order(binary, index, splats, growth, curve, progress)


def _leaves(splats: Splats, curve: _Curve, threads: int) -> tuple[_BinaryTree, Nodes]:
    """A tree of leaves alone, in the order of the curve, and the splat of each."""
    n = len(splats)
    nodes = 2 * n - 1
    binary = _BinaryTree(
        np.empty((nodes, pair_cost.WIDTH), np.float32),
        np.empty((nodes, 2), np.uint32),
        np.empty(nodes, np.float32),
        np.zeros(nodes, np.float32),
        n,
    )
    index = curve.sort(curve.centers(splats), np.arange(n, dtype=np.uint32), 0, threads)
    columns = SplatColumns(splats.center, splats.scale, splats.quat_xyzw, splats.opacity)
    node_rows.fill_leaf_rows(index, columns, splats.rgb, curve.space, binary.rows, binary.size)
    return binary, index


def _merge_all(binary: _BinaryTree, leaves: int, curve: _Curve, progress: Progress) -> None:
    """Merges pairs, level by level, up to one root."""
    level_of = np.ceil(np.log(binary.size[:leaves].astype(np.float64)) / math.log(BASE)).astype(np.int32)
    lowest = int(np.quantile(level_of, SMALLEST))
    level_of = np.maximum(level_of, lowest)
    by_level = np.argsort(level_of, kind="stable").astype(np.uint32)
    ends = np.cumsum(np.bincount(level_of - lowest))
    active = np.empty(0, np.uint32)
    joined = 0
    for level in range(len(ends)):
        active, joined = np.concatenate([active, by_level[joined : ends[level]]]), int(ends[level])
        # A node's size is about 2 * sqrt(trace of its covariance / 3).
        size = BASE ** (lowest + level + 1)
        active = _merge(binary, active, curve, 3 * size * size / 4, MOST_ROUNDS, progress)
    _merge(binary, active, curve, math.inf, None, progress)


def _merge(
    binary: _BinaryTree, active: Nodes, curve: _Curve, largest: float, rounds: int | None, progress: Progress
) -> Nodes:
    """Merges active nodes in rounds; returns those that are left, which is one if `rounds` is None.

    Args:
        binary: the tree.
        active: (n,) uint32 nodes without a parent.
        curve: the curve to sort them along.
        largest: largest trace of the covariance of a merged node, units squared.
        rounds: maximum number of rounds; None for no limit.
        progress: as for `build`.
    """
    done, leaves = 0, (len(binary.rows) + 1) // 2
    while len(active) > 1 and (rounds is None or done < rounds):
        with threads_for(len(active)) as threads:
            active = curve.sort(binary.rows, active, binary.rounds, threads)
            partner, cost = pair_cost.find_partners(binary.rows, active, WINDOW, np.float32(largest))
            before = len(active)
            pairs, rest = pair_cost.match_pairs(active, partner, cost, _largest_cost(cost), binary.used)
            if rounds is None and not len(pairs):  # no finite cost: too far apart for float32
                partner = np.arange(before, dtype=np.int32) ^ 1
                partner[partner >= before] = -1
                pairs, rest = pair_cost.match_pairs(active, partner, np.zeros_like(cost), np.float32(0), binary.used)
            active = rest
            pair_merge.merge_pairs(pairs, binary.used, binary.rows, binary.children, binary.size, binary.error)
        binary.used += len(pairs)
        binary.rounds += 1
        progress("building", binary.used - leaves, leaves - 1, "node")
        done += 1
        if rounds is not None and len(pairs) <= LEAST * before:
            break
    return active


def _largest_cost(cost: FloatArray) -> np.float32:
    """The largest cost of a pair that merges this round."""
    some = cost[:: max(1, len(cost) // SAMPLE)]
    some = some[np.isfinite(some)]
    return np.float32(np.quantile(some, CHEAP)) if len(some) > FEW else np.float32(np.inf)


def _in_final_order(
    binary: _BinaryTree, index: Nodes, splats: Splats, growth: float, curve: _Curve, progress: Progress
) -> tuple[Splats, LodTree]:
    """Prunes the tree, and writes it and its colours in final order."""
    n, nodes = len(index), binary.used
    progress("pruning", 0, nodes, "node")
    log_size, weight, lost = (np.empty(nodes, np.float32) for _ in range(3))
    parent = prune.fill_usefulness_terms(binary.children, n, binary.size, binary.error, log_size, weight, lost)
    saved = np.empty(nodes, np.int32)
    prune.drop_nodes(n, max(int(growth * n) - n, 1), parent, log_size, weight, lost, saved)
    inner, ends = _by_rank(binary, prune.size_ranks(n, parent, log_size, saved), curve)
    total = n + len(inner)
    progress("ordering", 0, total, "node")
    order = np.empty(total, np.uint32)
    tree = LodTree(np.zeros(total, np.uint16), np.zeros(total, np.uint32))
    final = prune.lay_out_children(inner, parent, saved, order, tree.child_start, tree.child_count)
    out = Splats.empty(total, degree_of(splats.sh.shape[1]))
    for name in COLUMNS:
        fill_leaves(order, index, getattr(splats, name).reshape(n, -1), getattr(out, name).reshape(total, -1))
    geometry = out.center, out.scale, out.quat_xyzw, out.opacity
    node_rows.fill_merged_splats(order, n, binary.rows, curve.space, *geometry)
    weights = binary.rows[:, pair_cost.WEIGHT].astype(np.float64)
    for begin, end in zip(ends[-2::-1], ends[:0:-1], strict=True):
        with threads_for(int(end - begin)) as threads:
            for color in (out.rgb, out.sh.reshape(total, -1)):
                merge_colors(final[begin:end], tree.child_start, tree.child_count, order, weights, color, threads)
        progress("ordering", total - int(begin), total, "node")
    return out, tree


def _by_rank(binary: _BinaryTree, rank: NDArray[np.int32], curve: _Curve) -> tuple[Nodes, NDArray[np.int64]]:
    """The remaining merged nodes, by rank and then along the curve, and where each rank ends, 0 first."""
    inner = np.flatnonzero(rank >= 0).astype(np.uint32)
    own = rank[inner]
    keys = curve.keys(binary.rows, inner, 0) | (own.astype(np.uint64) << np.uint64(3 * node_rows.CURVE_BITS))
    with threads_for(len(inner)) as threads:
        _, inner = sort_by_key(keys, inner, 3 * node_rows.CURVE_BITS + int(own.max()).bit_length(), threads)
    return inner, np.concatenate([[0], np.cumsum(np.bincount(own))]).astype(np.int64)
