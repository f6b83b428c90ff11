"""The pixel scale of a node: the weighted angular size by which the traversal orders nodes."""

from __future__ import annotations

import math

import numpy as np

from ...model.foveation import Foveation, Frustum
from ...system.jit import Type, f4, i8, kernel, out

#: A node as the traversal reads it; child indices are relative to its own tree. Siblings are adjacent, so that
#: a node's children share a few cache lines.
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

#: A camera in the object space of one instance, and how the instance's pixel scales are weighted.
VIEW = np.dtype(
    [
        *((f"origin_{axis}", "<f4") for axis in "xyz"),  # of the camera
        *((f"right_{axis}", "<f4") for axis in "xyz"),
        *((f"up_{axis}", "<f4") for axis in "xyz"),
        *((f"forward_{axis}", "<f4") for axis in "xyz"),
        ("lod_scale", "<f4"),
        ("behind", "<f4"),  # foveation weight behind the camera
        ("side", "<f4"),  # foveation weight at the outer cone, or outside the frustum
        ("inner", "<f4"),  # cosine of the inner cone's half angle, or tangent of half the horizontal field of view
        ("outer", "<f4"),  # cosine of the outer cone's half angle, or tangent of half the vertical field of view
        ("kind", "<u4"),  # NO_FOVEATION, CONE or FRUSTUM
        ("node_base", "<i8"),  # index of its tree's first node
        ("chunk_base", "<i8"),  # index of its tree's first chunk
    ]
)

#: Arrays of them, in the signatures of kernels.
NODES, VIEWS = Type(NODE)[:], Type(VIEW)[:]

#: Kinds of foveation.
NO_FOVEATION, CONE, FRUSTUM = 0, 1, 2

#: Least distance of a node, in object space, to which smaller ones are raised, as in Spark 2.2.0's traversal.
NEAREST = np.float32(1e-6)
ZERO, ONE, INFINITE = np.float32(0), np.float32(1), np.float32(np.inf)


def set_foveation(row: np.void, foveation: Foveation, fov_x: float, fov_y: float) -> None:
    """Fill the foveation fields of a `VIEW`; fields of view in radians."""
    row["behind"] = foveation.behind
    if isinstance(foveation, Frustum):
        row["kind"], row["side"] = FRUSTUM, foveation.outside
        row["inner"], row["outer"] = math.tan(fov_x / 2), math.tan(fov_y / 2)
    else:
        row["kind"], row["side"] = CONE, foveation.foveate
        for name, degrees in (("inner", foveation.fov0), ("outer", foveation.fov)):
            radians = np.float32(0.5) * np.float32(min(degrees, 180)) * np.float32(math.pi / 180)
            row[name] = math.cos(float(radians)) if degrees > 0 else 1  # rounded where Spark rounds
        row["outer"] = min(row["inner"], row["outer"])
    if row["behind"] == row["side"] == 1:
        row["kind"] = NO_FOVEATION


@kernel(inline=True)
def foveation_at(view, dx, dy, dz, inverse):
    """Return the foveation weight of a node's pixel scale.

    Cones: 1 inside the inner cone, falling linearly in the cosine to `side` at the outer cone, and on to `behind` at 90
    degrees. Frustum: 1 inside, `side` outside, `behind` behind the camera. `dx`, `dy`, `dz` are the offset of the node
    from the camera, object space; `inverse` is 1 / distance.
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
    """Return size over distance, times `lod_scale` and foveation weight; float32, operation by operation as Spark's."""
    dx, dy, dz = node.x - view.origin_x, node.y - view.origin_y, node.z - view.origin_z
    distance = np.sqrt((dx * dx + dy * dy) + dz * dz)
    if not distance > NEAREST:
        distance = NEAREST
    inverse = ONE / distance
    scale = node.size * inverse * view.lod_scale
    if view.kind != NO_FOVEATION:
        scale = foveation_at(view, dx, dy, dz, inverse) * scale
    return scale


@kernel(NODES, i8[:], VIEWS, i8, out(f4[:]))
def pixel_scales(nodes, index, views, number, scales):
    """Fill the absolute pixel scales of nodes `index` of one tree; NaN becomes infinity, as in the order of cuts."""
    view = views[number]
    for i in range(len(index)):
        scale = abs(pixel_scale(nodes[index[i]], view))
        scales[i] = scale if scale >= ZERO else INFINITE
