"""Select the pairs of nodes that the quality builder merges, and merge each into a node that covers the union of both.

The quality builder's node row is one cache line: 16 float32 for each node of the growing tree. Lengths are in a unit
near the median scale, with the origin in the middle of the scene, so that float32 holds their squares and products.

Pairs are the cheapest of neighbours along a curve: `nodes` (n,) are indices of rows in the order of the curve;
`partner` and the costs are (n,), too.

Coverage is opacity integrated over the plane of projection. The coverage of a union is the sum of the two coverages
less that of the overlap, and the same holds for first and second moments. A part of the overlap of flat nodes, which
lie in layers, is kept, so that neighbours in a layer overlap, too. The moments of the overlap are those of the product
of the two Gaussians in space. The overlap, and the difference between the pictures of a merged node and of its two
nodes, are integrals of products of Gaussians on the planes of the three axes.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...system.fast_math import log2
from ...system.jit import f4, i4, i8, kernel, out, u4
from .geometry import NEEDLE, ellipsoid_area, is_needle, profile_of, size_factor

f32 = np.float32

#: First columns of a node row: centre, covariance of the profile (xx yy zz xy xz yz), colour, logarithm of the
#: covariance's determinant, coverage (opacity * area), density of the coverage (see `geometry.py`), and the weight of
#: the colour, which is the sum of the leaves' weights; then the number of columns.
CENTER, COVARIANCE, COLOR, LOG_DET, COVERED, DENSITY, WEIGHT, WIDTH = 0, 3, 9, 12, 13, 14, 15, 16

#: Columns that the cost reads: all but the last two, side by side for a whole block.
LANES = 14

#: Nodes in a block: its columns, 30 KB, stay in the first-level cache. Results do not depend on it.
BLOCK = 512

#: Costs are computed for a multiple of this number of pairs, so that loops have whole vectors: a pair in the rest of a
#: loop takes as long as a vector. The surplus results are not used. Chosen.
SIDE_BY_SIDE = 16

#: Cost of a squared colour difference of 1 (channels are 0..1), in nats of shape. Between 3 and 10 it matters little
#: (benchmarks/notes/quality-builder.md).
COLOR_COST = f32(4)

#: Least variance along an axis in the cost, as a share of the trace: flatter splats are not cheaper to merge. Chosen.
FLATTEST = f32(1e-5)

#: Least trace of a covariance in the cost, units squared, so that a node without extent has a logarithm. Chosen.
LEAST_TRACE = f32(1e-30)

LN2 = f32(math.log(2))

#: The cost of a pair that must not be merged.
NEVER = f32(np.inf)


@kernel(inline=True)
def log_det(xx, yy, zz, xy, xz, yz):
    """Natural logarithm of a covariance's determinant, float32, from its pivots, none below FLATTEST of the trace."""
    trace = xx + yy + zz + LEAST_TRACE
    least = FLATTEST * trace
    inverse = f32(1) / trace
    first = max(xx, least)
    upper = xy / first
    second = max(yy - upper * xy, least)
    rest = yz - upper * xz
    third = max(zz - xz * xz / first - rest * rest / second, least)
    product = (first * inverse) * (second * inverse) * (third * inverse)
    return (f32(3) * log2(trace) + log2(product)) * LN2


