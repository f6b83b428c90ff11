"""One step of the optimiser: Adam (Kingma and Ba 2014) for the splats that a picture shows, each with its own count."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...model import gaussian
from ...system.jit import f4, fields, i4, i8, kernel, out

f32 = np.float32

#: Decay of the first and of the second moments.
BETA1, BETA2 = f32(0.9), f32(0.99)

#: Columns of the first moments: centre, in the splat's own axes and scales, ln(scale), rotation vector, D and colour.
CENTER, SCALE, TURN, OPACITY, COLOR = 0, 3, 6, 9, 10
FIRST = 13

#: Columns of the second moments, one of each property, SH among them.
SECOND = 6

#: Range of D in trees.
LEAST_D, MOST_D = f32(0.004), f32(5)

#: Largest factor of a scale, either way, and largest move of a centre, in the largest scale of the original splat.
MOST_CHANGE = f32(2)
FARTHEST = f32(2)

#: Colours stay in this range.
LEAST_COLOR, MOST_COLOR = f32(-2), f32(4)

#: Least length of an axis, as a share of the mean scale, for steps along the axis.
THIN = f32(0.1)

TINY = f32(1e-30)

SIZE_PER_D = f32(gaussian.SIZE_PER_D)

#: Added to the root of a second moment. Derivatives of splats that matter are above 1e-6; their squares may be 0
#: in float32 for splats that are hidden behind others.
EPSILON = f32(1e-8)

rotation_matrix = kernel(inline=True)(gaussian.rotation_matrix)


@fields(f4[:, :], f4[:, :], f4[:, :], f4[:], f4[:, :], f4[:, :, :])
class Columns(NamedTuple):
    """Columns of N nodes, float32."""

    center: Any  # (N, 3)
    scale: Any  # (N, 3)
    quat_xyzw: Any  # (N, 4)
    lod_opacity: Any  # (N,)
    rgb: Any  # (N, 3)
    sh: Any  # (N, K, 3)


@fields(f4[:, :], f4[:, :], f4[:, :], f4[:], f4[:, :], f4[:, :, :])
class Gradients(NamedTuple):
    """Derivatives by the properties of M drawn splats, float32; see `render.gradients.SplatGradients`."""

    center: Any  # (M, 3)
    log_scale: Any  # (M, 3)
    turn: Any  # (M, 3)
    lod_opacity: Any  # (M,)
    rgb: Any  # (M, 3)
    sh: Any  # (M, K, 3)


@fields(out(f4[:, :]), out(f4[:, :, :]), out(f4[:, :]), out(i4[:]))
class Moments(NamedTuple):
    """State of Adam for each merged splat."""

    first: Any  # (S, FIRST) float32
    first_sh: Any  # (S, K, 3) float32
    second: Any  # (S, SECOND) float32
    count: Any  # (S,) int32 steps


@fields(f4, f4, f4, f4, f4, f4)
class Rates(NamedTuple):
    """Step sizes, float32."""

    center: Any  # in scales
    log_scale: Any  # ln
    turn: Any  # radians
    lod_opacity: Any  # D
    rgb: Any  # 0..1
    sh: Any  # of rgb


@fields(f4, f4)
class FitBounds(NamedTuple):
    """Bounds of the splats that change, float32."""

    most_d: Any  # largest D
    most_growth: Any  # factor that the feature size may change by, either way; see `size_of`


@kernel(inline=True)
def size_of(scale, lod_opacity, node):
    """Return three halves of a node's feature size; see `gaussian.spark_size`."""
    mean = scale[node, 0] + scale[node, 1] + scale[node, 2]
    return mean * (f32(1) + SIZE_PER_D * max(lod_opacity[node] - f32(1), f32(0)))


@kernel(inline=True)
def moved(first, second, slot, column, of_property, gradient, rate, correction):
    """Return the step along three components of a property, whose second moment they share."""
    a, b, c = gradient
    v = second[slot, of_property]
    v += (f32(1) - BETA2) * ((a * a + b * b + c * c) / f32(3) - v)
    second[slot, of_property] = v
    first[slot, column] += (f32(1) - BETA1) * (a - first[slot, column])
    first[slot, column + 1] += (f32(1) - BETA1) * (b - first[slot, column + 1])
    first[slot, column + 2] += (f32(1) - BETA1) * (c - first[slot, column + 2])
    factor = -rate * correction / (np.sqrt(v) + EPSILON)
    return factor * first[slot, column], factor * first[slot, column + 1], factor * first[slot, column + 2]


