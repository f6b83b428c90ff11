"""What a Level-of-Detail tree is like, and what is wrong with it, however broken it is."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..lod.kernels.tree_links import find_cycles, find_parents, sizes_below, sum_levels, walk
from ..lod.traversal import CHUNK_NODES
from ..model.gaussian import spark_size
from ..model.lod_tree import LodTree
from ..model.splats import FloatArray, Splats
from .findings import Finding

#: A node may be this much smaller than what it stands for: its children in the mean, by what they cover. A merged splat
#: has their variance at least, so a node of a good tree is 0.5 times as large or more; one that is much smaller is
#: drawn in their place for too long. One child may be far larger than its parent where it is faint, which is no fault:
#: docs/decisions/2026-11-21-sizes-of-parents.md.
LEAST_RATIO = 1 / 3

#: Coarse before fine: nodes are wanted when their parent has become too coarse. Of so many parts of a file, none may be
#: wanted, by the median, more than so many times earlier than one before it; of fewer nodes chance decides.
PARTS, MOST_RISE, LEAST_NODES = 16, 1.6, 1024

#: Levels that are told of, from the root on. A good tree has some twenty; a chain could have one a node.
MOST_LEVELS = 1000

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Level:
    """The nodes that are equally many edges from the root.

    Attributes:
        nodes, leaves: how many.
        size: the geometric mean of their feature sizes (`gaussian.spark_size`), world units; None where one is 0.
    """

    nodes: int
    leaves: int
    size: float | None


@dataclass(frozen=True)
class TreeFacts:
    """What a tree is like.

    Attributes:
        leaves, inner: nodes without and with children.
        growth: nodes over leaves.
        depth: edges to the deepest node.
        levels: by the number of edges from the root, the first `MOST_LEVELS` of them.
        levels_left_out: how many come after those.
        children: how many inner nodes have so many children, by that number as text.
        more_than_opaque: the share of nodes with D > 1.
        chunks: of `CHUNK_NODES` nodes.
        chunks_of_coarse_cut: how many of them a viewer needs for the coarsest cut, the one that divides the largest
            nodes first, of at most so many nodes as a chunk has.
    """

    leaves: int
    inner: int
    growth: float
    depth: int
    levels: list[Level]
    levels_left_out: int
    children: dict[str, int]
    more_than_opaque: float
    chunks: int
    chunks_of_coarse_cut: int


def examine(
    splats: Splats, tree: LodTree, *, check: bool = True, scale_ends: tuple[float, float] = (0.0, math.inf)
) -> tuple[TreeFacts, list[Finding]]:
    """The facts of a tree and what is wrong with it; of a broken one, the facts of what its root leads to.

    Args:
        splats: N nodes, of which scale and opacity are looked at.
        tree: their links, N of them and at least one.
        check: look for what is wrong.
        scale_ends: the least and the largest scale that the file's format holds, world units: one of them may have been
            any smaller, or larger.
    """
    size = spark_size(splats)
    depth, limit = walk(tree.child_count, tree.child_start, size)
    with np.errstate(divide="ignore", invalid="ignore"):
        nodes, ends, logs, children = sum_levels(depth, tree.child_count, size)
        means = np.exp(logs / nodes)
    leaves = int(children[0])
    facts = TreeFacts(
        leaves=leaves,
        inner=len(tree) - leaves,
        growth=round(len(tree) / max(1, leaves), 4),
        depth=len(nodes) - 1,
        levels=[
            Level(int(count), int(end), float(f"{mean:.4g}") if 0 < mean < np.inf else None)
            for count, end, mean in itertools.islice(zip(nodes, ends, means, strict=True), MOST_LEVELS)
        ],
        levels_left_out=max(0, len(nodes) - MOST_LEVELS),
        children={str(number): int(children[number]) for number in np.flatnonzero(children) if number},
        more_than_opaque=round(float(np.count_nonzero(splats.opacity > 1)) / len(tree), 4),
        chunks=-(-len(tree) // CHUNK_NODES),
        chunks_of_coarse_cut=len(np.unique(_coarse_cut(tree, limit) // CHUNK_NODES)),
    )
    if not check:
        return facts, []
    parent, references = find_parents(tree.child_count, tree.child_start)
    return facts, [
        *_link_findings(tree, parent, references, depth),
        *_node_findings(splats, tree, parent, size, scale_ends),
        *_order_findings(parent, limit),
    ]


def _coarse_cut(tree: LodTree, limit: FloatArray) -> NDArray[np.int64]:
    """The nodes of the cut that divides the largest first, as far as it has no more than a chunk's."""
    inner = np.flatnonzero(~tree.is_leaf & (limit > 0))
    if len(inner) > CHUNK_NODES:  # each adds a node at least, so no more than these can be divided
        inner = inner[limit[inner] >= -np.partition(-limit[inner], CHUNK_NODES)[CHUNK_NODES]]
    # Stable, as a node that is larger than its parent has the limit of that, and comes after it.
    inner = inner[np.argsort(-limit[inner], kind="stable")]
    fits = np.cumsum(tree.child_count[inner].astype(np.int64) - 1) + 1 <= CHUNK_NODES
    divided = inner[: int(np.argmin(fits)) if not fits.all() else len(inner)]
    count = tree.child_count[divided].astype(np.int64)
    start = tree.child_start[divided].astype(np.int64)
    children = np.repeat(start - (np.cumsum(count) - count), count) + np.arange(count.sum())
    nodes = np.concatenate([np.zeros(1, np.int64), children])
    return np.setdiff1d(nodes[nodes < len(tree)], divided)


