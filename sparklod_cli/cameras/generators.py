"""Camera paths without a file: orbits, dollies, single views, and splines through keyframes."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..system.errors import CameraPathError
from .camera import Matrix, look_at, normalized
from .formats.table import Axes
from .frame import DEFAULT_FOV_Y, DEFAULT_FPS, NO_LENS, NUMBERED, Frame, Intrinsics, Sampled, sampled

#: Mean seconds from one key to the next, if the keys have no times.
SECONDS = 2.0

#: Distance at the start of a dolly, in multiples of that at which the scene fits the image, and how many times larger
#: the scene is at its end.
DOLLY_START, DOLLY_ZOOM = 4.0, 16.0

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


def orbit(count: int, center: ArrayLike, distance: float, elevation: float, up: ArrayLike) -> Sampled:
    """Return `count` frames once around a point, (3,) `center`, counter-clockwise seen from above.

    `distance` is in world units, `elevation` an angle above the point, radians, `up` the (3,) axis of the orbit.
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
    """Return `count` frames, at least 2, straight towards a point, which grows by the same factor from frame to frame.

    `far` and `near` are distances of the first and the last frame, world units; `center`, `elevation` and `up` as in
    `orbit`.
    """
    axis = normalized(up)
    offset = math.cos(elevation) * _front(axis) + math.sin(elevation) * axis

    def at(numbers: NDArray[np.int64]) -> list[Frame]:
        away = far * (near / far) ** (numbers / (count - 1))
        return _looking_at(center, away, np.broadcast_to(offset, (len(numbers), 3)), axis)

    return sampled(count, at)


def _looking_at(center: ArrayLike, distance: Matrix, offset: Matrix, up: Matrix) -> list[Frame]:
    """N frames that look at a point, (3,), from (N,) distances along (N, 3) unit vectors."""
    target = np.asarray(center, np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        eyes = target + distance[:, None] * offset
    return [frame_looking(eye, target, up) for eye in eyes]


def between(
    keys: Sequence[Key], fps: float | None, up: ArrayLike, lens: Intrinsics = NO_LENS, seconds: float = SECONDS
) -> Sampled:
    """Return frames from the first key to the last, on a Catmull-Rom spline through all of them.

    Eye, target, up axis and field of view are interpolated separately, so that a target of two keys stays in view
    between them. The parameter of the spline is time. Keys without times are spaced centripetally, by the square roots
    of the distances between them (Yuksel, Schaefer and Keyser 2011), which avoids loops and cusps.

    Args:
        fps: frames a second; None for `DEFAULT_FPS`.
        up: (3,) up axis of keys without one.
        lens: of keys without a field of view.
        seconds: mean time from key to key, if keys have no times.

    Raises:
        CameraPathError: there are fewer than two keys, or too many frames; times are missing, or do not increase.
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


def _front(up: Matrix) -> Matrix:
    """(3,) direction from which a scene is seen first: -z if -y is up, +z if y is up, -y if z is up."""
    across = np.cross([1.0, 0.0, 0.0], up)
    return normalized(across if np.linalg.norm(across) > 1e-6 else np.cross([0.0, 1.0, 0.0], up))


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
