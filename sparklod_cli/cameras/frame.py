"""What parsers of camera paths hand on: poses in the axes of their format, and what the file says of the lens."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
from numpy.typing import NDArray

from ..support.errors import TooManyCamerasError
from .axes import Axes
from .camera import Camera, Matrix

DEFAULT_SIZE = (1280, 720)
DEFAULT_FOV_Y = math.radians(60)
DEFAULT_FPS = 30.0

#: So many cameras are taken of a file that has them all; an hour at 60 frames a second has fewer.
MAX_FRAMES = 1 << 20

#: So many are made where a few numbers ask for them; half an hour at 30 frames a second has fewer.
MAX_MADE = 1 << 16

#: Pixels that a focal length has, and how far away the principal point is: what float32 holds, and products of it.
MOST_PIXELS = 1e15

#: Numbers of frames are below this, so that they are whole numbers as floats, too.
NUMBERED = 1 << 53

#: y is down in scenes as training leaves them.
DEFAULT_UP = (0.0, -1.0, 0.0)


@dataclass(frozen=True)
class Lens:
    """What is known of a camera's image; None is what a file does not say.

    Attributes:
        size: width and height, pixels.
        focal: fx, fy in pixels; means something with a size only.
        principal: cx, cy in pixels.
        fov: field of view in radians, where there is no focal length.
        fov_along: what `fov` is measured along: "x", "y", or "longer", which is the longer side of the image.
    """

    size: tuple[int, int] | None = None
    focal: tuple[float, float] | None = None
    principal: tuple[float, float] | None = None
    fov: float | None = None
    fov_along: str = "y"


#: Of a file that says nothing.
NO_LENS = Lens()


@dataclass(frozen=True)
class Frame:
    """One camera of a file.

    Attributes:
        matrix: (4, 4), in the axes of its format.
        lens: of the camera.
        time: seconds, from any moment on; None where the file has none.
        name: for people; may be empty.
        axes: of this very matrix, where they are beyond doubt: it was made of an eye and a target.
    """

    matrix: Matrix
    lens: Lens = NO_LENS
    time: float | None = None
    name: str = ""
    axes: Axes | None = None


@dataclass(frozen=True)
class Sampled(Sequence[Frame]):
    """Frames that are worked out where they are asked for: a few keys can make any number of them.

    Attributes:
        length: how many there are.
        at: makes those of some numbers, (K,) int64, each below `length`.
    """

    length: int
    at: Callable[[NDArray[np.int64]], list[Frame]]

    def __len__(self) -> int:
        return self.length

    @overload
    def __getitem__(self, index: int) -> Frame: ...

    @overload
    def __getitem__(self, index: slice) -> list[Frame]: ...

    def __getitem__(self, index: int | slice) -> Frame | list[Frame]:
        numbers = range(self.length)[index]
        if isinstance(numbers, int):
            return self.at(np.array([numbers]))[0]
        return self.at(np.arange(numbers.start, numbers.stop, numbers.step))

    def __iter__(self) -> Iterator[Frame]:
        return iter(self[:])


def sampled(count: float, at: Callable[[NDArray[np.int64]], list[Frame]]) -> Sampled:
    """Frames of a count that a formula gives, rounded up.

    Raises:
        TooManyCamerasError: it is more than can be counted, or no number.
    """
    if not count < NUMBERED:
        raise TooManyCamerasError(f"{count:.3g} frames are more than {MAX_MADE:,}")
    return Sampled(max(math.ceil(count), 1), at)


@dataclass(frozen=True)
class Settings:
    """What a user says about a path, over what its file says; None leaves it to the file.

    Attributes:
        axes: of the file's matrices.
        world: (4, 4) from the file's world to that of the splats: a rotation, a uniform scale and a translation.
        size: width and height of the images, pixels. The vertical field of view stays as it is.
        fov_y: vertical field of view, radians.
        fps: frames a second; times are then counted from the first frame on.
        every: only every so many frames are kept.
        up: x, y, z of what is up for a camera of which only eye and target are known.
    """

    axes: Axes | None = None
    world: Matrix | None = None
    size: tuple[int, int] | None = None
    fov_y: float | None = None
    fps: float | None = None
    every: int = 1
    up: tuple[float, float, float] | None = None


def camera_of(pose: Matrix, lens: Lens, time: float, name: str, settings: Settings) -> Camera:
    """A camera of a rigid pose in OpenGL's axes, with defaults for what nobody says.

    Raises:
        ValueError: the lens has no sense; its text goes on a sentence about the camera.
    """
    size = lens.size or settings.size or DEFAULT_SIZE
    focal = lens.focal if lens.size and lens.focal else _focal_of(lens, size)
    principal = lens.principal or (size[0] / 2, size[1] / 2)
    _check(focal, principal)
    if settings.fov_y is not None:
        fy = size[1] / (2 * math.tan(settings.fov_y / 2))
        focal = (focal[0] * fy / focal[1], fy)  # pixels keep their shape
    if settings.size and settings.size != size:
        zoom = settings.size[1] / size[1]
        focal = (focal[0] * zoom, focal[1] * zoom)
        # How far off the centre it is scales with the picture.
        off = [(principal[k] - size[k] / 2) * zoom for k in (0, 1)]
        size = settings.size
        principal = (size[0] / 2 + off[0], size[1] / 2 + off[1])
    _check(focal, principal)
    return Camera(pose, *size, focal, principal, time, name)


def _check(focal: tuple[float, float], principal: tuple[float, float]) -> None:
    if not min(focal) > 0 or not all(abs(number) <= MOST_PIXELS for number in (*focal, *principal)):
        raise ValueError(
            f"has a focal length of {focal[0]:g}, {focal[1]:g} and a principal point at {principal[0]:g},"
            f" {principal[1]:g}, of which one is not a sensible number"
        )


def _focal_of(lens: Lens, size: tuple[int, int]) -> tuple[float, float]:
    """Of square pixels."""
    fov = lens.fov if lens.fov is not None else DEFAULT_FOV_Y
    if not 0 < fov < math.pi:
        raise ValueError(f"has a field of view of {math.degrees(fov):g} degrees")
    side = {"x": size[0], "y": size[1], "longer": max(size)}[lens.fov_along]
    focal = side / (2 * math.tan(fov / 2))
    return focal, focal
