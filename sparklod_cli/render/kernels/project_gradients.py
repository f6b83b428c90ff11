"""The way back through the projection: from a splat on the screen to the splat in the world.

In float64, because elements of a long splat's covariance are small differences of large numbers.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...support.jit import kernel, prange
from ...support.jit_types import f4, fields, i8, out
from .backward import BY_RED, BY_SHAPE, BY_X, BY_XX, BY_XY, BY_Y, BY_YY, SUMS
from .ellipse import MAX_D, Lens, Limits, in_camera, jacobian, per_world_unit, rotation_matrix, turned
from .falloff import HALF_LOG2E
from .project import (
    ACROSS,
    ALONG,
    MAX_COLOR,
    OPACITY,
    SHEAR,
    ShadedColumns,
)

f64 = np.float64


#: Columns of a splat's gradient, float32, three of each but D: by centre, ln(scale), rotation vector, D and colour.
CENTER, LOG_SCALE, TURN, LOD_OPACITY, RGB = 0, 3, 6, 9, 10
GRADIENT_COLUMNS = 13


@fields(f4[:, :], i8[:], f4[:, :])
class Rows(NamedTuple):
    """Splats on the screen, and their sums, tile by tile.

    Attributes:
        screen: (N, COLUMNS) float32 of `project`.
        first: (N + 1,) int64 of `first_rows`.
        sums: (first[-1], SUMS) float32 of `weigh_tiles`.
    """

    screen: Any
    first: Any
    sums: Any


@kernel(inline=True)
def cross(a, b):
    """The cross product of two triples."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel(inline=True)
