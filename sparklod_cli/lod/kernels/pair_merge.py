"""Merges pairs of nodes into nodes that cover the union of both.

Coverage is opacity integrated over the plane of projection. The coverage of a union is the sum of the two coverages
less that of the overlap, and the same holds for first and second moments. The overlap's coverage is the integral of a
product of Gaussians, on the planes of the three axes; its moments are those of the product in space.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...support.jit import kernel, prange
from .geometry import ellipsoid_area
from .pair_cost import CENTER, COLOR, COVARIANCE, COVERED, DENSITY, LOG_DET, WEIGHT, WIDTH, log_det
from .profile import is_needle, profile_of, size_factor

#: Weight of opacity relative to each colour channel in the error of a picture, which may have any background. Chosen.
ALPHA_WEIGHT = 1.0

#: Row and column of the elements xx yy zz xy xz yz.
ROW, COLUMN = (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)

#: For the planes xy, xz and yz: indices of the two variances and the covariance among xx yy zz xy xz yz; the two axes.
PLANES = ((0, 1, 3, 0, 1), (0, 2, 4, 0, 2), (1, 2, 5, 1, 2))

#: Least semi-axis of a merged node, in the builder's unit, so that it has an area. Chosen.
SHORTEST = 1e-20

#: A covariance whose eigenvalues differ by less, as a share of their mean, is a sphere: the difference is float64's
#: rounding. Chosen.
SPHERICAL = 1e-12

#: Two Gaussians do not overlap on a plane from this exponent on: e^-30 is 1e-13, and coverage is stored as a float32,
#: whose precision is 6e-8. Chosen.
MAX_EXPONENT = 30

#: Added to the diagonal of P + Q, so that flat splats in one plane can be inverted: a share of its trace, which widens
#: an axis to a thousandth of the longest; and variance in units squared, where both have no extent. Chosen.
RIDGE, LEAST_RIDGE = 1e-6, 1e-30

#: Least trace of a union's covariance, as a share of that of its two nodes without the overlap's part; with less, the
#: product in space is not where they overlap (docs/decisions/2026-11-21-sizes-of-parents.md).
LEAST_UNION = 0.5


class Pair(NamedTuple):
    """Two nodes that are merged, in float64, and the product of their Gaussians.

    Attributes:
        share, other: each node's share of the sum of their coverages.
        offset: (3,) from the first centre to the second.
        middle: (3,) from the mean of the two to the centre of their product.
        p, q: (3, 3) covariances P and Q. gain: (3, 3) P (P + Q)^-1.
    """

    share: Any
    other: Any
    offset: Any
    middle: Any
    p: Any
    q: Any
    gain: Any


@kernel()
def semi_axes(xx, yy, zz, xy, xz, yz):
    """Square roots of a covariance's eigenvalues, the largest first (Smith 1961), in float64."""
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


@kernel(inline=True)
def overlap_on_plane(a, b, plane):
    """Integrals over a plane, divided by 2 pi, of Gaussians of height 1 that are projected onto it.

    Args:
        a, b: node rows.
        plane: one of PLANES.

    Returns:
        of the product of the two, of the first, and of the second.
    """
    first, second, mixed, across, along = plane
    axx, ayy, axy = (
        np.float64(a[COVARIANCE + first]),
        np.float64(a[COVARIANCE + second]),
        np.float64(a[COVARIANCE + mixed]),
    )
    bxx, byy, bxy = (
        np.float64(b[COVARIANCE + first]),
        np.float64(b[COVARIANCE + second]),
        np.float64(b[COVARIANCE + mixed]),
    )
    a_det, b_det = max(axx * ayy - axy * axy, 0.0), max(bxx * byy - bxy * bxy, 0.0)
    xx, yy, xy = axx + bxx, ayy + byy, axy + bxy
    det = xx * yy - xy * xy
    x, y = np.float64(b[CENTER + across]) - a[CENTER + across], np.float64(b[CENTER + along]) - a[CENTER + along]
    both = 0.0
    if det > 0:
        power = 0.5 * (yy * x * x - 2 * xy * x * y + xx * y * y) / det
        if power < MAX_EXPONENT:
            both = math.sqrt(a_det * b_det / det) * math.exp(-power)
    return both, math.sqrt(a_det), math.sqrt(b_det)


