"""`Camera`, a pinhole camera somewhere in the world, and poses as (4, 4) matrices."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..model.gaussian import rotation_matrix
from ..system.errors import CameraPathError
from . import DEFAULT_SIZE
from .formats.table import Axes

Matrix = NDArray[np.float64]


@dataclass(frozen=True, repr=False)
class Camera:
    """A pinhole camera, in the axes of OpenGL and three.js: x to the right, y up, looking along -z.

    Attributes:
        camera_to_world: (4, 4) float64, a rotation and a position (world units), without scale.
        width, height: of the image, pixels.
        focal: fx, fy in pixels.
        principal: cx, cy, where the optical axis meets the image, in pixels from its upper left corner.
        time: seconds since the start of its path.
        name: of its frame, for display; may be empty.
    """

    camera_to_world: Matrix
    width: int
    height: int
    focal: tuple[float, float]
    principal: tuple[float, float]
    time: float = 0.0
    name: str = ""

    @classmethod
    def look_at(
        cls,
        eye: Sequence[float],
        target: Sequence[float],
        *,
        up: Sequence[float] = (0.0, -1.0, 0.0),
        fov_y: float = 60.0,
        size: tuple[int, int] = DEFAULT_SIZE,
        time: float = 0.0,
        name: str = "",
    ) -> Camera:
        """Return a camera at a point that looks at another.

        Args:
            eye, target: x, y, z in world units.
            up: x, y, z of what is up in the picture; -y in scenes as training leaves them.
            fov_y: vertical field of view, degrees.
            size: width and height of the image, pixels.
            time: seconds since the start of its path.
            name: of its frame, for display.

        Raises:
            CameraPathError: eye and target are the same point, or a number is out of its range.
        """
        for what, vector in (("eye", eye), ("target", target), ("up", up)):
            if np.shape(vector) != (3,):
                raise CameraPathError(f"{what} is {vector!r}; give x, y, z")
        if any(int(side) != side for side in size):
            raise CameraPathError(f"a camera of {size[0]} x {size[1]} pixels; give whole numbers")
        if not 0 < fov_y < 180 or min(size) < 1:
            raise CameraPathError(f"a camera of {fov_y:g} degrees and {size[0]} x {size[1]} pixels sees nothing")
        try:
            pose = look_at(eye, target, up)
        except ValueError as error:
            raise CameraPathError(f"the camera {error}") from None
        focal = size[1] / (2 * math.tan(math.radians(fov_y) / 2))
        return cls(pose, *size, (focal, focal), (size[0] / 2, size[1] / 2), time, name)

    def __repr__(self) -> str:
        at, ahead = (", ".join(f"{value:.4g}" for value in vector) for vector in (self.position, self.forward))
        view = f"{math.degrees(self.fov_y):.4g} degrees, {self.width} x {self.height}"
        return f"Camera(at {at}, looking along {ahead}, {view})"

    @property
    def position(self) -> Matrix:
        """(3,) world units."""
        return self.camera_to_world[:3, 3]

    @property
    def forward(self) -> Matrix:
        """(3,) unit vector along the optical axis, in the world."""
        return -self.camera_to_world[:3, 2]

    @property
    def fov_x(self) -> float:
        """Horizontal field of view in radians, as if the principal point were the image's centre."""
        return 2 * math.atan(self.width / (2 * self.focal[0]))

    @property
    def fov_y(self) -> float:
        """Vertical field of view in radians, as if the principal point were the image's centre."""
        return 2 * math.atan(self.height / (2 * self.focal[1]))


#: Largest deviation of an element of R^T R from a multiple of the identity. Files that round to three decimals stay
#: well below it.
SKEW = 0.02

#: From OpenCV's axes to OpenGL's and back: y and z change their sign.
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])

#: Largest coordinate, world units: that of a float32, the type of centres.
FARTHEST = float(np.finfo(np.float32).max)


