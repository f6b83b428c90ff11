"""Rotation, scaling and translation of splats, with their axes, sizes and spherical harmonics; places on the Earth.

Conventions:
    A point p becomes scale * rotation @ p + translation: rotated first, then scaled, then moved, about the origin of
    the file; three.js (`Object3D.matrix`) and splat-transform (its TRS matrix) have the same order. Rotations are
    active and right-handed: a positive angle turns counterclockwise, seen from the tip of the axis.

    Euler angles are degrees about the fixed axes x, y, z of the file: first about x, then y, then z, so that
    rotation = Rz @ Ry @ Rx, as in `Quat.setFromEulerAngles` of PlayCanvas, so in splat-transform's `--rotate x,y,z`,
    and in three.js's Euler order "ZYX" (not its default, "XYZ"). Coordinates here are those of the file. Those of
    splat-transform since its version 2 are those of an engine that turns PLY files by 180 degrees about z on loading:
    for the same effect on a file, change the signs of its angles about x and y and of its translations along them.

    `up` names the axis of the file that points up; it becomes +y, as in three.js, by a rotation about x, so that right
    stays right. "-y" is half a turn: from the axes of trained scenes (y down, z forward) to those of three.js (y up, z
    back). "z" is a quarter turn, as from Blender to glTF: +y, forward there, becomes -z.

Places on the Earth: the ellipsoid is that of WGS 84. The Earth's axes (ECEF) have their origin at its centre, x towards
latitude 0 and longitude 0, z towards the north pole. Formulas: B. Hofmann-Wellenhof et al., GNSS, 2008, section 8.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..system.threads import blocks_of
from . import UP_AXES
from .gaussian import quat_of_rotation, rotation_matrices
from .sh import COEFFICIENTS, SH_C1, SH_C2, SH_C3
from .splats import FloatArray, Splats

Matrix = NDArray[np.float64]

#: Largest difference of R^T R from the identity; that of rotation matrices in float32 is 1e-7.
SKEW = 1e-6

#: Largest scale and translation, and the inverse of the smallest scale: their squares must fit into a float32.
LARGEST = 1e12

#: Numbers of an SH rotation this near to 0, 1 or -1 are replaced by these, so that half turns round nothing; the errors
#: of least squares are some 1e-15.
SNAP = 1e-12

#: Sampled directions for finding SH rotations: a few times the 7 coefficients of degree 3.
SAMPLES = 64

#: Splats transformed at a time: their float64 copies stay in a processor's cache.
ROWS = 1 << 12

#: Degrees about x that turn each up axis to +y.
_DEGREES_OF_UP = dict(zip(UP_AXES, (0.0, 180.0, -90.0, 90.0), strict=True))


@dataclass(frozen=True, eq=False)
class Transform:
    """A rotation, a uniform scale and a translation, in this order.

    Attributes:
        rotation: (3, 3) float64, orthonormal, determinant 1; read-only.
        scale: more than 0.
        translation: (3,) float64, world units; read-only.

    Raises:
        ValueError: the matrix is not a rotation, or a number is not finite or out of range.
    """

    rotation: Matrix = field(default_factory=lambda: np.eye(3))
    scale: float = 1.0
    translation: Matrix = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        rotation, translation = (np.array(value, np.float64) for value in (self.rotation, self.translation))
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise ValueError(
                f"a rotation of shape {rotation.shape} and a translation of shape {translation.shape};"
                " they must be (3, 3) and (3,)"
            )
        with np.errstate(all="ignore"):
            right = np.abs(rotation.T @ rotation - np.eye(3)).max() <= SKEW and np.linalg.det(rotation) > 0
        if not right:
            raise ValueError("the matrix is not a rotation: its columns must be a right-handed orthonormal basis")
        if not 1 / LARGEST <= self.scale <= LARGEST:
            raise ValueError(f"the scale {self.scale:g} is out of range; give {1 / LARGEST:g} to {LARGEST:g}")
        if not np.abs(translation).max() <= LARGEST:
            raise ValueError(
                f"the translation {','.join(f'{part:g}' for part in translation)} is out of range;"
                f" give {-LARGEST:g} to {LARGEST:g} for each axis"
            )
        for name, array in (("rotation", rotation), ("translation", translation)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        object.__setattr__(self, "scale", float(self.scale))

    @classmethod
    def from_euler(cls, x: float, y: float, z: float) -> Transform:
        """Return a rotation by x, then y, then z degrees about the fixed axes; multiples of 90 are exact.

        Raises:
            ValueError: an angle is not finite.
        """
        if not all(map(math.isfinite, (x, y, z))):
            raise ValueError(f"the angles {x:g},{y:g},{z:g} are not all finite; give three in degrees")
        rotation = np.eye(3)
        for axis, angle in enumerate((x, y, z)):
            quarters, rest = divmod(math.fmod(angle, 360), 90)
            if rest == 0:
                cosine, sine = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarters) % 4]
            else:
                cosine, sine = math.cos(math.radians(angle)), math.sin(math.radians(angle))
            turn = np.eye(3)
            first, second = (axis + 1) % 3, (axis + 2) % 3
            turn[first, first] = turn[second, second] = cosine
            turn[second, first], turn[first, second] = sine, -sine
            rotation = turn @ rotation
        return cls(rotation + 0.0)  # no -0

    @classmethod
    def from_quat(cls, quat_xyzw: ArrayLike) -> Transform:
        """Return a rotation by a (4,) quaternion x y z w of any positive length.

        Raises:
            ValueError: it has another shape, or a length of 0 or not finite.
        """
        quat = np.asarray(quat_xyzw, np.float64)
        if quat.shape != (4,):
            raise ValueError(f"a quaternion of shape {quat.shape}; it must be (4,), x y z w")
        largest = np.abs(quat).max()
        if not 0 < largest < math.inf:
            raise ValueError("the quaternion has a length of 0, or not finite; give x y z w of a rotation")
        quat = quat / largest  # so that no square overflows or vanishes
        quat /= math.hypot(*quat)
        return cls(rotation_matrices(quat[None])[:, :, 0])

    @classmethod
    def from_up(cls, axis: str) -> Transform:
        """Return the rotation after which `axis`, one of `UP_AXES`, is +y; see the conventions of this module.

        Raises:
            ValueError: there is no such axis.
        """
        if axis not in _DEGREES_OF_UP:
            raise ValueError(f"{axis!r} is not an axis that can point up; use one of {', '.join(UP_AXES)}")
        return cls.from_euler(_DEGREES_OF_UP[axis], 0, 0)

    @classmethod
    def from_parts(
        cls,
        *,
        up: str = "y",
        rotate: Sequence[float] = (0, 0, 0),
        scale: float = 1.0,
        translate: Sequence[float] = (0, 0, 0),
    ) -> Transform:
        """Return the transform of the options --up, --rotate, --scale and --translate, in this order.

        Args:
            up: one of `UP_AXES`.
            rotate: degrees about x, y, z, after `up` has turned the file.
            scale: a factor, more than 0.
            translate: x, y, z in world units, after scaling.

        Raises:
            ValueError: an argument is out of range.
        """
        rotation = cls.from_euler(*rotate).rotation @ cls.from_up(up).rotation
        return cls(rotation, scale, np.asarray(translate, np.float64))

    @property
    def is_identity(self) -> bool:
        """Whether the transform changes nothing at all."""
        return np.array_equal(self.rotation, np.eye(3)) and self.scale == 1 and not self.translation.any()

    @property
    def matrix(self) -> Matrix:
        """(4, 4) float64 matrix for column vectors x y z 1."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    def then(self, after: Transform) -> Transform:
        """Return the composition: this transform first, then another."""
        translation = after.scale * (after.rotation @ self.translation) + after.translation
        return Transform(after.rotation @ self.rotation, after.scale * self.scale, translation)

    def inverse(self) -> Transform:
        """Return the inverse transform."""
        back = self.rotation.T
        return Transform(back, 1 / self.scale, -(back @ self.translation) / self.scale)

    def apply(self, splats: Splats) -> Splats:
        """Rotate, scale and move splats: computed in float64, rounded once to float32.

        The identity returns `splats` itself, and unchanged columns are shared, not copied. Quaternions keep their
        length, so that invalid ones stay invalid, and may have any sign: q becomes r * q, where w of r is not negative.
        A number beyond the range of float32 becomes infinite, which makes its splat invalid.
        """
        if self.is_identity:
            return splats
        columns = {"center": np.empty_like(splats.center)}
        if not np.array_equal(self.rotation, np.eye(3)):
            columns["quat_xyzw"] = np.empty_like(splats.quat_xyzw)
            if splats.sh.shape[1]:
                columns["sh"] = np.empty_like(splats.sh)
        if self.scale != 1:
            columns["scale"] = np.empty_like(splats.scale)
        result = dataclasses.replace(splats, **columns)
        quat, of_degrees = _quat_product(self.rotation), sh_rotations(self.rotation, splats.sh_degree)
        matrix = self.scale * self.rotation
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            for part in blocks_of(len(splats), ROWS):
                result.center[part] = _multiplied(matrix, splats.center[part]) + self.translation
                if "scale" in columns:
                    result.scale[part] = splats.scale[part].astype(np.float64) * self.scale
                if "quat_xyzw" in columns:
                    result.quat_xyzw[part] = _multiplied(quat, splats.quat_xyzw[part])
                if "sh" in columns:
                    _turn_sh(of_degrees, splats.sh[part], result.sh[part])
        return result


