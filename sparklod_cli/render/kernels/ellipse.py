"""The ellipse that a splat covers on the screen, as Spark's vertex shader has it.

`on_screen` and `ellipse` are branch-free, so that LLVM vectorizes loops over splats.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...model import gaussian
from ...model.falloff import HALF_LOG2E, deviations_of, end_of
from ...system.fast_math import log2
from ...system.jit import f4, fields, kernel

f32, f64 = np.float32, np.float64

#: Largest D, as in Spark's encodings.
MAX_D = f32(5)

#: Largest variance on the screen, pixels squared, so that float32 holds determinants. Chosen, far beyond any picture.
MAX_VARIANCE = f32(1e18)

#: Least covariance on the screen, pixels squared, from which the direction of the longer axis is computed; below it the
#: axes are those of the screen. Spark's shader has the same.
LEAST_COVARIANCE = f32(1e-3)

rotation_matrix = kernel(inline=True)(gaussian.rotation_matrix)


@fields(f4, f4, f4, f4, f4, f4)
class Lens(NamedTuple):
    """A camera's picture; pixels, float32."""

    focal_x: Any
    focal_y: Any
    principal_x: Any
    principal_y: Any
    width: Any
    height: Any


@fields(f4, f4, f4, f4, f4, f4, f4, f4)
class Limits(NamedTuple):
    """Limits on what is drawn, float32; see `RasterSettings` and the constants in its module."""

    near: Any  # depth, world units
    far: Any  # depth, world units
    clip: Any  # largest distance of a centre from the picture's, in half pictures
    blur: Any  # variance added to a splat's on the screen, pixels squared
    min_alpha: Any  # least alpha
    std_devs: Any  # radius of a splat, in standard deviations
    std_devs_per_d: Any  # added to it per unit of D above 1
    max_radius: Any  # pixels


class OnScreen(NamedTuple):
    """A splat on the screen, before it is drawn; float32 but for `is_seen`."""

    is_seen: Any  # drawn, by its depth, place and opacity
    x: Any  # its centre, pixels from the upper left corner
    y: Any
    a: Any  # its covariance xx, xy and yy, pixels squared, after the blur
    b: Any
    c: Any
    det: Any  # of the covariance
    d: Any  # D after the blur
    deviations: Any  # its radius in standard deviations
    longest: Any  # the longer half axis, pixels
    depth: Any  # along the camera's axis
    square: Any  # of the distance from the camera


@kernel(inline=True)
def in_camera(m, x, y, z):
    """Return a point in the axes of a camera: right, down and forward; `m` is its (3, 4) world to camera."""
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
    )


@kernel(inline=True)
def jacobian(lens, inverse, dx, dy):
    """Return pixels per unit of a camera's axes at a point: x by right, y by down, x and y by forward.

    `inverse` is 1 / depth of the point; `dx`, `dy` lead from the principal point to it, pixels.
    """
    return lens.focal_x * inverse, lens.focal_y * inverse, -dx * inverse, -dy * inverse


@kernel(inline=True)
def per_world_unit(m, row, sideways, forward):
    """Return pixels per unit of the world's axes, from pixels per unit of a camera's axis `row` and forward axis."""
    return (
        sideways * m[row, 0] + forward * m[2, 0],
        sideways * m[row, 1] + forward * m[2, 1],
        sideways * m[row, 2] + forward * m[2, 2],
    )


@kernel(inline=True)
def turned(t, r):
    """Return three pixels per world unit t along the axes of a splat of rotation r, 9 elements row by row."""
    return (
        t[0] * r[0] + t[1] * r[3] + t[2] * r[6],
        t[0] * r[1] + t[1] * r[4] + t[2] * r[7],
        t[0] * r[2] + t[1] * r[5] + t[2] * r[8],
    )