@kernel(inline_late=True)
def step_of(i, nodes, old, index, slots, gradients, rates, moments, bounds):
    """Move the node of drawn splat `i`; see `step`."""
    center, scale, quat, lod_opacity, rgb, sh = nodes
    first, first_sh, second, count = moments
    one, two = f32(1), f32(2)
    node = index[i]
    slot = slots[node]
    if slot < 0:
        return
    g = gradients.center
    gx, gy, gz = g[i, 0], g[i, 1], g[i, 2]
    seen = abs(gx) + abs(gy) + abs(gz) + abs(gradients.lod_opacity[i])
    for c in range(3):
        seen += abs(gradients.rgb[i, c])
    if not (seen > 0 and seen < f32(1e30)):
        return
    count[slot] += 1
    t = f32(count[slot])
    correction = np.sqrt(one - BETA2**t)
    qx, qy, qz, qw = quat[node, 0], quat[node, 1], quat[node, 2], quat[node, 3]
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_matrix(qx, qy, qz, qw, one)
    # The centre, in the splat's own axes and scales.
    sx, sy, sz = scale[node, 0], scale[node, 1], scale[node, 2]
    least = THIN * (sx + sy + sz) / f32(3)
    ex, ey, ez = max(sx, least), max(sy, least), max(sz, least)
    local = (
        (r00 * gx + r10 * gy + r20 * gz) * ex,
        (r01 * gx + r11 * gy + r21 * gz) * ey,
        (r02 * gx + r12 * gy + r22 * gz) * ez,
    )
    mx, my, mz = moved(first, second, slot, CENTER, 0, local, rates.center, correction)
    mx, my, mz = mx * ex, my * ey, mz * ez
    x = center[node, 0] + (r00 * mx + r01 * my + r02 * mz) - old.center[node, 0]
    y = center[node, 1] + (r10 * mx + r11 * my + r12 * mz) - old.center[node, 1]
    z = center[node, 2] + (r20 * mx + r21 * my + r22 * mz) - old.center[node, 2]
    away = np.sqrt(x * x + y * y + z * z)
    most = FARTHEST * max(old.scale[node, 0], old.scale[node, 1], old.scale[node, 2])
    back = min(one, most / max(away, TINY))
    center[node, 0] = old.center[node, 0] + back * x
    center[node, 1] = old.center[node, 1] + back * y
    center[node, 2] = old.center[node, 2] + back * z
    g = gradients.log_scale
    longer = moved(first, second, slot, SCALE, 1, (g[i, 0], g[i, 1], g[i, 2]), rates.log_scale, correction)
    for c in range(3):
        was = old.scale[node, c]
        scale[node, c] = min(max(scale[node, c] * np.exp(longer[c]), was / MOST_CHANGE), was * MOST_CHANGE)
    g = gradients.turn
    ax, ay, az = moved(first, second, slot, TURN, 2, (g[i, 0], g[i, 1], g[i, 2]), rates.turn, correction)
    ax, ay, az = ax / two, ay / two, az / two
    # q * (a, 1), normalized, is q * exp(a) to second order.
    px = qw * ax + qx + qy * az - qz * ay
    py = qw * ay - qx * az + qy + qz * ax
    pz = qw * az + qx * ay - qy * ax + qz
    pw = qw - qx * ax - qy * ay - qz * az
    length = np.sqrt(px * px + py * py + pz * pz + pw * pw)
    quat[node, 0], quat[node, 1], quat[node, 2], quat[node, 3] = px / length, py / length, pz / length, pw / length
    d, gd = lod_opacity[node], gradients.lod_opacity[i]
    v = second[slot, 3]
    v += (one - BETA2) * (gd * gd - v)
    second[slot, 3] = v
    first[slot, OPACITY] += (one - BETA1) * (gd - first[slot, OPACITY])
    change = rates.lod_opacity * correction / (np.sqrt(v) + EPSILON) * first[slot, OPACITY]
    lod_opacity[node] = min(max(d - change * min(d, one), LEAST_D), bounds.most_d)
    grown = size_of(scale, lod_opacity, node) / max(size_of(old.scale, old.lod_opacity, node), TINY)
    back = min(max(grown, one / bounds.most_growth), bounds.most_growth) / max(grown, TINY)
    for c in range(3):
        scale[node, c] *= back
    g = gradients.rgb
    turned = moved(first, second, slot, COLOR, 4, (g[i, 0], g[i, 1], g[i, 2]), rates.rgb, correction)
    for c in range(3):
        was = old.rgb[node, c]
        rgb[node, c] = min(max(rgb[node, c] + turned[c], min(LEAST_COLOR, was)), max(MOST_COLOR, was))
    terms = sh.shape[1]
    if terms:
        total = f32(0)
        for k in range(terms):
            for c in range(3):
                g_sh = gradients.sh[i, k, c]
                total += g_sh * g_sh
                first_sh[slot, k, c] += (one - BETA1) * (g_sh - first_sh[slot, k, c])
        v = second[slot, 5]
        v += (one - BETA2) * (total / f32(3 * terms) - v)
        second[slot, 5] = v
        factor = rates.sh * correction / (np.sqrt(v) + EPSILON)
        for k in range(terms):
            for c in range(3):
                value = sh[node, k, c] - factor * first_sh[slot, k, c]
                was = old.sh[node, k, c]
                sh[node, k, c] = min(max(value, min(LEAST_COLOR, was)), max(MOST_COLOR, was))


@kernel(i8, out(Columns), Columns, i8[:], i4[:], Gradients, Rates, Moments, FitBounds, ranges=True)
def step(start, stop, nodes, old, index, slots, gradients, rates, moments, bounds):
    """Move the drawn merged splats against their gradients.

    Args:
        old: original columns, near which scales and centres stay.
        index: (M,) node of each drawn splat.
        slots: (N,) row of each node in `moments`; -1 for leaves.
    """
    for i in range(start, stop):
        step_of(i, nodes, old, index, slots, gradients, rates, moments, bounds)
