"""Merging of the nodes of each cell of the quick builder's grid: the cheapest pairs of neighbours, round by round.

A cell's nodes lie along a curve. In each round, every node finds its cheapest partner among the next few nodes on
either side, in its own cell only, and pairs that chose each other become one node that covers the union of both. The
nodes merged into one during all rounds of a level become a family. As nothing outside a cell matters, a tree can be
built in parts.

Node rows are those of `pair_merge.py`. The cells of a span of nodes are processed together, in columns, so that LLVM
vectorizes over nodes; results do not depend on the spans.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...system.fast_math import exp2
from ...system.jit import b1, f4, i8, kernel, out, u4
from .geometry import ellipsoid_area
from .pair_merge import COVARIANCE, COVERED, DENSITY, LOG_DET, NEVER, WEIGHT, WIDTH, log_det, pair_costs, semi_axes

f32 = np.float32

#: Nodes of a span: its columns, 32 KB, stay near the processor. Results do not depend on it.
SPAN = 512

#: Padding of columns: with a power of two as their length, they would share a few lines of the cache.
PADDING = 16

#: Rounds of merging at a level, and the largest distance of a partner on the curve. Measured, as the next three
#: (benchmarks/notes/quick-builder.md): fewer rounds give more nodes, a larger window takes longer.
ROUNDS, WINDOW = 6, 3

#: Least number of children of a family; smaller families wait for the next level, where they may grow.
LEAST_CHILDREN = 5

#: Share of the largest variance of a level up to which small families do not wait, to limit merges in vain.
PATIENCE = f32(0.15)

#: The largest finite float32: cost of any pair in a cell without a limit, so that no cost keeps a tree from ending.
LARGEST_COST = np.finfo(np.float32).max

#: Exponent from which on two nodes do not overlap: e^-30 is 1e-13, and coverage is a float32. Chosen.
MAX_EXPONENT = f32(30)

#: Bounds, so that products stay within float32: of an offset in units of both nodes' spread, far beyond any overlap,
#: and of a density, far above that of any profile. Chosen.
FARTHEST, DENSEST = f32(1e4), f32(1e4)

#: Least trace of a covariance here, units squared. Chosen.
LEAST_TRACE = f32(1e-30)

#: Number of pairs united side by side. Results do not depend on it.
GROUP = 64

#: The area of an ellipsoid over the root of the sum of its covariance's principal minors, if that is a sphere.
AREA_OF_MINORS = f32(4 * math.pi / math.sqrt(3))

LOG2_E = f32(math.log2(math.e))


@kernel(inline_late=True)
def on_plane(axx, ayy, axy, bxx, byy, bxy, x, y, density_a, density_b):
    """Return the coverage / (2 pi) of the overlap of two Gaussians on a plane, and of both; densities are heights."""
    area_a = math.sqrt(max(axx * ayy - axy * axy, f32(0)))
    area_b = math.sqrt(max(bxx * byy - bxy * bxy, f32(0)))
    xx, yy, xy = axx + bxx, ayy + byy, axy + bxy
    det = max(xx * yy - xy * xy, LEAST_TRACE)
    power = f32(0.5) * max(yy * x * x - f32(2) * xy * x * y + xx * y * y, f32(0)) / det
    both = area_a * area_b / math.sqrt(det) * exp2(-LOG2_E * min(power, MAX_EXPONENT))
    area_a, area_b = density_a * area_a, density_b * area_b
    return min(density_a * density_b * both, min(area_a, area_b)), area_a + area_b


@kernel()
def unite(a, b):
    """Replace each node of `a` by its union with the node of `b`.

    The overlap of two nodes is a share h of their coverage, at most 0.5, measured on the planes of the three axes. It
    is in the middle, and about half as wide as the two nodes; its moments are subtracted. The remaining covariance,
    ((1 - h / 2) (u P + v Q) + u v d d^T) / (1 - h), is always positive semidefinite; u and v are the nodes' shares of
    the coverage, P and Q their covariances, d is the offset between them. `a` and `b` are (WIDTH * GROUP,) columns of
    node rows, one after the other.
    """
    # The stride and the number of nodes are constants, so that LLVM knows that no arrays overlap, and vectorizes.
    for i in range(GROUP):
        px, py, pz = a[i], a[GROUP + i], a[2 * GROUP + i]
        pxx, pyy, pzz = a[3 * GROUP + i], a[4 * GROUP + i], a[5 * GROUP + i]
        pxy, pxz, pyz = a[6 * GROUP + i], a[7 * GROUP + i], a[8 * GROUP + i]
        qxx, qyy, qzz = b[3 * GROUP + i], b[4 * GROUP + i], b[5 * GROUP + i]
        qxy, qxz, qyz = b[6 * GROUP + i], b[7 * GROUP + i], b[8 * GROUP + i]
        dx, dy, dz = b[i] - px, b[GROUP + i] - py, b[2 * GROUP + i] - pz
        # The overlap, in units of both nodes' spread, so that products stay within float32.
        s = f32(1) / (pxx + pyy + pzz + qxx + qyy + qzz + LEAST_TRACE)
        root = math.sqrt(s)
        x = min(max(dx * root, -FARTHEST), FARTHEST)
        y = min(max(dy * root, -FARTHEST), FARTHEST)
        z = min(max(dz * root, -FARTHEST), FARTHEST)
        high_a, high_b = min(a[DENSITY * GROUP + i], DENSEST), min(b[DENSITY * GROUP + i], DENSEST)
        on_z, alone_z = on_plane(pxx * s, pyy * s, pxy * s, qxx * s, qyy * s, qxy * s, x, y, high_a, high_b)
        on_y, alone_y = on_plane(pxx * s, pzz * s, pxz * s, qxx * s, qzz * s, qxz * s, x, z, high_a, high_b)
        on_x, alone_x = on_plane(pyy * s, pzz * s, pyz * s, qyy * s, qzz * s, qyz * s, y, z, high_a, high_b)
        hidden = min((on_x + on_y + on_z) / max(alone_x + alone_y + alone_z, LEAST_TRACE), f32(0.5))
        # The union.
        total = a[COVERED * GROUP + i] + b[COVERED * GROUP + i]
        u, v = a[COVERED * GROUP + i] / total, b[COVERED * GROUP + i] / total
        left = f32(1) / (f32(1) - hidden)
        own, apart = (f32(1) - f32(0.5) * hidden) * left, u * v * left
        xx, yy, zz = own * (u * pxx + v * qxx), own * (u * pyy + v * qyy), own * (u * pzz + v * qzz)
        xy, xz, yz = own * (u * pxy + v * qxy), own * (u * pxz + v * qxz), own * (u * pyz + v * qyz)
        xx, yy, zz = xx + apart * dx * dx, yy + apart * dy * dy, zz + apart * dz * dz
        xy, xz, yz = xy + apart * dx * dy, xz + apart * dx * dz, yz + apart * dy * dz
        # Clamped, so that rounding cannot put the mean outside the two, and so outside their cell.
        qx, qy, qz = b[i], b[GROUP + i], b[2 * GROUP + i]
        a[i] = min(max(u * px + v * qx, min(px, qx)), max(px, qx))
        a[GROUP + i] = min(max(u * py + v * qy, min(py, qy)), max(py, qy))
        a[2 * GROUP + i] = min(max(u * pz + v * qz, min(pz, qz)), max(pz, qz))
        a[3 * GROUP + i], a[4 * GROUP + i], a[5 * GROUP + i] = xx, yy, zz
        a[6 * GROUP + i], a[7 * GROUP + i], a[8 * GROUP + i] = xy, xz, yz
        weight = a[WEIGHT * GROUP + i] + b[WEIGHT * GROUP + i]
        first, second = a[WEIGHT * GROUP + i] / weight, b[WEIGHT * GROUP + i] / weight
        a[9 * GROUP + i] = first * a[9 * GROUP + i] + second * b[9 * GROUP + i]
        a[10 * GROUP + i] = first * a[10 * GROUP + i] + second * b[10 * GROUP + i]
        a[11 * GROUP + i] = first * a[11 * GROUP + i] + second * b[11 * GROUP + i]
        a[LOG_DET * GROUP + i] = log_det(xx, yy, zz, xy, xz, yz)
        covered = total * (f32(1) - hidden)
        a[COVERED * GROUP + i] = covered
        a[WEIGHT * GROUP + i] = weight
        # The area of an ellipsoid within 16 %, from the sum of its squared projections; `finish_row` has a better one.
        s = f32(1) / (xx + yy + zz + LEAST_TRACE)
        xx, yy, zz, xy, xz, yz = xx * s, yy * s, zz * s, xy * s, xz * s, yz * s
        minors = max(xx * yy - xy * xy, f32(0)) + max(xx * zz - xz * xz, f32(0)) + max(yy * zz - yz * yz, f32(0))
        area = AREA_OF_MINORS * math.sqrt(minors) / s
        a[DENSITY * GROUP + i] = min(covered / max(area, LEAST_TRACE), DENSEST)


@kernel()
def finish_row(lanes, i, row):
    """Fill the node row of node i, with its exact density: coverage over the area of its ellipsoid."""
    for column in range(WIDTH):
        row[column] = lanes[column, i]
    large, middle, small = semi_axes(
        np.float64(row[COVARIANCE]),
        np.float64(row[COVARIANCE + 1]),
        np.float64(row[COVARIANCE + 2]),
        np.float64(row[COVARIANCE + 3]),
        np.float64(row[COVARIANCE + 4]),
        np.float64(row[COVARIANCE + 5]),
    )
    row[DENSITY] = min(np.float64(row[COVERED]) / ellipsoid_area(large, middle, small), LARGEST_COST)


@kernel()
def find_partners_in_cells(lanes, count, cell, place, largest, cost, best, at):
    """Fill the cost, `best`, and the place in the cell, `at` (or -1), of each node's cheapest partner in a span.

    Ties as in `pair_merge.keep_cheaper`. `lanes` has (WIDTH, at least count) columns of node rows; `cell` and `place`
    are the number of each node's cell and its place in the cell; `largest` bounds the trace of a pair's covariance,
    units squared; `cost` is working memory.
    """
    most = f32(LARGEST_COST) if largest == NEVER else NEVER
    for i in range(count):
        best[i], at[i] = NEVER, -1
    for step in range(1, min(WINDOW, count - 1) + 1):
        pairs = count - step
        pair_costs(lanes, 0, step, pairs, largest, cost)
        for i in range(pairs):
            price = cost[i] if cost[i] < most else most  # also for NaN
            cost[i] = price if cell[i] == cell[i + step] else NEVER
        for i in range(pairs):
            own, new = place[i], np.int32(place[i] + step)
            lower = (cost[i] < best[i]) | ((cost[i] == best[i]) & ((own ^ new) < (own ^ at[i])))
            best[i] = cost[i] if lower else best[i]
            at[i] = new if lower else at[i]
        for i in range(pairs):
            j = i + step
            own, new = place[j], np.int32(place[j] - step)
            lower = (cost[i] < best[j]) | ((cost[i] == best[j]) & ((own ^ new) < (own ^ at[j])))
            best[j] = cost[i] if lower else best[j]
            at[j] = new if lower else at[j]


@kernel()
def merge_span(nodes, is_first, rows, largest, begin, end, made, owner, row):
    """Merge the nodes `begin` to `end`, of whole cells; see `merge_in_cells`."""
    size = end - begin
    columns = rows.shape[1]  # a variable, as LLVM takes long to unroll WIDTH loops over nodes
    lanes = np.empty((WIDTH, size + PADDING), np.float32)
    a, b = np.ones(WIDTH * GROUP, np.float32), np.ones(WIDTH * GROUP, np.float32)
    cell, place, at = np.empty(size, np.int32), np.empty(size, np.int32), np.empty(size, np.int32)
    cost, best = np.empty(size, np.float32), np.empty(size, np.float32)
    # Lists are filled without branches, which would be mispredicted: every entry is written, and overwritten by the
    # next entry unless it is kept, so lists have room for one more. Indices are unsigned, as numba checks signs.
    first, second = np.empty(size + 1, np.uint64), np.empty(size + 1, np.uint64)
    kept, done, ends = np.empty(size + 1, np.uint64), np.empty(size + 1, np.uint64), np.empty(size + 1, np.uint64)
    slot, joined, members = np.empty(size, np.uint64), np.empty(size, np.uint64), np.ones(size, np.int64)
    is_dead = np.empty(size, np.uint8)
    number = np.int32(-1)
    for i in range(size):
        number += np.int32(is_first[begin + i])
        cell[i], slot[i], joined[i] = number, i, i
        node = nodes[begin + i]
        for column in range(WIDTH):
            lanes[column, i] = rows[node, column]
    merges = np.empty(number + 1, np.uint8)  # whether a cell has merges in a round
    count, families = size, begin // 2
    for turn in range(ROUNDS):
        run, before = np.int32(0), np.int32(-1)
        for i in range(count):
            run = np.int32(run + 1) if cell[i] == before else np.int32(0)
            before = cell[i]
            place[i] = run
        find_partners_in_cells(lanes, count, cell, place, largest, cost, best, at)
        pairs = np.int64(0)
        for i in range(count):
            j = max(i + at[i] - place[i], 0)
            first[pairs], second[pairs] = i, j
            pairs += (at[i] > place[i]) & (at[j] == place[i])
        for start in range(0, pairs, GROUP):
            some = min(GROUP, pairs - start)
            for column in range(columns):
                for k in range(some):
                    a[column * GROUP + k] = lanes[column, first[start + k]]
                    b[column * GROUP + k] = lanes[column, second[start + k]]
            unite(a, b)
            for column in range(columns):
                for k in range(some):
                    lanes[column, first[start + k]] = a[column * GROUP + k]
        merges[:] = 0
        is_dead[:count] = 0
        for pair in range(pairs):
            i, j = first[pair], second[pair]
            joined[slot[j]] = slot[i]
            members[slot[i]] += members[slot[j]]
            is_dead[j] = 1
            merges[np.uint64(cell[i])] = 1
        left = finished = np.int64(0)
        goes_on = np.uint8(turn < ROUNDS - 1)
        for i in range(count):
            lives, again = np.uint8(1) - is_dead[i], merges[np.uint64(cell[i])] & goes_on
            own = slot[i]
            kept[left], done[finished], ends[finished] = i, i, own
            cell[left], slot[left] = cell[i], own
            left += lives & again
            finished += lives & (np.uint8(1) - again)
        # Finished nodes: a cell without a merge would not change in another round.
        for k in range(finished):
            i, own = done[k], ends[k]
            trace = lanes[COVARIANCE, i] + lanes[COVARIANCE + 1, i] + lanes[COVARIANCE + 2, i]
            many = members[own]
            if many >= LEAST_CHILDREN or (many > 1 and trace <= PATIENCE * largest):
                finish_row(lanes, i, rows[made + families])
                row[begin + np.int64(own)] = made + families
                families += 1
            else:
                members[own] = 0
        for column in range(columns):
            for i in range(left):
                lanes[column, i] = lanes[column, kept[i]]
        count = left
    for i in range(size):
        joined[i] = joined[joined[i]]  # final, as it comes before
        owner[begin + i] = begin + (np.int64(joined[i]) if members[joined[i]] > 0 else i)


@kernel(i8, u4[:], b1[:], out(f4[:, :]), f4, i8, out(i8[:]), out(u4[:]), ranges=True)
def merge_in_cells(start, stop, nodes, is_first, rows, largest, made, owner, row):
    """Merge nodes with others of their cell, and fill the rows of the new parents.

    The rows of a range are spans of SPAN nodes, moved forward to the borders of cells.

    Args:
        nodes: (n,) rows, by cell and then along a curve.
        is_first: (n,) true where a cell begins.
        rows: node rows; up to n // 2 of them, from `made` on, are filled.
        largest: largest trace of the covariance of a merged node, units squared.
        owner: (n,) filled with the place in `nodes` of the first member of the node's family, or its own.
        row: (n,) filled, at the place of the first member of each family, with the row of the parent.
    """
    n = len(nodes)
    for span in range(start, stop):
        begin, end = span * SPAN, min(n, span * SPAN + SPAN)
        while begin < end and not is_first[begin]:
            begin += 1
        if begin < end:
            while end < n and not is_first[end]:
                end += 1
            merge_span(nodes, is_first, rows, largest, begin, end, made, owner, row)


def split_families(
    nodes: NDArray[Any], owner: NDArray[Any], row: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Separate the members of families from the roots; `owner` and `row` are of `merge_in_cells`.

    Returns:
        members: (C,) uint32 members, family after family, in the order of the first members.
        first: (F + 1,) int64, where each family begins in `members`.
        made: (F,) uint32 rows of the parents of the families.
        survivors: (S,) uint32, the roots: a parent replaces the first member of its family.
    """
    n = len(nodes)
    members, first = np.empty(n, np.uint32), np.empty(n // 2 + 1, np.int64)
    made, survivors = np.empty(n // 2, np.uint32), np.empty(n, np.uint32)
    used, families, left = fill_families(nodes, owner, row, members, first, made, survivors)
    return members[:used], first[: families + 1], made[:families], survivors[:left]


@kernel(u4[:], i8[:], u4[:], out(u4[:]), out(i8[:]), out(u4[:]), out(u4[:]), returns=(i8, i8, i8))
def fill_families(nodes, owner, row, members, first, made, survivors):
    """Fill the arrays of `split_families`; return the lengths of `members`, `made` and `survivors`."""
    n = len(nodes)
    size = np.zeros(n, np.int64)
    for i in range(n):
        size[owner[i]] += 1
    begin = np.empty(n, np.int64)
    used = families = left = 0
    for i in range(n):
        left += size[i] > 0
        if size[i] > 1:
            begin[i] = used
            used += size[i]
            families += 1
    first[0] = 0
    family = survivor = 0
    for i in range(n):
        own = owner[i]
        if size[own] > 1:
            members[begin[own]] = nodes[i]
            begin[own] += 1
        if own == i:
            survivors[survivor] = nodes[i]
            if size[i] > 1:
                survivors[survivor] = made[family] = row[i]
                family += 1
                first[family] = first[family - 1] + size[i]
            survivor += 1
    return used, families, left
