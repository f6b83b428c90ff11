"""Data that the cut kernels share: their arrays, limits as bits, and chunks."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...system.jit import b1, fields, i4, i8, kernel, u2, u4
from .pixel_scale import INFINITE, NODES, VIEWS, pixel_scale

#: Buckets of pixel scales: the upper half of a float32's bits. A bucket is at most 0.8 % wide, and any number has one.
BUCKET_BITS = 16
BUCKETS = 1 << (31 - BUCKET_BITS)

#: Pixel scales are compared as the bits of a float32 >= 0, which are in the order of the numbers. NaN is the largest,
#: as in Spark. The sign bit marks leaves, which makes them less than any threshold.
INFINITE_BITS = INFINITE.view(np.int32)
LEAF = np.int32(-(1 << 31))

#: Why a cut has no more nodes. FULL: the slots did not suffice, and there is no cut.
BUDGET, PIXEL, MISSING, EXHAUSTED, FULL = 0, 1, 2, 3, 4


#: Entries of `Slots.tally`: slots in use; refined nodes; pending ones; roots; nodes of the cut once all of bucket LOW
#: and above are refined; LOW itself; refined nodes whose children are missing; whether the slots did not suffice.
COUNT, RUNS, WAITING, BASE, DRAWN, LOW, GAPS, OVERFLOW = range(8)
TALLIES = 8


@fields(NODES, VIEWS, b1[:], i8)
class Trees(NamedTuple):
    """Instances of trees as one camera sees them."""

    nodes: Any  # `NODE` of all trees, one after the other
    views: Any  # (instances,) `VIEW`
    resident: Any  # (chunks,) bool, of all trees: the chunk is loaded. A node is not refined unless its children are.
    chunk_bits: Any  # a chunk has 2 ** chunk_bits nodes


@fields(i4, i8)
class Stop(NamedTuple):
    """Limits of refinement."""

    smallest: Any  # int32 bits of a pixel scale; nodes up to it are not refined
    budget: Any  # int64, number of nodes of a cut; at least one for each instance


@fields(u4[:], i4[:], u2[:])
class CutNodes(NamedTuple):
    """The nodes of a cut."""

    node: Any  # uint32 indices in their trees
    # int32 bits of their limits, see `find_cut`; LEAF marks nodes that the queue took out, which are not all leaves
    limit: Any
    instance: Any  # uint16


@fields(u4[:], i4[:], u2[:], i4[:], i4[:], i4[:], i4[:], i4[:], i8[:])
class Slots(NamedTuple):
    """Working memory for visited nodes: the roots, then the children of each refined node, run by run."""

    node: Any  # (slots,) uint32 index in its tree
    limit: Any  # (slots,) int32, see `limit_bits`
    instance: Any  # (slots,) uint16
    first: Any  # (slots,) int32, the first slot of each run
    queue: Any  # (slots,) int32 refined slots, one for each run, then slots to refine
    pending: Any  # (slots,) int32 slots below the threshold
    heap: Any  # (slots,) int32
    sums: Any  # (BUCKETS,) int32, for each bucket of limits the number of nodes that refining its nodes adds to the cut
    tally: Any  # (TALLIES,) int64, see COUNT


@kernel(inline=True)
def to_bits(value):
    """Return the bits of a float32 >= 0 as int32; NaN may have either sign."""
    return np.float32(value).view(np.int32) & ~LEAF


@kernel(inline=True)
def from_bits(bits):
    """Return the float32 of these bits, without the mark of a leaf."""
    return np.int32(bits & ~LEAF).view(np.float32)


@kernel(inline=True)
def limit_bits(node, view, above):
    """Return the bits of a node's limit, the least pixel scale from the root to it; `above` are those of its parent."""
    limit = min(to_bits(pixel_scale(node, view)), above)
    return limit if node.child_count else limit | LEAF


@kernel(inline=True)
def is_resident(trees, view, start, children):
    """Return whether children are resident; they are in one chunk or two."""
    last = start + children - 1
    return (
        trees.resident[view.chunk_base + (start >> trees.chunk_bits)]
        and trees.resident[view.chunk_base + (last >> trees.chunk_bits)]
    )


@kernel(inline=True)
def request_chunks(wanted, trees, view, start, children, limit):
    """Raise the priority of the chunks of a node's children to the node's limit."""
    for chunk in (start >> trees.chunk_bits, (start + children - 1) >> trees.chunk_bits):
        at = view.chunk_base + chunk
        wanted[at] = max(wanted[at], limit)


@kernel(inline=True)
def put(cut, at, node, limit, instance):
    """Write a node of the cut."""
    cut.node[at], cut.limit[at], cut.instance[at] = node, limit, instance
