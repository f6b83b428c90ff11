"""The quality builder: a binary tree of the cheapest pairs, of which the useful nodes are kept.

1. Leaves join from small to large. Those that are there, and what came of them, lie along a Morton curve; each looks for its
   cheapest partner among its neighbours on the curve (`kernels/pairs.py`), and pairs that chose each other merge, all at once.
   The curve moves from round to round, so that its seams do.
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

from ..errors import InvalidSplatsError
from ..gaussian import spark_size
from ..jit import threads_for
from ..limits import DEFAULT_GROWTH, MAX_GROWTH, MIN_GROWTH
from ..progress import Progress, silent
from ..sh import degree_of
from ..splats import FloatArray, Splats
from ..tree import LodTree
from .kernels import keep, pairs, state, union
from .kernels.order import fill_leaf_colors, merge_colors
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
class _Box:
    """Of the curve: middle half of the scene's slack, in units of the state."""

    low: NDArray[np.float64]
    extent: float

    def at(self, turn: int) -> tuple[NDArray[np.float64], float]:
        """Its corner and its cells' edge in a round."""
        moved = np.modf(np.array([1, 2, 3]) * GOLDEN * turn)[0] * SLACK * self.extent
        return self.low - moved, (1 + SLACK) * self.extent / (1 << state.CURVE_BITS)


def build(splats: Splats, growth: float = DEFAULT_GROWTH, *, progress: Progress = silent) -> tuple[Splats, LodTree]:
    """Builds a Level-of-Detail tree whose cuts are close to full detail.

    The result does not depend on the number of threads (`jit.use_threads`). Every input splat is one leaf, bit for bit.
    Nodes come in an order in which the root is 0, children are consecutive and after their parent, and a prefix is a
    coarser scene: larger nodes' children come first, along a Morton curve inside a step of size.

    Args:
        splats: N splats, finite, with positive opacity and at least one positive scale each.
        growth: the tree has at most so many nodes a leaf, 1.05 to 2.
        progress: told how many splats have joined the tree.

    Returns:
        M >= N splats and their tree.

    Raises:
        InvalidSplatsError: there is no splat, or one that cannot be drawn.
        ValueError: the growth is out of range.
    """
    if not MIN_GROWTH <= growth <= MAX_GROWTH:
        raise ValueError(f"growth {growth} is not within {MIN_GROWTH} to {MAX_GROWTH}")
    n = len(splats)
    if n == 0:
        raise InvalidSplatsError("no splat is left to build a tree of")
    largest = splats.scale.max(axis=1)
    if not (
        np.isfinite(splats.center).all() and np.isfinite(largest).all() and min(largest.min(), splats.opacity.min()) > 0
    ):
        raise InvalidSplatsError("a splat is not finite, or without opacity or scale: see Selection.apply")
    middle = np.median(splats.center, axis=0).astype(np.float64)
    unit = 2.0 ** round(math.log2(float(np.median(largest))))
    with threads_for(n) as threads:
        growing, index, box = _leaves(splats, middle, unit, threads)
        _grow(growing, n, box, progress)
        return _in_final_order(growing, index, splats, growth, middle, unit, box)


def _leaves(splats: Splats, middle: NDArray[np.float64], unit: float, threads: int) -> tuple[_Growing, Nodes, _Box]:
    """Rows of the leaves along the curve, the splat of each, and the curve's box."""
    n = len(splats)
    rows = 2 * n - 1
    growing = _Growing(
        np.empty((rows, pairs.WIDTH), np.float32),
        np.empty((rows, 2), np.uint32),
        np.empty(rows, np.float32),
        np.zeros(rows, np.float32),
        n,
    )
    index = np.arange(n, dtype=np.uint32)
    columns = splats.center, splats.scale, splats.quat_xyzw, splats.opacity, splats.rgb
    state.fill_state(index, *columns, middle, unit, growing.state)
    sample = growing.state[: n : max(1, n >> 16), :3]
    low, high = np.quantile(sample, [OUTSIDE, 1 - OUTSIDE], axis=0).astype(np.float64)
    box = _Box(low, float(max((high - low).max(), 1e-6)))
    keys = state.curve_keys(growing.state, index, *box.at(0))
    _, index = sort_by_key(keys, index, 3 * state.CURVE_BITS, threads)
    state.fill_state(index, *columns, middle, unit, growing.state)
    growing.size[:n] = spark_size(splats)[index] / np.float32(unit)
    return growing, index, box


