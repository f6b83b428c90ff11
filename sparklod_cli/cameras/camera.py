"""`Camera`, a pinhole camera in the world; frames and lenses as files have them; settings of camera paths."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..model.gaussian import rotation_matrix
from ..model.scene import ASSUMED, AXES
from ..system.errors import CameraPathError
from . import DEFAULT_SIZE
from .camera_formats import Axes

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
            up: x, y, z of the direction that is up in the picture; -y in scenes as trainers write them.
            fov_y: vertical field of view, degrees.

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


#: Largest deviation of an element of R^T R from a multiple of the identity. Numbers with three decimals have a much
#: smaller one.
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

    If the up axis is along the line of sight, a coordinate axis replaces it. `ValueError` if eye and target, world
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


#: x, y and z in world units, or of a direction.
Point = tuple[float, float, float]

#: Vertical field of view in radians, and frame rate, unless file or user give one.
DEFAULT_FOV_Y = math.radians(60)
DEFAULT_FPS = 30.0

#: Most cameras of a file that lists them all; an hour at 60 frames a second has fewer.
MAX_FRAMES = 1 << 20

#: Most cameras of a path that is computed from a few numbers; half an hour at 30 frames a second has fewer.
MAX_GENERATED = 1 << 16

#: Largest focal length and coordinate of a principal point, pixels: float32 holds them and their products.
MOST_PIXELS = 1e15

#: Numbers of frames are below this, so that float64 holds them exactly.
NUMBERED = 1 << 53

#: Mean seconds from one key to the next, if the keys have no times.
DEFAULT_SECONDS = 2.0

#: (K,) int64 numbers of frames, from 0.
Numbers = NDArray[np.int64]


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics of a camera in a file; None for missing ones.

    Attributes:
        focal: fx, fy in pixels; only used together with a size.
        fov: field of view in radians, used without a focal length.
        fov_along: side of the image that `fov` spans: "x", "y" or "longer".
    """

    size: tuple[int, int] | None = None
    focal: tuple[float, float] | None = None
    principal: tuple[float, float] | None = None
    fov: float | None = None
    fov_along: str = "y"


#: The lens of a file that says nothing about it.
NO_LENS = Intrinsics()


@dataclass(frozen=True)
class Frame:
    """One camera of a file.

    Attributes:
        matrix: (4, 4), in the axes of its format.
        time: seconds from an arbitrary start; None if the file has no times.
        axes: of this matrix, if known from its origin; None for those of the file or the user.
    """

    matrix: Matrix
    lens: Intrinsics = NO_LENS
    time: float | None = None
    name: str = ""
    axes: Axes | None = None


def frame_looking(
    eye: ArrayLike,
    target: ArrayLike,
    up: ArrayLike,
    lens: Intrinsics = NO_LENS,
    time: float | None = None,
    name: str = "",
) -> Frame:
    """Return a frame at `eye`, (3,), that looks at `target`, (3,), with `up`, (3,), pointing up in the image.

    `CameraPathError` if eye and target are the same point.
    """
    try:
        return Frame(look_at(eye, target, up), lens, time, name, Axes.OPENGL_C2W)
    except ValueError as error:
        place = ", ".join(f"{value:g}" for value in np.asarray(eye))
        raise CameraPathError(f"the camera at {place} {error}") from None


@dataclass(frozen=True)
class Settings:
    """User settings of a camera path; they override the file, and None leaves a value to the file.

    Attributes:
        axes: of the file's matrices.
        world: (4, 4) from the file's world to that of the splats: a rotation, a uniform scale and a translation.
        size: width and height of the images, pixels. The vertical field of view does not change.
        fov_y: vertical field of view, radians.
        fps: frames a second; times are then computed from the numbers of the frames.
        every: keep every n-th frame only.
        up: x, y, z of the up axis of cameras that have only an eye and a target.
        up_of_scene: called unless file or user give an up axis; returns the axis of the world of the splats that is
            up, one of `scene.AXES`, or None if it is unknown.
    """

    axes: Axes | None = None
    world: Matrix | None = None
    size: tuple[int, int] | None = None
    fov_y: float | None = None
    fps: float | None = None
    every: int = 1
    up: Point | None = None
    up_of_scene: Callable[[], str | None] = lambda: None

    @property
    def up_axis(self) -> Point:
        """x, y, z of the user's up axis, or else of that of the scene, in the world of the cameras."""
        if self.up is not None:
            return self.up
        axis = self.up_of_scene()
        up = AXES[axis or ASSUMED]
        if axis is None or self.world is None:
            return up
        x, y, z = (np.asarray(up) @ self.world[:3, :3]).tolist()  # the inverse rotation, of any length
        return x, y, z


def camera_of(pose: Matrix, lens: Intrinsics, time: float, name: str, settings: Settings) -> Camera:
    """Return the camera of a rigid pose in OpenGL's axes, with defaults for a lens that neither file nor user gives.

    The text of a `ValueError` about the lens continues a sentence about the camera.
    """
    size = lens.size or settings.size or DEFAULT_SIZE
    if lens.size and lens.focal:
        focal = lens.focal
    else:  # square pixels
        fov = lens.fov if lens.fov is not None else DEFAULT_FOV_Y
        if not 0 < fov < math.pi:
            raise ValueError(f"has a field of view of {math.degrees(fov):g} degrees")
        side = {"x": size[0], "y": size[1], "longer": max(size)}[lens.fov_along]
        pixels = side / (2 * math.tan(fov / 2))
        focal = pixels, pixels
    principal = lens.principal or (size[0] / 2, size[1] / 2)
    _check(focal, principal)
    if settings.fov_y is not None:
        fy = size[1] / (2 * math.tan(settings.fov_y / 2))
        focal = (focal[0] * fy / focal[1], fy)  # pixels keep their aspect
    if settings.size and settings.size != size:
        zoom = settings.size[1] / size[1]
        focal = (focal[0] * zoom, focal[1] * zoom)
        # The offset from the centre scales with the image.
        offset = [(principal[k] - size[k] / 2) * zoom for k in (0, 1)]
        size = settings.size
        principal = (size[0] / 2 + offset[0], size[1] / 2 + offset[1])
    _check(focal, principal)
    return Camera(pose, *size, focal, principal, time, name)


def _check(focal: tuple[float, float], principal: tuple[float, float]) -> None:
    if not min(focal) > 0 or not all(abs(number) <= MOST_PIXELS for number in (*focal, *principal)):
        raise ValueError(
            f"has a focal length of {focal[0]:g}, {focal[1]:g} and a principal point at {principal[0]:g},"
            f" {principal[1]:g}, one of which is not positive or too large"
        )