def scale_of(matrix: Matrix, skew: float) -> float | None:
    """Return the scale of a (4, 4) matrix of a rotation, a uniform scale and a translation; None for any other matrix.

    Args:
        skew: largest deviation of its axes from right angles and from equal length, as a share.
    """
    axes = matrix[:3, :3]
    with np.errstate(all="ignore"):
        scale = float(np.cbrt(np.linalg.det(axes)))
        is_even = scale > 0 and np.isfinite(matrix).all() and np.abs(axes.T @ axes / scale**2 - np.eye(3)).max() <= skew
    return scale if is_even and (matrix[3] == (0, 0, 0, 1)).all() else None


def sh_rotations(rotation: Matrix, degree: int) -> list[Matrix]:
    """Return the matrices by which a rotation multiplies the SH coefficients of the degrees 1 to `degree`.

    A colour f(d) = Y(d) c becomes f(R^-1 d), so Y(d) c' = Y(R^-1 d) c for all d: c' = X c, where X is the solution of
    Y(d) X = Y(R^-1 d). It is exact, as rotations map the functions of a degree to each other; least squares over more
    directions than coefficients find it in float64 precision.
    The matrices are (3, 3), (5, 5) and (7, 7) orthogonal float64.
    """
    # Spread evenly: a spiral from pole to pole by the golden angle.
    index = np.arange(SAMPLES)
    z = 1 - (2 * index + 1) / SAMPLES
    angle = index * (math.pi * (3 - math.sqrt(5)))
    radius = np.sqrt(1 - z * z)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    before, after = sh_basis(directions, degree), sh_basis(directions @ rotation, degree)
    found = []
    for l in range(1, degree + 1):  # noqa: E741 - as books call the degree
        part = slice(COEFFICIENTS[l - 1], COEFFICIENTS[l])
        turn = np.linalg.lstsq(before[:, part], after[:, part], rcond=None)[0]
        nearest = np.rint(turn)
        found.append(np.where(np.abs(turn - nearest) < SNAP, nearest + 0.0, turn))
    return found


