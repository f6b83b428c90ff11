"""Converts the foveation of a view to the fields that kernels read."""

from __future__ import annotations

import math

import numpy as np

from ..model.instances import Foveation, Frustum
from .kernels.pixel_scale import CONE, FRUSTUM, NO_FOVEATION


def set_foveation(row: np.void, foveation: Foveation, fov_x: float, fov_y: float) -> None:
    """Fills the foveation fields of a `kernels.pixel_scale.VIEW`; fields of view in radians."""
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