def _found(code: str, mask: Mask, what: str) -> list[Finding]:
    """A finding of the nodes of a mask, if there are any; {index} and {count} stand for the first and how many."""
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
    nobodys = references == 0
    nobodys[0] = False
    root = np.zeros(len(tree), np.bool_)
    root[0] = references[0] > 0
    return [
        *_found("tree.root", root, "is the root, and the child of another node"),
        *_found("tree.range", ~leaf & (end > len(tree)), f"has children past the last node, {len(tree) - 1:,}"),
        *_found("tree.order", ~leaf & (start <= node), "comes after one of its children, or is its own"),
        *_found("tree.shared", references > 1, "is the child of more than one node"),
        *_found("tree.orphan", nobodys, "is nobody's child"),
        *_found("tree.unreachable", find_cycles(parent, depth), "has a parent, but the root does not lead to it"),
        *_found("tree.leaf-start", leaf & (start != 0), "is a leaf with a child_start"),
        *_found("tree.single-child", tree.child_count == 1, "has a single child"),
    ]


def _node_findings(
    splats: Splats, tree: LodTree, parent: NDArray[np.int32], size: FloatArray, scale_ends: tuple[float, float]
) -> list[Finding]:
    findings = _found("tree.leaf-opacity", tree.is_leaf & (splats.opacity > 1), "is a leaf and more than opaque")
    smaller = size < LEAST_RATIO * sizes_below(parent, size, splats.scale, splats.opacity)
    # How wide a line is, and so what it covers beside others, is not known where the format holds no scale that small;
    # nor is how large a node was meant to be where it holds none that large.
    least, largest = scale_ends
    line = np.count_nonzero(splats.scale <= least, axis=1) >= 2
    smaller[parent[line & (parent >= 0)]] = False
    smaller &= splats.scale.max(axis=1) < largest
    return findings + _found("tree.size", smaller, "is less than a third as large as its children are in the mean")


def _order_findings(parent: NDArray[np.int32], limit: FloatArray) -> list[Finding]:
    children = np.flatnonzero(parent >= 0)
    if len(children) < LEAST_NODES:
        return []
    parts = np.array_split(children, PARTS)
    wanted = np.array([np.median(limit[parent[part]]) for part in parts])
    rises = np.flatnonzero(wanted[1:] > MOST_RISE * np.minimum.accumulate(wanted)[:-1])
    if not rises.size:
        return []
    at = int(parts[rises[0] + 1][0])
    what = f"nodes from {at:,} on are wanted before some that come before them"
    return [Finding("tree.coarse-first", what, at, len(parent) - at)]
