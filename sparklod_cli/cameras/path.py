"""Camera paths: turns the frames of a parser or a generator into cameras in OpenGL's axes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..system.errors import CameraPathError, TooManyCamerasError
from .camera import Camera
from .formats.source import Files, Parsed
from .formats.table import FORMATS, PathFormat
from .frame import DEFAULT_FPS, MAX_FRAMES, MAX_GENERATED, Sampled, Settings, camera_of
from .pose import rigid, to_opengl

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

    Raises:
        CameraPathError: there are none, or one makes no sense; the text names it.
        TooManyCamerasError: there are too many.
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
