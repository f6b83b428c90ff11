"""Orders of the nodes of a tree: for streaming, so that viewers need few chunks, and in bands, for files read whole.

A viewer fetches a tree chunk by chunk. It needs the chunks with the children of the nodes that it refines, so the unit
of an order is the *family*, the children of one node. The first chunk holds the largest families: a coarse picture of
the whole. The rest is split in two, again and again, until each part is a chunk: along x, y or z between subtrees, or
by size, the coarse part first. The split is chosen after which viewers at quasi-random viewpoints, with budgets of all
sizes, are expected to fetch the fewest bytes; docs/streaming.md compares it with other orders.

The order in bands goes from coarse to fine in few bands, and within a band from subtree to subtree, so that neighbours
in a file, which compress together, are neighbours in space. The order of a builder goes through the scene once for each
step of size. The nodes up to the end of a band are an even, coarser scene. benchmarks/notes/file-sizes.md has the
savings.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..model.foveation import SPARK
from ..model.gaussian import spark_size
from ..model.lod_tree import CHUNK_NODES, LodTree
from ..model.splats import FloatArray, Splats
from ..system.progress import Progress, silent
from ..system.threads import blocks_of, for_blocks, threads_for, threads_in_use
from .kernels.chunk_sets import DEMAND_BYTES, LANES, Families, fill_demand, sort_within_chunks, split_sets
from .kernels.pixel_scale import NODE, VIEW, set_foveation
from .kernels.sort import sort_by_key
from .kernels.tree_links import find_limits, find_parents

#: Viewpoints: half outside of the scene looking at it, a quarter anywhere inside, a quarter near a node. Chosen: 16
#: are as good for large trees, but not for trees of four chunks (benchmarks/notes/cuts-and-chunks.md).
VIEWPOINTS = 64

#: Distances of viewpoints from the middle of the scene, or from a node, in radii of the scene: log-uniform. Chosen.
OUTSIDE, NEAR = (0.5, 4.0), (0.02, 0.2)

#: Share of the centres, at either end of each axis, that the box of the scene leaves out. Chosen.
OUTLIERS = 0.02

#: Largest coordinate of a viewpoint: that of float32, which scenes may have, too.
LARGEST = float(np.finfo(np.float32).max)

#: Least budget of viewers, as a share of the nodes; at most one chunk. Chosen.
LEAST_BUDGET = 1 / 16

#: Bases of the Halton sequences that viewpoints are made of.
PRIMES = (2, 3, 5, 7, 11, 13, 17)

#: Families that a bake out of core orders at a time: those of some 15 million splats. Chosen: 0.7 GB.
MOST_FAMILIES = 1 << 22

#: Bytes of a family while it is ordered, besides the bytes of each thread. Measured.
FAMILY_BYTES = 124

#: Nodes of the first band, and growth of the number of nodes from the end of a band to the end of the next. Measured:
#: with a growth of 8, files are up to 0.5 % smaller, and without bands up to 0.9 %, but fewer prefixes are even scenes
#: (benchmarks/notes/file-sizes.md).
FIRST_BAND, BAND_GROWTH = 4096, 4

#: Sign bit of a float32.
SIGN = np.uint32(1 << 31)

Matrix = NDArray[np.float64]
Index = NDArray[np.int32]

#: Families per block on the way up the tree. Chosen.
_ROWS = 1 << 16


def arrange(splats: Splats, tree: LodTree, *, progress: Progress = silent) -> tuple[Splats, LodTree]:
    """Put the nodes of a tree into the order for streaming.

    The root is node 0, siblings are consecutive and come after their parent. Siblings lie in one chunk, unless families
    are too large to fill chunks with whole families. The result does not depend on the number of threads.
    """
    order, child_start = chunk_order(splats, tree, progress=progress)
    return reordered([(splats, tree)], order, child_start)


def chunk_order(
    splats: Splats, tree: LodTree, *, progress: Progress = silent
) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Return the order of `arrange`; see `node_order`."""
    nodes, parent = families_of(tree)
    if not len(nodes):
        return node_order(tree, nodes)
    size = spark_size(splats)[nodes]
    families = family_order(parent, tree.child_count[nodes], splats.center[nodes], size, progress=progress)
    return node_order(tree, nodes[families])


