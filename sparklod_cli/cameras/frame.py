"""Input and output of parsers of camera paths.

A parser reads `Files`, as text or as `CameraJson`, which checks values where they are used. It returns `Parsed` frames:
poses in the axes of their format, and lenses as the file has them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from ..model.scene import ASSUMED, AXES
from ..system import untrusted
from ..system.errors import CameraPathError, TooManyCamerasError
from ..system.untrusted import LARGEST, Origin, decoded_text, quoted_value
from . import DEFAULT_SIZE
from .camera import Camera, Matrix, pose, rotation_of
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

#: Up axis of cameras without one.
DEFAULT_UP: Point = AXES[ASSUMED]


def direction_of(up: str | None) -> Point:
    """x, y, z of the up axis of a scene; that of `ASSUMED` for None."""
    return AXES[up or ASSUMED]


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


@dataclass(frozen=True)
class Sampled(Sequence[Frame]):
    """Frames that are computed when they are used, as a few keys can yield any number of them.

    Attributes:
        at: computes the frames of (K,) int64 numbers, each below `length`.
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
    """Return computed frames, `count` rounded up and at least one; `TooManyCamerasError` from `NUMBERED` on."""
    if not count < NUMBERED:
        raise TooManyCamerasError(f"{count:.3g} frames are more than {MAX_GENERATED:,}")
    return Sampled(max(math.ceil(count), 1), at)


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
        up_of_scene: called for that where neither file nor user says it.
    """

    axes: Axes | None = None
    world: Matrix | None = None
    size: tuple[int, int] | None = None
    fov_y: float | None = None
    fps: float | None = None
    every: int = 1
    up: Point | None = None
    up_of_scene: Callable[[], Point] = lambda: DEFAULT_UP

    @property
    def up_axis(self) -> Point:
        """x, y, z of the up axis that was chosen, or else that of the scene."""
        return self.up or self.up_of_scene()


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


#: Most pixels along a side of an image.
MAX_SIDE = 1 << 16

#: Errors are prefixed with the name of the file where it is known.
ORIGIN = Origin("", CameraPathError)


@dataclass(frozen=True)
class Files:
    """The file of a camera path and those that belong to it.

    Attributes:
        contents: bytes of each file by name; the requested one comes first.
    """

    path: Path
    contents: Mapping[str, bytes]

    @property
    def data(self) -> bytes:
        return next(iter(self.contents.values()), b"")

    @cached_property
    def text(self) -> str | None:
        """The first file as text; None if it is not text."""
        return decoded(self.data)

    @cached_property
    def json(self) -> CameraJson | None:
        try:
            return CameraJson.parse(self.text or "", ORIGIN)
        except CameraPathError:
            return None

    def lines(self) -> list[str]:
        if self.text is None:
            raise CameraPathError("it is not a text file")
        return self.text.splitlines()

    def object(self) -> CameraJson:
        if self.json is None:
            raise CameraPathError("it is not JSON, or cut short")
        return self.json


@dataclass(frozen=True)
class Parsed:
    """The result of a parser.

    Attributes:
        frames: in order; those between keys are computed when they are used.
        notes: what was ignored or assumed, one sentence each, for display.
        fps: frames a second in the file; None if it gives none.
        turned: every camera has its own up axis.
    """

    frames: Sequence[Frame]
    notes: tuple[str, ...] = ()
    fps: float | None = None
    turned: bool = False


class CameraJson(untrusted.Json):
    """A value of a camera file, whose numbers may be written as texts; its errors are `CameraPathError`."""

    __slots__ = ()

    def __init__(self, value: Any, above: untrusted.Json | Origin = ORIGIN, key: str | int = "") -> None:
        super().__init__(value, above, key)

    def _number(self, value: Any) -> float | None:
        return _finite(value)

    def first_has(self, *keys: str) -> bool:
        return isinstance(self.value, list) and bool(self.value) and self.get(0).has(*keys)

    def pair(self) -> tuple[float, float]:
        first, second = self.numbers(2)
        return first, second

    def positive(self) -> float:
        if not (number := self.number()) > 0:
            raise self.unexpected("a number above 0")
        return number

    def side(self) -> int:
        number = self.number()
        if not _is_side(number):
            raise self.unexpected("a number of pixels")
        return int(number)

    def label(self, key: str) -> str:
        """Return the text of a key that only names its object: of a number its digits, empty without the key."""
        value = self.value.get(key) if isinstance(self.value, dict) else None
        return value if isinstance(value, str) else "" if value is None else quoted_value(value)


def decoded(data: bytes) -> str | None:
    """Return the text of a file, see `decoded_text`; None if it is not text."""
    try:
        text = decoded_text(data)
    except UnicodeDecodeError:
        return None
    return None if "\0" in text else text


def posed(quat_wxyz: Sequence[float], position: Sequence[float], way: str) -> Matrix:
    """Return the (4, 4) pose of a quaternion and a position; `CameraPathError`, naming the place, for length 0."""
    try:
        return pose(rotation_of(quat_wxyz), position)
    except ValueError as error:
        raise CameraPathError(f"{way} {error}") from None


def finite(value: Any, way: str) -> float:
    """Return a finite number from a number or its digits; `CameraPathError`, naming its place, for anything else."""
    number = _finite(value)
    if number is None:
        raise CameraPathError(f"{way} has {repr(value)[:30]}, which is not a finite number")
    return number


def _finite(value: Any) -> float | None:
    try:
        number = float(value) if not isinstance(value, bool) else math.nan
    except (TypeError, ValueError, OverflowError):
        return None
    return number if abs(number) < LARGEST else None


def whole(number: float, way: str) -> int:
    """Return a whole number; `CameraPathError`, naming its place, for a fraction."""
    if not number.is_integer():
        raise CameraPathError(f"{way} has {number:g}, which is not a whole number")
    return int(number)


def side(number: float, way: str) -> int:
    """Return pixels along a side of an image; `CameraPathError`, naming its place, for an impossible number."""
    if not _is_side(number):
        raise CameraPathError(f"{way} of {number:g} is not a number of pixels")
    return int(number)


def _is_side(number: float) -> bool:
    return 1 <= number <= MAX_SIDE and number == int(number)