def to_opengl(matrix: Matrix, axes: Axes) -> Matrix:
    """Return a pose as camera-to-world in OpenGL's axes; `ValueError` if it cannot be inverted.

    The (4, 4) matrix has 0 0 0 1 as its last row, and may have a uniform scale. The text of the error, as of all errors
    of poses here, continues a sentence about the camera.
    """
    if axes in (Axes.OPENGL_W2C, Axes.OPENCV_W2C):
        try:
            with np.errstate(all="ignore"):
                matrix = np.asarray(np.linalg.inv(matrix), np.float64)
        except np.linalg.LinAlgError:
            raise ValueError("has a matrix that cannot be inverted") from None
    return matrix @ FLIP if axes in (Axes.OPENCV_C2W, Axes.OPENCV_W2C) else matrix


def rigid(matrix: Matrix) -> Matrix:
    """Return a (4, 4) camera-to-world matrix without its scale, and with the nearest exact rotation.

    A `ValueError` says why a matrix is not a rotation, a uniform scale and a position.
    """
    with np.errstate(all="ignore"):
        if not np.isfinite(matrix).all() or np.abs(matrix[:3, 3]).max() > FARTHEST:
            raise ValueError("has numbers that are not finite, or too large")
        if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-4:
            raise ValueError("has a matrix whose last row is not 0 0 0 1")
        rotation = matrix[:3, :3]
        volume = np.linalg.det(rotation)
        if not np.isfinite(volume) or volume == 0:
            raise ValueError("has a matrix of determinant 0")
        if volume < 0:
            raise ValueError("has a matrix that mirrors")
        rotation = rotation / np.cbrt(volume)
        if not np.abs(rotation.T @ rotation - np.eye(3)).max() <= SKEW:
            raise ValueError("has axes that are not at right angles, or not of the same length")
    left, _, right = np.linalg.svd(rotation)
    result = np.eye(4)
    result[:3, :3] = left @ right  # the nearest rotation in the sense of least squares
    result[:3, 3] = matrix[:3, 3]
    return result


def pose(rotation: ArrayLike, position: ArrayLike) -> Matrix:
    """Return the (4, 4) matrix of a (3, 3) rotation and a (3,) position."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = position
    return matrix


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike) -> Matrix:
    """Return the (4, 4) camera-to-world matrix, in OpenGL's axes, of a camera at `eye` that looks at `target`.

    Another direction replaces the up axis if that is along the line of sight. `ValueError` if eye and target, world
    units, are the same point, or too far apart.
    """
    eye, target = np.asarray(eye, np.float64), np.asarray(target, np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        back = eye - target
    if not np.isfinite(back).all():
        raise ValueError("looks at a point that is too far away")
    back = normalized(back)
    if not np.isfinite(back).all():
        raise ValueError("looks at its own position")
    right = _cross(normalized(up), back)
    if not np.linalg.norm(right) > 1e-6:
        right = _cross(np.eye(3)[np.argmin(np.abs(back))], back)
    right = normalized(right)
    return pose(np.stack([right, _cross(back, right), back], axis=1), eye)


def _cross(a: Matrix, b: Matrix) -> Matrix:
    """Return the cross product of two (3,) vectors; `np.cross` takes ten times as long for a single pair."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def normalized(vector: ArrayLike) -> Matrix:
    """Return a (K,) vector scaled to length 1; NaN if its length is 0 or not finite."""
    array = np.asarray(vector, np.float64)
    with np.errstate(all="ignore"):
        array = array / np.abs(array).max()  # so that squares neither overflow nor vanish
        return array / float(np.linalg.norm(array))


def rotation_of(quat_wxyz: ArrayLike) -> Matrix:
    """Return the (3, 3) rotation of a quaternion w x y z of any length; `ValueError` if that is 0 or not finite."""
    w, x, y, z = unit = normalized(quat_wxyz)
    if not np.isfinite(unit).all():
        raise ValueError("has a quaternion of length 0")
    return np.array(rotation_matrix(x, y, z, w)).reshape(3, 3)
