"""The mathematics of one splat: quaternions, covariance, opacity and size, over whole arrays."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from .splats import FloatArray, Splats

#: Linear opacity of a merged splat is clamped to this range; 1000 is D = 4.45 of the 5 that the format holds.
MIN_OPACITY, MAX_OPACITY = 1e-6, 1e3

#: Lengths of a quaternion between which the squares of its components are exact enough in float32.
MIN_LENGTH, MAX_LENGTH = 1e-15, 1e15

#: Rows and columns of the six elements that tell a covariance: xx xy xz yy yz zz.
_ROW, _COLUMN = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2])

#: How much larger Spark's traversal takes a splat to be for each that its D is above 1.
SIZE_PER_D = 0.7

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


def covariance(scale: FloatArray, quat_xyzw: FloatArray) -> NDArray[np.float64]:
    """(N, 3) scales and (N, 4) unit quaternions, local to world, to (N, 6) covariances A diag(scale ** 2) A^T.

    In float64, because what is left of the elements of a thin splat are small differences of large numbers.
    """
    axes = rotation_matrices(quat_xyzw)
    axes *= scale.T
    return np.einsum("kin,kin->nk", axes[_ROW], axes[_COLUMN])


def rotation_matrices(quat_xyzw: FloatArray) -> NDArray[np.float64]:
    """(3, 3, N) rotations, world axis by local axis, of (N, 4) unit quaternions, local to world."""
    x, y, z, w = quat_xyzw.T.astype(np.float64)
    axes = np.empty((3, 3, len(quat_xyzw)))
    axes[0] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    axes[1] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    axes[2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return axes


def moved(points: FloatArray, matrix: NDArray[np.float64]) -> FloatArray:
    """(N, 3) float32 points, multiplied by a (4, 4) matrix that ends in 0 0 0 1."""
    result: FloatArray = (points @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)
    return result


def placed(splats: Splats, matrix: NDArray[np.float64]) -> Splats:
    """Splats under a (4, 4) rotation, uniform scale and translation; their SH are not turned."""
    size = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    turn = quat_of_rotation(matrix[:3, :3] / size)
    x, y, z, w = splats.quat_xyzw.T
    a, b, c, d = turn
    quat = [d * x + a * w + b * z - c * y, d * y - a * z + b * w + c * x, d * z + a * y - b * x + c * w]
    return dataclasses.replace(
        splats,
        center=moved(splats.center, matrix),
        scale=splats.scale * np.float32(size),
        quat_xyzw=np.stack([*quat, d * w - a * x - b * y - c * z], axis=1).astype(np.float32),
    )


def quat_of_rotation(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4,) unit x y z w, of either sign, of a (3, 3) rotation.

    The eigenvector of Bar-Itzhack's matrix, which needs no special cases.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    symmetric = np.array(
        [
            [xx - yy - zz, 0, 0, 0],
            [yx + xy, yy - xx - zz, 0, 0],
            [zx + xz, zy + yz, zz - xx - yy, 0],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    quat: NDArray[np.float64] = np.linalg.eigh(symmetric, UPLO="L").eigenvectors[:, -1]
    return quat


def lod_opacity(opacity: FloatArray) -> FloatArray:
    """Spark's opacity parameter D from linear opacity A: A up to 1, sqrt(1 + e * ln A) above (Spark's LoD design)."""
    d = np.array(opacity, np.float32)
    above = d > 1  # few are
    d[above] = np.sqrt(1 + np.float32(np.e) * np.log(d[above]))
    return d


def linear_opacity(lod_opacity: FloatArray) -> FloatArray:
    """Linear opacity A from Spark's D, the inverse of `lod_opacity`: exp((D ** 2 - 1) / e) above 1."""
    linear = np.array(lod_opacity, np.float32)
    above = linear > 1
    linear[above] = np.exp((linear[above] * linear[above] - 1) / np.float32(np.e))
    return linear


def spark_size(splats: Splats) -> FloatArray:
    """(N,) 2 * mean(scale) * (1 + 0.7 * max(0, D - 1)): what Spark 2.2.0 writes into its nodes.

    Found in its output, see docs/decisions/2026-11-20-what-spark-does.md; its `encode_lod_tree` has it so.
    """
    x, y, z = splats.scale.T
    mean = x + y
    mean += z
    mean /= np.float32(3)
    # 2 * (1 + 0.7 * beyond) * mean, in place: there may be tens of millions.
    factor = lod_opacity(splats.opacity)
    factor -= 1
    np.maximum(factor, 0, out=factor)
    factor *= np.float32(SIZE_PER_D)
    factor += 1
    factor *= 2
    factor *= mean
    return factor


def design_size(splats: Splats) -> FloatArray:
    """(N,) 2 * max(scale) * max(1, D): what the pages on Spark's LoD design say, and its quick builder sorts by."""
    return 2 * splats.scale.max(axis=1) * np.maximum(lod_opacity(splats.opacity), 1)
