"""The binary tree of the quality builder: the cheapest pairs of neighbours merge, level by level."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...model.splats import FloatArray
from ...support.jit import threads_for
from ...support.parallel import blocks_of
from ...support.progress import Progress
from ..kernels import pair_cost, pair_merge
from ..kernels.sort import Nodes
from .curve import FARTHEST, SAMPLE, Curve

#: Growth, from level to level, of the size up to which leaves join and nodes merge. Chosen.
BASE = 2.0

#: Largest distance on the curve of two nodes that merge. Measured: 8 loses 0.1 to 0.2 dB to 16; 16 and 24 gain nothing
#: over 12 (docs/decisions/2026-11-21-fidelity.md).
WINDOW = 12

#: Quantile of the costs of pairs up to which pairs merge in a round, which comes close to merging the cheapest first.
#: Measured: gains up to 0.6 dB over merging all (docs/decisions/2026-11-21-fidelity.md).
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


class Border(Protocol):
    """Where the part of a scene ends that a tree is built of."""

    def is_near(self, center: FloatArray, size: float) -> NDArray[np.bool_]:
        """Which of (n, 3) centres, in units, are so close that nodes of a size there may have partners beyond it."""


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
        error: (N,) float32, `kernels.pair_overlap.picture_error` of merged nodes.
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
        """A tree of leaves alone, from their rows, which it takes over, and their feature sizes in units."""
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
        """(n,) rows of nodes; those of leaves that are merged have other content by now."""
        found = nodes.copy()
        merged = nodes >= self.leaves
        found[merged] = self.row[nodes[merged] - np.uint32(self.leaves)]
        return found

    def keep_rows(self, slots: Nodes) -> None:
        """Drops all rows but those of some merged nodes, which are numbered from the first.

        In place: those that are kept would be a large part of the memory that a build takes.
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
    """(n,) levels that leaves of a size, in units, join at."""
    levels: Levels = np.ceil(np.log(size.astype(np.float64)) / math.log(BASE)).astype(np.int32)
    return levels


def lowest_level(levels: Levels) -> int:
    """The first level that nodes merge at; smaller leaves join there."""
    return int(np.quantile(levels, SMALLEST))


def merge_levels(
    binary: BinaryTree, levels: Levels, curve: Curve, border: Border | None, progress: Progress
) -> tuple[Nodes, Levels]:
    """Merges pairs, level by level, as far as the border allows; without one up to the root.

    Args:
        binary: the tree.
        levels: (N,) that its leaves join at.
        curve: to sort nodes along.
        border: of the region that the leaves are in, None for the whole scene.
        progress: told of the merges.

    Returns:
        nodes: (n,) uint32, without a parent.
        levels: (n,) at which they would have merged next.
    """
    by_level = np.argsort(levels, kind="stable").astype(np.uint32)
    lowest = int(levels.min())
    ends = np.cumsum(np.bincount(levels - lowest))
    del levels
    active = np.empty(0, np.uint32)
    waiting: list[tuple[Nodes, Levels]] = []
    joined = level = 0
    while level < len(ends) or (border is not None and len(active) > 1 and BASE ** (lowest + level) < FARTHEST):
        end = int(ends[min(level, len(ends) - 1)])
        active, joined = np.concatenate([active, by_level[joined:end]]), end
        # A node's size is about 2 * sqrt(trace of its covariance / 3).
        size = BASE ** (lowest + level + 1)
        if border is not None:
            near = border.is_near(binary.rows[binary.rows_of(active), : pair_cost.COVARIANCE], size)
            waiting.append((active[near], np.full(np.count_nonzero(near), lowest + level, np.int32)))
            active = active[~near]
        active = _merge(binary, active, curve, 3 * size * size / 4, MOST_ROUNDS, progress)
        level += 1
    del by_level
    if border is None:
        active = _merge(binary, active, curve, math.inf, None, progress)
    waiting.append((active, np.full(len(active), lowest + level, np.int32)))
    return np.concatenate([nodes for nodes, _ in waiting]), np.concatenate([at for _, at in waiting])


def _merge(
    binary: BinaryTree, active: Nodes, curve: Curve, largest: float, rounds: int | None, progress: Progress
) -> Nodes:
    """Merges active nodes in rounds; returns those that are left, which is one if `rounds` is None.

    Args:
        binary: the tree.
        active: (n,) uint32 nodes without a parent.
        curve: the curve to sort them along.
        largest: largest trace of the covariance of a merged node, units squared.
        rounds: maximum number of rounds; None for no limit.
        progress: as for `merge_levels`.
    """
    done, leaves = 0, binary.leaves
    while len(active) > 1 and (rounds is None or done < rounds):
        with threads_for(len(active)) as threads:
            active, at = curve.sort(binary.rows, binary.row, active, binary.rounds, threads)
            partner, cost = pair_cost.find_partners(binary.rows, at, WINDOW, np.float32(largest))
            del at
            before = len(active)
            pairs, rest = pair_cost.match_pairs(active, partner, cost, _largest_cost(cost), binary.used)
            if rounds is None and not len(pairs):  # no finite cost: too far apart for float32
                partner = np.arange(before, dtype=np.int32) ^ 1
                partner[partner >= before] = -1
                pairs, rest = pair_cost.match_pairs(active, partner, np.zeros_like(cost), np.float32(0), binary.used)
            active = rest
            columns = binary.rows, binary.row, binary.spare, binary.children, binary.size, binary.error
            pair_merge.merge_pairs(pairs, binary.used, leaves, *columns)
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
