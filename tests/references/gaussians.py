"""The formulas of splats in float64: areas, rotations and covariances."""

from __future__ import annotations

import math

import numpy as np

from sparklod_cli.model.gaussian import THOMSEN_P


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
