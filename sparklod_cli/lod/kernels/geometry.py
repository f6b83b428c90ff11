"""Surfaces, bounds and covariances of splats, the axes of covariances, and opacity profiles of merged splats.

Eigenvalues and eigenvectors are found by cyclic Jacobi rotations. Unlike the closed form, Jacobi's method is exact for
flat, needle-like and spherical matrices. Eigenvectors are returned as the quaternion of the product of the rotations,
so they are right-handed by construction. Matrices are stored side by side, one row per element, and every step is
branch-free, so that LLVM vectorizes over matrices.

Spark draws a splat of linear opacity A > 1 with the alpha 1 - (1 - exp(-t)) ** A, t = z^2 / 2: that of A equal splats
on top of each other. Its coverage, the integral over the plane, is 2 pi sigma^2 * H(A), where H(A) is the
harmonic number 1 + 1/2 + ... + 1/A. Its variance along an axis is sigma^2 * (H(A) + H2(A) / H(A)) / 2, with H2(A) = 1 +
1/4 + ... + 1/A^2. Both follow from integration by parts; for A up to 1 they are 2 pi sigma^2 * A and sigma^2.

The A of a splat of given coverage and variance therefore depends on the *density* alone, coverage / (2 pi * variance).
The density is A itself up to 1, and H / spread above, which tends to 2, the density of a disc with a sharp edge.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...model import gaussian
from ...model.falloff import harmonic
from ...model.gaussian import MIN_OPACITY, SIZE_PER_D, THOMSEN_P, linear_opacity
from ...system.jit import f4, f8, fields, i8, kernel, out

#: Largest float32, world units, to which centres and scales of merged splats are clamped.
LARGEST = float(np.finfo(np.float32).max)

#: Least semi-axis of `ellipsoid_area`, as a share of the longest: far below any needle in a file, and its power is a
#: float32 above 0. Chosen.
AXIS_FLOOR = np.float32(1e-20)
THOMSEN_P32, THOMSEN_ROOT, THIRD = np.float32(THOMSEN_P), np.float32(1 / THOMSEN_P), np.float32(1 / 3)

#: Least scale of a merged splat, world units, as PLY and SPZ store logarithms. Chosen.
SCALE_FLOOR = 1e-30
rotation_matrix = kernel(inline=True)(gaussian.rotation_matrix)

#: Sweeps over the three off-diagonal elements of every matrix. They usually suffice, as Jacobi's method converges
#: quadratically: of 68,802 merges of two real scenes, 2 % need all 4, and none needs more.
SURE_SWEEPS = 4

#: Most sweeps of a matrix, if it does not converge before.
MAX_SWEEPS = 16

#: Largest sum of squares of the off-diagonal elements of a converged matrix, whose largest diagonal element is 1. An
#: error of 1e-9 is far below the 6e-8 of float32, to which eigenvalues and vectors are rounded. Chosen.
CONVERGED = 1e-18

#: Rows of the array of matrices: xx yy zz, xy xz yz, and x y z w of the quaternion.
ROWS = 10


@fields(f4[:, :], f4[:, :], f4[:, :], f4[:])
class SplatColumns(NamedTuple):
    """Geometry of N splats, float32 columns as in `Splats`, for a kernel to read."""

    center: Any  # (N, 3)
    scale: Any  # (N, 3)
    quat_xyzw: Any  # (N, 4)
    opacity: Any  # (N,)


@kernel()
def ellipsoid_area(a, b, c):
    """Return the surface area of an ellipsoid with semi-axes a, b, c, not all 0, by Knud Thomsen's formula.

    Semi-axes are at least AXIS_FLOOR of the longest, so that needles have an area.
    """
    largest = max(a, b, c)
    smallest = min(a, b, c)
    middle = max(min(a, b), min(max(a, b), c))
    # Powers of ratios at most 1 stay in range, and in float32, where a power of a product of scales would not.
    y = max(np.float32(middle / largest), AXIS_FLOOR) ** THOMSEN_P32
    z = max(np.float32(smallest / largest), AXIS_FLOOR) ** THOMSEN_P32
    mean = ((y + z + y * z) * THIRD) ** THOMSEN_ROOT
    return 4 * math.pi * np.float64(largest) * np.float64(largest) * np.float64(mean)


@kernel(i8, f4[:, :], f4[:, :], out(f8[:, :]), out(f8[:, :]), ranges=True)
def find_bounds(start, stop, center, scale, low, high):
    """Fill (blocks, 4) least and greatest x, y, z and largest scale of the splats of each block."""
    n, blocks = len(center), len(low)
    for c in range(start, stop):
        x0 = y0 = z0 = s0 = np.float32(np.inf)
        x1 = y1 = z1 = s1 = np.float32(-np.inf)
        for i in range(n * c // blocks, n * (c + 1) // blocks):
            x, y, z, s = center[i, 0], center[i, 1], center[i, 2], max(scale[i, 0], scale[i, 1], scale[i, 2])
            x0, y0, z0, s0 = min(x0, x), min(y0, y), min(z0, z), min(s0, s)
            x1, y1, z1, s1 = max(x1, x), max(y1, y), max(z1, z), max(s1, s)
        low[c, 0], low[c, 1], low[c, 2], low[c, 3] = x0, y0, z0, s0
        high[c, 0], high[c, 1], high[c, 2], high[c, 3] = x1, y1, z1, s1


@kernel()
def covariance(a, b, c, x, y, z, w):
    """Return xx, yy, zz, xy, xz, yz of R diag(a^2, b^2, c^2) R^T, by scales a, b, c and a unit quaternion, float64."""
    a, b, c = a * a, b * b, c * c
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_matrix(x, y, z, w, 1.0)
    return (
        r00 * r00 * a + r01 * r01 * b + r02 * r02 * c,
        r10 * r10 * a + r11 * r11 * b + r12 * r12 * c,
        r20 * r20 * a + r21 * r21 * b + r22 * r22 * c,
        r00 * r10 * a + r01 * r11 * b + r02 * r12 * c,
        r00 * r20 * a + r01 * r21 * b + r02 * r22 * c,
        r10 * r20 * a + r11 * r21 * b + r12 * r22 * c,
    )


@kernel()
def decompose(m, count):
    """Replace matrices, the first `count` columns of `m`, by their eigenvalues and eigenvectors.

    The result for a matrix does not depend on the other matrices, to the last bit. Rows 0 to 5 of `m`, (ROWS, at least
    count), are xx, yy, zz, xy, xz, yz on entry. On return, rows 0 to 2 are the eigenvalues, and rows 6 to 9 the
    rotation from the eigenvectors to the world's axes, a unit quaternion x y z w.
    """
    scale = np.empty(count, np.float64)
    for i in range(count):
        largest = max(m[0, i], m[1, i], m[2, i])
        scale[i] = largest if largest > 0 else 1.0
        for row in range(6):
            m[row, i] /= scale[i]
        m[6, i], m[7, i], m[8, i], m[9, i] = 0.0, 0.0, 0.0, 1.0
    for _ in range(SURE_SWEEPS):
        sweep(m, 0, count)
    for i in range(count):
        for _ in range(SURE_SWEEPS, MAX_SWEEPS):
            if m[3, i] * m[3, i] + m[4, i] * m[4, i] + m[5, i] * m[5, i] <= CONVERGED:
                break
            sweep(m, i, i + 1)
    for i in range(count):
        unit = 1 / math.sqrt(m[6, i] * m[6, i] + m[7, i] * m[7, i] + m[8, i] * m[8, i] + m[9, i] * m[9, i])
        for row in range(6, 10):
            m[row, i] *= unit
        for row in range(3):
            m[row, i] *= scale[i]


@kernel()
def sweep(m, begin, end):
    """Apply a Jacobi rotation in each of the planes xy, xz and yz to columns `begin` to `end` of `m`."""
    xx, yy, zz, xy, xz, yz = m[0], m[1], m[2], m[3], m[4], m[5]
    qx, qy, qz, qw = m[6], m[7], m[8], m[9]
    for i in range(begin, end):
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
    """Return the rotation by at most 45 degrees that makes the element `off` between diagonal elements p and q 0.

    Returns:
        tan, cos and sin of the angle, then cos and sin of half the angle.
    """
    x, y = q - p, 2 * off
    length = math.sqrt(x * x + y * y)
    length = length if length > 0 else 1.0
    c = math.sqrt(0.5 + 0.5 * abs(x) / length)
    s = (y if x >= 0 else -y) / (2 * length * c)
    half_c = math.sqrt(0.5 + 0.5 * c)
    return s / c, c, s, half_c, s / (2 * half_c)


#: Largest D of a merged splat; sharper profiles gain nothing (benchmarks/notes/quality-builder.md). A splat of higher
#: density than this profile is drawn larger instead.
MAX_D = 2.5

#: Largest ratio of the second axis to the longest of a needle, and the largest D of needles. They may be thinner than a
#: pixel, where the blur of the rasterizer takes more from a sharp profile than from the original splats: wires would
#: fade. Measured; between 0.25 and 0.4, and between 1.5 and 1.75, little changes
#: (benchmarks/notes/quality-builder.md).
NEEDLE, NEEDLE_D = 0.25, 1.5

#: Entries of the table of profiles by density, between which it is interpolated linearly. Chosen.
ENTRIES = 256

lod_opacity_above_1 = kernel(inline=True)(gaussian.lod_opacity_above_1)


def _profiles(lod_opacity: NDArray[np.float32]) -> tuple[NDArray[np.float64], ...]:
    """Return linear opacity, spread (variance / sigma^2) and density of profiles of D at least 1."""
    a = linear_opacity(lod_opacity).astype(np.float64)
    first, second = harmonic(a)
    spread = (first + second / first) / 2
    return a, spread, first / spread


#: Linear opacity and spread at ENTRIES densities from 1 to that of MAX_D.
_OPACITY, _SPREAD, _DENSITY = _profiles(np.linspace(1, MAX_D, 4096, dtype=np.float32))
MAX_DENSITY = float(_DENSITY[-1])
OPACITIES, SPREADS = (np.interp(np.linspace(1, MAX_DENSITY, ENTRIES), _DENSITY, each) for each in (_OPACITY, _SPREAD))
NEEDLE_OPACITY, NEEDLE_SPREAD, NEEDLE_DENSITY = (float(x[0]) for x in _profiles(np.array([NEEDLE_D], np.float32)))


@kernel(inline=True)
def is_needle(a, b, c):
    """Return whether the second of three variances along the axes is below NEEDLE squared of the largest."""
    return max(min(a, b), min(max(a, b), c)) < NEEDLE * NEEDLE * max(a, b, c)


@kernel(inline=True)
def profile_of(density, needle):
    """Return linear opacity and spread (variance / sigma^2) of a splat, or a needle, by its density.

    Above the density of the largest D, the spread is smaller than the profile's: a larger sigma keeps the coverage.
    """
    if density <= 1:
        return max(density, MIN_OPACITY), 1.0
    if needle and density >= NEEDLE_DENSITY:
        return NEEDLE_OPACITY, NEEDLE_SPREAD * NEEDLE_DENSITY / density
    if density >= MAX_DENSITY:
        return OPACITIES[-1], SPREADS[-1] * MAX_DENSITY / density
    at = (density - 1) * ((ENTRIES - 1) / (MAX_DENSITY - 1))
    low = min(int(at), ENTRIES - 2)
    part = at - low
    return (
        OPACITIES[low] + part * (OPACITIES[low + 1] - OPACITIES[low]),
        SPREADS[low] + part * (SPREADS[low + 1] - SPREADS[low]),
    )


@kernel(inline=True)
def size_factor(opacity):
    """Return the ratio of feature size to 2 * mean(scale) by linear opacity, float64; see `gaussian.size_factor`."""
    return 1 + SIZE_PER_D * (lod_opacity_above_1(opacity, 1.0, math.e) - 1) if opacity > 1 else 1.0
