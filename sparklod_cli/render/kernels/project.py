"""Projects splats onto the screen, where each covers an ellipse."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...model import gaussian
from ...support.fast_math import log2
from ...support.jit import kernel, prange
from .falloff import HALF_LOG2E

f32, f64 = np.float32, np.float64

#: Columns of a splat on the screen, float32, 64 bytes:
#: X, Y: its centre, in pixels from the upper left corner.
#: ALONG, SHEAR, ACROSS, LOG: of the exponent t of its falloff 2 ** t, dx and dy pixels from its centre:
#: t = LOG - (ALONG (dx - SHEAR dy))^2 - ACROSS dy^2. A dx^2 + 2 B dx dy + C dy^2 is the same, but its terms cancel in
#: needles. LOG is log2(D) up to D = 1, so that 2 ** t is alpha, and 0 above.
#: LEAST: the splat is drawn where t is at least this.
#: OPACITY, POWER: D, and the exponent of the falloff, linear opacity above D = 1 and 1 up to it.
#: RED, GREEN, BLUE: its colour.
#: HALF_WIDTH, HALF_HEIGHT: half the sides of its box, pixels.
#: SLOPE, TALL: y by x of the middle between the upper and the lower side of its ellipse, and half the height of the
#: ellipse above its centre, pixels.
X, Y, ALONG, SHEAR, ACROSS, LOG, LEAST, OPACITY = range(8)
POWER, RED, GREEN, BLUE, HALF_WIDTH, HALF_HEIGHT, SLOPE, TALL = range(8, 16)
COLUMNS = 16

#: Side of a tile of the picture, pixels.
TILE = 16

#: Largest D, as in Spark's encodings, and largest colour value, that of the float16 that Spark keeps colours in.
MAX_D, MAX_COLOR = f32(5), f32(65504)

#: The key of a splat that is not drawn; it is sorted behind all others.
NOT_DRAWN = np.uint64(0xFFFFFFFFFFFFFFFF)

#: The distance of a splat that is not drawn.
NOT_SEEN = f32(-1)

#: The largest index in a key, whose lower half it is.
MAX_INDEX = 0xFFFFFFFF

#: Largest variance on the screen, pixels squared, so that float32 holds determinants. Chosen, far beyond any picture.
MAX_VARIANCE = f32(1e18)

#: Least covariance on the screen, pixels squared, from which the direction of the longer axis is computed; below it the
#: axes are those of the screen. Spark's shader has the same.
LEAST_COVARIANCE = f32(1e-3)

rotation_matrix = kernel(inline=True)(gaussian.rotation_matrix)
linear_opacity_above_1 = kernel(inline=True)(gaussian.linear_opacity_above_1)


class ShadedColumns(NamedTuple):
    """Columns of `ShadedSplats`, float32.

    Attributes:
        center: (N, 3). scale: (N, 3). quat_xyzw: (N, 4). lod_opacity: (N,). rgb: (N, 3).
    """

    center: Any
    scale: Any
    quat_xyzw: Any
    lod_opacity: Any
    rgb: Any


class Lens(NamedTuple):
    """A camera's picture; pixels, float32.

    Attributes:
        focal_x, focal_y: focal lengths. principal_x, principal_y: principal point. width, height: of the picture.
    """

    focal_x: Any
    focal_y: Any
    principal_x: Any
    principal_y: Any
    width: Any
    height: Any


class Limits(NamedTuple):
    """Limits on what is drawn, float32; see `RasterSettings` and the constants in its module.

    Attributes:
        near, far: range of depths, world units.
        clip: largest distance of a centre from the picture's, in half pictures.
        blur: variance added to a splat's on the screen, pixels squared.
        min_alpha: least alpha.
        std_devs: radius of a splat, in standard deviations. std_devs_per_d: added to it per unit of D above 1.
        max_radius: pixels.
    """

    near: Any
    far: Any
    clip: Any
    blur: Any
    min_alpha: Any
    std_devs: Any
    std_devs_per_d: Any
    max_radius: Any


@kernel(inline=True)
def in_camera(m, x, y, z):
    """A point in the axes of a camera: right, down and forward; `m` is its (3, 4) world to camera."""
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
    )


@kernel(inline=True)
def jacobian(lens, inverse, dx, dy):
    """Pixels per unit of a camera's axes at a point: x by right, y by down, x and y by forward.

    Args:
        lens: `Lens`.
        inverse: 1 / depth of the point.
        dx, dy: from the principal point to the point, pixels.
    """
    return lens.focal_x * inverse, lens.focal_y * inverse, -dx * inverse, -dy * inverse


@kernel(inline=True)
def per_world_unit(m, row, sideways, forward):
    """Pixels per unit of the world's axes, of pixels per unit of axis `row` of a camera and of its forward axis."""
    return (
        sideways * m[row, 0] + forward * m[2, 0],
        sideways * m[row, 1] + forward * m[2, 1],
        sideways * m[row, 2] + forward * m[2, 2],
    )


