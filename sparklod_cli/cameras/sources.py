"""Cameras of a path, and their sources without a file: an orbit, a dolly, single views, the whole scene, keyframes."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..system.errors import CameraPathError, TooManyCamerasError
from . import framing
from .camera import (
    DEFAULT_FOV_Y,
    DEFAULT_FPS,
    DEFAULT_SECONDS,
    MAX_FRAMES,
    MAX_GENERATED,
    NO_LENS,
    NUMBERED,
    Camera,
    Frame,
    Intrinsics,
    Matrix,
    Numbers,
    Settings,
    camera_of,
    frame_looking,
    normalized,
    rigid,
    to_opengl,
)
from .camera_formats import Axes

#: x, y and z in world units.
Point = tuple[float, ...]

#: Returns the bounding spheres of the splats; called only where a camera is placed by the scene.
Scene = Callable[[], framing.Balls]

#: Most that a camera turns from one frame of a movement to the next, degrees: a quarter of the default field of view.
MOST_TURN = 15.0


@dataclass(frozen=True, repr=False)
class CameraPath:
    """Cameras in the order of a path.

    Attributes:
        cameras: at least one; camera-to-world in OpenGL's axes, in the world of the splats.
        format: their origin, for display.
        notes: ignored parts and assumptions, one sentence each, for display.
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
        """Return whether a camera continues the movement of the one before it.

        It does if its time is later, its picture has the same size, and it is turned by no more than `MOST_TURN`.
        Cameras of single views all have the same time, and cameras around an object are turned by more.
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
    frames: Sequence[Frame] | Callable[[Numbers], list[Frame]],
    settings: Settings,
    title: str,
    axes: Axes | None = Axes.OPENGL_C2W,
    *,
    count: float = 0,
    fps: float | None = None,
    notes: tuple[str, ...] = (),
) -> CameraPath:
    """Return the cameras of frames from a file or a generator.

    Args:
        frames: all of them; or a function of (K,) numbers of frames, as a few keys can yield any number of them.
        axes: of frames without their own, unless settings have some.
        count: number of frames, rounded up and at least one, where a function computes them.

    Raises:
        CameraPathError: there are no cameras, or one is impossible, which the text names; its subclass
            `TooManyCamerasError` if there are too many.
    """
    every, is_listed = settings.every, isinstance(frames, Sequence)
    if not is_listed and not count < NUMBERED:
        raise TooManyCamerasError(f"{count:.3g} frames are more than {MAX_GENERATED:,}")
    numbers = range(0, len(frames) if isinstance(frames, Sequence) else max(math.ceil(count), 1), every)
    if not numbers:
        raise CameraPathError("it has no cameras")
    most = MAX_FRAMES if is_listed else MAX_GENERATED
    if len(numbers) > most:
        raise TooManyCamerasError(f"it has {len(numbers):,} cameras, more than {most:,}; leave some out with --every")
    chosen = frames[::every] if isinstance(frames, Sequence) else frames(np.array(numbers))
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


#: Distance at the start of a dolly, in multiples of that at which the scene fits the image, and how many times larger
#: the scene is at its end.
DOLLY_START, DOLLY_ZOOM = 4.0, 16.0


def _frames_around(center: ArrayLike, distance: Matrix, turn: Matrix, elevation: float, up: ArrayLike) -> list[Frame]:
    """Return N frames that look at a point, (3,), from (N,) distances, turned by (N,) radians from its front.

    A scene is seen first from the front: from -z if -y is up, from +z if y is up, from -y if z is up.
    """
    axis, target = normalized(up), np.asarray(center, np.float64)
    across = np.cross([1.0, 0.0, 0.0], axis)
    front = normalized(across if np.linalg.norm(across) > 1e-6 else np.cross([0.0, 1.0, 0.0], axis))
    side, turn = np.cross(axis, front), turn[:, None]
    offset = math.cos(elevation) * (np.cos(turn) * front + np.sin(turn) * side) + math.sin(elevation) * axis
    with np.errstate(over="ignore", invalid="ignore"):
        eyes = target + distance[:, None] * offset
    return [frame_looking(eye, target, axis) for eye in eyes]


def orbit(
    count: int, center: Point | None, distance: float | None, elevation: float, settings: Settings, scene: Scene
) -> CameraPath:
    """Return cameras once around a point, the middle of the scene if None.

    `distance` from there is in world units, None for where the scene fits the image; `elevation` in degrees.
    """
    up, tilt = settings.up_axis, math.radians(elevation)
    some = np.arange(0, count, -(-count // framing.CAMERAS))
    ahead = _frames_around((0.0, 0.0, 0.0), np.ones(len(some)), 2 * math.pi * some / count, tilt, up)
    target, away = _aim(ahead, center, distance, settings, scene)

    def frames(numbers: Numbers) -> list[Frame]:
        return _frames_around(target, np.full(len(numbers), away), 2 * math.pi * numbers / count, tilt, up)

    return cameras_of(frames, settings, "an orbit", count=count)


def dolly(
    seconds: float, center: Point | None, distance: float | None, elevation: float, settings: Settings, scene: Scene
) -> CameraPath:
    """Return cameras straight towards a point, from far to near; `center` and `elevation` as in `orbit`.

    `distance` is that of the first camera, world units, None for 4 times that at which the scene fits the image.
    """
    up, tilt = settings.up_axis, math.radians(elevation)
    count = max(2, round(seconds * (settings.fps or DEFAULT_FPS)))
    ahead = _frames_around((0.0, 0.0, 0.0), np.ones(1), np.zeros(1), tilt, up)
    target, far = _aim(ahead, center, distance, settings, scene, DOLLY_START)

    def frames(numbers: Numbers) -> list[Frame]:
        away = far * (1 / DOLLY_ZOOM) ** (numbers / (count - 1))  # the scene grows by one factor a frame
        return _frames_around(target, away, np.zeros(len(numbers)), tilt, up)

    return cameras_of(frames, settings, "a dolly", count=count)


def _aim(
    frames: Sequence[Frame],
    center: Point | None,
    distance: float | None,
    settings: Settings,
    scene: Scene,
    times: float = 1,
) -> tuple[Point, float]:
    """Return the target of cameras, (3,), and their distance from there; both are chosen for the scene where None.

    The cameras of `frames` may be at any distance; a chosen distance is `times` that at which the scene fits the image.
    """
    if center is not None and distance is not None:
        return center, distance
    visible = framing.covered(scene())
    target = framing.middle_of(visible) if center is None else np.asarray(center, np.float64)
    if distance is None:
        try:
            cameras = [camera_of(frame.matrix, frame.lens, 0, "", settings) for frame in frames]
        except ValueError as error:
            raise CameraPathError(f"the camera {error}") from None
        distance = times * framing.distance(cameras, target, visible)
    return tuple(target), distance


def whole_scene(elevation: float, settings: Settings, scene: Scene) -> CameraPath:
    """Return one camera in front of the scene, `elevation` degrees above it, whose picture the scene just fits."""
    path = orbit(1, (0.0, 0.0, 0.0), 1.0, elevation, settings, scene)
    fitted = framing.fitted(path.cameras[0], framing.covered(scene()))
    return dataclasses.replace(path, cameras=(fitted,))


def single_views(views: Sequence[tuple[Point, Point]], settings: Settings, *, named: bool = False) -> CameraPath:
    """Return a camera at time 0 for each pair, at least one, of an eye and the target that it looks at.

    The names of `named` cameras have their eye and target.
    """
    frames = []
    for view in views:
        name = " to ".join(", ".join(f"{x:g}" for x in point) for point in view) if named else ""
        frames.append(frame_looking(*view, settings.up_axis, time=0.0, name=name))
    return cameras_of(frames, dataclasses.replace(settings, fps=None, every=1), "one view")


def keyframes(views: Sequence[tuple[Point, Point]], seconds: float, settings: Settings) -> CameraPath:
    """Return cameras that move smoothly along at least two views, eye and target, `seconds` each on average."""
    keys = [Key(eye, target) for eye, target in views]
    frames, count = between(keys, settings.fps or DEFAULT_FPS, settings.up_axis, seconds=seconds)
    return cameras_of(frames, settings, "keyframes", count=count)


#: Smallest step between knots as a share of the mean step, so that no step takes no time.
SHORTEST = 1e-3


@dataclass(frozen=True)
class Key:
    """A keyframe: a view through which the camera must pass.

    Attributes:
        eye, target: x, y, z in the world.
        up: x, y, z; None for the up axis of the path.
        fov: field of view in radians; None for that of the lens.
        time: seconds; either all keys of a path have a time or none.
    """

    eye: tuple[float, ...]
    target: tuple[float, ...]
    up: tuple[float, ...] | None = None
    fov: float | None = None
    time: float | None = None


def between(
    keys: Sequence[Key], fps: float | None, up: ArrayLike, lens: Intrinsics = NO_LENS, seconds: float = DEFAULT_SECONDS
) -> tuple[Callable[[Numbers], list[Frame]], float]:
    """Return a function that computes frames from their numbers, on a Catmull-Rom spline through all keys; their count.

    Eye, target, up axis and field of view are interpolated separately, so that a target of two keys stays in view
    between them. The parameter of the spline is time. Keys without times are spaced centripetally, by the square roots
    of the distances between them (Yuksel, Schaefer and Keyser 2011), which avoids loops and cusps.

    `up` and `lens` are for keys without their own; `seconds` is the mean time from key to key, if keys have no times.
    `CameraPathError` if there are fewer than two keys, some times are missing, or they do not increase.
    """
    rate = fps or DEFAULT_FPS
    if len(keys) < 2:
        raise CameraPathError("a path needs at least two keyframes")
    ups = [normalized(key.up or up) for key in keys]
    known = lens.fov if lens.fov is not None else DEFAULT_FOV_Y
    fovs = [key.fov if key.fov is not None else known for key in keys]
    values = np.array([[*key.eye, *key.target, *up, fov] for key, up, fov in zip(keys, ups, fovs, strict=True)])
    knots = _times(keys, values, seconds)
    with np.errstate(all="ignore"):
        count = (float(knots[-1]) - float(knots[0])) * rate
        tangents = catmull_rom_tangents(knots, values)
    fov_is_known = any(key.fov is not None for key in keys)

    def at(numbers: Numbers) -> list[Frame]:
        times = numbers / rate
        samples = along(lambda at: hermite(knots, values, tangents, at), np.minimum(knots[0] + times, knots[-1]))
        frames = []
        for time, sample in zip(times, samples, strict=True):
            fov = float(np.clip(sample[9], min(fovs), max(fovs)))  # a spline may overshoot
            own = dataclasses.replace(lens, fov=fov, focal=None) if fov_is_known else lens
            frames.append(frame_looking(sample[:3], sample[3:6], sample[6:9], own, float(time)))
        return frames

    return at, math.floor(count + 1e-6) + 1 if count < NUMBERED else count


def along(curve: Callable[[Matrix], Matrix], at: Matrix) -> Matrix:
    """Return (N, K) points of a curve; `CameraPathError` if keys are too far apart, or too close in time."""
    with np.errstate(all="ignore"):
        points = curve(at)
    if not np.isfinite(points).all():
        raise CameraPathError("its keyframes are too far apart, or too close in time, to interpolate between them")
    return points


def _times(keys: Sequence[Key], values: Matrix, seconds: float) -> Matrix:
    times = [key.time for key in keys]
    if all(time is None for time in times):
        knots = centripetal_knots(values[:, :6])
        return knots * (seconds * (len(keys) - 1) / knots[-1])
    if any(time is None for time in times):
        raise CameraPathError("some of its keyframes have a time and some have none; give a time to all or to none")
    knots = np.array(times, np.float64)
    with np.errstate(all="ignore"):
        if not (np.diff(knots) > 0).all():
            raise CameraPathError("the times of its keyframes do not increase")
    return knots


def centripetal_knots(points: Matrix) -> Matrix:
    """Return (n,) knots from 0 on that differ by the square roots of the distances between n >= 2 points, (n, D).

    If all points are the same, the steps are 1.
    """
    with np.errstate(over="ignore"):
        steps = np.sqrt(np.linalg.norm(np.diff(points, axis=0), axis=1))
    steps = np.maximum(steps, SHORTEST * steps.mean()) if steps.any() else np.ones(len(steps))
    return np.concatenate([[0.0], np.cumsum(steps)])


def catmull_rom_tangents(knots: Matrix, points: Matrix) -> Matrix:
    """Return (n, D) tangents of the Catmull-Rom spline with (n,) increasing knots, n >= 2 (Barry and Goldman 1988).

    Each is the tangent of the parabola through a point and its neighbours; at the ends, through the last three points.
    """
    steps = np.diff(knots)[:, None]
    slopes = np.diff(points, axis=0) / steps
    if len(points) == 2:
        return np.repeat(slopes, 2, axis=0)
    inner = (slopes[:-1] * steps[1:] + slopes[1:] * steps[:-1]) / (steps[:-1] + steps[1:])
    return np.concatenate([2 * slopes[:1] - inner[:1], inner, 2 * slopes[-1:] - inner[-1:]])


def cardinal_tangents(knots: Matrix, points: Matrix) -> Matrix:
    """Return (n, D) tangents along the line from the previous to the next point, as SuperSplat has them."""
    slopes = np.diff(points, axis=0) / np.diff(knots)[:, None]
    inner = (points[2:] - points[:-2]) / (knots[2:] - knots[:-2])[:, None]
    return np.concatenate([slopes[:1], inner, slopes[-1:]])


def hermite(knots: Matrix, points: Matrix, tangents: Matrix, at: Matrix) -> Matrix:
    """Return (m, D) points, at (m,) parameters, of the piecewise cubic curve with points and tangents at `knots`."""
    piece = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)
    step = np.diff(knots)[piece, None]
    t = (at[:, None] - knots[piece, None]) / step
    return (
        (1 + 2 * t) * (1 - t) ** 2 * points[piece]
        + t * (1 - t) ** 2 * step * tangents[piece]
        + t * t * (3 - 2 * t) * points[piece + 1]
        + t * t * (t - 1) * step * tangents[piece + 1]
    )
