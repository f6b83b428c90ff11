"""Merging Gaussians: moment matching with a symmetric 3x3 eigen-solver.

Weights, moments and the eigen-decomposition are in float64: a mean of float32 centres 1e7 units from the origin, or
squares of scales near 1e-30, would not survive float32.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from ...gaussian import MAX_OPACITY, MIN_OPACITY
from ...jit import kernel
from .geometry import CENTER, OPACITY, QUAT, SCALE, WIDTH, ellipsoid_area

SCALE_FLOOR = 1e-30
MAX_SWEEPS = 16
BLOCK = 64  # groups that are gathered before they are merged
OFF_DIAGONAL = 1e-18  # square of an off-diagonal element, relative to the largest diagonal, that counts as zero


@kernel()
def covariance(a, b, c, x, y, z, w):
    """xx, yy, zz, xy, xz, yz of R S S^T R^T, from scales a, b, c and a unit quaternion."""
    a, b, c = a * a, b * b, c * c
    r00, r01, r02 = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    r10, r11, r12 = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    r20, r21, r22 = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    return (
        r00 * r00 * a + r01 * r01 * b + r02 * r02 * c,
        r10 * r10 * a + r11 * r11 * b + r12 * r12 * c,
        r20 * r20 * a + r21 * r21 * b + r22 * r22 * c,
        r00 * r10 * a + r01 * r11 * b + r02 * r12 * c,
        r00 * r20 * a + r01 * r21 * b + r02 * r22 * c,
        r10 * r20 * a + r11 * r21 * b + r12 * r22 * c,
    )


@kernel()
def jacobi_rotation(p, q, off):
    """The rotation that clears the off-diagonal element between diagonals p and q: tan, cos, sin, and of its half."""
    theta = (q - p) / (2 * off)
    t = 1 / (abs(theta) + math.sqrt(theta * theta + 1))
    if theta < 0:
        t = -t
    c = 1 / math.sqrt(t * t + 1)
    s = t * c
    half_c = math.sqrt((1 + c) / 2)
    return t, c, s, half_c, s / (2 * half_c)


@kernel()
def eigen_symmetric(a, b, c, d, e, f):
    """Eigenvalues and eigenvectors of a symmetric matrix xx, yy, zz, xy, xz, yz by cyclic Jacobi rotations.

    Unlike the closed form, it keeps the eigenvectors of flat, needle-like and spherical matrices. The vectors come as
    the quaternion of the product of its rotations, so they are right-handed by construction.

    Returns:
        the three eigenvalues, and x, y, z, w of the rotation from their axes to the world's.
    """
    largest = max(a, b, c)
    x = y = z = 0.0
    w = 1.0
    if not largest > 0:
        return 0.0, 0.0, 0.0, x, y, z, w
    unit = 1 / largest
    a, b, c, d, e, f = a * unit, b * unit, c * unit, d * unit, e * unit, f * unit
    for _ in range(MAX_SWEEPS):
        if max(d * d, e * e, f * f) <= OFF_DIAGONAL:
            break
        if d * d > OFF_DIAGONAL:  # in the xy plane: about -z
            t, cs, sn, hc, hs = jacobi_rotation(a, b, d)
            a, b, d, e, f = a - t * d, b + t * d, 0.0, cs * e - sn * f, sn * e + cs * f
            x, y, z, w = x * hc - y * hs, y * hc + x * hs, z * hc - w * hs, w * hc + z * hs
        if e * e > OFF_DIAGONAL:  # in the xz plane: about y
            t, cs, sn, hc, hs = jacobi_rotation(a, c, e)
            a, c, e, d, f = a - t * e, c + t * e, 0.0, cs * d - sn * f, sn * d + cs * f
            x, y, z, w = x * hc - z * hs, y * hc + w * hs, z * hc + x * hs, w * hc - y * hs
        if f * f > OFF_DIAGONAL:  # in the yz plane: about -x
            t, cs, sn, hc, hs = jacobi_rotation(b, c, f)
            b, c, f, d, e = b - t * f, c + t * f, 0.0, cs * d - sn * e, sn * d + cs * e
            x, y, z, w = x * hc - w * hs, y * hc - z * hs, z * hc + y * hs, w * hc + x * hs
    norm = 1 / math.sqrt(x * x + y * y + z * z + w * w)
    return a * largest, b * largest, c * largest, x * norm, y * norm, z * norm, w * norm


@kernel(parallel=True)
def merge_groups(nodes, first, geometry, weight, base):
    """One merged node for each group of nodes, by moments weighted with opacity * area.

    Args:
        nodes: (C,) uint32 rows of geometry, the members of all groups.
        first: (G + 1,) where each group starts in `nodes`.
        geometry: rows of `geometry.py`; base .. base + G are filled.
        weight: (len(geometry),) float64 opacity * area of each row; the same are filled.
        base: the first row to fill.
    """
    groups = len(first) - 1
    for block in prange((groups + BLOCK - 1) // BLOCK):
        block_begin, block_end = block * BLOCK, min(groups, block * BLOCK + BLOCK)
        offset = first[block_begin]
        # Copying the members first lets their cache misses overlap; the arithmetic below would wait for each in turn.
        row = np.empty((first[block_end] - offset, WIDTH), np.float32)
        row_weight = np.empty(len(row), np.float64)
        for k in range(len(row)):
            for column in range(WIDTH):
                row[k, column] = geometry[nodes[offset + k], column]
        for k in range(len(row)):
            row_weight[k] = weight[nodes[offset + k]]
        for g in range(block_begin, block_end):
            begin, end = first[g] - offset, first[g + 1] - offset
            total = x = y = z = 0.0
            for k in range(begin, end):
                w = row_weight[k]
                total += w
                x += w * row[k, CENTER]
                y += w * row[k, CENTER + 1]
                z += w * row[k, CENTER + 2]
            x, y, z = x / total, y / total, z / total
            xx = yy = zz = xy = xz = yz = 0.0
            for k in range(begin, end):
                cxx, cyy, czz, cxy, cxz, cyz = covariance(
                    np.float64(row[k, SCALE]),
                    np.float64(row[k, SCALE + 1]),
                    np.float64(row[k, SCALE + 2]),
                    np.float64(row[k, QUAT]),
                    np.float64(row[k, QUAT + 1]),
                    np.float64(row[k, QUAT + 2]),
                    np.float64(row[k, QUAT + 3]),
                )
                w = row_weight[k] / total
                dx, dy, dz = row[k, CENTER] - x, row[k, CENTER + 1] - y, row[k, CENTER + 2] - z
                xx += w * (cxx + dx * dx)
                yy += w * (cyy + dy * dy)
                zz += w * (czz + dz * dz)
                xy += w * (cxy + dx * dy)
                xz += w * (cxz + dx * dz)
                yz += w * (cyz + dy * dz)
            a, b, c, qx, qy, qz, qw = eigen_symmetric(xx, yy, zz, xy, xz, yz)
            a = max(math.sqrt(max(a, 0.0)), SCALE_FLOOR)
            b = max(math.sqrt(max(b, 0.0)), SCALE_FLOOR)
            c = max(math.sqrt(max(c, 0.0)), SCALE_FLOOR)
            area = ellipsoid_area(a, b, c)
            opacity = min(max(total / area, MIN_OPACITY), MAX_OPACITY)
            made = base + g
            geometry[made, CENTER], geometry[made, CENTER + 1], geometry[made, CENTER + 2] = x, y, z
            geometry[made, SCALE], geometry[made, SCALE + 1], geometry[made, SCALE + 2] = a, b, c
            geometry[made, QUAT], geometry[made, QUAT + 1] = qx, qy
            geometry[made, QUAT + 2], geometry[made, QUAT + 3] = qz, qw
            geometry[made, OPACITY] = opacity
            weight[made] = opacity * area
