"""How much two nodes overlap, and how much a merged node's picture differs from that of its two.

Both are integrals of products of Gaussians, on the planes of the three axes.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...support.jit import kernel
from .pair_cost import CENTER, COLOR, COVARIANCE, DENSITY

#: Weight of opacity relative to each colour channel in the error of a picture, which may have any background. Chosen.
ALPHA_WEIGHT = 1.0

#: Two Gaussians do not overlap on a plane from this exponent on: e^-30 is 1e-13, and coverage is stored as a float32,
#: whose precision is 6e-8. Chosen.
MAX_EXPONENT = 30


class OnPlane(NamedTuple):
    """Integrals over a plane, divided by 2 pi, of Gaussians of height 1 that are projected onto it, in float64.

    Attributes:
        both: of the product of the two.
        first, second: of either.
    """

    both: Any
    first: Any
    second: Any


@kernel(inline=True)
def overlap_on_plane(axx, ayy, axy, bxx, byy, bxy, x, y):
    """`OnPlane` of two Gaussians with covariances a and b, of which the second is at x, y from the first."""
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
    """The centre of a node row, in float64."""
    return np.float64(row[CENTER]), np.float64(row[CENTER + 1]), np.float64(row[CENTER + 2])


@kernel(inline=True)
def covariance_of(row):
    """The covariance of a node row, xx yy zz xy xz yz, in float64."""
    xx, yy, zz = np.float64(row[COVARIANCE]), np.float64(row[COVARIANCE + 1]), np.float64(row[COVARIANCE + 2])
    xy, xz, yz = np.float64(row[COVARIANCE + 3]), np.float64(row[COVARIANCE + 4]), np.float64(row[COVARIANCE + 5])
    return xx, yy, zz, xy, xz, yz


@kernel()
def overlaps(a, b):
    """`OnPlane` of two node rows on the planes xy, xz and yz."""
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
    """The coverage of two nodes' overlap, as a share of the sum of their coverages; over the three planes.

    Args:
        planes: `overlaps` of the two.
        density_a, density_b: DENSITY of the two.
    """
    shared = alone = 0.0
    density_a, density_b = np.float64(density_a), np.float64(density_b)
    for both, area_a, area_b in planes:
        area_a, area_b = density_a * area_a, density_b * area_b
        shared += min(density_a * density_b * both, min(area_a, area_b))
        alone += area_a + area_b
    return shared / alone if alone > 0 else 0.0


@kernel()
def picture_error(a, b, merged, planes):
    """Squared difference between the picture of a merged node and that of its two nodes.

    It is summed over red, green, blue and opacity, and over the three planes.

    Args:
        a, b, merged: node rows.
        planes: `overlaps` of a and b.
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
