"""Pixel scales outside of kernels: a view's foveation, and the pixel scales of many nodes at once."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..model.foveation import Foveation, Frustum
from .kernels.pixel_scale import CONE, FRUSTUM, NEAREST, NO_FOVEATION

#: Fields of a `kernels.pixel_scale.VIEW` that say how pixel scales count by direction.
FOVEATION = ("side", "behind", "inner", "outer")


def set_foveation(row: np.void, foveation: Foveation, fov_x: float, fov_y: float) -> None:
    """Fills what a `kernels.pixel_scale.VIEW` says of foveation; fields of view are radians."""
    row["behind"] = foveation.behind
    if isinstance(foveation, Frustum):
        row["kind"] = FRUSTUM
        row["side"] = foveation.outside
        row["inner"], row["outer"] = math.tan(fov_x / 2), math.tan(fov_y / 2)
    else:
        row["kind"] = CONE
        row["side"] = foveation.foveate
        row["inner"] = _half_angle_cosine(foveation.fov0)
        row["outer"] = min(row["inner"], _half_angle_cosine(foveation.fov))
    if row["behind"] == row["side"] == 1:
        row["kind"] = NO_FOVEATION


def _half_angle_cosine(degrees: float) -> np.float32:
    """The cosine of half an angle, 1 for none, that of 180 degrees for more; rounded to float32 where Spark rounds."""
    if degrees <= 0:
        return np.float32(1)
    radians = np.float32(0.5) * np.float32(min(degrees, 180)) * np.float32(math.pi / 180)
    return np.float32(math.cos(float(radians)))


def pixel_scales(values: Sequence[NDArray[np.float32]], view: np.void) -> NDArray[np.float32]:
    """(N,) pixel scales, bit for bit those of the kernel `pixel_scale`; infinite where that gives NaN.

    Args:
        values: x, y, z and feature sizes, (N,) each.
        view: a `kernels.pixel_scale.VIEW`.
    """
    one = np.float32(1)
    with np.errstate(all="ignore"):
        delta = [value - view[f"origin_{axis}"] for axis, value in zip("xyz", values, strict=False)]

        def along(way: str) -> NDArray[np.float32]:
            x, y, z = (part * view[f"{way}_{axis}"] for axis, part in zip("xyz", delta, strict=True))
            return (x + y) + z

        x, y, z = delta
        distance = np.sqrt((x * x + y * y) + z * z)
        inverse = one / np.where(distance > NEAREST, distance, NEAREST)
        scale: NDArray[np.float32] = values[3] * inverse * view["lod_scale"]
        if view["kind"] != NO_FOVEATION:
            ahead, side, behind, inner, outer = along("forward"), *(view[name] for name in FOVEATION)
            if view["kind"] == FRUSTUM:
                inside = (abs(along("right")) <= inner * ahead) & (abs(along("up")) <= outer * ahead)
                weight = np.where(inside, one, side)
            else:
                cosine = ahead * inverse
                within = side + (one - side) * ((cosine - outer) / (inner - outer))
                beyond = behind + (side - behind) * (cosine / outer)
                weight = np.where(cosine >= inner, one, np.where(cosine >= outer, within, beyond))
            scale = np.where(ahead <= 0, behind, weight) * scale
        return np.where(np.isnan(scale), np.float32(np.inf), abs(scale))