@kernel()
def overlap_share(a, b):
    """The coverage of two nodes' overlap, as a share of the sum of their coverages; over the three planes."""
    shared = alone = 0.0
    density_a, density_b = np.float64(a[DENSITY]), np.float64(b[DENSITY])
    for plane in PLANES:
        both, area_a, area_b = overlap_on_plane(a, b, plane)
        area_a, area_b = density_a * area_a, density_b * area_b
        shared += min(density_a * density_b * both, min(area_a, area_b))
        alone += area_a + area_b
    return shared / alone if alone > 0 else 0.0


@kernel()
def picture_error(a, b, merged):
    """Squared difference between the picture of a merged node and that of its two nodes.

    It is summed over red, green, blue and opacity, and over the three planes.

    Args:
        a, b, merged: node rows.
    """
    high_a, high_b, high = min(a[DENSITY], 1.0), min(b[DENSITY], 1.0), min(merged[DENSITY], 1.0)
    aa = bb = mm = ab = am = bm = 0.0
    for plane in PLANES:
        both, area_a, area_b = overlap_on_plane(a, b, plane)
        ab += both
        both, _, area = overlap_on_plane(a, merged, plane)
        am += both
        both, _, _ = overlap_on_plane(b, merged, plane)
        bm += both
        aa, bb, mm = aa + area_a / 2, bb + area_b / 2, mm + area / 2
    total = 0.0
    for channel in range(4):
        if channel < 3:
            p, q, r = high_a * a[COLOR + channel], high_b * b[COLOR + channel], high * merged[COLOR + channel]
        else:
            root = math.sqrt(ALPHA_WEIGHT)
            p, q, r = high_a * root, high_b * root, high * root
        total += p * p * aa + q * q * bb + r * r * mm + 2 * (p * q * ab - p * r * am - q * r * bm)
    return max(total, 0.0)


@kernel()
def merge_pair(a, b, merged):
    """Fills the centre, covariance and coverage of the union of two nodes.

    The product of two Gaussians with covariances P and Q at 0 and d is a Gaussian with covariance P - P (P + Q)^-1 P at
    P (P + Q)^-1 d. That of needles side by side, or of flat splats nearly in one plane, may be far away from both,
    where their lines or planes cross; they overlap in projection only. The overlap is then not there, and subtracting
    its moments would make the union's variance too small, or negative: they are left out.

    Args:
        a, b: node rows.
        merged: the row to fill.
    """
    total = np.float64(a[COVERED]) + np.float64(b[COVERED])
    share, other = np.float64(a[COVERED]) / total, np.float64(b[COVERED]) / total
    hidden = overlap_share(a, b)
    offset, p, q, joint = np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        offset[i] = np.float64(b[CENTER + i]) - np.float64(a[CENTER + i])
    fill_covariance_matrix(a, p)
    fill_covariance_matrix(b, q)
    trace = p[0, 0] + p[1, 1] + p[2, 2] + q[0, 0] + q[1, 1] + q[2, 2]
    for i in range(3):
        for j in range(3):
            joint[i, j] = p[i, j] + q[i, j]
        joint[i, i] += RIDGE * trace + LEAST_RIDGE
    # gain = P (P + Q)^-1
    gain, inverse = np.empty((3, 3)), np.empty((3, 3))
    det = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for m in range(3):
            n, o = (m + 1) % 3, (m + 2) % 3
            inverse[m, i] = joint[j, n] * joint[k, o] - joint[j, o] * joint[k, n]
        det += joint[i, 0] * inverse[0, i]
    for i in range(3):
        for j in range(3):
            gain[i, j] = (p[i, 0] * inverse[0, j] + p[i, 1] * inverse[1, j] + p[i, 2] * inverse[2, j]) / det
    merged[COVERED] = total * (1 - hidden)
    # The product's centre from the mean of the two; moments are about that mean, so that nothing cancels.
    middle = np.empty(3)
    from_a = from_b = reach = 0.0
    for i in range(3):
        of_a = gain[i, 0] * offset[0] + gain[i, 1] * offset[1] + gain[i, 2] * offset[2]
        middle[i] = of_a - other * offset[i]
        from_a += of_a * of_a
        from_b += (of_a - offset[i]) * (of_a - offset[i])
        reach += offset[i] * offset[i]
    pair = Pair(share, other, offset, middle, p, q, gain)
    if not max(from_a, from_b) <= reach + trace or not fill_covariance(pair, hidden, merged):
        fill_covariance(pair, 0.0, merged)
        hidden = 0.0
    for i in range(3):
        merged[CENTER + i] = a[CENTER + i] + (other * offset[i] - hidden * middle[i] / (1 - hidden))


