"""How large a camera sees a node: what the traversal goes by."""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel

#: A node as the traversal reads it, its links relative to its own tree. Children lie side by side, so that a node's
#: are in one or two cache lines.
NODE = np.dtype(
    [
        ("x", "<f4"),  # centre, object space
        ("y", "<f4"),
        ("z", "<f4"),
        ("size", "<f4"),  # feature size, object space
        ("child_start", "<u4"),
        ("child_count", "<u4"),
    ]
)

#: An instance as one camera sees it; vectors in object space.
VIEW = np.dtype(
    [
        *((f"origin_{axis}", "<f4") for axis in "xyz"),  # of the camera
        *((f"right_{axis}", "<f4") for axis in "xyz"),
        *((f"up_{axis}", "<f4") for axis in "xyz"),
        *((f"forward_{axis}", "<f4") for axis in "xyz"),
        ("lod_scale", "<f4"),
        ("behind", "<f4"),  # foveation behind the camera
        ("side", "<f4"),  # at the outer cone, or outside the frustum
        ("inner", "<f4"),  # cosine of the inner cone's half angle, or the tangent of half the horizontal field of view
        ("outer", "<f4"),  # cosine of the outer cone's, or the tangent of half the vertical one
        ("kind", "<u4"),  # of foveation
        ("node_base", "<i8"),  # where its tree's nodes begin
        ("chunk_base", "<i8"),  # where its tree's chunks begin
    ]
)

#: Kinds of foveation.
NO_FOVEATION, CONE, FRUSTUM = 0, 1, 2

NEAREST = np.float32(1e-6)
ZERO, ONE = np.float32(0), np.float32(1)


@kernel(inline=True)
def foveation_at(view, dx, dy, dz, inverse):
    """How much a node's pixel scale counts.

    Cones: 1 inside the inner one, linear in the cosine to `side` at the outer one, then to `behind` at 90 degrees.
    Frustum: 1 inside, `side` outside, `behind` behind.

    Args:
        view: a record of `VIEW`.
        dx, dy, dz: from the camera to the node, object space.
        inverse: of their length.
    """
    ahead = (dx * view.forward_x + dy * view.forward_y) + dz * view.forward_z
    if ahead <= ZERO:
        return view.behind
    if view.kind == FRUSTUM:
        across = (dx * view.right_x + dy * view.right_y) + dz * view.right_z
        along = (dx * view.up_x + dy * view.up_y) + dz * view.up_z
        inside = abs(across) <= view.inner * ahead and abs(along) <= view.outer * ahead
        return ONE if inside else view.side
    cosine = ahead * inverse
    if cosine >= view.inner:
        return ONE
    if cosine >= view.outer:
        return view.side + (ONE - view.side) * ((cosine - view.outer) / (view.inner - view.outer))
    return view.behind + (view.side - view.behind) * (cosine / view.outer)


@kernel(inline=True)
def pixel_scale(node, view):
    """The angular size of a node, size / distance, times its weights; in float32, operation by operation as Spark's.

    Args:
        node: a record of `NODE`.
        view: a record of `VIEW`.
    """
    dx, dy, dz = node.x - view.origin_x, node.y - view.origin_y, node.z - view.origin_z
    distance = np.sqrt((dx * dx + dy * dy) + dz * dz)
    if not distance > NEAREST:
        distance = NEAREST
    inverse = ONE / distance
    scale = node.size * inverse * view.lod_scale
    if view.kind != NO_FOVEATION:
        scale = foveation_at(view, dx, dy, dz, inverse) * scale
    return scale