def family_order(
    parent: NDArray[np.int32],
    count: NDArray[np.uint16],
    center: FloatArray,
    size: FloatArray,
    *,
    most: int | None = None,
    progress: Progress = silent,
) -> Index:
    """Return the order of the families of `arrange`.

    Args:
        parent: (F,) for each node that has children, the place of its parent among these nodes, which comes before it;
            -1 for the root.
        count, center, size: number of children, centre and feature size of each node, world units.
        most: number of families that are ordered at a time, see `family_bytes`; None for all. Each of the parts, see
            `parts_of`, is ordered like a tree of its own.

    Returns:
        (F,) int32 places of the nodes in the order in which their children are written.
    """
    total, filled, found = 1 + int(count.sum(dtype=np.int64)), 1, []
    size = np.fmax(size, np.float32(0))
    _, limit = find_limits(parent, size)
    for members in parts_of(parent, center, limit, most or len(parent)):
        with threads_for(len(members)) as threads:
            at = slice(None) if len(members) == len(parent) else members  # a slice copies nothing
            # Parents first: by descending limit.
            keys = np.uint64(0x7FFFFFFF) - limit[at].view(np.uint32).astype(np.uint64)
            largest = sort_by_key(keys, np.arange(len(members), dtype=np.uint32), 31, threads)[1]
            del keys
            part = _part(parent, members), count[at], center[at], size[at]
            families = _families(*part, largest, threads)
            found.append(members[largest[_sequence(families, filled, total, progress)]])
        filled += int(families.count.sum(dtype=np.int64))
    return np.concatenate(found)


