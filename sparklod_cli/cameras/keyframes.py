"""Keyframes: views through which a camera moves on a spline."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..system.errors import CameraPathError
from .camera import (
    DEFAULT_FOV_Y,
    DEFAULT_FPS,
    DEFAULT_SECONDS,
    NO_LENS,
    NUMBERED,
    Frame,
    Intrinsics,
    Matrix,
    Numbers,
    frame_looking,
    normalized,
)

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
    """Return a function of numbers of frames, from the first key to the last, and how many frames there are.

    The frames are on a Catmull-Rom spline through all keys.

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
