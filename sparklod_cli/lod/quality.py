"""The quality builder: a binary tree of the cheapest pairs, of which the useful nodes are kept.

1. Leaves join from small to large. Those that are there, and what came of them, lie along a Morton curve; each looks
   for its cheapest partner among its neighbours on the curve (`kernels/pairs.py`). Of the pairs that chose each other
   the cheaper ones merge, all at once. The curve moves from round to round, so that its seams do.
2. A merged node covers what its two cover together (`kernels/union.py`), and is drawn with the profile that covers as
   much (`kernels/profile.py`).
3. Of the binary tree's nodes those are dropped that are of little use (`kernels/keep.py`).

Why so, and what else was tried: docs/decisions/2026-11-21-fidelity.md.
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
from .check import Extremes, check
from .kernels import node_rows, pair_cost, pair_merge, prune
from .kernels.final_order import fill_leaves, merge_colors
from .kernels.sort import Nodes, sort_by_key

#: Growth from level to level of the size up to which leaves have joined, and nodes merge.
BASE = 2.0

#: How far apart on the curve two may be that merge.
WINDOW = 12

#: In a round those pairs merge that cost no more than this share of the costs, so that the cheapest of all come first.
CHEAP = 0.5

#: So many costs are looked at to tell.
SAMPLE = 1 << 14

#: Where there are no more nodes, all pairs merge.
FEW = 1000

#: A level ends when a round merges no more than this share of its nodes, or after so many rounds.
LEAST, MOST_ROUNDS = 0.02, 8

#: The share of the leaves that the curve's box leaves out on each side: scenes have a few that are far away.
OUTSIDE = 0.005

#: The curve's box is wider than the scene by this; so far it moves, by the golden section of it from round to round.
SLACK, GOLDEN = 0.3, 0.6180339887


#: Nothing is farther away, nor larger, than so many units: float32 holds its square.
FARTHEST = 1e15


@dataclass
class _Growing:
    """The binary tree while it grows from its leaves: rows, leaves first.

    Attributes:
        state: (2N - 1, WIDTH) float32. children: (2N - 1, 2) uint32. size, error: (2N - 1,) float32.
        used: rows that are filled.
    """

    state: FloatArray
    children: NDArray[np.uint32]
    size: FloatArray
    error: FloatArray
    used: int
    rounds: int = 0


@dataclass(frozen=True)
class _Space:
    """Where rows of state are, and the curve through them.

    Attributes:
        middle: (3,) of the scene, world units. unit: of length, world units.
        low: (3,) corner of what the curve goes through, in units. extent: its edge.
    """

    middle: NDArray[np.float64]
    unit: float
    low: NDArray[np.float64]
    extent: float

    @classmethod
    def of(cls, splats: Splats, found: Extremes) -> _Space:
        """Around most of the splats, in a unit that is a power of two near their size, if what is far away allows."""
        some = slice(None, None, max(1, len(splats) // SAMPLE))
        center = splats.center[some].astype(np.float64)
        middle = np.median(center, axis=0)
        reach = max(float((found.high - found.low).max()), found.largest) / FARTHEST
        unit = 2.0 ** round(math.log2(max(float(np.median(splats.scale[some].max(axis=1).astype(np.float64))), reach)))
        low, high = np.quantile((center - middle) / unit, [OUTSIDE, 1 - OUTSIDE], axis=0)
        return cls(middle, unit, low, float(max((high - low).max(), 1.0)))

    def centers(self, splats: Splats) -> FloatArray:
        """(N, 3) where splats are, in units from the middle: the first columns of their rows of state."""
        return ((splats.center.astype(np.float64) - self.middle) / self.unit).astype(np.float32)

    def sort(self, rows: FloatArray, nodes: Nodes, turn: int, threads: int) -> Nodes:
        """Nodes along the curve, which moves from turn to turn."""
        _, nodes = sort_by_key(self.places(rows, nodes, turn), nodes.copy(), 3 * node_rows.CURVE_BITS, threads)
        return nodes

    def places(self, rows: FloatArray, nodes: Nodes, turn: int) -> NDArray[np.uint64]:
        """Where nodes are on the curve."""
        moved = np.modf(np.array([1, 2, 3]) * GOLDEN * turn)[0] * SLACK * self.extent
        step = (1 + SLACK) * self.extent / (1 << node_rows.CURVE_BITS)
        return node_rows.curve_keys(rows, nodes, self.low - moved, step)


def build(splats: Splats, growth: float = DEFAULT_GROWTH, *, progress: Progress = silent) -> tuple[Splats, LodTree]:
    """Builds a Level-of-Detail tree whose cuts are close to full detail.

    The result does not depend on the number of threads (`jit.use_threads`). Every input splat is one leaf, bit for bit.
    Nodes come in an order in which the root is 0, children are consecutive and after their parent, and a prefix is a
    coarser scene: larger nodes' children come first, along a Morton curve inside a step of size.

    Args:
        splats: N splats, finite, with positive opacity and at least one positive scale each.
        growth: the tree has at most so many nodes a leaf, 1.05 to 2.
        progress: told of three stages, building, pruning and ordering, how many nodes are done.

    Returns:
        M >= N splats and their tree.

    Raises:
        InvalidSplatsError: there is no splat, or one that cannot be drawn.
        ValueError: the growth is out of range.
    """
    if not MIN_GROWTH <= growth <= MAX_GROWTH:
        raise ValueError(f"growth {growth} is not within {MIN_GROWTH} to {MAX_GROWTH}")
    found = check(splats)
    n = len(splats)
    if n == 1:
        return splats, LodTree(np.zeros(1, np.uint16), np.zeros(1, np.uint32))
    space = _Space.of(splats, found)
    with threads_for(n) as threads:
        growing, index = _leaves(splats, space, threads)
        _grow(growing, n, space, progress)
        return _in_final_order(growing, index, splats, growth, space, progress)


def _leaves(splats: Splats, space: _Space, threads: int) -> tuple[_Growing, Nodes]:
    """Rows of the leaves along the curve, and the splat of each."""
    n = len(splats)
    rows = 2 * n - 1
    growing = _Growing(
        np.empty((rows, pair_cost.WIDTH), np.float32),
        np.empty((rows, 2), np.uint32),
        np.empty(rows, np.float32),
        np.zeros(rows, np.float32),
        n,
    )
    index = space.sort(space.centers(splats), np.arange(n, dtype=np.uint32), 0, threads)
    columns = splats.center, splats.scale, splats.quat_xyzw, splats.opacity, splats.rgb
    node_rows.fill_state(index, *columns, space.middle, space.unit, growing.state, growing.size)
    return growing, index


def _grow(growing: _Growing, leaves: int, space: _Space, progress: Progress) -> None:
    """Merges pairs, up to one root."""
    level_of = np.ceil(np.log(growing.size[:leaves].astype(np.float64)) / math.log(BASE)).astype(np.int32)
    lowest = int(np.quantile(level_of, 0.01))
    level_of = np.maximum(level_of, lowest)
    by_level = np.argsort(level_of, kind="stable").astype(np.uint32)
    ends = np.cumsum(np.bincount(level_of - lowest))
    active = np.empty(0, np.uint32)
    joined = 0
    for level in range(len(ends)):
        active, joined = np.concatenate([active, by_level[joined : ends[level]]]), int(ends[level])
        # A node's size is about twice the root of a third of its covariance's trace.
        size = BASE ** (lowest + level + 1)
        active = _merge(growing, active, space, 3 * size * size / 4, MOST_ROUNDS, progress)
    _merge(growing, active, space, math.inf, None, progress)


def _merge(
    growing: _Growing, active: Nodes, space: _Space, largest: float, rounds: int | None, progress: Progress
) -> Nodes:
    """Rounds of merging; returns what is left, which is one node if `rounds` is None."""
    done, leaves = 0, (len(growing.state) + 1) // 2
    while len(active) > 1 and (rounds is None or done < rounds):
        with threads_for(len(active)) as threads:
            active = space.sort(growing.state, active, growing.rounds, threads)
            partner, cost = pair_cost.cheapest(growing.state, active, WINDOW, np.float32(largest))
            before = len(active)
            found, rest = pair_cost.pair_up(active, partner, cost, _limit(cost), growing.used)
            if rounds is None and not len(found):  # no cost is a number: what is left is too far apart for float32
                partner = np.arange(before, dtype=np.int32) ^ 1
                partner[partner >= before] = -1
                found, rest = pair_cost.pair_up(active, partner, np.zeros_like(cost), np.float32(0), growing.used)
            active = rest
            pair_merge.unite_pairs(found, growing.used, growing.state, growing.children, growing.size, growing.error)
        growing.used += len(found)
        growing.rounds += 1
        progress("building", growing.used - leaves, leaves - 1, "node")
        done += 1
        if rounds is not None and len(found) <= LEAST * before:
            break
    return active


def _limit(cost: FloatArray) -> np.float32:
    """What a merge may cost this round."""
    some = cost[:: max(1, len(cost) // SAMPLE)]
    some = some[np.isfinite(some)]
    return np.float32(np.quantile(some, CHEAP)) if len(some) > FEW else np.float32(np.inf)


def _in_final_order(
    growing: _Growing, index: Nodes, splats: Splats, growth: float, space: _Space, progress: Progress
) -> tuple[Splats, LodTree]:
    """Keeps the useful nodes, and puts them and their colours in place."""
    n, rows = len(index), growing.used
    progress("pruning", 0, rows, "node")
    log_size, weight, lost = (np.empty(rows, np.float32) for _ in range(3))
    parent = prune.value_nodes(growing.children, n, growing.size, growing.error, log_size, weight, lost)
    saved = np.empty(rows, np.int32)
    prune.drop_nodes(n, max(int(growth * n) - n, 1), parent, log_size, weight, lost, saved)
    inner, ends = _by_level(growing, prune.levels_of(n, parent, log_size, saved), space)
    total = n + len(inner)
    progress("ordering", 0, total, "node")
    order = np.empty(total, np.uint32)
    tree = LodTree(np.zeros(total, np.uint16), np.zeros(total, np.uint32))
    place = prune.place_nodes(inner, parent, saved, order, tree.child_start, tree.child_count)
    out = Splats.empty(total, degree_of(splats.sh.shape[1]))
    for name in COLUMNS:
        fill_leaves(order, index, getattr(splats, name).reshape(n, -1), getattr(out, name).reshape(total, -1))
    geometry = out.center, out.scale, out.quat_xyzw, out.opacity
    node_rows.fill_merged(order, n, growing.state, space.middle, space.unit, *geometry)
    weights = growing.state[:, pair_cost.WEIGHT].astype(np.float64)
    for begin, end in zip(ends[-2::-1], ends[:0:-1], strict=True):
        with threads_for(int(end - begin)) as threads:
            for color in (out.rgb, out.sh.reshape(total, -1)):
                merge_colors(place[begin:end], tree.child_start, tree.child_count, order, weights, color, threads)
        progress("ordering", total - int(begin), total, "node")
    return out, tree


def _by_level(growing: _Growing, level: NDArray[np.int32], space: _Space) -> tuple[Nodes, NDArray[np.int64]]:
    """The merged nodes that are kept, level by level along the curve, and where each level ends, from 0."""
    inner = np.flatnonzero(level >= 0).astype(np.uint32)
    own = level[inner]
    keys = space.places(growing.state, inner, 0) | (own.astype(np.uint64) << np.uint64(3 * node_rows.CURVE_BITS))
    with threads_for(len(inner)) as threads:
        _, inner = sort_by_key(keys, inner, 3 * node_rows.CURVE_BITS + int(own.max()).bit_length(), threads)
    return inner, np.concatenate([[0], np.cumsum(np.bincount(own))]).astype(np.int64)