def sh_basis(directions: Matrix, degree: int) -> Matrix:
    """Return (N, K) real spherical harmonics of degree 1 to `degree` in (N, 3) unit directions, as `Splats.sh`.

    The polynomials and signs are those of `eval_sh` in the original code of 3D Gaussian Splatting; the rasterizer has
    them in `kernels/shade.py`.
    """
    x, y, z = directions.T
    columns = [SH_C1 * -y, SH_C1 * z, SH_C1 * -x] if degree else []
    if degree > 1:
        second = x * y, y * z, 2 * z * z - x * x - y * y, x * z, x * x - y * y
        columns += [c * p for c, p in zip(SH_C2, second, strict=True)]
    if degree > 2:
        third = (
            y * (3 * x * x - y * y),
            x * y * z,
            y * (4 * z * z - x * x - y * y),
            z * (2 * z * z - 3 * x * x - 3 * y * y),
            x * (4 * z * z - x * x - y * y),
            z * (x * x - y * y),
            x * (x * x - 3 * y * y),
        )
        columns += [c * p for c, p in zip(SH_C3, third, strict=True)]
    return np.stack(columns, axis=1) if columns else np.empty((len(directions), 0))


def _quat_product(rotation: Matrix) -> Matrix:
    """Return the (4, 4) matrix of the product r * q, where r is the quaternion of a rotation with w >= 0."""
    quat = quat_of_rotation(rotation)
    quat[np.abs(quat) < SNAP] = 0
    first = quat[3] or quat[np.argmax(np.abs(quat))]  # half turns have no w: then the largest part is positive
    x, y, z, w = quat if first > 0 else -quat
    return np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]])


