"""Facts and findings about a Level-of-Detail tree, however broken it is."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..lod.kernels.tree_links import (
    add_weighted,
    fill_weights,
    find_cycles,
    find_depths,
    find_parents,
    sum_by_depth,
)
from ..model.gaussian import spark_size
from ..model.lod_tree import LodTree
from ..model.nodes import CHUNK_BITS, CHUNK_NODES
from ..model.scene import Scene
from ..model.splats import FloatArray, Splats
from ..support.parallel import blocks_of
from .blocks import Block, Blocks, Mask, Tally, largest
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

#: Columns of `Splats` that the facts of a tree are computed from.
USED = ("scale", "opacity")


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


@dataclass(frozen=True, eq=False)
class Columns:
    """What the facts of a tree of N nodes need of each of them, 10 bytes.

    Attributes:
        tree: children, (N,); as far as the blocks have come, unless all are in memory.
        is_whole: the tree is in memory.
        size: (N,) float32 feature sizes, world units.
        tallies: merged nodes of D > 1, and leaves of D > 1.
    """

    tree: LodTree
    is_whole: bool
    size: FloatArray
    opaque: Tally
    opaque_leaves: Tally

    @classmethod
    def of(cls, blocks: Blocks) -> Columns:
        """For the nodes of some blocks, none of which has been added."""
        count, tree = blocks.count, blocks.tree
        if tree is None:
            tree = LodTree(np.empty(count, np.uint16), np.empty(count, np.uint32))
        return cls(tree, blocks.tree is not None, np.empty(count, np.float32), Tally(), Tally())

    def part_of(self, block: Block) -> tuple[Tally, Tally]:
        """Sets what is here of the nodes of a block, with the columns `USED`; the tallies are to be merged in order."""
        assert block.tree is not None
        part = slice(block.start, block.start + len(block.splats))
        if not self.is_whole:
            self.tree.child_count[part], self.tree.child_start[part] = block.tree.child_count, block.tree.child_start
        self.size[part] = spark_size(block.splats)
        found, more = (Tally(), Tally()), block.splats.opacity > 1
        found[0].add(more, block.start)
        found[1].add(more & block.tree.is_leaf, block.start)
        return found

    def merge(self, part: tuple[Tally, Tally]) -> None:
        """Adds the tallies of the next block."""
        self.opaque.merge(part[0])
        self.opaque_leaves.merge(part[1])


def examine(
    splats: Splats, tree: LodTree, *, check: bool = True, scale_ends: tuple[float, float] = (0.0, math.inf)
) -> tuple[TreeFacts, list[Finding]]:
    """The facts of a tree in memory and findings about it, see `examine_blocks`.

    Args:
        splats: N nodes, of which scale and opacity are used.
        tree: of N nodes, at least one.
        check: look for faults.
        scale_ends: smallest and largest scale that the format holds, world units.
    """
    blocks = Blocks.of(Scene(splats, tree))
    columns = Columns.of(blocks)
    for block in blocks.read(USED):
        columns.merge(columns.part_of(block))
    return examine_blocks(blocks, columns, check=check, scale_ends=scale_ends)


def examine_blocks(
    blocks: Blocks,
    columns: Columns,
    *,
    check: bool,
    scale_ends: tuple[float, float] = (0.0, math.inf),
    in_chunks: bool = False,
    threads: int = 1,
) -> tuple[TreeFacts, list[Finding]]:
    """The facts of a tree and findings about it; of a broken tree, the facts of the nodes that its root leads to.

    At most 31 bytes a node are in memory, those of `columns` among them; 18 where nothing is checked.

    Args:
        blocks: read once more to compare nodes with their children, where faults are looked for.
        columns: of all blocks.
        check: look for faults.
        scale_ends: smallest and largest scale that the format holds, world units. A scale at one of them may have been
            clamped.
        in_chunks: the format orders nodes by chunks, so that they need not be coarse before fine.
        threads: to work on.
    """
    tree, size = columns.tree, columns.size
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
        more_than_opaque=round(float(columns.opaque.count) / len(tree), 4),
        chunks=-(-len(tree) // CHUNK_NODES),
        chunks_of_coarse_cut=len(np.unique(_coarse_cut(tree, limit) // CHUNK_NODES)),
        split_siblings=sum(_split_siblings(tree, part) for part in _parts(tree)),
    )
    if not check:
        return facts, []
    if in_chunks:
        del limit
    parent, references = find_parents(tree.child_count, tree.child_start)
    found = _link_findings(tree, parent, references, depth)
    del references, depth
    found += columns.opaque_leaves.finding("tree.leaf-opacity", _told(columns.opaque_leaves, "is a leaf with D > 1"))
    found += _size_findings(blocks, parent, size, scale_ends, threads)
    return facts, found if in_chunks else [*found, *_order_findings(parent, limit)]


def _parts(tree: LodTree) -> list[slice]:
    """Nodes that are looked at together, so that what is computed of them is small."""
    return blocks_of(len(tree), CHUNK_NODES)


def _coarse_cut(tree: LodTree, limit: FloatArray) -> NDArray[np.int64]:
    """The nodes of the cut that refines the largest nodes first, until it would have more than `CHUNK_NODES`."""
    # Each adds at least a node, so that no more than the largest ones can be refined.
    largest = np.empty(0, np.float32)
    for part in _parts(tree):
        largest = np.concatenate([largest, limit[part][_refinable(tree, limit, part)]])
        if len(largest) > CHUNK_NODES:
            largest = -np.partition(-largest, CHUNK_NODES)[: CHUNK_NODES + 1]
    least = largest.min() if len(largest) > CHUNK_NODES else 0
    inner = np.concatenate(
        [part.start + np.flatnonzero(_refinable(tree, limit, part) & (limit[part] >= least)) for part in _parts(tree)]
    )
    # Stable: a node that is larger than its parent has its parent's limit, and comes after it.
    inner = inner[np.argsort(-limit[inner], kind="stable")]
    fits = np.cumsum(tree.child_count[inner].astype(np.int64) - 1) + 1 <= CHUNK_NODES
    refined = inner[: int(np.argmin(fits)) if not fits.all() else len(inner)]
    count = tree.child_count[refined].astype(np.int64)
    start = tree.child_start[refined].astype(np.int64)
    children = np.repeat(start - (np.cumsum(count) - count), count) + np.arange(count.sum())
    nodes = np.concatenate([np.zeros(1, np.int64), children])
    return np.setdiff1d(nodes[nodes < len(tree)], refined)


def _refinable(tree: LodTree, limit: FloatArray, part: slice) -> Mask:
    return (tree.child_count[part] > 0) & (limit[part] > 0)


def _split_siblings(tree: LodTree, part: slice) -> int:
    count = tree.child_count[part]
    first = tree.child_start[part][count > 0].astype(np.int64)
    last = first + count[count > 0] - 1
    return int(np.count_nonzero(first >> CHUNK_BITS != last >> CHUNK_BITS))


def _told(tally: Tally, what: str) -> str:
    """The text of a finding about nodes."""
    return f"node {{first}} {what}{' (and {more} more)' if tally.count > 1 else ''}"


def _link_findings(
    tree: LodTree, parent: NDArray[np.int32], references: NDArray[np.int32], depth: NDArray[np.int32]
) -> list[Finding]:
    faults = {
        "tree.root": "is the root but the child of another node",
        "tree.range": f"has children beyond the last node, {len(tree) - 1:,}",
        "tree.order": "comes after one of its children, or is its own child",
        "tree.shared": "is the child of more than one node",
        "tree.orphan": "has no parent",
        "tree.unreachable": "has a parent, but the root does not lead to it",
        "tree.leaf-start": "is a leaf with a child_start other than 0",
        "tree.single-child": "has a single child",
    }
    tallies = {code: Tally() for code in faults}
    tallies["tree.root"].add(references[:1] > 0, 0)
    cycles = find_cycles(parent, depth)
    for part in _parts(tree):
        count, start, held = tree.child_count[part], tree.child_start[part].astype(np.int64), references[part]
        node = np.arange(part.start, part.stop)
        inner = count > 0
        masks = {
            "tree.range": inner & (start + count > len(tree)),
            "tree.order": inner & (start <= node),
            "tree.shared": held > 1,
            "tree.orphan": (held == 0) & (node > 0),
            "tree.unreachable": cycles[part],
            "tree.leaf-start": ~inner & (start != 0),
            "tree.single-child": count == 1,
        }
        for code, mask in masks.items():
            tallies[code].add(mask, part.start)
    return [found for code, what in faults.items() for found in tallies[code].finding(code, _told(tallies[code], what))]


class _Sized(NamedTuple):
    """What the comparison of nodes with their children needs of a block.

    Attributes:
        part: of all nodes.
        weight: (n,) float64, of each node in the mean size of its parent's children.
        line: (n,) bool, the format cannot hold the width of the line that it is, so that its area is unknown.
        clamped: (n,) bool, nor a scale as large as it may have.
    """

    part: slice
    weight: NDArray[np.float64]
    line: Mask
    clamped: Mask


def _size_findings(
    blocks: Blocks, parent: NDArray[np.int32], size: FloatArray, scale_ends: tuple[float, float], threads: int
) -> list[Finding]:
    sums, weights, excused = np.zeros(len(parent)), np.zeros(len(parent)), np.zeros(len(parent), np.bool_)
    low, high = scale_ends

    def sized(block: Block) -> _Sized:
        part, scale = slice(block.start, block.start + len(block.splats)), block.splats.scale
        weight = np.empty(len(scale), np.float64)
        fill_weights(parent[part], size[part], scale, block.splats.opacity, weight)
        x, y, z = scale.T
        line = (x <= low) & (y <= low) | (x <= low) & (z <= low) | (y <= low) & (z <= low)
        return _Sized(part, weight, line, ~(largest(scale) < high))

    for part, weight, line, clamped in blocks.map(sized, USED, threads):
        above = parent[part]
        add_weighted(above, size[part], weight, sums, weights)
        excused[above[line & (above >= 0)]] = True
        excused[part] |= clamped
    small = Tally()
    for part in blocks_of(len(parent), CHUNK_NODES):
        weight = weights[part]
        mean = np.divide(sums[part], weight, out=np.zeros(len(weight)), where=weight > 0)
        small.add((size[part] < MIN_SIZE_RATIO * mean) & ~excused[part], part.start)
    return small.finding("tree.size", _told(small, "is less than a third as large as the mean of its children"))


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