def family_bytes(threads: int) -> int:
    """Return the memory for each of the families that are ordered at a time, bytes."""
    return FAMILY_BYTES + DEMAND_BYTES * min(threads, VIEWPOINTS // LANES)


def _part(parent: Index, members: Index) -> Index:
    """Return the place of each member's parent among the ascending members; -1 if it is not a member."""
    if len(members) == len(parent):
        return parent
    place = np.full(len(parent) + 1, -1, np.int32)
    place[members] = np.arange(len(members), dtype=np.int32)
    return place[parent[members]]  # the parent -1 of the root finds the last place, -1


def _families(
    parent: NDArray[np.int32],
    count: NDArray[np.uint16],
    center: FloatArray,
    size: FloatArray,
    order: NDArray[np.uint32],
    threads: int,
) -> Families:
    """Return a part's families, given in any order, in the order `order`: by descending size, with their demand."""
    above, center = parent[order], center[order]
    parent = np.where(above < 0, np.int32(-1), _places(order)[above])
    records = np.zeros(len(order), NODE)
    for axis, name in enumerate("xyz"):
        records[name] = center[:, axis]
    records["size"], records["child_count"] = size[order], count[order]
    rank = _ranks(center, threads)
    views = viewpoints(center)
    del above, center
    demand = np.empty((len(order), VIEWPOINTS), np.uint8)
    total = 1 + int(count.sum(dtype=np.int64))
    least = min(total * LEAST_BUDGET, float(CHUNK_NODES))
    fill_demand(VIEWPOINTS // LANES, records, parent, views, least, float(total), demand)
    return Families(parent, records["child_count"].astype(np.int32), rank, demand)


def _places(order: NDArray[np.uint32]) -> Index:
    """Return the place of each number in an order: the inverse permutation."""
    place = np.empty(len(order), np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    return place


def _ranks(center: FloatArray, threads: int) -> NDArray[np.int32]:
    """Return the (F, 3) ranks of centres along each axis."""
    rank = np.empty((len(center), 3), np.int32)
    for axis in range(3):
        bits = center[:, axis].copy().view(np.uint32)
        keys = np.where(bits & SIGN, ~bits, bits | SIGN).astype(np.uint64)  # ascend as the numbers do
        rank[:, axis] = _places(sort_by_key(keys, np.arange(len(bits), dtype=np.uint32), 32, threads)[1])
    return rank


def _sequence(families: Families, filled: int, total: int, progress: Progress) -> Index:
    """Return the order of the (F,) families of a part in the file.

    Args:
        filled: number of nodes before the part.
        total: number of nodes of the tree, for the progress.
    """
    length, own = len(families.count), int(families.count.sum(dtype=np.int64))
    sequence = np.arange(length, dtype=np.int32)
    set_of, root, spare = (np.full(length, -1, np.int32) for _ in range(3))
    weight = np.empty(length, np.int64)
    # Begin and end of each set, its nodes, and for the first set the room for nodes in the chunk that the root or the
    # part before has begun.
    room = -filled % CHUNK_NODES
    sets, ends, used = ([(0, length, own, room)] if room or own > CHUNK_NODES else []), [0, length], 0
    while sets:
        rows = [
            (begin, end, used + number, CHUNK_NODES, -(-nodes // CHUNK_NODES), room)
            for number, (begin, end, nodes, room) in enumerate(sets)
        ]
        lengths = np.zeros(len(sets), np.int64)
        split_sets(len(sets), families, np.array(rows, np.int64), sequence, set_of, root, weight, spare, lengths)
        used += len(sets)
        parts = []
        for (begin, end, nodes, _), first in zip(sets, lengths.tolist(), strict=True):
            inside = int(families.count[sequence[begin : begin + first]].sum(dtype=np.int64))
            parts += [(begin, begin + first, inside, 0), (begin + first, end, nodes - inside, 0)]
        ends += [end for _, end, nodes, _ in parts if nodes <= CHUNK_NODES]
        sets = [part for part in parts if part[2] > CHUNK_NODES]
        progress("arranging", filled + own - sum(nodes for _, _, nodes, _ in sets), total, "node")
    bits = (length - 1).bit_length()
    set_of[:] = -1  # numbers of sets are not numbers of chunks
    bounds = np.unique(ends)
    sort_within_chunks(len(bounds) - 1, bounds, families.parent, families.rank, bits, sequence, set_of, root)
    return sequence


def viewpoints(centers: FloatArray) -> NDArray[np.void]:
    """Return (VIEWPOINTS,) `pixel_scale.VIEW` with Spark's foveation, spread over centres by Halton sequences."""
    low, high = np.percentile(centers, [100 * OUTLIERS, 100 - 100 * OUTLIERS], axis=0).astype(np.float64)
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    u = [_halton(base) for base in PRIMES]
    direction, gaze = _on_sphere(u[0], u[1]), _on_sphere(u[2], u[3])
    outside = middle + direction * _log_uniform(OUTSIDE, u[4]) * radius
    inside = low + (high - low) * np.stack([u[0], u[1], u[4]], axis=1)
    some = centers[(u[5] * len(centers)).astype(np.int64)]
    near = some + direction * _log_uniform(NEAR, u[4]) * radius
    kind = np.arange(VIEWPOINTS)[:, None] % 4
    eye = np.where(kind < 2, outside, np.where(kind == 2, inside, near))
    ahead = np.where(kind < 2, middle + gaze * (u[6][:, None] * radius / 2) - outside, gaze)
    length = np.linalg.norm(ahead, axis=1, keepdims=True)
    ahead = np.where(length > 0, ahead / np.where(length > 0, length, 1), gaze)
    eye = np.clip(eye, -LARGEST, LARGEST)
    views = np.zeros(VIEWPOINTS, VIEW)
    for axis, name in enumerate("xyz"):
        views[f"origin_{name}"], views[f"forward_{name}"] = eye[:, axis], ahead[:, axis]
    views["lod_scale"] = 1
    for view in views:
        set_foveation(view, SPARK, math.pi / 2, math.pi / 2)
    return views


def _halton(base: int) -> Matrix:
    """Return VIEWPOINTS elements of the Halton sequence, from the second on: evenly spread in 0..1."""
    left, share, out = np.arange(1, VIEWPOINTS + 1), 1.0, np.zeros(VIEWPOINTS)
    while left.any():
        share /= base
        out += share * (left % base)
        left //= base
    return out


def _on_sphere(u: Matrix, v: Matrix) -> Matrix:
    """Map (u, v), evenly spread in the unit square, to (N, 3) directions, evenly spread on the sphere."""
    z = 2 * u - 1
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(2 * np.pi * v), across * np.sin(2 * np.pi * v), z], axis=1)


def _log_uniform(bounds: tuple[float, float], u: Matrix) -> Matrix:
    """Map (N,) numbers 0..1 to (N, 1) numbers between bounds, linearly in their logarithms."""
    low, high = bounds
    return low * (high / low) ** u[:, None]


def parts_of(
    parent: Index, center: FloatArray, limit: FloatArray, most: int, members: Index | None = None
) -> Iterator[Index]:
    """Yield all families in parts of at most `most`; the part of a family never precedes the part of its parent.

    The first part has the largest families. Each of the others has neighbouring subtrees below them; a subtree that is
    too large is divided like the tree. The peak is about 50 bytes a family.

    Args:
        parent: (F,) int32 family of each family's parent, which comes before it; -1 for the root.
        center: (F, 3) of the parents.
        limit: (F,) least size from the root to the parent.
        members: (N,) families of a subtree, ascending; all by default.
    """
    if members is None:
        members = np.arange(len(parent), dtype=np.int32)
    if len(members) <= most:
        yield members
        return
    largest = _largest(limit[members], most)
    yield members[largest]
    rest = members[~largest]
    del members, largest
    root = _roots(parent, rest)
    roots = np.flatnonzero(root == np.arange(len(rest), dtype=np.int32))
    number_of = np.empty(len(rest), np.int32)
    number_of[roots] = np.arange(len(roots), dtype=np.int32)
    root = number_of[root]
    del number_of
    weight = np.zeros(len(roots), np.int64)
    for part in blocks_of(len(root), most):  # as bincount copies its input to int64
        weight += np.bincount(root[part], minlength=len(roots))
    groups = list(_neighbours(center[rest[roots]], weight, np.arange(len(roots)), most))
    group = np.empty(len(roots), np.int32)
    for number, some in enumerate(groups):
        group[some] = number
    of_family = group[root]
    del root, roots, weight, group
    for number in range(len(groups)):
        yield from parts_of(parent, center, limit, most, rest[of_family == number])


def _largest(limit: FloatArray, most: int) -> NDArray[np.bool_]:
    """Return a (N,) mask of the `most` largest numbers; the first among equals, as parents come first."""
    least = np.partition(limit, len(limit) - most)[len(limit) - most]
    found: NDArray[np.bool_] = limit > least
    equal = np.flatnonzero(limit == least)
    found[equal[: most - int(np.count_nonzero(found))]] = True
    return found


def _roots(parent: Index, members: Index) -> Index:
    """Return the (N,) places, among ascending members, of each member's highest ancestor that is a member."""
    above = _part(parent, members)
    root = np.where(above < 0, np.arange(len(above), dtype=np.int32), above)
    del above
    for part in blocks_of(len(root), _ROWS):
        while not np.array_equal(higher := root[root[part]], root[part]):
            root[part] = higher
    return root


def _neighbours(
    center: FloatArray, weight: NDArray[np.int64], some: NDArray[np.int64], most: int
) -> Iterator[NDArray[np.int64]]:
    """Divide subtrees into groups of at most `most` families, or one subtree, by halving along the longest side."""
    if len(some) == 1 or weight[some].sum() <= most:
        yield some
        return
    axis = int(np.ptp(center[some], axis=0).argmax())
    ordered = some[np.argsort(center[some, axis], kind="stable")]
    until = np.cumsum(weight[ordered])
    middle = min(max(1, int(np.searchsorted(until, until[-1] / 2))), len(some) - 1)
    yield from _neighbours(center, weight, ordered[:middle], most)
    yield from _neighbours(center, weight, ordered[middle:], most)


def families_of(tree: LodTree) -> tuple[NDArray[np.uint32], NDArray[np.int32]]:
    """Return (F,) uint32 nodes with children, ascending, and (F,) int32 places of their parents among them, or -1."""
    nodes = np.flatnonzero(tree.child_count).astype(np.uint32)
    number = np.full(len(tree), -1, np.int32)
    number[nodes] = np.arange(len(nodes), dtype=np.int32)
    above, _ = find_parents(tree.child_count, tree.child_start)
    return nodes, np.where(above[nodes] < 0, np.int32(-1), number[above[nodes]])


def node_order(tree: LodTree, parents: NDArray[np.uint32]) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Return the order of nodes with the root first, then the children of (F,) `parents`.

    Returns:
        (M,) uint32 node at each place, and (M,) uint32 its `child_start`.
    """
    total = len(tree)
    order, child_start = np.zeros(total, np.uint32), np.zeros(total, np.uint32)
    if not len(parents):
        return order, child_start
    count = tree.child_count[parents].astype(np.int64)
    first = np.cumsum(count) - count
    order[1:] = np.repeat(tree.child_start[parents] - first, count) + np.arange(total - 1)
    place = np.empty(total, np.uint32)
    place[order] = np.arange(total, dtype=np.uint32)
    child_start[place[parents]] = first + 1
    return order, child_start


def reordered(
    built: list[tuple[Splats, LodTree]], order: NDArray[np.uint32], child_start: NDArray[np.uint32]
) -> tuple[Splats, LodTree]:
    """Put a tree into an order of `node_order`. Empties `built`, so that columns are freed one by one."""
    nodes, tree = built.pop()
    columns = dict(vars(nodes))
    del nodes
    for name in columns:
        columns[name] = _rows(columns[name], order)
    return Splats(**columns), LodTree(tree.child_count[order], child_start)


def _rows(column: FloatArray, order: NDArray[np.uint32]) -> FloatArray:
    """Return `column[order]`, copied on all threads."""
    found = np.empty((len(order), *column.shape[1:]), column.dtype)

    def copy(part: slice) -> None:
        # With "clip", numpy writes to `found` without a buffer.
        np.take(column, order[part], axis=0, out=found[part], mode="clip")

    for_blocks(copy, len(order), threads_in_use())
    return found


def banded(built: list[tuple[Splats, LodTree]]) -> tuple[Splats, LodTree]:
    """Put the nodes of a tree into bands. Empties `built`, see `reordered`.

    The root is node 0, siblings are consecutive, in their old order, and come after their parent. The result does not
    depend on the number of threads.
    """
    nodes, tree = built[0]
    families, parent = families_of(tree)
    parents = families[band_order(parent, tree.child_count[families], spark_size(nodes)[families])]
    del nodes
    return reordered(built, *node_order(tree, parents))


def band_order(parent: Index, count: NDArray[np.uint16], size: FloatArray) -> Index:
    """Return the order of the families of `banded`, as `family_order`.

    Args:
        parent: as of `family_order`, for nodes in the order of the tree.
        count, size: (F,) number of children and feature size of each node.
    """
    if not len(parent):
        return np.empty(0, np.int32)
    depth, limit = find_limits(parent, np.fmax(size, np.float32(0)))
    levels = np.split(np.argsort(depth, kind="stable"), np.cumsum(np.bincount(depth))[:-1])
    by_size = np.argsort(-limit, kind="stable")  # parents first among equals
    band = np.empty(len(parent), np.int32)
    before = np.cumsum(count[by_size], dtype=np.int64) - count[by_size]
    ends = [FIRST_BAND * BAND_GROWTH**k for k in range(max(1, math.ceil(math.log2(len(before)))) + 1)]
    band[by_size] = np.searchsorted(ends, before, side="right")
    return np.lexsort((_depth_first(parent, levels), band)).astype(np.int32)


def _depth_first(parent: Index, levels: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Return the (F,) place of each family in depth-first order."""
    below = np.ones(len(parent), np.int64)  # families of each subtree
    for level in levels[:0:-1]:
        np.add.at(below, parent[level], below[level])
    ends = np.cumsum(below)
    starts = ends - below
    # Families of siblings are one after the other.
    first = np.flatnonzero(np.diff(parent, prepend=-2))
    starts -= np.repeat(starts[first], np.diff(first, append=len(parent)))
    for level in levels[1:]:
        starts[level] += starts[parent[level]] + 1
    return starts
