"""The covariance of a splat, in float64, which holds squares of scales near 1e-30."""

from __future__ import annotations

from ...model import gaussian
from ...support.jit import kernel

#: Least scale of a merged splat, world units: a scale of 0 has no logarithm, which PLY and SPZ store. Chosen.
SCALE_FLOOR = 1e-30

rotation_matrix = kernel(inline=True)(gaussian.rotation_matrix)


@kernel()
def covariance(a, b, c, x, y, z, w):
    """xx, yy, zz, xy, xz, yz of R diag(a^2, b^2, c^2) R^T, of scales a, b, c and a unit quaternion in float64."""
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
