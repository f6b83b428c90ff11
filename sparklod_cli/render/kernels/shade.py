"""Spherical harmonics: the colour of a splat from one direction."""

from __future__ import annotations

import numpy as np
from numba import prange

from ...model.sh import SH_C1, SH_C2, SH_C3
from ...support.jit import kernel

f32 = np.float32

C1, C2, C3 = f32(SH_C1), tuple(map(f32, SH_C2)), tuple(map(f32, SH_C3))


@kernel(parallel=True)
def add_sh(center, sh, eye, degree, rgb):
    """Adds the terms of degree 1 and above to colours.

    Args:
        center: (N, 3) float32.
        sh: (N, K, 3) float32 coefficients of degree 1 and above, K = 3, 8 or 15.
        eye: (3,) float32 position of the camera.
        degree: 1 to 3.
        rgb: (N, 3) float32, added to.
    """
    for i in prange(len(center)):
        x, y, z = center[i, 0] - eye[0], center[i, 1] - eye[1], center[i, 2] - eye[2]
        length = np.sqrt(x * x + y * y + z * z)
        if length == 0:
            continue
        x, y, z = x / length, y / length, z / length
        for c in range(3):
            value = C1 * (-y * sh[i, 0, c] + z * sh[i, 1, c] - x * sh[i, 2, c])
            if degree > 1:
                value += (
                    C2[0] * x * y * sh[i, 3, c]
                    + C2[1] * y * z * sh[i, 4, c]
                    + C2[2] * (f32(2) * z * z - x * x - y * y) * sh[i, 5, c]
                    + C2[3] * x * z * sh[i, 6, c]
                    + C2[4] * (x * x - y * y) * sh[i, 7, c]
                )
            if degree > 2:
                value += (
                    C3[0] * y * (f32(3) * x * x - y * y) * sh[i, 8, c]
                    + C3[1] * x * y * z * sh[i, 9, c]
                    + C3[2] * y * (f32(4) * z * z - x * x - y * y) * sh[i, 10, c]
                    + C3[3] * z * (f32(2) * z * z - f32(3) * x * x - f32(3) * y * y) * sh[i, 11, c]
                    + C3[4] * x * (f32(4) * z * z - x * x - y * y) * sh[i, 12, c]
                    + C3[5] * z * (x * x - y * y) * sh[i, 13, c]
                    + C3[6] * x * (x * x - f32(3) * y * y) * sh[i, 14, c]
                )
            rgb[i, c] += value
