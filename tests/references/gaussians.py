"""The formulas of splats, their areas and their merging, in float64."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sparklod_cli.model.gaussian import MAX_OPACITY, MIN_OPACITY, THOMSEN_P
from sparklod_cli.model.splats import Splats


def ellipsoid_area(scale: np.ndarray) -> np.ndarray:
    """Knud Thomsen's approximation of the surface of ellipsoids with (..., 3) semi-axes."""
    a, b, c = np.moveaxis(np.asarray(scale, np.float64), -1, 0)
    mean = ((a * b) ** THOMSEN_P + (a * c) ** THOMSEN_P + (b * c) ** THOMSEN_P) / 3
    return 4 * math.pi * mean ** (1 / THOMSEN_P)


def rotation_matrix(quat_xyzw: np.ndarray) -> np.ndarray:
    """Returns (..., 3, 3) from (..., 4) quaternions, by rotating the axes."""
    quat = np.asarray(quat_xyzw, np.float64)
    vector, w = quat[..., None, :3], quat[..., None, 3:]
    axes = np.broadcast_to(np.eye(3), (*quat.shape[:-1], 3, 3))
    turned = axes + 2 * np.cross(vector, np.cross(vector, axes) + w * axes)
    return np.swapaxes(turned, -1, -2)


def covariance(scale: np.ndarray, quat_xyzw: np.ndarray) -> np.ndarray:
    """Returns the (..., 3, 3) covariances R S S^T R^T."""
    factor = rotation_matrix(quat_xyzw) * np.asarray(scale, np.float64)[..., None, :]
    return factor @ np.swapaxes(factor, -1, -2)


@dataclass
class Moments:
    """The values that a merged splat must have."""

    center: np.ndarray
    covariance: np.ndarray
    weight: float
    rgb: np.ndarray
    sh: np.ndarray


def merge(splats: Splats) -> Moments:
    """Merges splats by matching moments, with weights of opacity * area."""
    weight = splats.opacity.astype(np.float64) * ellipsoid_area(splats.scale)
    share = weight / weight.sum()
    center = share @ splats.center.astype(np.float64)
    offset = splats.center - center
    spread = covariance(splats.scale, splats.quat_xyzw) + offset[:, :, None] * offset[:, None, :]
    return Moments(
        center,
        np.tensordot(share, spread, 1),
        weight.sum(),
        share @ splats.rgb.astype(np.float64),
        np.tensordot(share, splats.sh.astype(np.float64), 1),
    )


def opacity_of(weight: float, scale: np.ndarray) -> float:
    """Returns the linear opacity of a merged splat of these scales."""
    return float(np.clip(weight / ellipsoid_area(scale), MIN_OPACITY, MAX_OPACITY))