@kernel(inline=True)
def turned(t, r):
    """Three pixels per world unit t along the axes of a splat of rotation r, 9 elements row by row."""
    return (
        t[0] * r[0] + t[1] * r[3] + t[2] * r[6],
        t[0] * r[1] + t[1] * r[4] + t[2] * r[7],
        t[0] * r[2] + t[1] * r[5] + t[2] * r[8],
    )


@kernel(inline=True)
def project_splat(splats, i, world_to_camera, lens, limits, radial, row):
    """A splat on the screen, as Spark's vertex shader projects it.

    Args:
        splats: `ShadedColumns`.
        i: which of them.
        world_to_camera: (3, 4) float32; the camera looks along z, with y down.
        lens: `Lens`.
        limits: `Limits`.
        radial: splats are sorted by distance from the camera, not by depth.
        row: (COLUMNS,) float32, filled if the splat is drawn.

    Returns:
        float32 distance to sort by, world units; NOT_SEEN if the splat is not drawn.
    """
    center, scale, quat, lod_opacity, rgb = splats
    m = world_to_camera
    d = min(lod_opacity[i], MAX_D)
    x, y, z = center[i, 0], center[i, 1], center[i, 2]
    u, v, w = in_camera(m, x, y, z)
    if not (w > limits.near and w < limits.far and d >= limits.min_alpha):
        return NOT_SEEN
    # In float64 up to the covariance: a direction in float32 is off by hundredths of a pixel at the ends of a needle.
    exact_u, exact_v, exact_w = in_camera(m, f64(x), f64(y), f64(z))
    inverse = f64(1) / exact_w
    dx, dy = lens.focal_x * exact_u * inverse, lens.focal_y * exact_v * inverse
    half_width, half_height = f32(0.5) * lens.width, f32(0.5) * lens.height
    if abs(lens.principal_x + dx - half_width) > limits.clip * half_width or (
        abs(lens.principal_y + dy - half_height) > limits.clip * half_height
    ):
        return NOT_SEEN
    # T: Jacobian of the projection, times the rotation into the camera. With the splat's rotation R and scales S,
    # the covariance on the screen is (T R S) (T R S)^T; p and q are the rows of T R S.
    jx, jy, kx, ky = jacobian(lens, inverse, dx, dy)
    across, down = per_world_unit(m, 0, jx, kx), per_world_unit(m, 1, jy, ky)
    rotation = rotation_matrix(f64(quat[i, 0]), f64(quat[i, 1]), f64(quat[i, 2]), f64(quat[i, 3]), f64(1))
    sx, sy, sz = scale[i, 0], scale[i, 1], scale[i, 2]
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
    if not (det > 0 and a < MAX_VARIANCE and c < MAX_VARIANCE):
        return NOT_SEEN
    one = f32(1)
    deviations = limits.std_devs + limits.std_devs_per_d * max(d - one, f32(0))
    d *= np.sqrt(before / det)
    if not d >= limits.min_alpha:
        return NOT_SEEN
    mean = f32(0.5) * (a + c)
    spread = np.sqrt(max(mean * mean - det, f32(0)))
    longest = deviations * np.sqrt(mean + spread)
    if longest > limits.max_radius:  # each axis is shortened by itself
        is_turned = abs(b) > LEAST_COVARIANCE
        ax, ay = (b, mean + spread - a) if is_turned else ((one, f32(0)) if a >= c else (f32(0), one))
        norm = one / np.sqrt(ax * ax + ay * ay)
        ax, ay = ax * norm, ay * norm
        # The smaller eigenvalue is determinant / larger one: mean - spread cancels for thin splats.
        first = (limits.max_radius / deviations) ** f32(2)
        second = min(first, det / (mean + spread))
        a, b, c = (
            first * ax * ax + second * ay * ay,
            (first - second) * ax * ay,
            first * ay * ay + second * ax * ax,
        )
        det = first * second
        if not det > 0:
            return NOT_SEEN
    end = deviations * deviations
    log = f32(0)
    if d <= one:
        log = log2(f32(d))
        # Where alpha is least: a faint splat ends there.
        end = min(end, (log - log2(limits.min_alpha)) / HALF_LOG2E)
    end = max(end, f32(0))
    row[X] = lens.principal_x + dx
    row[Y] = lens.principal_y + dy
    row[ALONG] = np.sqrt(HALF_LOG2E * c / det)
    row[SHEAR] = b / c
    row[ACROSS] = HALF_LOG2E / c
    row[LOG] = log
    row[LEAST] = log - HALF_LOG2E * end
    row[OPACITY] = d
    row[POWER] = linear_opacity_above_1(d, one, f32(np.e)) if d > one else one
    for channel in range(3):
        value = rgb[i, channel]
        row[RED + channel] = min(value, MAX_COLOR) if value > 0 else f32(0)
    row[HALF_WIDTH] = np.sqrt(end * a)
    row[HALF_HEIGHT] = np.sqrt(end * c)
    row[SLOPE] = b / a
    row[TALL] = np.sqrt(end * det / a)
    if (
        row[X] + row[HALF_WIDTH] < 0
        or row[X] - row[HALF_WIDTH] > lens.width
        or row[Y] + row[HALF_HEIGHT] < 0
        or row[Y] - row[HALF_HEIGHT] > lens.height
    ):
        return NOT_SEEN
    return np.sqrt(u * u + v * v + w * w) if radial else w


