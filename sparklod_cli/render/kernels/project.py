"""Puts splats onto the screen: the ellipse that each covers there."""

from __future__ import annotations

import numpy as np
from numba import prange

from ...support.jit import kernel

f32 = np.float32

#: Columns of a splat on the screen, float32: its centre in pixels from the upper left corner; z^2 = A dx^2 + 2 B dx dy
#: + C dy^2, how many standard deviations a pixel is away, squared; where that ends; D; exp((D^2 - 1) / e) above 1;
#: colour; half the sides of its box.
X, Y, A, B, C, END, OPACITY, POWER, RED, GREEN, BLUE, HALF_WIDTH, HALF_HEIGHT = range(13)
COLUMNS = 13

#: D has no more, and colours have none brighter: what Spark's own numbers can be.
MOST_OPAQUE, BRIGHTEST = f32(5), f32(65504)

#: A key that is sorted behind all others: not on the screen.
NOWHERE = np.uint64(0xFFFFFFFFFFFFFFFF)
#: The largest index that a key has room for.
LAST = 0xFFFFFFFF


@kernel(parallel=True)
def project(center, scale, quat, lod_opacity, rgb, world_to_camera, lens, limits, radial, screen, keys):
    """Splats on the screen, as Spark's vertex shader puts them there.

    Args:
        center, scale, quat, lod_opacity, rgb: columns of `ShadedSplats`.
        world_to_camera: (3, 4) float32; the camera looks along z, with y down.
        lens: (6,) float32: focal x and y, principal x and y, width, height; pixels.
        limits: (8,) float32: near, far, clip, blur, least alpha, standard deviations, more of them for each D, largest
            radius.
        radial: keys are by distance, not by depth.
        screen: (N, COLUMNS) float32, filled where a key is.
        keys: (N,) uint64, filled: distance and index, so that they sort from near to far, and of those at the same
            distance, as in Spark, the last is in front; NOWHERE for what is not seen.
    """
    m = world_to_camera
    for i in prange(len(center)):
        keys[i] = NOWHERE
        d = min(lod_opacity[i], MOST_OPAQUE)
        x, y, z = center[i, 0], center[i, 1], center[i, 2]
        u = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
        v = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
        w = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        if not (w > limits[0] and w < limits[1] and d >= limits[4]):
            continue
        inverse = f32(1) / w
        dx, dy = lens[0] * u * inverse, lens[1] * v * inverse
        half_width, half_height = f32(0.5) * lens[4], f32(0.5) * lens[5]
        if abs(lens[2] + dx - half_width) > limits[2] * half_width or (
            abs(lens[3] + dy - half_height) > limits[2] * half_height
        ):
            continue
        # Rows of the Jacobian of the projection, times the rotation into the camera, times that of the splat, times its
        # scale: the square of that is the covariance on the screen.
        jx, jy = lens[0] * inverse, lens[1] * inverse
        kx, ky = -dx * inverse, -dy * inverse
        t00, t01, t02 = jx * m[0, 0] + kx * m[2, 0], jx * m[0, 1] + kx * m[2, 1], jx * m[0, 2] + kx * m[2, 2]
        t10, t11, t12 = jy * m[1, 0] + ky * m[2, 0], jy * m[1, 1] + ky * m[2, 1], jy * m[1, 2] + ky * m[2, 2]
        qx, qy, qz, qw = quat[i, 0], quat[i, 1], quat[i, 2], quat[i, 3]
        two = f32(2)
        one = f32(1)
        r00, r01, r02 = one - two * (qy * qy + qz * qz), two * (qx * qy - qw * qz), two * (qx * qz + qw * qy)
        r10, r11, r12 = two * (qx * qy + qw * qz), one - two * (qx * qx + qz * qz), two * (qy * qz - qw * qx)
        r20, r21, r22 = two * (qx * qz - qw * qy), two * (qy * qz + qw * qx), one - two * (qx * qx + qy * qy)
        sx, sy, sz = scale[i, 0], scale[i, 1], scale[i, 2]
        p0, p1, p2 = (
            (t00 * r00 + t01 * r10 + t02 * r20) * sx,
            (t00 * r01 + t01 * r11 + t02 * r21) * sy,
            (t00 * r02 + t01 * r12 + t02 * r22) * sz,
        )
        q0, q1, q2 = (
            (t10 * r00 + t11 * r10 + t12 * r20) * sx,
            (t10 * r01 + t11 * r11 + t12 * r21) * sy,
            (t10 * r02 + t11 * r12 + t12 * r22) * sz,
        )
        a, b, c = p0 * p0 + p1 * p1 + p2 * p2, p0 * q0 + p1 * q1 + p2 * q2, q0 * q0 + q1 * q1 + q2 * q2
        # Determinants before and after the blur as sums of what is not negative: a * c - b * b would leave nothing of
        # those of needles.
        before = (p0 * q1 - p1 * q0) ** 2 + (p0 * q2 - p2 * q0) ** 2 + (p1 * q2 - p2 * q1) ** 2
        det = before + limits[3] * (a + c) + limits[3] * limits[3]
        a += limits[3]
        c += limits[3]
        if not (det > 0 and a < f32(1e18) and c < f32(1e18)):
            continue
        deviations = limits[5] + limits[6] * max(d - one, f32(0))
        d *= np.sqrt(before / det)
        if not d >= limits[4]:
            continue
        screen[i, END] = deviations * deviations
        mean = f32(0.5) * (a + c)
        spread = np.sqrt(max(mean * mean - det, f32(0)))
        longest = deviations * np.sqrt(mean + spread)
        if longest > limits[7]:  # squeezed, each axis by itself
            ax, ay = (b, mean + spread - a) if abs(b) > f32(1e-3) else ((one, f32(0)) if a >= c else (f32(0), one))
            norm = one / np.sqrt(ax * ax + ay * ay)
            ax, ay = ax * norm, ay * norm
            # The lesser eigenvalue is what the determinant leaves: mean - spread cancels where a splat is thin.
            first = (limits[7] / deviations) ** f32(2)
            second = min(first, det / (mean + spread))
            a, b, c = (
                first * ax * ax + second * ay * ay,
                (first - second) * ax * ay,
                first * ay * ay + second * ax * ax,
            )
            det = first * second
            if not det > 0:
                continue
        screen[i, X] = lens[2] + dx
        screen[i, Y] = lens[3] + dy
        screen[i, A] = c / det
        screen[i, B] = -b / det
        screen[i, C] = a / det
        screen[i, OPACITY] = d
        screen[i, POWER] = np.exp((d * d - one) / f32(np.e)) if d > one else one
        for channel in range(3):
            value = rgb[i, channel]
            screen[i, RED + channel] = min(value, BRIGHTEST) if value > 0 else f32(0)
        screen[i, HALF_WIDTH] = deviations * np.sqrt(a)
        screen[i, HALF_HEIGHT] = deviations * np.sqrt(c)
        if (
            screen[i, X] + screen[i, HALF_WIDTH] < 0
            or screen[i, X] - screen[i, HALF_WIDTH] > lens[4]
            or screen[i, Y] + screen[i, HALF_HEIGHT] < 0
            or screen[i, Y] - screen[i, HALF_HEIGHT] > lens[5]
        ):
            continue
        depth = np.sqrt(u * u + v * v + w * w) if radial else w
        keys[i] = (np.uint64(np.float32(depth).view(np.uint32)) << np.uint64(32)) | np.uint64(LAST - i)


@kernel(parallel=True)
def arrange(screen, keys, arranged):
    """Puts the splats that are seen side by side, from near to far.

    Args:
        screen: (N, COLUMNS) of `project`.
        keys: (M,) uint64 of it, sorted, without NOWHERE.
        arranged: (M, COLUMNS) float32, filled.
    """
    for i in prange(len(keys)):
        at = LAST - np.int64(keys[i] & np.uint64(LAST))
        for column in range(COLUMNS):
            arranged[i, column] = screen[at, column]