def dot(a, b):
    """The dot product of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel(inline=True)
def weighed(a, u, b, v, c, w):
    """a u + b v + c w of triples u, v and w."""
    return a * u[0] + b * v[0] + c * w[0], a * u[1] + b * v[1] + c * w[1], a * u[2] + b * v[2] + c * w[2]


@kernel(ShadedColumns, f4[:, :], Lens, Limits, Rows, out(f4[:, :]), parallel=True)
def carry_back(splats, world_to_camera, lens, limits, rows, gradients):
    """Derivatives by the properties of splats; see `SplatGradients`.

    The box of a splat and where it ends are held constant, and so is the shape of one whose axes are shortened to the
    largest radius.

    Args:
        splats, world_to_camera, lens, limits: of `project.project_splat`.
        rows: `Rows`.
        gradients: (N, GRADIENT_COLUMNS) float32, filled for the splats that are drawn.
    """
    for i in prange(len(rows.screen)):
        if rows.first[i] == rows.first[i + 1]:
            continue
        total = np.zeros(SUMS)
        for entry in range(rows.first[i], rows.first[i + 1]):
            for column in range(SUMS):
                total[column] += rows.sums[entry, column]
        carry_splat_back(splats, i, world_to_camera, lens, limits, rows.screen[i], total, gradients[i])


@kernel(inline=True)
def carry_splat_back(splats, i, m, lens, limits, seen, total, row):
    """Fills a row of gradients from splat `i` on the screen and its sums; see `carry_back`."""
    one, two, half = f64(1), f64(2), f64(0.5)
    center, scale, quat = splats.center, splats.scale, splats.quat_xyzw
    for channel in range(3):
        is_held = splats.rgb[i, channel] > MAX_COLOR
        row[RGB + channel] = f64(0) if is_held else total[BY_RED + channel]
    # The projection again, with its names.
    u, v, w = in_camera(m, f64(center[i, 0]), f64(center[i, 1]), f64(center[i, 2]))
    inverse = one / w
    dx, dy = lens.focal_x * u * inverse, lens.focal_y * v * inverse
    jx, jy, kx, ky = jacobian(lens, inverse, dx, dy)
    across, down = per_world_unit(m, 0, jx, kx), per_world_unit(m, 1, jy, ky)
    rotation = rotation_matrix(f64(quat[i, 0]), f64(quat[i, 1]), f64(quat[i, 2]), f64(quat[i, 3]), one)
    s = (f64(scale[i, 0]), f64(scale[i, 1]), f64(scale[i, 2]))
    p_unit, q_unit = turned(across, rotation), turned(down, rotation)
    p = (p_unit[0] * s[0], p_unit[1] * s[1], p_unit[2] * s[2])
    q = (q_unit[0] * s[0], q_unit[1] * s[1], q_unit[2] * s[2])
    a, c = dot(p, p), dot(q, q)
    normal = cross(p, q)
    before = dot(normal, normal)
    det = before + limits.blur * (a + c) + limits.blur * limits.blur
    a += limits.blur
    c += limits.blur
    # D: compensated for the blur by sqrt(before / det), and the exponent of a merged splat.
    kept, d = math.sqrt(before / det), f64(seen[OPACITY])
    by_d = total[BY_SHAPE]
    if d > one:
        by_d *= math.exp((d * d - one) / math.e) * two * d / math.e
    row[LOD_OPACITY] = by_d * kept if splats.lod_opacity[i] <= MAX_D else f64(0)
    by_before = half * by_d * d * (one / before - one / det)
    by_blurred = -half * by_d * d / det * limits.blur  # by a and by c through det
    # The shape: z^2 = (dx - (b / c) dy)^2 c / det + dy^2 / c, so that v^2 is the first term times HALF_LOG2E.
    along, shear = f64(seen[ALONG]), f64(seen[SHEAR])
    mean = half * (a + c)
    deviations = limits.std_devs + limits.std_devs_per_d * max(min(splats.lod_opacity[i], MAX_D) - one, f64(0))
    longest = deviations * math.sqrt(mean + math.sqrt(max(mean * mean - det, f64(0))))
    by_a, by_b, by_c = f64(0), f64(0), f64(0)
    if not longest > limits.max_radius:
        by_width = -total[BY_XX] / HALF_LOG2E * c / det  # by a - b^2 / c, the variance along a row of pixels
        by_shear = -two * total[BY_XY] * along / HALF_LOG2E  # by b / c
        by_a = by_width
        by_b = -shear * by_width + half * by_shear / c  # half of it, since b stands twice in the covariance
        by_c = shear * shear * by_width - shear * by_shear / c - total[BY_YY] / (c * c)
    by_a += by_blurred
    by_c += by_blurred
    by_p = weighed(two * by_a, p, two * by_b, q, two * by_before, cross(q, normal))
    by_q = weighed(two * by_b, p, two * by_c, q, two * by_before, cross(normal, p))
    # p and q: rows of T R S.
    for axis in range(3):
        row[LOG_SCALE + axis] = by_p[axis] * p[axis] + by_q[axis] * q[axis]
    by_p = (by_p[0] * s[0], by_p[1] * s[1], by_p[2] * s[2])
    by_q = (by_q[0] * s[0], by_q[1] * s[1], by_q[2] * s[2])
    turn_p, turn_q = cross(by_p, p_unit), cross(by_q, q_unit)
    for axis in range(3):
        row[TURN + axis] = turn_p[axis] + turn_q[axis]
    r = rotation
    by_across = (
        dot(by_p, (r[0], r[1], r[2])),
        dot(by_p, (r[3], r[4], r[5])),
        dot(by_p, (r[6], r[7], r[8])),
    )
    by_down = (
        dot(by_q, (r[0], r[1], r[2])),
        dot(by_q, (r[3], r[4], r[5])),
        dot(by_q, (r[6], r[7], r[8])),
    )
    # T: rows of the Jacobian times the rotation into the camera.
    right, below, ahead = (m[0, 0], m[0, 1], m[0, 2]), (m[1, 0], m[1, 1], m[1, 2]), (m[2, 0], m[2, 1], m[2, 2])
    by_jx, by_kx = dot(by_across, right), dot(by_across, ahead)
    by_jy, by_ky = dot(by_down, below), dot(by_down, ahead)
    by_x = -two * along / HALF_LOG2E * total[BY_X]
    by_y = -shear * by_x - two * f64(seen[ACROSS]) / HALF_LOG2E * total[BY_Y]
    by_u = by_x * jx - by_kx * jx * inverse
    by_v = by_y * jy - by_ky * jy * inverse
    by_w = by_x * kx + by_y * ky - (by_jx * jx + by_jy * jy) * inverse - two * (by_kx * kx + by_ky * ky) * inverse
    by_center = weighed(by_u, right, by_v, below, by_w, ahead)
    for axis in range(3):
        row[CENTER + axis] = by_center[axis]