@kernel(inline=True)
def on_screen(center, scale, quat, lod_opacity, world_to_camera, lens, limits):
    """Return the covariance of a splat on the screen, as Spark's vertex shader has it.

    The camera of `world_to_camera` (3, 4) looks along z, with y down. The result is an `OnScreen`; where the splat is
    not seen, its numbers may be anything.
    """
    m = world_to_camera
    x, y, z = center
    sx, sy, sz = scale
    d = min(lod_opacity, MAX_D)
    u, v, w = in_camera(m, x, y, z)
    is_near = (w > limits.near) & (w < limits.far) & (d >= limits.min_alpha)
    # In float64 up to the covariance: a direction in float32 is off by hundredths of a pixel at the ends of a needle.
    exact_u, exact_v, exact_w = in_camera(m, f64(x), f64(y), f64(z))
    inverse = f64(1) / exact_w
    dx, dy = lens.focal_x * exact_u * inverse, lens.focal_y * exact_v * inverse
    half_width, half_height = f32(0.5) * lens.width, f32(0.5) * lens.height
    is_beside = (abs(lens.principal_x + dx - half_width) > limits.clip * half_width) | (
        abs(lens.principal_y + dy - half_height) > limits.clip * half_height
    )
    # T: Jacobian of the projection, times the rotation into the camera. With the splat's rotation R and scales S,
    # the covariance on the screen is (T R S) (T R S)^T; p and q are the rows of T R S.
    jx, jy, kx, ky = jacobian(lens, inverse, dx, dy)
    across, down = per_world_unit(m, 0, jx, kx), per_world_unit(m, 1, jy, ky)
    rotation = rotation_matrix(f64(quat[0]), f64(quat[1]), f64(quat[2]), f64(quat[3]), f64(1))
    px, py, pz = turned(across, rotation)
    qx, qy, qz = turned(down, rotation)
    p0, p1, p2 = px * sx, py * sy, pz * sz
    q0, q1, q2 = qx * sx, qy * sy, qz * sz
    xx, xy, yy = p0 * p0 + p1 * p1 + p2 * p2, p0 * q0 + p1 * q1 + p2 * q2, q0 * q0 + q1 * q1 + q2 * q2
    # Determinants before and after the blur as sums of terms >= 0: for needles, a * c - b * b would cancel.
    minor, other, third = p0 * q1 - p1 * q0, p0 * q2 - p2 * q0, p1 * q2 - p2 * q1
    area = minor * minor + other * other + third * third
    before, a, b, c = f32(area), f32(xx + limits.blur), f32(xy), f32(yy + limits.blur)
    det = f32(area + limits.blur * (xx + yy) + limits.blur * limits.blur)
    is_shaped = (det > 0) & (a < MAX_VARIANCE) & (c < MAX_VARIANCE)
    deviations = deviations_of(d, limits.std_devs, limits.std_devs_per_d)
    d *= np.sqrt(before / det)
    mean = f32(0.5) * (a + c)
    spread = np.sqrt(max(mean * mean - det, f32(0)))
    longest = deviations * np.sqrt(mean + spread)
    is_seen = is_near & (not is_beside) & is_shaped & (d >= limits.min_alpha)
    place = f32(lens.principal_x + dx), f32(lens.principal_y + dy)
    return OnScreen(is_seen, *place, a, b, c, det, d, deviations, longest, w, u * u + v * v + w * w)


@kernel(inline=True)
def shortened(a, b, c, det, deviations, max_radius):
    """Return the covariance of a splat, each axis shortened by itself to `max_radius` pixels, and its determinant."""
    one = f32(1)
    mean = f32(0.5) * (a + c)
    spread = np.sqrt(max(mean * mean - det, f32(0)))
    is_turned = abs(b) > LEAST_COVARIANCE
    ax, ay = (b, mean + spread - a) if is_turned else ((one, f32(0)) if a >= c else (f32(0), one))
    norm = one / np.sqrt(ax * ax + ay * ay)
    ax, ay = ax * norm, ay * norm
    # The smaller eigenvalue is determinant / larger one: mean - spread cancels for thin splats.
    first = (max_radius / deviations) ** f32(2)
    second = min(first, det / (mean + spread))
    a, b, c = (
        first * ax * ax + second * ay * ay,
        (first - second) * ax * ay,
        first * ay * ay + second * ax * ax,
    )
    return a, b, c, first * second


@kernel(inline=True)
def ellipse(a, b, c, det, d, deviations, min_alpha):
    """Return where a splat is drawn, from its `OnScreen` after `shortened`.

    The columns are ALONG, SHEAR, ACROSS, LOG, LEAST, HALF_WIDTH, HALF_HEIGHT, SLOPE and TALL.
    """
    log = log2(d)
    end = end_of(d, log, deviations, min_alpha)
    log = log if d <= f32(1) else f32(0)
    falloff = np.sqrt(HALF_LOG2E * c / det), b / c, HALF_LOG2E / c, log, log - HALF_LOG2E * end
    return *falloff, np.sqrt(end * a), np.sqrt(end * c), b / a, np.sqrt(end * det / a)
