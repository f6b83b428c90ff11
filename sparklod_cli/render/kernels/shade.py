"""Spherical harmonics: the colour of a splat from one direction."""

from __future__ import annotations

import numpy as np

from ...model.sh import SH_C1, SH_C2, SH_C3
from ...system.jit import f4, i8, kernel, out

f32 = np.float32

C1, C2, C3 = f32(SH_C1), tuple(map(f32, SH_C2)), tuple(map(f32, SH_C3))


@kernel(inline=True)
def second(x, y, z):
    """Return the spherical harmonics of degree 2 in a unit direction."""
    return (
        C2[0] * x * y,
        C2[1] * y * z,
        C2[2] * (f32(2) * z * z - x * x - y * y),
        C2[3] * x * z,
        C2[4] * (x * x - y * y),
    )


@kernel(inline=True)
def third(x, y, z):
    """Return the spherical harmonics of degree 3 in a unit direction."""
    return (
        C3[0] * y * (f32(3) * x * x - y * y),
        C3[1] * x * y * z,
        C3[2] * y * (f32(4) * z * z - x * x - y * y),
        C3[3] * z * (f32(2) * z * z - f32(3) * x * x - f32(3) * y * y),
        C3[4] * x * (f32(4) * z * z - x * x - y * y),
        C3[5] * z * (x * x - y * y),
        C3[6] * x * (x * x - f32(3) * y * y),
    )


@kernel(inline=True)
def direction(center, i, eye):
    """Return the unit vector from a camera to a splat; zeros at the camera."""
    x, y, z = center[i, 0] - eye[0], center[i, 1] - eye[1], center[i, 2] - eye[2]
    length = np.sqrt(x * x + y * y + z * z)
    inverse_of = length if length > 0 else f32(1)
    return x / inverse_of, y / inverse_of, z / inverse_of, length > 0


@kernel(inline=True)
def add_sh_of(i, center, sh, eye, degree, rgb):
    """Add the terms of degree 1 and above to the colour of splat `i`; see `add_sh`."""
    x, y, z, is_away = direction(center, i, eye)
    if not is_away:
        return
    for c in range(3):
        value = C1 * (-y * sh[i, 0, c] + z * sh[i, 1, c] - x * sh[i, 2, c])
        if degree > 1:
            b3, b4, b5, b6, b7 = second(x, y, z)
            value += b3 * sh[i, 3, c] + b4 * sh[i, 4, c] + b5 * sh[i, 5, c] + b6 * sh[i, 6, c] + b7 * sh[i, 7, c]
        if degree > 2:
            b8, b9, b10, b11, b12, b13, b14 = third(x, y, z)
            value += (
                b8 * sh[i, 8, c]
                + b9 * sh[i, 9, c]
                + b10 * sh[i, 10, c]
                + b11 * sh[i, 11, c]
                + b12 * sh[i, 12, c]
                + b13 * sh[i, 13, c]
                + b14 * sh[i, 14, c]
            )
        rgb[i, c] += value


@kernel(i8, f4[:, :], f4[:, :, :], f4[:], i8, out(f4[:, :]), ranges=True)
def add_sh(start, stop, center, sh, eye, degree, rgb):
    """Add the terms of degree 1 to `degree` to (N, 3) colours, seen from `eye`; `sh` is (N, K, 3), K = 3, 8 or 15."""
    for i in range(start, stop):
        add_sh_of(i, center, sh, eye, degree, rgb)


@kernel(inline=True)
def sh_gradient_of(center, node, eye, by_rgb, by_sh, i):
    """Fill row `i` of derivatives by the SH coefficients of splat `node`; see `sh_gradients`."""
    coefficients = by_sh.shape[1]
    x, y, z, is_away = direction(center, node, eye)
    for c in range(3):
        by = by_rgb[i, c] if is_away else f32(0)
        by_sh[i, 0, c], by_sh[i, 1, c], by_sh[i, 2, c] = -C1 * y * by, C1 * z * by, -C1 * x * by
        if coefficients > 3:
            values = second(x, y, z)
            for k in range(5):
                by_sh[i, 3 + k, c] = values[k] * by
        if coefficients > 8:
            more = third(x, y, z)
            for k in range(7):
                by_sh[i, 8 + k, c] = more[k] * by


@kernel(i8, f4[:, :], f4[:], f4[:, :], out(f4[:, :, :]), ranges=True)
def sh_gradients(start, stop, center, eye, by_rgb, by_sh):
    """Fill (N, K, 3) derivatives by SH coefficients: the basis in a splat's direction times (N, 3) `by_rgb`."""
    for i in range(start, stop):
        sh_gradient_of(center, i, eye, by_rgb, by_sh, i)
