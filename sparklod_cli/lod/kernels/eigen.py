"""Eigen-decomposition of many symmetric 3x3 matrices at once, by cyclic Jacobi rotations.

Unlike the closed form, Jacobi's method keeps the eigenvectors of flat, needle-like and spherical matrices. The vectors
come as the quaternion of the product of its rotations, so they are right-handed by construction. Matrices lie side by
side, one row an element, and every step is free of branches, so that the compiler works on several at a time.
"""

from __future__ import annotations

import math

import numpy as np

from ...support.jit import kernel

MAX_SWEEPS = 16  # 4 suffice as a rule
CONVERGED = 1e-18  # sum of squares of the off-diagonal, relative to the largest diagonal
ROWS = 10  # xx yy zz, xy xz yz, and x y z w of the quaternion


@kernel()
def decompose(m, count):
    """Eigenvalues and eigenvectors of the first `count` columns of `m`, in place.

    Args:
        m: (10, at least count) float64. Rows 0 to 5 are xx, yy, zz, xy, xz, yz; after it, rows 0 to 2 are the
            eigenvalues and 6 to 9 the rotation from their axes to the world's, a unit quaternion x, y, z, w.
        count: columns.
    """
    scale = np.empty(count, np.float64)
    for i in range(count):
        largest = max(m[0, i], m[1, i], m[2, i])
        scale[i] = largest if largest > 0 else 1.0
        for row in range(6):
            m[row, i] /= scale[i]
        m[6, i], m[7, i], m[8, i], m[9, i] = 0.0, 0.0, 0.0, 1.0
    for _ in range(MAX_SWEEPS):
        off = 0.0
        for i in range(count):
            off = max(off, m[3, i] * m[3, i] + m[4, i] * m[4, i] + m[5, i] * m[5, i])
        if off <= CONVERGED:
            break
        sweep(m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8], m[9], count)
    for i in range(count):
        unit = 1 / math.sqrt(m[6, i] * m[6, i] + m[7, i] * m[7, i] + m[8, i] * m[8, i] + m[9, i] * m[9, i])
        for row in range(6, 10):
            m[row, i] *= unit
        for row in range(3):
            m[row, i] *= scale[i]


@kernel()
def sweep(xx, yy, zz, xy, xz, yz, qx, qy, qz, qw, count):
    """One Jacobi rotation in each of the planes xy, xz and yz; arguments are the rows of `decompose`."""
    for i in range(count):
        a, b, c, d, e, f = xx[i], yy[i], zz[i], xy[i], xz[i], yz[i]
        x, y, z, w = qx[i], qy[i], qz[i], qw[i]
        t, cs, sn, hc, hs = rotation(a, b, d)  # about -z
        a, b, d, e, f = a - t * d, b + t * d, 0.0, cs * e - sn * f, sn * e + cs * f
        x, y, z, w = x * hc - y * hs, y * hc + x * hs, z * hc - w * hs, w * hc + z * hs
        t, cs, sn, hc, hs = rotation(a, c, e)  # about y
        a, c, e, d, f = a - t * e, c + t * e, 0.0, cs * d - sn * f, sn * d + cs * f
        x, y, z, w = x * hc - z * hs, y * hc + w * hs, z * hc + x * hs, w * hc - y * hs
        t, cs, sn, hc, hs = rotation(b, c, f)  # about -x
        b, c, f, d, e = b - t * f, c + t * f, 0.0, cs * d - sn * e, sn * d + cs * e
        x, y, z, w = x * hc - w * hs, y * hc - z * hs, z * hc + y * hs, w * hc + x * hs
        xx[i], yy[i], zz[i], xy[i], xz[i], yz[i] = a, b, c, d, e, f
        qx[i], qy[i], qz[i], qw[i] = x, y, z, w


@kernel()
def rotation(p, q, off):
    """The rotation of at most 45 degrees that clears the off-diagonal element between diagonals p and q.

    Returns:
        tan, cos and sin of its angle, cos and sin of half its angle.
    """
    x, y = q - p, 2 * off
    length = math.sqrt(x * x + y * y)
    length = length if length > 0 else 1.0
    c = math.sqrt(0.5 + 0.5 * abs(x) / length)
    s = (y if x >= 0 else -y) / (2 * length * c)
    half_c = math.sqrt(0.5 + 0.5 * c)
    return s / c, c, s, half_c, s / (2 * half_c)
