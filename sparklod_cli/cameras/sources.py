"""Sources of cameras: a file, an orbit around a scene, a dolly towards it, single views, or keyframes.

`read` and `cameras_of` turn the frames of a parser or a generator into a `CameraPath`.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import io
from ..system.errors import CameraPathError, SparklodError, TooManyCamerasError
from ..system.untrusted import Origin, parse_json
from . import ELEVATION, framing, generators
from .camera import Camera, Matrix, rigid, to_opengl
from .formats.table import FORMATS, NAMES, Axes, PathFormat
from .frame import (
    DEFAULT_FPS,
    MAX_FRAMES,
    MAX_GENERATED,
    CameraJson,
    Files,
    Frame,
    Parsed,
    Sampled,
    Settings,
    camera_of,
    finite,
)

if TYPE_CHECKING:
    from .framing import Balls

#: Bytes of a camera path's file. COLMAP's images.txt has all points that its images see.
LARGEST = 1 << 31

#: x, y and z in world units.
Point = tuple[float, ...]

#: Gives what the splats cover; called only by sources that are chosen for the scene.
Scene = Callable[[], "Balls"]

#: Most that a camera turns from one frame of a movement to the next, degrees: a quarter of the default field of view.
MOST_TURN = 15.0


@dataclass(frozen=True, repr=False)
class CameraPath:
    """Cameras in the order of a path.

    Attributes:
        cameras: at least one; camera-to-world in OpenGL's axes, in the world of the splats.
        format: their origin, for display.
        notes: what was ignored or assumed, one sentence each, for display.
        numbers: number of each camera in the file or on the whole path, from 0.
    """

    cameras: tuple[Camera, ...]
    format: str
    notes: tuple[str, ...]
    numbers: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.cameras)

    def __iter__(self) -> Iterator[Camera]:
        return iter(self.cameras)

    def __getitem__(self, index: int) -> Camera:
        return self.cameras[index]

    def follows(self, index: int) -> bool:
        """Return whether a camera goes on from where the one before it was, as frames of a movement do.

        It does if its time is later, its picture has the same size, and it is turned by no more than `MOST_TURN`.
        Cameras of single views have no times of their own, and those around an object are turned by more.
        """
        if index == 0:
            return False
        before, camera = self.cameras[index - 1], self.cameras[index]
        turn = before.camera_to_world[:3, :3].T @ camera.camera_to_world[:3, :3]
        return (
            camera.time > before.time
            and (camera.width, camera.height) == (before.width, before.height)
            and (float(np.trace(turn)) - 1) / 2 >= math.cos(math.radians(MOST_TURN))
        )

    def __repr__(self) -> str:
        return f"CameraPath({len(self.cameras):,} camera{'s' * (len(self.cameras) != 1)} of {self.format})"


def read(files: Files, *, format: str | None = None, settings: Settings | None = None) -> CameraPath:
    """Return the cameras of a file.

    Args:
        files: the file, and those that belong to it.
        format: name of a row of `FORMATS`; None recognizes the format by the content.

    Raises:
        CameraPathError: the file has no known format or is broken, or a camera makes no sense.
    """
    settings = settings or Settings()
    if not any(files.contents.values()):
        raise CameraPathError("it is empty")
    form = _known(files) if format is None else next(form for form in FORMATS if form.name == format)
    if settings.axes and form.axes is None:
        raise CameraPathError(f"{form.title} has targets instead of axes, so --camera-axes cannot be used with it")
    parsed = form.parse(files, settings)
    if settings.up is not None and (parsed.turned or not form.looking):
        raise CameraPathError("its cameras have their own up axes, so --up cannot be used with them")
    return cameras_of(parsed, form, settings)


def _known(files: Files) -> PathFormat:
    form = next((form for form in FORMATS if form.recognises(files)), None)
    from .formats import own

    if form is None and own.resembles_csv(files):
        form = next(form for form in FORMATS if form.name == "csv")  # whose error names the missing columns
    if form is None:
        names = ", ".join(form.name for form in FORMATS)
        raise CameraPathError(f"its content is of no known format; name the format with --camera-format ({names})")
    return form


def cameras_of(parsed: Parsed, form: PathFormat, settings: Settings) -> CameraPath:
    """Return the cameras of frames from a file or a generator.

    `CameraPathError` if there are none, or one makes no sense, which the text names; `TooManyCamerasError` if there are
    too many.
    """
    numbers = range(0, len(parsed.frames), settings.every)
    if not numbers:
        raise CameraPathError("it has no cameras")
    most = MAX_GENERATED if isinstance(parsed.frames, Sampled) else MAX_FRAMES
    if len(numbers) > most:
        raise TooManyCamerasError(f"it has {len(numbers):,} cameras, more than {most:,}; leave some out with --every")
    frames = parsed.frames[:: settings.every]
    first = frames[0].time
    world = np.eye(4) if settings.world is None else settings.world
    cameras = []
    for number, frame in zip(numbers, frames, strict=True):
        if frame.time is None or first is None or settings.fps:
            time = number / (settings.fps or parsed.fps or DEFAULT_FPS)
        else:
            time = frame.time - first
        try:
            axes = frame.axes or settings.axes or form.axes
            assert axes is not None
            with np.errstate(all="ignore"):
                pose = rigid(world @ to_opengl(frame.matrix, axes))
            cameras.append(camera_of(pose, frame.lens, time, frame.name, settings))
        except ValueError as error:
            name = f" ({' '.join(frame.name.split())[:60]})" if frame.name else ""
            raise CameraPathError(f"the camera of frame {number}{name} {error}") from None
    notes = parsed.notes
    if form.world and settings.world is None:
        notes += (form.world,)
    if not all(a.time <= b.time for a, b in itertools.pairwise(cameras)):
        notes += ("Its times do not increase; --fps replaces them.",)
    if not all(math.isfinite(camera.time) for camera in cameras):
        raise CameraPathError("its times are too far apart")
    return CameraPath(tuple(cameras), form.title, notes, tuple(numbers))


@dataclass(frozen=True)
class CameraFile:
    """The cameras of a file, or of a folder that COLMAP wrote.

    Attributes:
        format: its name in `formats.table.FORMATS`; None recognizes it by the content.
    """

    path: Path
    format: str | None = None

    fits_scene = False

    def cameras(self, settings: Settings, scene: Scene) -> CameraPath:
        return read_path(self.path, self.format, settings)


class _Aimed:
    """Cameras that look at one point from a distance; both are chosen for the scene where they are None."""

    center: Point | None
    distance: float | None
    elevation: float

    @property
    def fits_scene(self) -> bool:
        return self.distance is None

    def _aim(
        self, frames: Callable[[], Sequence[Frame]], settings: Settings, scene: Scene, times: float = 1
    ) -> tuple[Any, float]:
        """Return the target of the cameras, (3,), and their distance from there.

        Args:
            frames: makes cameras of their directions; called where something is chosen for the scene.
            times: factor of a chosen distance over that at which the scene just fits the image.
        """
        if self.center is not None and self.distance is not None:
            return self.center, self.distance
        visible = framing.covered(scene())
        center = framing.middle_of(visible) if self.center is None else np.asarray(self.center, np.float64)
        some = framing.sampled_cameras(frames())
        try:
            cameras = [camera_of(frame.matrix, frame.lens, 0, "", settings) for frame in some]
        except ValueError as error:
            raise CameraPathError(f"the camera {error}") from None
        return center, self.distance or times * framing.distance(cameras, center, visible)


@dataclass(frozen=True)
class Orbit(_Aimed):
    """Cameras once around a scene.

    Attributes:
        center: what they look at; None for the middle of the scene.
        distance: from there, world units; None for where the scene fits the image.
        elevation: above there, degrees.
    """

    count: int
    center: Point | None = None
    distance: float | None = None
    elevation: float = ELEVATION

    def cameras(self, settings: Settings, scene: Scene) -> CameraPath:
        up, tilt = settings.up_axis, math.radians(self.elevation)
        around = functools.partial(generators.orbit, self.count, (0.0, 0.0, 0.0), 1, tilt, up)
        center, distance = self._aim(around, settings, scene)
        return _generated("an orbit", generators.orbit(self.count, center, distance, tilt, up), settings)


@dataclass(frozen=True)
class Dolly(_Aimed):
    """Cameras straight towards a scene, from far to near.

    Attributes:
        center: what they look at; None for the middle of the scene.
        distance: of the first camera from there, world units; None for 4 times where the scene fits the image.
        elevation: above there, degrees.
    """

    seconds: float = generators.SECONDS
    center: Point | None = None
    distance: float | None = None
    elevation: float = ELEVATION

    def cameras(self, settings: Settings, scene: Scene) -> CameraPath:
        up, tilt = settings.up_axis, math.radians(self.elevation)
        count = max(2, round(self.seconds * (settings.fps or DEFAULT_FPS)))
        ahead = functools.partial(generators.dolly, 2, (0.0, 0.0, 0.0), 1, 1, tilt, up)
        center, distance = self._aim(ahead, settings, scene, generators.DOLLY_START)
        last = distance / generators.DOLLY_ZOOM
        return _generated("a dolly", generators.dolly(count, center, distance, last, tilt, up), settings)


@dataclass(frozen=True)
class WholeScene:
    """One camera in front of the middle of the scene, and above it, that has all of it just inside its picture."""

    elevation: float = ELEVATION

    fits_scene = True

    def cameras(self, settings: Settings, scene: Scene) -> CameraPath:
        path = Orbit(1, (0.0, 0.0, 0.0), 1.0, self.elevation).cameras(settings, scene)
        fitted = framing.fitted(path.cameras[0], framing.covered(scene()))
        return dataclasses.replace(path, cameras=(fitted,))


@dataclass(frozen=True)
class SingleViews:
    """A camera at time 0 for each pair of an eye and the target that it looks at.

    Attributes:
        views: at least one (eye, target).
        named: each camera is called after its eye and target.
    """

    views: Sequence[tuple[Point, Point]]
    named: bool = False

    fits_scene = False

    def cameras(self, settings: Settings, scene: Scene) -> CameraPath:
        up = settings.up_axis
        paths = [_generated("one view", [generators.frame_looking(*view, up)], settings) for view in self.views]
        cameras = [path.cameras[0] for path in paths]
        if self.named:
            cameras = [
                dataclasses.replace(camera, name=" to ".join(", ".join(f"{x:g}" for x in point) for point in view))
                for camera, view in zip(cameras, self.views, strict=True)
            ]
        return dataclasses.replace(paths[0], cameras=tuple(cameras), numbers=tuple(range(len(cameras))))


@dataclass(frozen=True)
class Keyframes:
    """Cameras that move smoothly from view to view.

    Attributes:
        views: at least two (eye, target).
        seconds: from one to the next, on average.
    """

    views: Sequence[tuple[Point, Point]]
    seconds: float = generators.SECONDS

    fits_scene = False

    def cameras(self, settings: Settings, scene: Scene) -> CameraPath:
        keys = [generators.Key(eye, target) for eye, target in self.views]
        fps, up = settings.fps or DEFAULT_FPS, settings.up_axis
        return _generated("keyframes", generators.between(keys, fps, up, seconds=self.seconds), settings)


#: Each has `fits_scene`, whether its cameras are as far away as the scene asks for, and
#: `cameras(settings, scene) -> CameraPath`, which raises a `CameraPathError` where a camera makes no sense, its
#: subclass `TooManyCamerasError` where there are too many, and an `InvalidSplatsError` where there is no scene to fit.
CameraSource = CameraFile | Orbit | Dolly | WholeScene | SingleViews | Keyframes


def read_path(path: Path, format: str | None = None, settings: Settings | None = None) -> CameraPath:
    """Return the cameras of a file, or of a folder that COLMAP wrote; see `read`.

    A `CameraPathError`, also where it cannot be read, names the file.
    """
    try:
        contents = io.read_together(path, NAMES, LARGEST)
    except SparklodError as error:
        raise CameraPathError(str(error)) from None
    try:
        return read(Files(path, contents), format=format, settings=settings)
    except CameraPathError as error:
        raise CameraPathError(f"{path}: {error}") from None


def similarity(text: str) -> Matrix:
    """Return a (4, 4) matrix of a rotation, a uniform scale and a translation from 16 numbers, row by row.

    The numbers are separated by commas or white space, or JSON: a list of them or of rows. The text of a
    `CameraPathError` continues a sentence about them.
    """
    words = re.split(r"[\s,;]+", text.strip())
    try:
        if text.lstrip().startswith("["):
            numbers = CameraJson(parse_json(text), Origin("matrix", CameraPathError)).matrix(4)
        else:
            numbers = [finite(word, "matrix") for word in words]
    except ValueError:
        raise CameraPathError("is not JSON") from None
    if len(numbers) != 16:
        raise CameraPathError(f"has {len(numbers)} numbers, not 16")
    matrix = np.array(numbers).reshape(4, 4)
    try:
        rigid(matrix)
    except ValueError as error:
        raise CameraPathError(f"{error}") from None
    return matrix


def read_world_transform(path: Path) -> Matrix:
    """Return the `similarity` in a file; a `CameraPathError` names the file."""
    try:
        return similarity(io.read_text(path))
    except CameraPathError as error:
        raise CameraPathError(f"{path}: --world-transform {error}") from None
    except SparklodError as error:
        raise CameraPathError(str(error)) from None


def _generated(title: str, frames: Sequence[Frame], settings: Settings) -> CameraPath:
    return cameras_of(Parsed(frames), PathFormat("", title, "", Axes.OPENGL_C2W), settings)