def _multiplied(matrix: Matrix, rows: FloatArray) -> Matrix:
    """Return (N, K) float64, each row multiplied by a (K, K) matrix.

    With einsum, sums have a fixed order, which BLAS would choose by processor and threads. Columns make it fast.
    """
    columns: Matrix = np.einsum("ij,jn->in", matrix, rows.T.astype(np.float64, order="C"))
    return columns.T


def _turn_sh(of_degrees: list[Matrix], sh: FloatArray, out: FloatArray) -> None:
    """Fill (N, K, 3) with rotated SH coefficients, degree by degree; see `_multiplied` on einsum."""
    count, start = len(sh), 0
    for turn in of_degrees:
        part = slice(start, start + len(turn))
        columns = sh[:, part].transpose(1, 2, 0).astype(np.float64, order="C").reshape(len(turn), 3 * count)
        turned = np.einsum("kj,jn->kn", turn, columns).reshape(len(turn), 3, count)
        out[:, part] = turned.transpose(2, 0, 1)
        start = part.stop


#: Equatorial radius in metres, and the flattening of WGS 84.
RADIUS, FLATTENING = 6_378_137.0, 1 / 298.257223563

#: Iterations for a latitude: each leaves a hundredth of the error near the surface.
ROUNDS = 8

#: A (4, 4) matrix for column vectors, column by column, as 3D Tiles and glTF write it.
Matrix16 = tuple[float, ...]

IDENTITY: Matrix16 = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def earth_matrix(latitude: float, longitude: float, height: float = 0.0, heading: float = 0.0) -> Matrix16:
    """Return the matrix from local axes, z up, with their origin at a place, to those of the Earth.

    Args:
        latitude, longitude: degrees, north and east positive; geodetic.
        height: metres above the ellipsoid.
        heading: degrees clockwise from north, seen from above, of the local y axis; x is right of it.
    """
    phi, lam, turn = map(math.radians, (latitude, longitude, heading))
    sin_phi, cos_phi, sin_lam, cos_lam = math.sin(phi), math.cos(phi), math.sin(lam), math.cos(lam)
    squared = FLATTENING * (2 - FLATTENING)
    normal = RADIUS / math.sqrt(1 - squared * sin_phi * sin_phi)
    east = (-sin_lam, cos_lam, 0.0)
    north = (-sin_phi * cos_lam, -sin_phi * sin_lam, cos_phi)
    up = (cos_phi * cos_lam, cos_phi * sin_lam, sin_phi)
    cosine, sine = math.cos(turn), math.sin(turn)
    right = (cosine * e - sine * n for e, n in zip(east, north, strict=True))
    ahead = (sine * e + cosine * n for e, n in zip(east, north, strict=True))
    origin = (
        (normal + height) * cos_phi * cos_lam,
        (normal + height) * cos_phi * sin_lam,
        (normal * (1 - squared) + height) * sin_phi,
    )
    return (*right, 0.0, *ahead, 0.0, *up, 0.0, *origin, 1.0)


@dataclass(frozen=True)
class EarthPlace:
    """Place of the origin of a matrix and heading of its y axis, as for `earth_matrix`; degrees and metres."""

    latitude: float
    longitude: float
    height: float
    heading: float


def place_of(matrix: Matrix16) -> EarthPlace:
    """Return the place of a matrix, the inverse of `earth_matrix`; its origin must not be the centre of the Earth."""
    x, y, z = matrix[12:15]
    ahead = matrix[4:7]
    lam, across, squared = math.atan2(y, x), math.hypot(x, y), FLATTENING * (2 - FLATTENING)
    phi = math.atan2(z, across * (1 - squared))
    for _ in range(ROUNDS):
        normal = RADIUS / math.sqrt(1 - squared * math.sin(phi) ** 2)
        phi = math.atan2(z + squared * normal * math.sin(phi), across)
    sin_phi, cos_phi, sin_lam, cos_lam = math.sin(phi), math.cos(phi), math.sin(lam), math.cos(lam)
    height = across * cos_phi + z * sin_phi - RADIUS * math.sqrt(1 - squared * sin_phi**2)
    east = -sin_lam * ahead[0] + cos_lam * ahead[1]
    north = -sin_phi * (cos_lam * ahead[0] + sin_lam * ahead[1]) + cos_phi * ahead[2]
    return EarthPlace(math.degrees(phi), math.degrees(lam), height, math.degrees(math.atan2(east, north)) % 360)
