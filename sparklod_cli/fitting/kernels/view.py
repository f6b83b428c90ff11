"""What one camera may see of some nodes, as columns of shaded splats."""

from __future__ import annotations

import numpy as np

from ...render.kernels.ellipse import Lens, Limits
from ...support.jit import kernel, prange
from ...support.jit_types import b1, f4, i8, out
from .adam import Columns

f32 = np.float32


@kernel(f4[:, :], f4[:], i8[:], f4[:, :], Lens, Limits, out(b1[:]), parallel=True)
def mark_seen(center, lod_opacity, index, world_to_camera, lens, limits, seen):
    """Marks the nodes that `project` may draw: between near and far, with a centre in or near the picture.

    Args:
        center: (N, 3) float32 world units.
        lod_opacity: (N,) float32.
        index: (M,) int64 nodes.
        world_to_camera: (3, 4) float32.
        lens: `project.Lens`.
        limits: `project.Limits`.
        seen: (M,) bool, filled.
    """
    m = world_to_camera
    half_width, half_height = f32(0.5) * lens.width, f32(0.5) * lens.height
    for i in prange(len(index)):
        at = index[i]
        x, y, z = center[at, 0], center[at, 1], center[at, 2]
        w = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        visible = False
        if w > limits.near and w < limits.far and lod_opacity[at] >= limits.min_alpha:
            u = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
            v = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
            inverse = f32(1) / w
            dx, dy = lens.focal_x * u * inverse, lens.focal_y * v * inverse
            visible = (
                abs(lens.principal_x + dx - half_width) <= limits.clip * half_width
                and abs(lens.principal_y + dy - half_height) <= limits.clip * half_height
            )
        seen[i] = visible


@kernel(Columns, i8[:], out(Columns), parallel=True)
def gather(columns, index, found):
    """Copies some nodes.

    Args:
        columns: `adam.Columns` of N nodes.
        index: (M,) int64 nodes.
        found: `adam.Columns` of M, filled.
    """
    center, scale, quat, lod_opacity, rgb, sh = columns
    to_center, to_scale, to_quat, to_opacity, to_rgb, to_sh = found
    for i in prange(len(index)):
        at = index[i]
        for c in range(3):
            to_center[i, c] = center[at, c]
            to_scale[i, c] = scale[at, c]
            to_rgb[i, c] = rgb[at, c]
        for c in range(4):
            to_quat[i, c] = quat[at, c]
        to_opacity[i] = lod_opacity[at]
        for k in range(sh.shape[1]):
            for c in range(3):
                to_sh[i, k, c] = sh[at, k, c]
