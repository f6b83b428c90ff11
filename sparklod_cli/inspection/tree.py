"""Facts and findings about a Level-of-Detail tree, however broken it is."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..lod.kernels.tree_links import (
    LIMIT_BITS,
    count_limits,
    find_depths,
    find_parents,
    sum_by_depth,
)
from ..model.gaussian import spark_size
from ..model.lod_tree import LodTree
from ..model.nodes import CHUNK_BITS, CHUNK_NODES
from ..model.scene import Scene
from ..model.splats import FloatArray, Splats
from ..support.parallel import ordered_map
from .blocks import Block, Blocks, Tally
from .findings import Finding
from .tree_findings import USED, link_findings, order_findings, parts_of, size_findings, told

#: Most depths that a report lists, from the root on. Good trees have some twenty; a chain could have one a node.
MAX_DEPTHS = 1000


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
        """Sets what is here of the nodes of a block; the tallies are to be merged in order.

        Args:
            block: with the columns `USED`, or with codes.
        """
        assert block.tree is not None
        part = block.part
        if not self.is_whole:
            self.tree.child_count[part], self.tree.child_start[part] = block.tree.child_count, block.tree.child_start
        if block.coded is None:
            self.size[part] = spark_size(block.splats)
            more = block.splats.opacity > 1
        else:
            block.coded.fill_sizes(part, self.size[part])
            more = (block.coded.table("opacity") > 1)[block.coded.codes["alphas"][part, 0]]
        found = (Tally(), Tally())
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
    sums, (coarse, split), parents = _at_once(
        threads,
        functools.partial(sum_by_depth, depth, tree.child_count, size),
        functools.partial(_coarse_cut, tree, limit),
        functools.partial(find_parents, tree.child_count, tree.child_start) if check else lambda: None,
    )
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
        more_than_opaque=round(float(columns.opaque.count) / len(tree), 4),
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
    found += columns.opaque_leaves.finding("tree.leaf-opacity", told(columns.opaque_leaves, "is a leaf with D > 1"))
    found += size_findings(blocks, tree, parent, size, scale_ends, threads)
    return facts, found if in_chunks else [*found, *order_findings(parent, limit, threads)]


def _at_once(threads: int, *work: Callable[[], Any]) -> Iterator[Any]:
    """What each of these returns."""
    return ordered_map(lambda each: each(), work, threads)


def _coarse_cut(tree: LodTree, limit: FloatArray) -> tuple[NDArray[np.int64], int]:
    """The nodes of the cut that refines the largest nodes first, until it would have more than `CHUNK_NODES`.

    Also the number of inner nodes whose children lie in more than one chunk.
    """
    # Each adds at least a node, so that no more than the largest ones can be refined.
    counts = np.zeros(1 << LIMIT_BITS, np.int64)
    split = count_limits(tree.child_count, tree.child_start, limit, CHUNK_BITS, counts)
    above = np.cumsum(counts[::-1])[::-1]  # nodes of this limit or more
    bucket = max(0, int(np.count_nonzero(above > CHUNK_NODES)) - 1)
    least = float(np.array(bucket << (32 - LIMIT_BITS), np.uint32).view(np.float32)[()])
    inner = np.concatenate([part.start + _large(tree, limit, least, part) for part in parts_of(tree)])
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


def _large(tree: LodTree, limit: FloatArray, least: float, part: slice) -> NDArray[np.intp]:
    """The places in a part of the inner nodes whose limits are above 0 and `least` or more."""
    some = limit[part]
    return np.flatnonzero((tree.child_count[part] > 0) & (some > 0) & (some >= least))
