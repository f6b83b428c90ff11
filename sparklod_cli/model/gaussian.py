"""The formulas of one splat: rotation, covariance, opacity and size.

The functions that accept scalars as well as arrays are also compiled into kernels. They take their constants as
arguments, in the type of the computation, because in compiled code a float32 plus a literal is a float64.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .splats import FloatArray, Splats

#: Least and largest linear opacity A of a merged splat; 1000 is D = 4.45, where Spark's encodings hold up to 5.
#: Builders clamp to the least; their largest D, `lod.kernels.geometry.MAX_D`, is well below the other.
MIN_OPACITY, MAX_OPACITY = 1e-6, 1e3

#: Range of a quaternion's length in which float32 holds the squares of its components: 1e-30 to 1e30.
MIN_LENGTH, MAX_LENGTH = 1e-15, 1e15

#: Row and column of the six elements of a covariance: xx xy xz yy yz zz.
_ROW, _COLUMN = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2])

#: Rise of the feature size per unit of D above 1, as a share; inferred from Spark 2.2.0's output, see `spark_size`.
SIZE_PER_D = 0.7

#: Exponent of Knud Thomsen's approximation (2004) of an ellipsoid's surface area, within 1.061 % of it.
THOMSEN_P = 1.6075


def rotation_matrix(x: Any, y: Any, z: Any, w: Any, one: Any = 1.0) -> tuple[Any, ...]:
    """Return the 9 elements, row by row, of the rotation by a unit quaternion; `one` is of the type of x."""
    two = one + one
    return (
        *(one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)),
        *(two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)),
        *(two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)),
    )


def lod_opacity_above_1(opacity: Any, one: Any, e: Any) -> Any:
    """Return D of linear opacity A above 1: sqrt(1 + e * ln A) (Spark's LoD design); `one` and `e` of the type of A."""
    return np.sqrt(one + e * np.log(opacity))


def linear_opacity_above_1(lod_opacity: Any, one: Any, e: Any) -> Any:
    """Return linear opacity A of D above 1: exp((D ** 2 - 1) / e), the inverse of `lod_opacity_above_1`."""
    return np.exp((lod_opacity * lod_opacity - one) / e)


def normalized_quat(quat: FloatArray) -> FloatArray:
    """Normalize (N, 4) quaternions of any length; those of length 0, or not finite, become NaN."""
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
    """Return (N, 6) covariances R diag(scale ** 2) R^T, xx xy xz yy yz zz, of (N, 3) scales and (N, 4) quaternions.

    In float64, as the elements for a thin splat are small differences of large numbers.
    """
    axes = rotation_matrices(quat_xyzw)
    axes *= scale.T
    return np.einsum("kin,kin->nk", axes[_ROW], axes[_COLUMN])


def rotation_matrices(quat_xyzw: FloatArray) -> NDArray[np.float64]:
    """Return (3, 3, N) rotations, world axis by local axis, of (N, 4) unit quaternions, local to world."""
    return np.array(rotation_matrix(*quat_xyzw.T.astype(np.float64))).reshape(3, 3, -1)


def moved(points: FloatArray, matrix: NDArray[np.float64]) -> FloatArray:
    """Return (N, 3) float32 points under a (4, 4) affine transform."""
    result: FloatArray = (points @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)
    return result


def placed(splats: Splats, matrix: NDArray[np.float64]) -> Splats:
    """Return splats under a (4, 4) rotation, uniform scale and translation; their SH are not rotated."""
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
    """Return (4,) unit x y z w, of either sign, of a (3, 3) rotation.

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
    """Return (N,) LoD opacity D, Spark's parameter, of linear opacity A: A up to 1, sqrt(1 + e * ln A) above."""
    d = np.array(opacity, np.float32)
    above = d > 1  # usually few
    d[above] = lod_opacity_above_1(d[above], np.float32(1), np.float32(np.e))
    return d


def linear_opacity(lod_opacity: FloatArray) -> FloatArray:
    """Return (N,) linear opacity A of LoD opacity D: D up to 1, exp((D ** 2 - 1) / e) above."""
    linear = np.array(lod_opacity, np.float32)
    above = linear > 1
    linear[above] = linear_opacity_above_1(linear[above], np.float32(1), np.float32(np.e))
    return linear


def size_factor(lod_opacity: FloatArray, out: FloatArray | None = None) -> FloatArray:
    """Return (N,) 1 + 0.7 * max(0, D - 1), the ratio of feature size to 2 * mean(scale); into `out` if given."""
    factor: FloatArray = np.subtract(lod_opacity, np.float32(1), out=out)
    np.maximum(factor, 0, out=factor)
    factor *= np.float32(SIZE_PER_D)
    factor += 1
    return factor


@np.errstate(over="ignore", invalid="ignore")  # reports need it for scales that are not finite, too
def spark_size(splats: Splats) -> FloatArray:
    """Return (N,) feature size, 2 * mean(scale) * (1 + 0.7 * max(0, D - 1)): what Spark 2.2.0 writes into its nodes.

    Inferred from its output, see docs/decisions/14-cuts.md; its `encode_lod_tree` computes the same.
    """
    x, y, z = splats.scale.T
    mean = x + y
    mean += z
    mean /= np.float32(3)
    d = lod_opacity(splats.opacity)
    factor = size_factor(d, out=d)  # in place: there may be tens of millions
    factor *= 2
    factor *= mean
    return factor