@kernel(inline=True)
def exponent(row, dx, dy):
    """t of the falloff 2 ** t of a splat on the screen, from its centre to a pixel; see `COLUMNS`."""
    along = row[ALONG] * (dx - row[SHEAR] * dy)
    return row[LOG] - along * along - row[ACROSS] * dy * dy


@kernel(inline=True)
def tiles_of(row, across, down):
    """First and last tile on each axis that overlap the box of a splat on the screen."""
    left = max(0, math.floor((row[X] - row[HALF_WIDTH]) / TILE))
    right = min(across - 1, math.floor((row[X] + row[HALF_WIDTH]) / TILE))
    top = max(0, math.floor((row[Y] - row[HALF_HEIGHT]) / TILE))
    bottom = min(down - 1, math.floor((row[Y] + row[HALF_HEIGHT]) / TILE))
    return left, right, top, bottom


@kernel(inline=True)
def index_of(key):
    """Which splat a key is of."""
    return MAX_INDEX - np.int64(key & np.uint64(MAX_INDEX))


@kernel(parallel=True)
def project(splats, world_to_camera, lens, limits, radial, screen, keys, boxes):
    """Splats on the screen; see `project_splat`.

    Args:
        splats, world_to_camera, lens, limits, radial: of `project_splat`.
        screen: (N, COLUMNS) float32, filled for splats that are drawn.
        keys: (N,) uint64, filled with distance and index, so that they sort from near to far, and among equal
            distances the last splat is in front, as in Spark; NOT_DRAWN for splats that are not drawn.
        boxes: (N, 4) int32, filled with the `tiles_of` splats that are drawn, and for others with an empty box.
    """
    across, down = -(-np.int64(lens.width) // TILE), -(-np.int64(lens.height) // TILE)
    for i in prange(len(splats.center)):
        depth = project_splat(splats, i, world_to_camera, lens, limits, radial, screen[i])
        if depth >= 0:
            keys[i] = (np.uint64(np.float32(depth).view(np.uint32)) << np.uint64(32)) | np.uint64(MAX_INDEX - i)
            boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = tiles_of(screen[i], across, down)
        else:
            keys[i] = NOT_DRAWN
            boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = 0, -1, 0, -1
