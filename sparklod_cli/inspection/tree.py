"""Facts and findings about a Level-of-Detail tree, however broken it is."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..lod.kernels.tree_links import (
    LIMIT_BITS,
    add_weighted,
    count_limits,
    fill_weights,
    find_cycles,
    find_depths,
    find_parents,
    mark_small,
    sum_by_depth,
)
from ..model.gaussian import spark_size
from ..model.lod_tree import CHUNK_BITS, CHUNK_NODES, LodTree
from ..model.splats import FloatArray
from ..system.threads import blocks_of, ordered_map
from .findings import Block, Finding, Mask, MaskTally, ReportBlocks, Tallies, largest, merged, tallies

#: Smallest feature size of a node over the mean of its children's, weighted by area. A merged splat has at least their
#: variance, so nodes of a good tree reach 0.5; a much smaller one is drawn in their place for too long. A single faint
#: child may be far larger than its parent, which is no fault: docs/decisions/11-quality-builder.md.
MIN_SIZE_RATIO = 1 / 3
#: More than rounding adds to a mean, as a factor.
ROUNDING = 1 + 1e-6

#: Nodes are ordered coarse before fine if the median limit of their parents, the pixel scale at which the traversal
#: refines them, rises by no more than the factor `MAX_RISE` from one of `PARTS` equal parts of the file to a later one.
#: Trees with fewer than `MIN_NODES` children are not checked: there, chance decides.
PARTS, MAX_RISE, MIN_NODES = 16, 1.6, 1024

#: Columns of `Splats` that the facts of a tree, and findings about it, are computed from.
USED = ("scale", "opacity")


def parts_of(tree: LodTree) -> list[slice]:
    """Parts of the nodes that are examined at a time, to bound memory."""
    return blocks_of(len(tree), CHUNK_NODES)


def node_findings(tally: MaskTally, code: str, what: str) -> list[Finding]:
    """Return a finding that says `what` of nodes, if there are any."""
    return tally.finding(code, f"node {{first}} {what}{{rest}}", " (and {:,} more)")


def link_findings(
    tree: LodTree, parent: NDArray[np.int32], references: NDArray[np.int32], depth: NDArray[np.int32], threads: int
) -> list[Finding]:
    """Return findings about the links of a tree, from the results of `find_parents` and `find_depths`."""
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
    cycles = find_cycles(parent, depth)

    def tallied(part: slice) -> Tallies:
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
        return tallies(masks, part.start)

    roots = tallies({"tree.root": references[:1] > 0}, 0)
    total = merged([roots, *ordered_map(tallied, parts_of(tree), threads)])
    return [found for code, what in faults.items() for found in node_findings(total[code], code, what)]


def size_findings(
    blocks: ReportBlocks,
    tree: LodTree,
    parent: NDArray[np.int32],
    size: FloatArray,
    scale_ends: tuple[float, float],
    threads: int,
) -> list[Finding]:
    """Return findings about nodes that are much smaller than their children, by (N,) feature sizes.

    Args:
        blocks: read only if a node may be too small.
        scale_ends: those of `examine`.
    """
    # No mean is larger than the largest child, but for rounding: in a good tree, nearly all nodes pass this test.
    marks = np.zeros(len(parent), np.bool_)
    if not mark_small(tree.child_count, tree.child_start, size, MIN_SIZE_RATIO * ROUNDING, marks):
        return []
    sums, weights, excused = np.zeros(len(parent)), np.zeros(len(parent)), np.zeros(len(parent), np.bool_)
    low, high = scale_ends

    def sized(block: Block) -> tuple[slice, NDArray[np.int32], NDArray[np.float64], Mask, Mask] | None:
        """Return the data of a block for the comparison; None if no node of it is compared.

        These are the range of the block and, for each of its nodes: its parent, -1 if that is not compared; its weight
        in the mean size of its siblings; whether it is a line, whose width, and so its area, the format cannot hold;
        whether it has a scale as large as the format holds.
        """
        part, scale = block.part, block.splats.scale
        above = np.where(marks[parent[part]], parent[part], -1)
        above[parent[part] < 0] = -1
        if not (marks[part].any() or (above >= 0).any()):
            return None
        weight = np.empty(len(scale), np.float64)
        fill_weights(above, size[part], scale, block.splats.opacity, weight)
        x, y, z = scale.T
        line = (x <= low) & (y <= low) | (x <= low) & (z <= low) | (y <= low) & (z <= low)
        return part, above, weight, line, ~(largest(scale) < high)

    for found in blocks.map(sized, USED, threads):
        if found is None:
            continue
        part, above, weight, line, clamped = found
        add_weighted(above, size[part], weight, sums, weights)
        excused[above[line & (above >= 0)]] = True
        excused[part] |= clamped
    small = MaskTally()
    for part in parts_of(tree):
        if not marks[part].any():
            continue
        weight = weights[part]
        mean = np.divide(sums[part], weight, out=np.zeros(len(weight)), where=weight > 0)
        small += tallies({"small": (size[part] < MIN_SIZE_RATIO * mean) & ~excused[part]}, part.start)["small"]
    return node_findings(small, "tree.size", "is less than a third as large as the mean of its children")


def order_findings(parent: NDArray[np.int32], limit: FloatArray, threads: int) -> list[Finding]:
    """Return a finding if nodes with these parents and limits are not in the order coarse before fine."""
    held = parent >= 0
    count = int(np.count_nonzero(held))
    if count < MIN_NODES:
        return []
    # In a good tree all nodes but the first, which need not be listed.
    children = range(1, len(parent)) if count == len(parent) - 1 and not held[0] else np.flatnonzero(held)
    del held
    ends = [count // PARTS * end + min(count % PARTS, end) for end in range(PARTS + 1)]

    def median(part: int) -> np.float32:
        nodes = children[ends[part] : ends[part + 1]]
        above = parent[nodes.start : nodes.stop] if isinstance(nodes, range) else parent[nodes]
        found: np.float32 = np.median(limit[above])
        return found

    limits = np.array(list(ordered_map(median, range(PARTS), threads)))
    rises = np.flatnonzero(limits[1:] > MAX_RISE * np.minimum.accumulate(limits)[:-1])
    if not rises.size:
        return []
    at = int(children[ends[rises[0] + 1]])
    what = f"nodes from {at:,} on are refined before some of the nodes before them"
    return [Finding("tree.coarse-first", what, at, len(parent) - at)]


#: Most depths that a report lists, from the root on. Good trees have some twenty; a chain could have one a node.
MAX_DEPTHS = 1000


@dataclass(frozen=True)
class Level:
    """The nodes of one depth, see `schema.json`."""

    nodes: int
    leaves: int
    size: float | None


@dataclass(frozen=True)
class TreeFacts:
    """Facts of a tree, see `schema.json`."""

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
class TreeColumns:
    """Columns of N nodes for the facts of their tree, which `add` fills; 10 bytes a node.

    Attributes:
        is_whole: the tree was in memory from the beginning.
        size: (N,) float32 feature sizes, world units.
    """

    tree: LodTree
    is_whole: bool
    size: FloatArray

    @classmethod
    def of(cls, blocks: ReportBlocks) -> TreeColumns:
        """Return columns for the nodes of blocks, before any `add`."""
        count, tree = blocks.count, blocks.about.tree
        blank = LodTree(np.empty(count, np.uint16), np.empty(count, np.uint32)) if tree is None else tree
        return cls(blank, tree is not None, np.empty(count, np.float32))

    def add(self, block: Block) -> Tallies:
        """Add the nodes of a block with the columns `USED`; return tallies of its nodes and its leaves with D > 1."""
        assert block.tree is not None
        part = block.part
        if not self.is_whole:
            self.tree.child_count[part], self.tree.child_start[part] = block.tree.child_count, block.tree.child_start
        self.size[part] = spark_size(block.splats)
        more = block.splats.opacity > 1
        return tallies({"opaque": more, "opaque leaves": more & block.tree.is_leaf}, block.start)


def examine(
    blocks: ReportBlocks,
    columns: TreeColumns,
    opaque: Tallies,
    *,
    check: bool,
    scale_ends: tuple[float, float],
    in_chunks: bool,
    threads: int,
) -> tuple[TreeFacts, list[Finding]]:
    """Return the facts of a tree of one or more nodes, and with `check` findings about it.

    The facts of a broken tree are those of the nodes below its root. At most 31 bytes a node are in memory, those of
    `columns` among them; 18 without a check.

    Args:
        blocks: read once more by a check, to compare nodes with their children.
        columns: filled with all blocks.
        opaque: tallies of all blocks from `TreeColumns.add`.
        scale_ends: smallest and largest scale that the format holds, world units; scales at an end may be clamped.
        in_chunks: the format orders nodes by chunks, so they need not be coarse before fine.
    """
    tree, size = columns.tree, columns.size
    depth, limit = find_depths(tree.child_count, tree.child_start, size)
    work: list[Callable[[], Any]] = [
        functools.partial(sum_by_depth, depth, tree.child_count, size),
        functools.partial(_coarse_cut, tree, limit),
        functools.partial(find_parents, tree.child_count, tree.child_start) if check else lambda: None,
    ]
    sums, (coarse, split), parents = ordered_map(lambda each: each(), work, threads)
    nodes, ends, logs, children = sums
    with np.errstate(divide="ignore", invalid="ignore"):
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
        more_than_opaque=round(opaque["opaque"].count / len(tree), 4),
        chunks=-(-len(tree) // CHUNK_NODES),
        chunks_of_coarse_cut=len(np.unique(coarse // CHUNK_NODES)),
        split_siblings=split,
    )
    if not check:
        return facts, []
    if in_chunks:
        del limit
    parent, references = parents
    found = link_findings(tree, parent, references, depth, threads)
    del references, depth, parents
    found += node_findings(opaque["opaque leaves"], "tree.leaf-opacity", "is a leaf with D > 1")
    found += size_findings(blocks, tree, parent, size, scale_ends, threads)
    return facts, found if in_chunks else [*found, *order_findings(parent, limit, threads)]


def _coarse_cut(tree: LodTree, limit: FloatArray) -> tuple[NDArray[np.int64], int]:
    """Return the nodes of the cut that refines the largest nodes first, up to `CHUNK_NODES` nodes.

    Also returns the number of inner nodes whose children lie in more than one chunk.
    """
    # Refining a node adds at least one, so that only the `CHUNK_NODES` largest can be refined.
    counts = np.zeros(1 << LIMIT_BITS, np.int64)
    split = count_limits(tree.child_count, tree.child_start, limit, CHUNK_BITS, counts)
    above = np.cumsum(counts[::-1])[::-1]  # nodes of this limit or more
    bucket = max(0, int(np.count_nonzero(above > CHUNK_NODES)) - 1)
    least = float(np.array(bucket << (32 - LIMIT_BITS), np.uint32).view(np.float32)[()])
    large = []
    for part in parts_of(tree):
        limits = limit[part]
        large.append(part.start + np.flatnonzero((tree.child_count[part] > 0) & (limits > 0) & (limits >= least)))
    inner = np.concatenate(large)
    if len(inner) > CHUNK_NODES:
        limits = limit[inner]
        inner = inner[limits >= -np.partition(-limits, CHUNK_NODES)[CHUNK_NODES]]
    # Stable: a node that is larger than its parent has its parent's limit, and comes after it.
    inner = inner[np.argsort(-limit[inner], kind="stable")]
    fits = np.cumsum(tree.child_count[inner].astype(np.int64) - 1) + 1 <= CHUNK_NODES
    refined = inner[: int(np.argmin(fits)) if not fits.all() else len(inner)]
    count = tree.child_count[refined].astype(np.int64)
    start = tree.child_start[refined].astype(np.int64)
    children = np.repeat(start - (np.cumsum(count) - count), count) + np.arange(count.sum())
    nodes = np.concatenate([np.zeros(1, np.int64), children])
    return np.setdiff1d(nodes[nodes < len(tree)], refined), split
