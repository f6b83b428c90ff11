"""Merging two nodes into one that covers what they cover together.

What the two cover (coverage: opacity summed over the plane of projection) is what each covers, less what both do. The
same holds for its first and second moments. How much both cover is a product of Gaussians, on the planes of the three
axes; the moments of it are those of the product in space.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from ...support.jit import kernel
from .geometry import ellipsoid_area
from .pair_cost import CENTER, COLOR, COVARIANCE, COVERED, DENSITY, LOG_DET, WEIGHT, log_det
from .profile import profile_of, size_factor

#: How much opacity counts in the error of a picture beside each channel of colour: on black and on white.
ALPHA = 1.0

#: Rows and columns of a matrix for xx yy zz xy xz yz.
ROW, COLUMN = (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)

#: Places among xx yy zz xy xz yz, for the planes xy, xz and yz: first, second, mixed; and their axes.
PLANES = ((0, 1, 3, 0, 1), (0, 2, 4, 0, 2), (1, 2, 5, 1, 2))

#: No semi-axis is shorter, in the unit of the state.
SHORTEST = 1e-20


@kernel()
def semi_axes(xx, yy, zz, xy, xz, yz):
    """Square roots of the eigenvalues of a covariance, the largest first (Smith 1961, in float64)."""
    mean = (xx + yy + zz) / 3
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = math.sqrt((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    if not spread > 1e-12 * mean:
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
def product(a, b, plane):
    """Integral of the product of two Gaussians of height 1 over a plane, over 2 pi, and of each with itself.

    Args:
        a, b: rows of state. plane: one of PLANES.
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
        if power < 30:
            both = math.sqrt(a_det * b_det / det) * math.exp(-power)
    return both, math.sqrt(a_det), math.sqrt(b_det)


@kernel()
def shared_share(a, b):
    """The share of what two nodes cover by themselves that both cover."""
    shared = alone = 0.0
    density_a, density_b = np.float64(a[DENSITY]), np.float64(b[DENSITY])
    for plane in PLANES:
        both, area_a, area_b = product(a, b, plane)
        area_a, area_b = density_a * area_a, density_b * area_b
        shared += min(density_a * density_b * both, min(area_a, area_b))
        alone += area_a + area_b
    return shared / alone if alone > 0 else 0.0


@kernel()
def picture_error(a, b, merged):
    """How far a merged node's picture is from that of its two, squared: over red, green, blue and opacity, 3 planes."""
    high_a, high_b, high = min(a[DENSITY], 1.0), min(b[DENSITY], 1.0), min(merged[DENSITY], 1.0)
    aa = bb = mm = ab = am = bm = 0.0
    for plane in PLANES:
        both, area_a, area_b = product(a, b, plane)
        ab += both
        both, _, area = product(a, merged, plane)
        am += both
        both, _, _ = product(b, merged, plane)
        bm += both
        aa, bb, mm = aa + area_a / 2, bb + area_b / 2, mm + area / 2
    total = 0.0
    for channel in range(4):
        if channel < 3:
            p, q, r = high_a * a[COLOR + channel], high_b * b[COLOR + channel], high * merged[COLOR + channel]
        else:
            root = math.sqrt(ALPHA)
            p, q, r = high_a * root, high_b * root, high * root
        total += p * p * aa + q * q * bb + r * r * mm + 2 * (p * q * ab - p * r * am - q * r * bm)
    return max(total, 0.0)


@kernel()
def unite(a, b, merged):
    """Centre, covariance and coverage of what two nodes cover together.

    The product of two Gaussians with covariances P and Q at 0 and d is one with P - P (P + Q)^-1 P at P (P + Q)^-1 d.
    Needles side by side, or flat splats nearly in one plane, may have it far away from both, where the lines or planes
    that they lie in cross; they overlap in projection only. That is no place of what both cover: its moments are then
    left alone, or the variance of the two would come out too small, or negative.

    Args:
        a, b: rows of state. merged: the row to fill; but for its density.
    """
    total = np.float64(a[COVERED]) + np.float64(b[COVERED])
    share, other = np.float64(a[COVERED]) / total, np.float64(b[COVERED]) / total
    hidden = shared_share(a, b)
    offset, p, q, joint = np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        offset[i] = np.float64(b[CENTER + i]) - np.float64(a[CENTER + i])
    fill_matrix(a, p)
    fill_matrix(b, q)
    trace = p[0, 0] + p[1, 1] + p[2, 2] + q[0, 0] + q[1, 1] + q[2, 2]
    for i in range(3):
        for j in range(3):
            joint[i, j] = p[i, j] + q[i, j]
        joint[i, i] += 1e-6 * trace + 1e-30  # flat splats in one plane
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
    # Of the product's centre from the mean of the two; moments are about that mean, so that nothing cancels.
    middle = np.empty(3)
    from_a = from_b = reach = 0.0
    for i in range(3):
        of_a = gain[i, 0] * offset[0] + gain[i, 1] * offset[1] + gain[i, 2] * offset[2]
        middle[i] = of_a - other * offset[i]
        from_a += of_a * of_a
        from_b += (of_a - offset[i]) * (of_a - offset[i])
        reach += offset[i] * offset[i]
    if not max(from_a, from_b) <= reach + trace or not fill_moments(
        share, other, hidden, offset, middle, gain, p, q, merged
    ):
        fill_moments(share, other, 0.0, offset, middle, gain, p, q, merged)
        hidden = 0.0
    for i in range(3):
        merged[CENTER + i] = a[CENTER + i] + (other * offset[i] - hidden * middle[i] / (1 - hidden))


@kernel()
def fill_moments(share, other, hidden, offset, middle, gain, p, q, merged):
    """The covariance of two, less what they share; tells whether it can be one: not below 0 nor half of theirs.

    Args:
        share, other: of each of the two in what they cover. hidden: the share that both cover.
        offset: (3,) from the first to the second. middle: (3,) from their mean to the centre of their product.
        gain: (3, 3) P (P + Q)^-1. p, q: (3, 3) P and Q.
        merged: the row whose covariance is filled.
    """
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
    return sound and trace >= 0.5 * of_two


@kernel(inline=True)
def fill_matrix(row, matrix):
    """The covariance of a row of state, (3, 3) float64."""
    matrix[0, 0], matrix[1, 1], matrix[2, 2] = row[COVARIANCE], row[COVARIANCE + 1], row[COVARIANCE + 2]
    matrix[0, 1] = matrix[1, 0] = row[COVARIANCE + 3]
    matrix[0, 2] = matrix[2, 0] = row[COVARIANCE + 4]
    matrix[1, 2] = matrix[2, 1] = row[COVARIANCE + 5]


@kernel(parallel=True)
def unite_pairs(pairs, made, state, children, size, error):
    """Makes one node of each pair.

    Args:
        pairs: (P, 2) uint32 rows of state.
        made: the first row to fill.
        state: rows of `pairs.py`.
        children: (rows, 2) uint32, filled.
        size: (rows,) float32, filled: how large the traversal sees the node that will be drawn.
        error: (rows,) float32, filled: `picture_error`.
    """
    for pair in prange(len(pairs)):
        a, b, merged = state[pairs[pair, 0]], state[pairs[pair, 1]], state[made + pair]
        children[made + pair, 0], children[made + pair, 1] = pairs[pair, 0], pairs[pair, 1]
        unite(a, b, merged)
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
        opacity, spread = profile_of(np.float64(merged[DENSITY]))
        mean = (large + middle + small) / (3 * math.sqrt(spread))
        size[made + pair] = 2 * mean * size_factor(opacity)
        error[made + pair] = picture_error(a, b, merged)