@kernel()
def fill_covariance(pair, hidden, merged):
    """Fills the covariance of a union: that of its two nodes, less that of their overlap.

    Args:
        pair: `Pair`.
        hidden: the overlap's coverage, as a share of the sum of the two.
        merged: the node row whose covariance is filled.

    Returns:
        whether it is a covariance: no variance is negative, and the trace is at least LEAST_UNION of the two nodes'.
    """
    share, other, offset, middle, p, q, gain = pair
    left = 1 - hidden
    of_two = trace = 0.0
    sound = True
    for element in range(6):
        i, j = ROW[element], COLUMN[element]
        plain = share * p[i, j] + other * q[i, j] + share * other * offset[i] * offset[j]
        united = plain
        if hidden > 0:
            of_product = p[i, j] - (gain[i, 0] * p[0, j] + gain[i, 1] * p[1, j] + gain[i, 2] * p[2, j])
            # Without the product's part the mean moves by -hidden / left * middle.
            united = (plain - hidden * of_product) / left - hidden / (left * left) * middle[i] * middle[j]
        merged[COVARIANCE + element] = united
        if element < 3:
            of_two += plain
            trace += united
            sound = sound and united >= 0
    return sound and trace >= LEAST_UNION * of_two


@kernel(inline=True)
def fill_covariance_matrix(row, matrix):
    """Fills a (3, 3) float64 matrix with the covariance of a node row."""
    matrix[0, 0], matrix[1, 1], matrix[2, 2] = row[COVARIANCE], row[COVARIANCE + 1], row[COVARIANCE + 2]
    matrix[0, 1] = matrix[1, 0] = row[COVARIANCE + 3]
    matrix[0, 2] = matrix[2, 0] = row[COVARIANCE + 4]
    matrix[1, 2] = matrix[2, 1] = row[COVARIANCE + 5]


@kernel(parallel=True)
def merge_pairs(pairs, made, leaves, rows, row, spare, children, size, error):
    """Merges each pair of nodes into one, which takes over the row that is to spare in the tree of the first.

    Args:
        pairs: (P, 2) uint32 nodes.
        made: the first node to fill; the next pair's is one more.
        leaves: number of leaves, the nodes below it; `row` and the rest are of merged nodes.
        rows: (leaves, WIDTH) node rows, see `pair_cost.py`; that of a leaf is its own.
        row: (leaves,) uint32, filled with their rows.
        spare: (leaves,) uint32, filled with a row that is to spare in their trees.
        children: (leaves, 2) uint32, filled.
        size: (2 * leaves,) float32, of all nodes, filled with the feature size of the splat that will be drawn, in
            units.
        error: (leaves,) float32, filled with `picture_error`.
    """
    for pair in prange(len(pairs)):
        first, second, node = pairs[pair, 0], pairs[pair, 1], made + pair - leaves
        a = rows[first if first < leaves else row[first - leaves]]
        b = rows[second if second < leaves else row[second - leaves]]
        merged = np.empty(WIDTH, np.float32)  # its row may be that of `a`
        merge_pair(a, b, merged)
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
        merged[DENSITY] = np.float64(merged[COVERED]) / ellipsoid_area(large, middle, small)
        needle = is_needle(large * large, middle * middle, small * small)
        opacity, spread = profile_of(np.float64(merged[DENSITY]), needle)
        mean = (large + middle + small) / (3 * math.sqrt(spread))
        size[made + pair] = 2 * mean * size_factor(opacity)
        error[node] = picture_error(a, b, merged)
        children[node, 0], children[node, 1] = first, second
        row[node] = first if first < leaves else spare[first - leaves]
        spare[node] = second if second < leaves else spare[second - leaves]
        for column in range(WIDTH):
            rows[row[node], column] = merged[column]
