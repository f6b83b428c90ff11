"""Camera paths that need no file: around a scene, towards it, a single view, and smoothly from key to key."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..support.errors import CameraPathError
from .axes import Axes
from .camera import Matrix
from .frame import DEFAULT_FOV_Y, DEFAULT_FPS, NO_LENS, NUMBERED, Frame, Lens, Sampled, sampled
from .pose import look_at, normalized
from .spline import catmull_rom_tangents, centripetal_knots, hermite

#: Seconds from one key to the next, on average, where the keys have no times.
SECONDS = 2.0

#: A dolly begins so many times as far away as the scene fits the image, and ends where it is this much larger.
DOLLY_START, DOLLY_ZOOM = 4.0, 16.0


@dataclass(frozen=True)
class Key:
    """Where a camera must pass.

    Attributes:
        eye, target: x, y, z in the world.
        up: x, y, z; None for the up of the path.
        fov: radians; None leaves it to the lens.
        time: seconds; all keys of a path have one, or none has.
    """

    eye: tuple[float, ...]
    target: tuple[float, ...]
    up: tuple[float, ...] | None = None
    fov: float | None = None
    time: float | None = None


def frame_looking(
    eye: ArrayLike, target: ArrayLike, up: ArrayLike, lens: Lens = NO_LENS, time: float | None = None, name: str = ""
) -> Frame:
    """A frame at `eye`, (3,), that looks at `target`, (3,), with `up`, (3,), upwards.

    Raises:
        CameraPathError: eye and target are the same point.
    """
    try:
        return Frame(look_at(eye, target, up), lens, time, name, Axes.OPENGL_C2W)
    except ValueError as error:
        raise CameraPathError(f"the camera at {_spell(eye)} {error}") from None


def orbit(count: int, center: ArrayLike, distance: float, elevation: float, up: ArrayLike) -> Sampled:
    """`count` frames once around, counter-clockwise as seen from above.

    Args:
        count: of frames.
        center: (3,) that all look at.
        distance: of each from it, world units.
        elevation: above it, radians.
        up: (3,) the axis.
    """
    axis = normalized(up)
    front = _front(axis)
    side = np.cross(axis, front)

    def at(numbers: NDArray[np.int64]) -> list[Frame]:
        turn = 2 * math.pi * numbers[:, None] / count
        offset = math.cos(elevation) * (np.cos(turn) * front + np.sin(turn) * side) + math.sin(elevation) * axis
        return _looking_at(center, np.full(len(numbers), distance), offset, axis)

    return Sampled(count, at)


def dolly(count: float, center: ArrayLike, far: float, near: float, elevation: float, up: ArrayLike) -> Sampled:
    """`count` frames straight towards a point; from each to the next, what is there grows by the same factor.

    Args:
        count: of frames, at least 2.
        center: (3,) that all look at.
        far, near: distance of the first and the last from it, world units.
        elevation: above it, radians.
        up: (3,)
    """
    axis = normalized(up)
    offset = math.cos(elevation) * _front(axis) + math.sin(elevation) * axis

    def at(numbers: NDArray[np.int64]) -> list[Frame]:
        away = far * (near / far) ** (numbers / (count - 1))
        return _looking_at(center, away, np.broadcast_to(offset, (len(numbers), 3)), axis)

    return sampled(count, at)


def _looking_at(center: ArrayLike, distance: Matrix, offset: Matrix, up: Matrix) -> list[Frame]:
    """Frames that look at a point, (3,), from (N,) distances along (N, 3) unit vectors."""
    target = np.asarray(center, np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        eyes = target + distance[:, None] * offset
    return [frame_looking(eye, target, up) for eye in eyes]


def between(
    keys: Sequence[Key], fps: float | None, up: ArrayLike, lens: Lens = NO_LENS, seconds: float = SECONDS
) -> Sampled:
    """Frames from the first key to the last, on a Catmull-Rom spline through all of them.

    Eye, target, up and field of view each have theirs, so that what two keys look at stays in view between them. The
    spline's parameter is the time. Where the keys have none it is shared out centripetally, by the square roots of the
    distances between keys (Yuksel, Schaefer and Keyser 2011), which makes no loops and no cusps.

    Args:
        keys: at least two.
        fps: frames a second; None is the default.
        up: (3,) for keys that have none.
        lens: for what keys do not say.
        seconds: from key to key on average, where keys have no times.

    Raises:
        CameraPathError: there are too few keys, or too many frames; times are missing, or do not increase.
    """
    rate = fps or DEFAULT_FPS
    if len(keys) < 2:
        raise CameraPathError("a path of keyframes takes two of them, or more")
    ups = [normalized(key.up or up) for key in keys]
    known = lens.fov if lens.fov is not None else DEFAULT_FOV_Y
    fovs = [key.fov if key.fov is not None else known for key in keys]
    values = np.array([[*key.eye, *key.target, *up, fov] for key, up, fov in zip(keys, ups, fovs, strict=True)])
    knots = _times(keys, values, seconds)
    with np.errstate(all="ignore"):
        count = (float(knots[-1]) - float(knots[0])) * rate
        tangents = catmull_rom_tangents(knots, values)
    fov_is_known = any(key.fov is not None for key in keys)

    def at(numbers: NDArray[np.int64]) -> list[Frame]:
        times = numbers / rate
        samples = along(lambda at: hermite(knots, values, tangents, at), np.minimum(knots[0] + times, knots[-1]))
        frames = []
        for time, sample in zip(times, samples, strict=True):
            fov = float(np.clip(sample[9], min(fovs), max(fovs)))  # a spline may overshoot
            own = dataclasses.replace(lens, fov=fov, focal=None) if fov_is_known else lens
            frames.append(frame_looking(sample[:3], sample[3:6], sample[6:9], own, float(time)))
        return frames

    return sampled(math.floor(count + 1e-6) + 1 if count < NUMBERED else count, at)


def along(curve: Callable[[Matrix], Matrix], at: Matrix) -> Matrix:
    """(N, K) points of a curve.

    Args:
        curve: from parameters to points.
        at: (N,) parameters.

    Raises:
        CameraPathError: some are no numbers: keys are too far apart, or too near in time.
    """
    with np.errstate(all="ignore"):
        points = curve(at)
    if not np.isfinite(points).all():
        raise CameraPathError("its keyframes have numbers so large that what is between them is no number")
    return points


def _times(keys: Sequence[Key], values: Matrix, seconds: float) -> Matrix:
    """(keys,) seconds."""
    times = [key.time for key in keys]
    if all(time is None for time in times):
        knots = centripetal_knots(values[:, :6])
        return knots * (seconds * (len(keys) - 1) / knots[-1])
    if any(time is None for time in times):
        raise CameraPathError("some of its keyframes have a time, and some have none")
    knots = np.array(times, np.float64)
    with np.errstate(all="ignore"):
        if not (np.diff(knots) > 0).all():
            raise CameraPathError("the times of its keyframes do not increase")
    return knots


def _front(up: Matrix) -> Matrix:
    """(3,) the side of a scene from which it is first seen: -z where -y is up, +z where y is, -y where z is."""
    across = np.cross([1.0, 0.0, 0.0], up)
    return normalized(across if np.linalg.norm(across) > 1e-6 else np.cross([0.0, 1.0, 0.0], up))


def _spell(point: ArrayLike) -> str:
    return ", ".join(f"{value:g}" for value in np.asarray(point))