@kernel()
def pair_costs(lanes, first, step, count, largest, cost):
    """Fill the costs of merging node first + i with the node `step` places on: Runnalls' bound on the divergence.

    With coverages w as weights, and covariances P, it is ((w_i + w_j) ln|P_ij| - w_i ln|P_i| - w_j ln|P_j|) / 2
    (Runnalls 2007), plus COLOR_COST times Ward's variance of the colours. Branch-free, and columns are contiguous, so
    that LLVM vectorizes over pairs; with a slice of `lanes` instead of `first` it does not, and takes four times as
    long. Indices are unsigned: signed ones might count from the end, so that LLVM would load the second nodes one by
    one.

    Args:
        lanes: (LANES, at least first + count + step) columns of node rows, C-contiguous.
        largest: units squared; a pair is never merged if its covariance has a larger trace.
        cost: (at least count,) filled.
    """
    start, distance = np.uint64(first), np.uint64(step)
    for i in range(count):
        p = start + np.uint64(i)
        q = p + distance
        wi, wj = lanes[13, p], lanes[13, q]
        inverse = f32(1) / (wi + wj)
        a, b = wi * inverse, wj * inverse
        ab = a * b
        dx, dy, dz = lanes[0, q] - lanes[0, p], lanes[1, q] - lanes[1, p], lanes[2, q] - lanes[2, p]
        mxx = a * lanes[3, p] + b * lanes[3, q] + ab * dx * dx
        myy = a * lanes[4, p] + b * lanes[4, q] + ab * dy * dy
        mzz = a * lanes[5, p] + b * lanes[5, q] + ab * dz * dz
        mxy = a * lanes[6, p] + b * lanes[6, q] + ab * dx * dy
        mxz = a * lanes[7, p] + b * lanes[7, q] + ab * dx * dz
        myz = a * lanes[8, p] + b * lanes[8, q] + ab * dy * dz
        joint = log_det(mxx, myy, mzz, mxy, mxz, myz)
        dr, dg, db = lanes[9, q] - lanes[9, p], lanes[10, q] - lanes[10, p], lanes[11, q] - lanes[11, p]
        shape = f32(0.5) * (wi * (joint - lanes[12, p]) + wj * (joint - lanes[12, q]))
        total = shape + COLOR_COST * (wi * b) * (dr * dr + dg * dg + db * db)
        cost[i] = total if mxx + myy + mzz <= largest else NEVER


