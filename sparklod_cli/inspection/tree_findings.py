"""Findings about a Level-of-Detail tree, however broken it is: its links, the sizes of its nodes, and their order."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..lod.kernels.tree_links import add_weighted, fill_weights, find_cycles, mark_small
from ..model.lod_tree import LodTree
from ..model.nodes import CHUNK_NODES
from ..model.splats import FloatArray
from ..support.parallel import blocks_of, ordered_map
from .blocks import Block, Blocks, Mask, Tally, largest
from .findings import Finding

#: Smallest feature size of a node over the mean of its children's, weighted by area. A merged splat has at least their
#: variance, so nodes of a good tree reach 0.5; a much smaller one is drawn in their place for too long. A single faint
#: child may be far larger than its parent, which is no fault: docs/decisions/2026-11-21-sizes-of-parents.md.
MIN_SIZE_RATIO = 1 / 3
#: More than rounding adds to a mean, as a factor.
ROUNDING = 1 + 1e-6

#: A file is ordered coarse before fine if the median limit of its nodes' parents, at which the traversal refines them,
#: does not rise by more than a factor `MAX_RISE` from one of `PARTS` equal parts to a later one. Trees with fewer than
#: `MIN_NODES` children are not checked: chance decides there.
PARTS, MAX_RISE, MIN_NODES = 16, 1.6, 1024

#: Columns of `Splats` that the facts of a tree, and findings about it, are computed from.
USED = ("scale", "opacity")


def parts_of(tree: LodTree) -> list[slice]:
    """Nodes that are looked at together, so that what is computed of them is small."""
    return blocks_of(len(tree), CHUNK_NODES)


def told(tally: Tally, what: str) -> str:
    """The text of a finding about nodes."""
    return f"node {{first}} {what}{' (and {more} more)' if tally.count > 1 else ''}"


def link_findings(
    tree: LodTree, parent: NDArray[np.int32], references: NDArray[np.int32], depth: NDArray[np.int32], threads: int
) -> list[Finding]:
    """Findings about the links of a tree of N nodes.

    Args:
        tree: of them.
        parent, references: (N,) of `find_parents`.
        depth: (N,) of `find_depths`.
        threads: to work on.
    """
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

    def tallied(part: slice) -> dict[str, Tally]:
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
        return {code: Tally.of(mask, part.start) for code, mask in masks.items()}

    for found in ordered_map(tallied, parts_of(tree), threads):
        for code, tally in found.items():
            tallies[code].merge(tally)
    return [found for code, what in faults.items() for found in tallies[code].finding(code, told(tallies[code], what))]


class _Sized(NamedTuple):
    """What the comparison of nodes with their children needs of a block.

    Attributes:
        part: of all nodes.
        above: (n,) int32 parents of those that are compared with them, -1 for others.
        weight: (n,) float64, of each node in the mean size of its parent's children.
        line: (n,) bool, the format cannot hold the width of the line that it is, so that its area is unknown.
        clamped: (n,) bool, nor a scale as large as it may have.
    """

    part: slice
    above: NDArray[np.int32]
    weight: NDArray[np.float64]
    line: Mask
    clamped: Mask


def size_findings(
    blocks: Blocks,
    tree: LodTree,
    parent: NDArray[np.int32],
    size: FloatArray,
    scale_ends: tuple[float, float],
    threads: int,
) -> list[Finding]:
    """Findings about nodes that are much smaller than their children, N nodes in all.

    Args:
        blocks: of the nodes; read if a node may be too small.
        tree: of them.
        parent: (N,) of `find_parents`.
        size: (N,) feature sizes, world units.
        scale_ends: as for `tree.examine_blocks`.
        threads: to work on.
    """
    # No mean is larger than the largest child, but for rounding. In a good tree, that tells of nearly all nodes that
    # they are large enough.
    marks = np.zeros(len(parent), np.bool_)
    if not mark_small(tree.child_count, tree.child_start, size, MIN_SIZE_RATIO * ROUNDING, marks):
        return []
    sums, weights, excused = np.zeros(len(parent)), np.zeros(len(parent)), np.zeros(len(parent), np.bool_)
    low, high = scale_ends

    def sized(block: Block) -> _Sized | None:
        part, scale = block.part, block.splats.scale
        above = np.where(marks[parent[part]], parent[part], -1)
        above[parent[part] < 0] = -1
        if not (marks[part].any() or (above >= 0).any()):
            return None
        weight = np.empty(len(scale), np.float64)
        fill_weights(above, size[part], scale, block.splats.opacity, weight)
        x, y, z = scale.T
        line = (x <= low) & (y <= low) | (x <= low) & (z <= low) | (y <= low) & (z <= low)
        return _Sized(part, above, weight, line, ~(largest(scale) < high))

    for found in blocks.map(sized, USED, threads):
        if found is None:
            continue
        part, above, weight, line, clamped = found
        add_weighted(above, size[part], weight, sums, weights)
        excused[above[line & (above >= 0)]] = True
        excused[part] |= clamped
    small = Tally()
    for part in parts_of(tree):
        if not marks[part].any():
            continue
        weight = weights[part]
        mean = np.divide(sums[part], weight, out=np.zeros(len(weight)), where=weight > 0)
        small.add((size[part] < MIN_SIZE_RATIO * mean) & ~excused[part], part.start)
    return small.finding("tree.size", told(small, "is less than a third as large as the mean of its children"))


def order_findings(parent: NDArray[np.int32], limit: FloatArray, threads: int) -> list[Finding]:
    """A finding if a tree of N nodes is not in the order coarse before fine.

    Args:
        parent: (N,) of `find_parents`.
        limit: (N,) of `find_depths`.
        threads: to work on.
    """
    held = parent >= 0
    count = int(np.count_nonzero(held))
    if count < MIN_NODES:
        return []
    # In a good tree all nodes but the first, which need not be listed.
    children = range(1, len(parent)) if count == len(parent) - 1 and not held[0] else np.flatnonzero(held)
    del held
    ends = [count // PARTS * end + min(count % PARTS, end) for end in range(PARTS + 1)]

    def median(part: int) -> np.float32:
        some = children[ends[part] : ends[part + 1]]
        above = parent[some.start : some.stop] if isinstance(some, range) else parent[some]
        found: np.float32 = np.median(limit[above])
        return found

    limits = np.array(list(ordered_map(median, range(PARTS), threads)))
    rises = np.flatnonzero(limits[1:] > MAX_RISE * np.minimum.accumulate(limits)[:-1])
    if not rises.size:
        return []
    at = int(children[ends[rises[0] + 1]])
    what = f"nodes from {at:,} on are refined before some of the nodes before them"
    return [Finding("tree.coarse-first", what, at, len(parent) - at)]
