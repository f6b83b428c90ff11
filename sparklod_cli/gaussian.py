"""The mathematics of one splat: quaternions and opacity, over whole arrays."""

from __future__ import annotations

import numpy as np

from .splats import FloatArray

#: Linear opacity of a merged splat is clamped to this range; 1000 is D = 4.45 of the 5 that the format holds.
MIN_OPACITY, MAX_OPACITY = 1e-6, 1e3

#: Lengths of a quaternion between which the squares of its components are exact enough in float32.
MIN_LENGTH, MAX_LENGTH = 1e-15, 1e15

#: Exponent of Knud Thomsen's approximation of an ellipsoid's surface, within 1.061 % of the true area.
THOMSEN_P = 1.6075


def normalized_quat(quat: FloatArray) -> FloatArray:
    """Unit quaternions from (N, 4) of any length; one of length 0 or that is not finite becomes NaN."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        length = np.sqrt(np.einsum("ij,ij->i", quat, quat))
        extreme = np.flatnonzero(~((length > MIN_LENGTH) & (length < MAX_LENGTH)))
        if extreme.size:  # dividing by the largest component first keeps the squares inside float32
            rows = quat[extreme]
            rows = rows / np.abs(rows).max(axis=1, keepdims=True)
            quat = quat.copy()
            quat[extreme] = rows
            length[extreme] = np.sqrt(np.einsum("ij,ij->i", rows, rows))
        unit: FloatArray = quat / length[:, None]
    return unit


def lod_opacity(opacity: FloatArray) -> FloatArray:
    """Spark's opacity parameter D from linear opacity A: A up to 1, sqrt(1 + e * ln A) above (Spark's LoD design)."""
    above = np.maximum(opacity, np.float32(1))
    return np.where(opacity > 1, np.sqrt(1 + np.float32(np.e) * np.log(above)), opacity).astype(np.float32, copy=False)


def linear_opacity(lod_opacity: FloatArray) -> FloatArray:
    """Linear opacity A from Spark's D, the inverse of `lod_opacity`: exp((D ** 2 - 1) / e) above 1."""
    above = np.maximum(lod_opacity, np.float32(1))
    linear = np.exp((above * above - 1) / np.float32(np.e))
    return np.where(lod_opacity > 1, linear, lod_opacity).astype(np.float32, copy=False)
