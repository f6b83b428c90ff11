"""Foveation of a view, as the kernels of cuts read it."""

from __future__ import annotations

import math

import numpy as np

from ..model.foveation import Foveation, Frustum
from .kernels import pixel_scale


def set_foveation(row: np.void, foveation: Foveation, fov_x: float, fov_y: float) -> None:
    """Fill the foveation fields of a `kernels.pixel_scale.VIEW`; fields of view in radians."""
    row["behind"] = foveation.behind
    if isinstance(foveation, Frustum):
        row["kind"] = pixel_scale.FRUSTUM
        row["side"] = foveation.outside
        row["inner"], row["outer"] = math.tan(fov_x / 2), math.tan(fov_y / 2)
    else:
        row["kind"] = pixel_scale.CONE
        row["side"] = foveation.foveate
        row["inner"] = _half_angle_cosine(foveation.fov0)
        row["outer"] = min(row["inner"], _half_angle_cosine(foveation.fov))
    if row["behind"] == row["side"] == 1:
        row["kind"] = pixel_scale.NO_FOVEATION


def _half_angle_cosine(degrees: float) -> np.float32:
    """Return the cosine of half an angle, of 0 to 180 degrees at most; rounded to float32 where Spark rounds."""
    if degrees <= 0:
        return np.float32(1)
    radians = np.float32(0.5) * np.float32(min(degrees, 180)) * np.float32(math.pi / 180)
    return np.float32(math.cos(float(radians)))