def _grow(growing: _Growing, leaves: int, box: _Box, progress: Progress) -> None:
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
        progress("building", joined, leaves, "splat")
        # A node's size is about twice the root of a third of its covariance's trace.
        size = BASE ** (lowest + level + 1)
        active = _merge(growing, active, box, largest=3 * size * size / 4, rounds=MOST_ROUNDS)
    _merge(growing, active, box, largest=math.inf, rounds=None)


def _merge(growing: _Growing, active: Nodes, box: _Box, largest: float, rounds: int | None) -> Nodes:
    """Rounds of merging; returns what is left, which is one node if `rounds` is None."""
    done = 0
    while len(active) > 1 and (rounds is None or done < rounds):
        with threads_for(len(active)) as threads:
            keys = state.curve_keys(growing.state, active, *box.at(growing.rounds))
            _, active = sort_by_key(keys, active, 3 * state.CURVE_BITS, threads)
            partner, cost = pairs.cheapest(growing.state, active, WINDOW, np.float32(largest))
            before = len(active)
            found, active = pairs.pair_up(active, partner, cost, _limit(cost), growing.used)
            union.unite_pairs(found, growing.used, growing.state, growing.children, growing.size, growing.error)
        growing.used += len(found)
        growing.rounds += 1
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
    growing: _Growing,
    index: Nodes,
    splats: Splats,
    growth: float,
    middle: NDArray[np.float64],
    unit: float,
    box: _Box,
) -> tuple[Splats, LodTree]:
    """Keeps the useful nodes, and puts them and their colours in place."""
    n, rows = len(index), growing.used
    log_size, weight, lost = (np.empty(rows, np.float32) for _ in range(3))
    parent = keep.value_nodes(growing.children, n, growing.size, growing.error, log_size, weight, lost)
    saved = np.empty(rows, np.int32)
    keep.drop_nodes(n, max(int(growth * n) - n, 1), parent, log_size, weight, lost, saved)
    inner, ends = _by_level(growing, keep.levels_of(n, parent, log_size, saved), box)
    total = n + len(inner)
    order = np.empty(total, np.uint32)
    tree = LodTree(np.zeros(total, np.uint16), np.zeros(total, np.uint32))
    place = keep.place_nodes(inner, parent, saved, order, tree.child_start, tree.child_count)
    out = Splats.empty(total, degree_of(splats.sh.shape[1]))
    state.fill_leaves(order, index, splats.center, splats.scale, splats.quat_xyzw, splats.opacity, *_geometry(out))
    state.fill_merged(order, n, growing.state, middle, unit, *_geometry(out))
    flat_sh = out.sh.reshape(total, -1)
    fill_leaf_colors(order, index, splats.rgb, splats.sh.reshape(n, -1), out.rgb, flat_sh)
    weights = growing.state[:, pairs.WEIGHT].astype(np.float64)
    for begin, end in zip(ends[-2::-1], ends[:0:-1], strict=True):
        with threads_for(int(end - begin)) as threads:
            for color in (out.rgb, flat_sh):
                merge_colors(place[begin:end], tree.child_start, tree.child_count, order, weights, color, threads)
    return out, tree


def _by_level(growing: _Growing, level: NDArray[np.int32], box: _Box) -> tuple[Nodes, NDArray[np.int64]]:
    """The merged nodes that are kept, level by level along the curve, and where each level ends, from 0."""
    inner = np.flatnonzero(level >= 0).astype(np.uint32)
    own = level[inner]
    keys = state.curve_keys(growing.state, inner, *box.at(0)) | (
        own.astype(np.uint64) << np.uint64(3 * state.CURVE_BITS)
    )
    inner = inner[np.argsort(keys, kind="stable")]
    return inner, np.concatenate([[0], np.cumsum(np.bincount(own))]).astype(np.int64)


def _geometry(splats: Splats) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    return splats.center, splats.scale, splats.quat_xyzw, splats.opacity