@kernel(i8, f4[:, :], u4[:], i8, f4, out(i4[:]), out(f4[:]), ranges=True)
def find_partners(start, stop, rows, nodes, window, largest, partner, lowest):
    """Fill `partner`, an index into `nodes` or -1, at most `window` places away, and its cost."""
    lanes = np.empty((LANES, BLOCK + 2 * window + SIDE_BY_SIDE), np.float32)
    cost = np.empty(BLOCK + window + SIDE_BY_SIDE, np.float32)
    best, at = np.empty(BLOCK + 2 * window, np.float32), np.empty(BLOCK + 2 * window, np.int32)
    for begin in range(start, stop, BLOCK):
        end = min(stop, begin + BLOCK)
        low, high = max(0, begin - window), min(len(nodes), end + window)
        best[:], at[:] = NEVER, -1
        for i in range(low, high):
            for column in range(LANES):
                lanes[column, i - low] = rows[nodes[i], column]
        for step in range(1, window + 1):
            # Pairs with at least one node in the block; the first node may lie before it.
            first = max(low, begin - step) - low
            count = min(end - low, high - low - step) - first
            if count <= 0:
                continue
            pair_costs(lanes, first, step, -(-count // SIDE_BY_SIDE) * SIDE_BY_SIDE, largest, cost)
            keep_cheaper(cost, count, best[first:], at[first:], low + first, low + first + step)
            keep_cheaper(cost, count, best[first + step :], at[first + step :], low + first + step, low + first)
        for i in range(begin, end):
            partner[i], lowest[i] = at[i - low], best[i - low]


@kernel()
def keep_cheaper(cost, count, best, at, here, there):
    """Update the best costs and partners of nodes here + i by the costs of the pairs (here + i, there + i).

    Among equal costs, the partner wins whose index differs from the node's in the lowest bits. This relation is
    symmetric, so among many equal splats half choose each other.
    """
    for i in range(count):
        own, new = np.int32(here + i), np.int32(there + i)
        lower = (cost[i] < best[i]) | ((cost[i] == best[i]) & ((own ^ new) < (own ^ at[i])))
        best[i] = cost[i] if lower else best[i]
        at[i] = new if lower else at[i]


@kernel(inline=True)
def is_mutual(i, partner, cost, limit):
    """Return whether a node and its partner chose each other, at no more than a cost."""
    j = partner[i]
    return (j >= 0) & (partner[j] == i) & (cost[i] <= limit)


@kernel(i8, i4[:], f4[:], f4, out(i8[:, :]), ranges=True)
def count_pairs(start, stop, partner, cost, limit, counts):
    """Count the pairs of nodes that are each other's cheapest partner, at a cost of at most `limit`.

    `counts` (blocks, 2) gets the nodes of each block that are the first, and the second, of a pair.
    """
    n, blocks = len(partner), len(counts)
    for block in range(start, stop):
        first = second = 0
        for i in range(n * block // blocks, n * (block + 1) // blocks):
            merges = is_mutual(i, partner, cost, limit)
            first += merges & (partner[i] > i)
            second += merges & (partner[i] < i)
        counts[block, 0], counts[block, 1] = first, second


@kernel(i8, u4[:], i4[:], f4[:], f4, i8, i8[:, :], out(u4[:, :]), out(u4[:]), ranges=True)
def list_pairs(start, stop, nodes, partner, cost, limit, made, before, pairs, rest):
    """List the pairs of `count_pairs`, and the nodes after they have merged.

    Args:
        made: number of the merged node of the first pair; the following pairs count up.
        before: (blocks, 2) sums of `counts` of the blocks before.
        pairs: (P, 2) filled.
        rest: (n - P,) filled with the nodes in their order; a merged node replaces the first of its pair.
    """
    n, blocks = len(nodes), len(before)
    for block in range(start, stop):
        begin = n * block // blocks
        found, left = before[block, 0], begin - before[block, 1]
        for i in range(begin, n * (block + 1) // blocks):
            j = partner[i]
            merges = is_mutual(i, partner, cost, limit)
            if merges & (j < i):
                continue
            rest[left] = made + found if merges else nodes[i]
            left += 1
            if merges:
                pairs[found, 0], pairs[found, 1] = nodes[i], nodes[j]
                found += 1


#: Least semi-axis of a merged node, in the builder's unit, so that it has an area. Chosen.
SHORTEST = 1e-20

#: Largest difference of a sphere's eigenvalues, as a share of their mean, by the rounding of float64. Chosen.
SPHERICAL = 1e-12

#: Added to the diagonal of P + Q, so that flat splats in one plane can be inverted: a share of its trace, which widens
#: an axis to a thousandth of the longest; and variance in units squared, where both have no extent. Chosen.
RIDGE, LEAST_RIDGE = 1e-6, 1e-30

#: Least trace of a union's covariance, as a share of the trace without subtracting the overlap; with less, the product
#: in space is not at the overlap (docs/decisions/11-quality-builder.md).
LEAST_UNION = 0.5

#: Overlap that a node in a layer keeps, as a share of its pair's coverage. Without it, nodes of a coarse cut only just
#: touch, and the background shows between them. Measured (benchmarks/notes/quality-builder.md).
CLOSING = 0.12

#: Overlaps, as shares of coverage, between which the kept part falls to nothing: splats with much overlap leave no
#: cracks. Two equal opaque splats at one place overlap by a quarter. Measured, too.
LOOSE, DENSE = 0.15, 0.19

#: Ratios of a node's shortest axis to its second: up to FLAT it is in a layer, from ROUND on it is in none. Chosen.
FLAT, ROUND = 0.1, 0.35

#: Weight of opacity relative to each colour channel in the error of a picture, which may have any background. Chosen.
ALPHA_WEIGHT = 1.0

#: Exponent from which on two Gaussians on a plane do not overlap: e^-30 is 1e-13, and the precision of coverage, a
#: float32, is 6e-8. Chosen.
MAX_EXPONENT = 30


@kernel()
def semi_axes(xx, yy, zz, xy, xz, yz):
    """Return square roots of a covariance's eigenvalues, the largest first (Smith 1961), in float64."""
    mean = (xx + yy + zz) / 3
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = math.sqrt((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    if not spread > SPHERICAL * mean:
        root = max(math.sqrt(max(mean, 0.0)), SHORTEST)
        return root, root, root
    half_det = (a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)) / (2 * spread**3)
    angle = math.acos(min(max(half_det, -1.0), 1.0)) / 3
    large = mean + 2 * spread * math.cos(angle)
    small = mean + 2 * spread * math.cos(angle + 2 * math.pi / 3)
    middle = 3 * mean - large - small
    return (
        max(math.sqrt(max(large, 0.0)), SHORTEST),
        max(math.sqrt(max(middle, 0.0)), SHORTEST),
        max(math.sqrt(max(small, 0.0)), SHORTEST),
    )


@kernel()
def merge_pair(a, b, planes, merged):
    """Fill the centre, covariance and coverage of the union of two nodes; return their overlap as a share of coverage.

    The product of two Gaussians with covariances P and Q at 0 and d is a Gaussian with covariance P - P (P + Q)^-1 P at
    P (P + Q)^-1 d. The product of needles side by side, or of flat splats nearly in one plane, may be far away from
    both, where their lines or planes cross, while they overlap in projection only. Subtracting its moments would make
    the union's variance too small, or negative: they are left out.

    Args:
        a, b: node rows.
        planes: `overlaps` of the two.
        merged: the row to fill.
    """
    total = np.float64(a[COVERED]) + np.float64(b[COVERED])
    share, other = np.float64(a[COVERED]) / total, np.float64(b[COVERED]) / total
    overlap = hidden = overlap_share(planes, a[DENSITY], b[DENSITY])
    x, y, z = center_of(a)
    u, v, w = center_of(b)
    dx, dy, dz = u - x, v - y, w - z
    pxx, pyy, pzz, pxy, pxz, pyz = covariance_of(a)
    qxx, qyy, qzz, qxy, qxz, qyz = covariance_of(b)
    trace = pxx + pyy + pzz + qxx + qyy + qzz
    ridge = RIDGE * trace + LEAST_RIDGE
    # (P + Q)^-1 is its adjugate over its determinant, and the gain P (P + Q)^-1.
    xx, yy, zz = pxx + qxx + ridge, pyy + qyy + ridge, pzz + qzz + ridge
    xy, xz, yz = pxy + qxy, pxz + qxz, pyz + qyz
    ixx, ixy, ixz = yy * zz - yz * yz, yz * xz - zz * xy, xy * yz - xz * yy
    inverse = ixx, zz * xx - xz * xz, xx * yy - xy * xy, ixy, ixz, xz * xy - xx * yz
    det = xx * ixx + xy * ixy + xz * ixz
    gx = row_times(pxx, pxy, pxz, inverse, det)
    gy = row_times(pxy, pyy, pyz, inverse, det)
    gz = row_times(pxz, pyz, pzz, inverse, det)
    # The product's centre, from the first node's; moments are about the mean of the two, so that nothing cancels.
    x, y, z = dot(gx, dx, dy, dz), dot(gy, dx, dy, dz), dot(gz, dx, dy, dz)
    from_a = x * x + y * y + z * z
    from_b = (x - dx) * (x - dx) + (y - dy) * (y - dy) + (z - dz) * (z - dz)
    reach = dx * dx + dy * dy + dz * dz
    x, y, z = x - other * dx, y - other * dy, z - other * dz
    mixed = share * other
    mxx, mxy = share * pxx + other * qxx + mixed * dx * dx, share * pxy + other * qxy + mixed * dx * dy
    myy, mxz = share * pyy + other * qyy + mixed * dy * dy, share * pxz + other * qxz + mixed * dx * dz
    mzz, myz = share * pzz + other * qzz + mixed * dz * dz, share * pyz + other * qyz + mixed * dy * dz
    merged[COVERED] = total * (1 - hidden)
    if hidden > 0 and max(from_a, from_b) <= reach + trace:
        uxx = without(mxx, pxx - dot(gx, pxx, pxy, pxz), hidden, x, x)
        uyy = without(myy, pyy - dot(gy, pxy, pyy, pyz), hidden, y, y)
        uzz = without(mzz, pzz - dot(gz, pxz, pyz, pzz), hidden, z, z)
        if uxx >= 0 and uyy >= 0 and uzz >= 0 and uxx + uyy + uzz >= LEAST_UNION * (mxx + myy + mzz):
            mxx, myy, mzz = uxx, uyy, uzz
            mxy = without(mxy, pxy - dot(gx, pxy, pyy, pyz), hidden, x, y)
            mxz = without(mxz, pxz - dot(gx, pxz, pyz, pzz), hidden, x, z)
            myz = without(myz, pyz - dot(gy, pxz, pyz, pzz), hidden, y, z)
        else:
            hidden = 0.0
    else:
        hidden = 0.0
    merged[COVARIANCE], merged[COVARIANCE + 1], merged[COVARIANCE + 2] = mxx, myy, mzz
    merged[COVARIANCE + 3], merged[COVARIANCE + 4], merged[COVARIANCE + 5] = mxy, mxz, myz
    merged[CENTER] = a[CENTER] + (other * dx - hidden * x / (1 - hidden))
    merged[CENTER + 1] = a[CENTER + 1] + (other * dy - hidden * y / (1 - hidden))
    merged[CENTER + 2] = a[CENTER + 2] + (other * dz - hidden * z / (1 - hidden))
    return overlap


@kernel(inline=True)
def closing(overlap, large, middle, small):
    """Return the part of an overlap, as a share of the pair's coverage, that a merged node keeps to close a layer.

    `large`, `middle` and `small` are the merged node's semi-axes; needles are in no layer.
    """
    flat = (ROUND - small / middle) / (ROUND - FLAT) if middle >= NEEDLE * large else 0.0
    loose = (DENSE - overlap) / (DENSE - LOOSE)
    return min(CLOSING * min(max(flat, 0.0), 1.0) * min(max(loose, 0.0), 1.0), overlap)


@kernel(inline=True)
def dot(row, x, y, z):
    """Return the scalar product of a tuple and x, y, z."""
    return row[0] * x + row[1] * y + row[2] * z


@kernel(inline=True)
def row_times(x, y, z, symmetric, divisor):
    """Return the row x, y, z times a symmetric matrix, xx yy zz xy xz yz, divided by a number."""
    xx, yy, zz, xy, xz, yz = symmetric
    return (
        (x * xx + y * xy + z * xz) / divisor,
        (x * xy + y * yy + z * yz) / divisor,
        (x * xz + y * yz + z * zz) / divisor,
    )


@kernel(inline=True)
def without(moment, of_product, hidden, first, second):
    """Return a second moment of two nodes, about their mean, less that of their overlap.

    Without the overlap, the mean moves by -hidden / (1 - hidden) times the offset of the product's centre. `of_product`
    is the covariance of the product of the Gaussians, `hidden` the overlap's coverage as a share of the sum of both,
    `first` and `second` are coordinates of the product's centre, from the mean of the two.
    """
    left = 1 - hidden
    return (moment - hidden * of_product) / left - hidden / (left * left) * first * second


@kernel(i8, u4[:, :], i8, i8, out(f4[:, :]), out(u4[:]), out(u4[:]), out(u4[:, :]), out(f4[:]), out(f4[:]), ranges=True)
def merge_pairs(start, stop, pairs, made, leaves, rows, row, spare, children, size, error):
    """Merge each pair of nodes into one, which takes over the spare row in the tree of the first.

    Args:
        pairs: (P, 2) nodes.
        made: number of the merged node of the first pair; the following pairs count up.
        leaves: number of leaves, which have the first numbers; arrays of merged nodes leave them out.
        rows: (leaves, WIDTH) node rows; that of a leaf is its own.
        row: (leaves,) filled with the rows of merged nodes.
        spare: (leaves,) filled with an unused row in the tree of each merged node.
        children: (leaves, 2) filled.
        size: (2 * leaves,) of all nodes, filled with the feature size of the splat that will be drawn, units.
        error: (leaves,) filled with `picture_error`.
    """
    merged = np.empty(WIDTH, np.float32)  # its row may be that of its first node
    for pair in range(start, stop):
        first, second, node = pairs[pair, 0], pairs[pair, 1], made + pair - leaves
        a = rows[first if first < leaves else row[first - leaves]]
        b = rows[second if second < leaves else row[second - leaves]]
        planes = overlaps(a, b)
        overlap = merge_pair(a, b, planes, merged)
        weight = np.float64(a[WEIGHT]) + np.float64(b[WEIGHT])
        for channel in range(3):
            merged[COLOR + channel] = (a[WEIGHT] * a[COLOR + channel] + b[WEIGHT] * b[COLOR + channel]) / weight
        merged[WEIGHT] = weight
        xx, yy, zz = merged[COVARIANCE], merged[COVARIANCE + 1], merged[COVARIANCE + 2]
        xy, xz, yz = merged[COVARIANCE + 3], merged[COVARIANCE + 4], merged[COVARIANCE + 5]
        merged[LOG_DET] = log_det(xx, yy, zz, xy, xz, yz)
        large, middle, small = semi_axes(
            np.float64(xx), np.float64(yy), np.float64(zz), np.float64(xy), np.float64(xz), np.float64(yz)
        )
        covered = np.float64(a[COVERED]) + np.float64(b[COVERED])
        merged[COVERED] += covered * closing(overlap, large, middle, small)
        merged[DENSITY] = np.float64(merged[COVERED]) / ellipsoid_area(large, middle, small)
        needle = is_needle(large * large, middle * middle, small * small)
        opacity, spread = profile_of(np.float64(merged[DENSITY]), needle)
        mean = (large + middle + small) / (3 * math.sqrt(spread))
        size[made + pair] = 2 * mean * size_factor(opacity)
        error[node] = picture_error(a, b, merged, planes)
        children[node, 0], children[node, 1] = first, second
        row[node] = first if first < leaves else spare[first - leaves]
        spare[node] = second if second < leaves else spare[second - leaves]
        for column in range(WIDTH):
            rows[row[node], column] = merged[column]


class OnPlane(NamedTuple):
    """Integrals over a plane / (2 pi) of two projected Gaussians of height 1, and of their product, float64."""

    both: Any  # of the product
    first: Any
    second: Any


@kernel(inline=True)
def overlap_on_plane(axx, ayy, axy, bxx, byy, bxy, x, y):
    """Return `OnPlane` of two Gaussians with covariances a and b, the second at x, y from the first."""
    a_det, b_det = max(axx * ayy - axy * axy, 0.0), max(bxx * byy - bxy * bxy, 0.0)
    xx, yy, xy = axx + bxx, ayy + byy, axy + bxy
    det = xx * yy - xy * xy
    both = 0.0
    if det > 0:
        power = 0.5 * (yy * x * x - 2 * xy * x * y + xx * y * y) / det
        if power < MAX_EXPONENT:
            both = math.sqrt(a_det * b_det / det) * math.exp(-power)
    return OnPlane(both, math.sqrt(a_det), math.sqrt(b_det))


@kernel(inline=True)
def center_of(row):
    """Return the centre of a node row, in float64."""
    return np.float64(row[CENTER]), np.float64(row[CENTER + 1]), np.float64(row[CENTER + 2])


@kernel(inline=True)
def covariance_of(row):
    """Return the covariance of a node row, xx yy zz xy xz yz, in float64."""
    xx, yy, zz = np.float64(row[COVARIANCE]), np.float64(row[COVARIANCE + 1]), np.float64(row[COVARIANCE + 2])
    xy, xz, yz = np.float64(row[COVARIANCE + 3]), np.float64(row[COVARIANCE + 4]), np.float64(row[COVARIANCE + 5])
    return xx, yy, zz, xy, xz, yz


@kernel()
def overlaps(a, b):
    """Return `OnPlane` of two node rows on the planes xy, xz and yz."""
    x, y, z = center_of(a)
    u, v, w = center_of(b)
    axx, ayy, azz, axy, axz, ayz = covariance_of(a)
    bxx, byy, bzz, bxy, bxz, byz = covariance_of(b)
    return (
        overlap_on_plane(axx, ayy, axy, bxx, byy, bxy, u - x, v - y),
        overlap_on_plane(axx, azz, axz, bxx, bzz, bxz, u - x, w - z),
        overlap_on_plane(ayy, azz, ayz, byy, bzz, byz, v - y, w - z),
    )


@kernel()
def overlap_share(planes, density_a, density_b):
    """Return the coverage of two nodes' overlap, as a share of the sum of their coverages; over the three `planes`."""
    shared = alone = 0.0
    density_a, density_b = np.float64(density_a), np.float64(density_b)
    for both, area_a, area_b in planes:
        area_a, area_b = density_a * area_a, density_b * area_b
        shared += min(density_a * density_b * both, min(area_a, area_b))
        alone += area_a + area_b
    return shared / alone if alone > 0 else 0.0


@kernel()
def picture_error(a, b, merged, planes):
    """Return the squared difference between the picture of a merged node and that of its two nodes.

    The sum over red, green, blue and opacity, and over the three planes; `planes` are `overlaps` of a and b.
    """
    high_a, high_b, high = min(a[DENSITY], 1.0), min(b[DENSITY], 1.0), min(merged[DENSITY], 1.0)
    aa = bb = mm = ab = am = bm = 0.0
    with_a, with_b = overlaps(a, merged), overlaps(b, merged)
    for plane in range(3):
        both, area_a, area_b = planes[plane]
        ab += both
        am += with_a[plane].both
        bm += with_b[plane].both
        aa, bb, mm = aa + area_a / 2, bb + area_b / 2, mm + with_a[plane].second / 2
    total = 0.0
    for channel in range(4):
        if channel < 3:
            p, q, r = high_a * a[COLOR + channel], high_b * b[COLOR + channel], high * merged[COLOR + channel]
        else:
            root = math.sqrt(ALPHA_WEIGHT)
            p, q, r = high_a * root, high_b * root, high * root
        total += p * p * aa + q * q * bb + r * r * mm + 2 * (p * q * ab - p * r * am - q * r * bm)
    return max(total, 0.0)
