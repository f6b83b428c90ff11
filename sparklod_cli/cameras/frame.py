"""Frames and lenses of a camera path before they become cameras, and the settings that override them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..model.scene import ASSUMED, AXES
from ..system.errors import CameraPathError
from . import DEFAULT_SIZE
from .camera import Camera, Matrix, look_at
from .formats.table import Axes

#: x, y and z in world units, or of a direction.
Point = tuple[float, float, float]

#: Vertical field of view in radians and frame rate where neither file nor user gives one.
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

#: Up axis of cameras without one.
DEFAULT_UP: Point = AXES[ASSUMED]


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics of a camera in a file; None for those that the file does not have.

    Attributes:
        size: width and height, pixels.
        focal: fx, fy in pixels; only used together with a size.
        principal: cx, cy in pixels.
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
        axes: of this matrix if they are certain, since it was computed from an eye and a target; otherwise None.
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
        up_of_scene: called where neither file nor user says it; returns the axis of the world of the splats that is up,
            one of `scene.AXES`, or None if it is unknown.
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
        """x, y, z of the up axis that was chosen, or else that of the scene, in the world of the cameras."""
        if self.up is not None:
            return self.up
        axis = self.up_of_scene()
        up = AXES[axis or ASSUMED]
        if axis is None or self.world is None:
            return up
        x, y, z = (np.asarray(up) @ self.world[:3, :3]).tolist()  # the inverse rotation, of any length
        return x, y, z


def camera_of(pose: Matrix, lens: Intrinsics, time: float, name: str, settings: Settings) -> Camera:
    """Return the camera of a rigid pose in OpenGL's axes, with defaults for what neither file nor user says.

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
