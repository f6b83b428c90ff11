"""Cameras of a path, and their sources without a file: an orbit, a dolly, single views, keyframes, the whole scene."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..system.errors import CameraPathError, TooManyCamerasError
from . import framing, generators
from .camera import Camera, rigid, to_opengl
from .formats.table import Axes
from .frame import DEFAULT_FPS, MAX_FRAMES, MAX_GENERATED, Frame, Sampled, Settings, camera_of

if TYPE_CHECKING:
    from .framing import Balls

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


def cameras_of(
    frames: Sequence[Frame] | Sampled,
    settings: Settings,
    title: str,
    axes: Axes | None = Axes.OPENGL_C2W,
    *,
    fps: float | None = None,
    notes: tuple[str, ...] = (),
) -> CameraPath:
    """Return the cameras of frames from a file or a generator.

    Args:
        title: origin of the frames, for display.
        axes: of frames without their own, unless settings have some.
        fps: frames a second of the file; None if it gives none.
        notes: what was ignored or assumed.

    Raises:
        CameraPathError: there are no cameras, or one makes no sense, which the text names; its subclass
            `TooManyCamerasError` if there are too many.
    """
    length = frames.length if isinstance(frames, Sampled) else len(frames)
    numbers = range(0, length, settings.every)
    if not numbers:
        raise CameraPathError("it has no cameras")
    most = MAX_GENERATED if isinstance(frames, Sampled) else MAX_FRAMES
    if len(numbers) > most:
        raise TooManyCamerasError(f"it has {len(numbers):,} cameras, more than {most:,}; leave some out with --every")
    every = settings.every
    chosen = frames.at(np.arange(0, length, every)) if isinstance(frames, Sampled) else frames[::every]
    first = chosen[0].time
    world = np.eye(4) if settings.world is None else settings.world
    cameras = []
    for number, frame in zip(numbers, chosen, strict=True):
        if frame.time is None or first is None or settings.fps:
            time = number / (settings.fps or fps or DEFAULT_FPS)
        else:
            time = frame.time - first
        try:
            own = frame.axes or settings.axes or axes
            assert own is not None
            with np.errstate(all="ignore"):
                matrix = frame.matrix if own is Axes.OPENGL_C2W else to_opengl(frame.matrix, own)
                pose = rigid(world @ matrix)
            cameras.append(camera_of(pose, frame.lens, time, frame.name, settings))
        except ValueError as error:
            name = f" ({' '.join(frame.name.split())[:60]})" if frame.name else ""
            raise CameraPathError(f"the camera of frame {number}{name} {error}") from None
    if not all(a.time <= b.time for a, b in itertools.pairwise(cameras)):
        notes += ("Its times do not increase; --fps replaces them.",)
    if not all(math.isfinite(camera.time) for camera in cameras):
        raise CameraPathError("its times are too far apart")
    return CameraPath(tuple(cameras), title, notes, tuple(numbers))


class CameraSource(NamedTuple):
    """Cameras that a user chose.

    Attributes:
        cameras: makes them, of settings and the scene. It raises a `CameraPathError` where a camera makes no sense, its
            subclass `TooManyCamerasError` where there are too many, and an `InvalidSplatsError` where there is no scene
            to fit.
        fits_scene: they are as far away as the scene asks for.
    """

    cameras: Callable[[Settings, Scene], CameraPath]
    fits_scene: bool = False


def orbit(
    count: int, center: Point | None, distance: float | None, elevation: float, settings: Settings, scene: Scene
) -> CameraPath:
    """Return cameras once around a scene.

    Args:
        center: what they look at; None for the middle of the scene.
        distance: from there, world units; None for where the scene fits the image.
        elevation: above there, degrees.
    """
    up, tilt = settings.up_axis, math.radians(elevation)
    around = generators.orbit(count, (0.0, 0.0, 0.0), 1, tilt, up)
    target, away = _aim(around, center, distance, settings, scene)
    return cameras_of(generators.orbit(count, target, away, tilt, up), settings, "an orbit")


def dolly(
    seconds: float, center: Point | None, distance: float | None, elevation: float, settings: Settings, scene: Scene
) -> CameraPath:
    """Return cameras straight towards a scene, from far to near.

    Args:
        center: what they look at; None for the middle of the scene.
        distance: of the first camera from there, world units; None for 4 times where the scene fits the image.
        elevation: above there, degrees.
    """
    up, tilt = settings.up_axis, math.radians(elevation)
    count = max(2, round(seconds * (settings.fps or DEFAULT_FPS)))
    ahead = generators.dolly(2, (0.0, 0.0, 0.0), 1, 1, tilt, up)
    target, first = _aim(ahead, center, distance, settings, scene, generators.DOLLY_START)
    last = first / generators.DOLLY_ZOOM
    return cameras_of(generators.dolly(count, target, first, last, tilt, up), settings, "a dolly")


def _aim(
    directions: Sampled,
    center: Point | None,
    distance: float | None,
    settings: Settings,
    scene: Scene,
    times: float = 1,
) -> tuple[ArrayLike, float]:
    """Return the target of cameras, (3,), and their distance from there; both are chosen for the scene where None.

    Args:
        directions: the cameras, at any distance.
        times: factor of a chosen distance over that at which the scene just fits the image.
    """
    if center is not None and distance is not None:
        return center, distance
    visible = framing.covered(scene())
    target = framing.middle_of(visible) if center is None else np.asarray(center, np.float64)
    if distance is None:
        frames = directions.at(np.arange(0, directions.length, -(-directions.length // framing.CAMERAS)))
        try:
            cameras = [camera_of(frame.matrix, frame.lens, 0, "", settings) for frame in frames]
        except ValueError as error:
            raise CameraPathError(f"the camera {error}") from None
        distance = times * framing.distance(cameras, target, visible)
    return target, distance


def whole_scene(elevation: float, settings: Settings, scene: Scene) -> CameraPath:
    """Return one camera in front of the middle of the scene, and above it, that just has all of it in its picture."""
    path = orbit(1, (0.0, 0.0, 0.0), 1.0, elevation, settings, scene)
    fitted = framing.fitted(path.cameras[0], framing.covered(scene()))
    return dataclasses.replace(path, cameras=(fitted,))


def single_views(views: Sequence[tuple[Point, Point]], settings: Settings, *, named: bool = False) -> CameraPath:
    """Return a camera at time 0 for each pair, at least one, of an eye and the target that it looks at.

    `named` cameras are called after their eye and target.
    """
    cameras: list[Camera] = []
    for view in views:
        path = cameras_of([generators.frame_looking(*view, settings.up_axis)], settings, "one view")
        name = " to ".join(", ".join(f"{x:g}" for x in point) for point in view) if named else ""
        cameras.append(dataclasses.replace(path.cameras[0], name=name))
    return dataclasses.replace(path, cameras=tuple(cameras), numbers=tuple(range(len(cameras))))


def keyframes(views: Sequence[tuple[Point, Point]], seconds: float, settings: Settings) -> CameraPath:
    """Return cameras that move smoothly along at least two views, eye and target, `seconds` each on average."""
    keys = [generators.Key(eye, target) for eye, target in views]
    fps, up = settings.fps or DEFAULT_FPS, settings.up_axis
    return cameras_of(generators.between(keys, fps, up, seconds=seconds), settings, "keyframes")
