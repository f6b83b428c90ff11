"""From a binary tree to the nodes that are kept: pruned, in final order, with their geometry and colours."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..model.lod_tree import MAX_CHILDREN, LodTree
from ..model.sh import degree_of
from ..model.splats import COLUMNS, FloatArray, Splats
from ..system.progress import Progress
from ..system.threads import threads_for, threads_in_use
from .kernels import node_rows, pair_cost, prune
from .kernels.node_rows import fill_leaves, merge_colors
from .kernels.sort import Keys, Nodes, sort_by_key
from .pair_tree import BinaryTree, Curve

#: Columns of merged splats that come from their node rows, and columns that are merged from their children.
GEOMETRY = ("center", "scale", "quat_xyzw", "opacity")
COLORS = tuple(name for name in COLUMNS if name not in GEOMETRY)


@dataclass(frozen=True)
class PruningGoal:
    """Bounds of the nodes of a pruned tree, and their order.

    Attributes:
        most: number of merged nodes.
        splats: number of splats of the scene under the tree's leaves.
        is_whole: whether its last node is the root of the scene. Otherwise the nodes without a parent get one later; if
            one is dropped, its children are left without a parent.
        highest: ln(size) of rank 0, in units; None for the root's.
        latest: (N,) ranks that the parents of leaves must be below; empty for any.
    """

    most: int
    splats: int
    is_whole: bool = True
    highest: float | None = None
    latest: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))


@dataclass(frozen=True, eq=False)
class FinalTree:
    """Pruned tree in final order.

    If the tree is not whole, node 0 stands for what the nodes without a parent will be under, and is not to be drawn.

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
        """Final index of the first node that has a parent."""
        return len(self.order) - int(self.tree.child_count[self.parents].sum(dtype=np.int64))


def in_final_order(
    binary: BinaryTree,
    index: Nodes,
    columns: dict[str, FloatArray],
    goal: PruningGoal,
    curve: Curve,
    progress: Progress,
) -> FinalTree:
    """Prune a tree, and write its nodes and their colours in final order. The binary tree is of no use afterwards.

    Args:
        index: (N,) splat of each of its leaves.
        columns: of the splats as the leaves are drawn; emptied, so that each is freed if there is no other reference.
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
    parents = prune.lay_out_children(np.concatenate([root, inner]), n, parent, saved, *links)[hidden:]
    del parent, saved
    out = Splats.empty(total, degree_of(columns["sh"].shape[1]))

    def fill(name: str) -> None:
        fill_leaves(total, order, index, columns.pop(name).reshape(n, -1), getattr(out, name).reshape(total, -1))

    for name in GEOMETRY:
        fill(name)
    places = (getattr(out, name)[hidden:] for name in GEOMETRY)
    shown = order[hidden:]
    node_rows.fill_merged_splats(len(shown), shown, n, binary.row, binary.rows, curve.space, *places)
    weight = binary.rows[binary.row[slots], pair_cost.WEIGHT]
    binary.rows = rows = binary.rows[binary.row[slots[:0] if goal.is_whole else slots]]  # frees what is not returned
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
    """Return parents of all nodes, `saved` of `drop_nodes`, and ranks; frees what only pruning needs."""
    n, top, blocks = binary.leaves, binary.used - goal.is_whole, threads_in_use()
    progress("pruning", 0, binary.used, "node")
    log_size, lost, weight = binary.size[: top + 1], binary.error[: top + 1 - n], np.empty(top + 1 - n, np.float32)
    children = binary.children[: binary.used - n]
    parent = fill_usefulness_terms(children, n, goal.splats, top, log_size, lost, weight, blocks)
    binary.children = children = np.empty((0, 2), np.uint32)
    saved = np.ones(top + 1 - n, np.int32)
    if not goal.is_whole:
        saved[-1] = np.count_nonzero(parent[:-1] == top) - 1 - prune.ROOM
    # A root that is only to be is one node more.
    drop_nodes(n, goal.most + (not goal.is_whole), parent, log_size, lost, weight, saved, blocks)
    if not goal.is_whole:
        saved[-1] += prune.ROOM
    highest = log_size[top] if goal.highest is None else np.float32(goal.highest)
    rank = prune.size_ranks(n, highest, parent, log_size, saved, goal.latest)
    binary.size = binary.error = np.empty(0, np.float32)
    return parent, saved, rank


def _by_rank(binary: BinaryTree, rank: NDArray[np.int32], curve: Curve) -> tuple[Nodes, NDArray[np.int32], Keys]:
    """Return the remaining merged nodes, by rank and then along the curve, with both."""
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
        leaves: number of leaves; they come first, and have no place in arrays of merged nodes.
        drawn_leaves: number of splats of the scene under them.
        top: the root. T - 1, or T if nodes without a parent are to get one later, which is that root until then.
        log_size: (top + 1,) float32 feature sizes, replaced by ln(size), but no more than the parent's: the threshold
            above which the traversal does not refine the node.
        lost: (top + 1 - leaves,) float32, `picture_error`, replaced by the error cost of merged nodes, in splats.
        weight: (top + 1 - leaves,) float32, filled for merged nodes with their rarity weight.
        blocks: ranges of nodes to process in parallel; the result does not depend on it.

    Returns:
        (top + 1,) uint32 parents; the root's is itself.
    """
    parent = np.full(top + 1, top, np.uint32)
    steps = prune.STEPS * prune.OCTAVES
    step_of, inner, sums = np.empty(len(children), np.uint16), np.zeros(steps, np.int64), np.zeros(steps)
    prune.link(children, leaves, lost, parent, log_size, step_of, inner, sums)
    counts = np.zeros((blocks, steps), np.int64)
    prune.count_leaves(blocks, leaves, parent, log_size, counts)
    # Roughly the splats of a cut whose threshold is the step.
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
        parent: (T,) uint32, updated for what is kept: the nearest ancestor that is kept.
        leaves, log_size, lost, weight, blocks: of `fill_usefulness_terms`; `lost` of a dropped node is added to its
            parent's.
        saved: (T - leaves,) int32, on entry 1 for each merged node; what is less for the root allows it that many more
            children. Updated: the number of children minus 1 of kept nodes, -1 for dropped nodes.
    """
    slots = len(saved) - 1
    # Merged nodes but the root, less `leaves`, parents first.
    kept = np.arange(slots - 1, -1, -1, dtype=np.uint32)
    keys = np.empty(slots, np.uint16)
    turn, children = prune.ROUNDS, prune.MOST_CHILDREN
    while len(kept) + 1 > most:  # also after ROUNDS, where nodes gained usefulness as their children were dropped
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
