"""Facts and findings about a Level-of-Detail tree, however broken it is."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..lod.kernels.tree_links import find_cycles, find_depths, find_parents, mean_child_sizes, sum_by_depth
from ..model.gaussian import spark_size
from ..model.lod_tree import LodTree
from ..model.nodes import CHUNK_BITS, CHUNK_NODES
from ..model.splats import FloatArray, Splats
from .findings import Finding

#: Smallest feature size of a node over the mean of its children's, weighted by area. A merged splat has at least their
#: variance, so nodes of a good tree reach 0.5; a much smaller one is drawn in their place for too long. A single faint
#: child may be far larger than its parent, which is no fault: docs/decisions/2026-11-21-sizes-of-parents.md.
MIN_SIZE_RATIO = 1 / 3

#: A file is ordered coarse before fine if the median limit of its nodes' parents, at which the traversal refines them,
#: does not rise by more than a factor `MAX_RISE` from one of `PARTS` equal parts to a later one. Trees with fewer than
#: `MIN_NODES` children are not checked: chance decides there.
PARTS, MAX_RISE, MIN_NODES = 16, 1.6, 1024

#: Most depths that a report lists, from the root on. Good trees have some twenty; a chain could have one a node.
MAX_DEPTHS = 1000

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Level:
    """The nodes of one depth.

    Attributes:
        nodes, leaves: their number, and that of the leaves among them.
        size: geometric mean of their feature sizes (`gaussian.spark_size`), world units; None if one of them is 0.
    """

    nodes: int
    leaves: int
    size: float | None


@dataclass(frozen=True)
class TreeFacts:
    """The facts of a tree.

    Attributes:
        leaves, inner: nodes without and with children.
        growth: nodes over leaves.
        depth: edges from the root to the deepest node.
        levels: the nodes of each depth, from 0 on; at most `MAX_DEPTHS`.
        levels_left_out: depths beyond those.
        children: number of inner nodes by number of children, as text.
        more_than_opaque: share of nodes with D > 1.
        chunks: of `CHUNK_NODES` nodes.
        chunks_of_coarse_cut: chunks that a viewer needs for a coarse cut: the one of at most `CHUNK_NODES` nodes that
            refines the largest nodes first.
        split_siblings: inner nodes whose children lie in more than one chunk.
    """

    leaves: int
    inner: int
    growth: float
    depth: int
    levels: list[Level]
    levels_left_out: int
    children: dict[str, int]
    more_than_opaque: float | None
    chunks: int
    chunks_of_coarse_cut: int
    split_siblings: int


def examine(
    splats: Splats,
    tree: LodTree,
    *,
    check: bool = True,
    scale_ends: tuple[float, float] = (0.0, math.inf),
    in_chunks: bool = False,
) -> tuple[TreeFacts, list[Finding]]:
    """The facts of a tree and findings about it; of a broken tree, the facts of the nodes that its root leads to.

    Args:
        splats: N nodes, of which scale and opacity are used.
        tree: of N nodes, at least one.
        check: look for faults.
        scale_ends: smallest and largest scale that the format holds, world units. A scale at one of them may have been
            clamped.
        in_chunks: the format orders nodes by chunks, so that they need not be coarse before fine.
    """
    size = spark_size(splats)
    depth, limit = find_depths(tree.child_count, tree.child_start, size)
    with np.errstate(divide="ignore", invalid="ignore"):
        nodes, ends, logs, children = sum_by_depth(depth, tree.child_count, size)
        means = np.exp(logs / nodes)
    leaves = int(children[0])
    facts = TreeFacts(
        leaves=leaves,
        inner=len(tree) - leaves,
        growth=round(len(tree) / max(1, leaves), 4),
        depth=len(nodes) - 1,
        levels=[
            Level(int(count), int(end), float(f"{mean:.4g}") if 0 < mean < np.inf else None)
            for count, end, mean in itertools.islice(zip(nodes, ends, means, strict=True), MAX_DEPTHS)
        ],
        levels_left_out=max(0, len(nodes) - MAX_DEPTHS),
        children={str(number): int(children[number]) for number in np.flatnonzero(children) if number},
        more_than_opaque=round(float(np.count_nonzero(splats.opacity > 1)) / len(tree), 4),
        chunks=-(-len(tree) // CHUNK_NODES),
        chunks_of_coarse_cut=len(np.unique(_coarse_cut(tree, limit) // CHUNK_NODES)),
        split_siblings=_split_siblings(tree),
    )
    if not check:
        return facts, []
    parent, references = find_parents(tree.child_count, tree.child_start)
    return facts, [
        *_link_findings(tree, parent, references, depth),
        *_node_findings(splats, tree, parent, size, scale_ends),
        *([] if in_chunks else _order_findings(parent, limit)),
    ]


def _coarse_cut(tree: LodTree, limit: FloatArray) -> NDArray[np.int64]:
    """The nodes of the cut that refines the largest nodes first, until it would have more than `CHUNK_NODES`."""
    inner = np.flatnonzero(~tree.is_leaf & (limit > 0))
    if len(inner) > CHUNK_NODES:  # each adds at least a node, so no more can be refined
        inner = inner[limit[inner] >= -np.partition(-limit[inner], CHUNK_NODES)[CHUNK_NODES]]
    # Stable: a node that is larger than its parent has its parent's limit, and comes after it.
    inner = inner[np.argsort(-limit[inner], kind="stable")]
    fits = np.cumsum(tree.child_count[inner].astype(np.int64) - 1) + 1 <= CHUNK_NODES
    refined = inner[: int(np.argmin(fits)) if not fits.all() else len(inner)]
    count = tree.child_count[refined].astype(np.int64)
    start = tree.child_start[refined].astype(np.int64)
    children = np.repeat(start - (np.cumsum(count) - count), count) + np.arange(count.sum())
    nodes = np.concatenate([np.zeros(1, np.int64), children])
    return np.setdiff1d(nodes[nodes < len(tree)], refined)


def _split_siblings(tree: LodTree) -> int:
    inner = np.flatnonzero(~tree.is_leaf)
    first = tree.child_start[inner].astype(np.int64)
    last = first + tree.child_count[inner] - 1
    return int(np.count_nonzero(first >> CHUNK_BITS != last >> CHUNK_BITS))


def _found(code: str, mask: Mask, what: str) -> list[Finding]:
    """A finding about the nodes of a mask; none if the mask is empty."""
    count = int(np.count_nonzero(mask))
    if not count:
        return []
    index = int(np.argmax(mask))
    more = f" (and {count - 1:,} more)" if count > 1 else ""
    return [Finding(code, f"node {index:,} {what}{more}", index, count)]


def _link_findings(
    tree: LodTree, parent: NDArray[np.int32], references: NDArray[np.int64], depth: NDArray[np.int32]
) -> list[Finding]:
    leaf = tree.is_leaf
    node = np.arange(len(tree))
    start = tree.child_start.astype(np.int64)
    end = start + tree.child_count
    orphan = references == 0
    orphan[0] = False
    root = np.zeros(len(tree), np.bool_)
    root[0] = references[0] > 0
    return [
        *_found("tree.root", root, "is the root but the child of another node"),
        *_found("tree.range", ~leaf & (end > len(tree)), f"has children beyond the last node, {len(tree) - 1:,}"),
        *_found("tree.order", ~leaf & (start <= node), "comes after one of its children, or is its own child"),
        *_found("tree.shared", references > 1, "is the child of more than one node"),
        *_found("tree.orphan", orphan, "has no parent"),
        *_found("tree.unreachable", find_cycles(parent, depth), "has a parent, but the root does not lead to it"),
        *_found("tree.leaf-start", leaf & (start != 0), "is a leaf with a child_start other than 0"),
        *_found("tree.single-child", tree.child_count == 1, "has a single child"),
    ]


def _node_findings(
    splats: Splats, tree: LodTree, parent: NDArray[np.int32], size: FloatArray, scale_ends: tuple[float, float]
) -> list[Finding]:
    findings = _found("tree.leaf-opacity", tree.is_leaf & (splats.opacity > 1), "is a leaf with D > 1")
    smaller = size < MIN_SIZE_RATIO * mean_child_sizes(parent, size, splats.scale, splats.opacity)
    # Where the format cannot hold a scale that small, the width of a line, and so its area, is unknown; where it cannot
    # hold one that large, so is the size that the node was meant to have.
    least, largest = scale_ends
    line = np.count_nonzero(splats.scale <= least, axis=1) >= 2
    smaller[parent[line & (parent >= 0)]] = False
    smaller &= splats.scale.max(axis=1) < largest
    return findings + _found("tree.size", smaller, "is less than a third as large as the mean of its children")


def _order_findings(parent: NDArray[np.int32], limit: FloatArray) -> list[Finding]:
    children = np.flatnonzero(parent >= 0)
    if len(children) < MIN_NODES:
        return []
    parts = np.array_split(children, PARTS)
    limits = np.array([np.median(limit[parent[part]]) for part in parts])
    rises = np.flatnonzero(limits[1:] > MAX_RISE * np.minimum.accumulate(limits)[:-1])
    if not rises.size:
        return []
    at = int(parts[rises[0] + 1][0])
    what = f"nodes from {at:,} on are refined before some of the nodes before them"
    return [Finding("tree.coarse-first", what, at, len(parent) - at)]
