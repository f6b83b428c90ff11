"""Where pictures of a whole scene are seen from, and how much of it they show."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.splats import Splats
from .ellipsoids import Points

#: A picture shows the outermost splats too where they are not farther from the others than this share of these.
NEAR = 0.35


@dataclass(frozen=True)
class Viewpoint:
    """Where a picture of a whole scene is seen from, in perspective; a path is made of `camera.Camera`s.

    Attributes:
        position, target: (3,) world units.
        axes: (3, 3) rows: to the right, up, and into the picture.
        angle: degrees that the height of the picture spans.
        aspect: width over height.
        shift: where `target` stands in the picture: -1 left or bottom, 0 middle, 1 right or top.
    """

    position: Points
    target: Points
    axes: Points
    angle: float
    aspect: float
    shift: Points

    def project(self, points: Points) -> Points:
        """(N, 3) points to (N, 2) places in the picture: 0..1 from its left and from its top."""
        local = (np.asarray(points, np.float64) - self.position) @ self.axes.T
        return (1 + (_seen(local, self.angle, self.aspect) + self.shift) * (1, -1)) / 2


def viewpoint(
    points: Points, direction: Points, up: Points, *, aspect: float, frame: tuple[float, float, float, float]
) -> Viewpoint:
    """The viewpoint that looks along a direction and has all points just inside a frame.

    Args:
        points: (N, 3) to be seen.
        direction, up: (3,) world axes.
        aspect: width over height.
        frame: left, top, right and bottom of the frame in the picture, 0..1 from its left and from its top.
    """
    angle = 25.0
    forward = direction / np.linalg.norm(direction)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(right, forward), forward])
    target = (points.min(axis=0) + points.max(axis=0)) / 2
    local = (points - target) @ axes.T
    left, top, end, bottom = frame
    room = 2 * np.array([end - left, bottom - top])
    radius = float(np.linalg.norm(local, axis=1).max()) or 1.0
    near, far = 1.01 * radius, 1e3 * radius
    for _ in range(60):  # halves what the distance can be: the picture shrinks with it
        distance = (near + far) / 2
        seen = _seen(local + np.array([0, 0, distance]), angle, aspect)
        near, far = (near, distance) if (np.ptp(seen, axis=0) <= room).all() else (distance, far)
    seen = _seen(local + np.array([0, 0, far]), angle, aspect)
    shift = np.array([left + end - 1, 1 - top - bottom]) - (seen.min(axis=0) + seen.max(axis=0)) / 2
    return Viewpoint(target - far * forward, target, axes, angle, aspect, shift)


def _seen(local: Points, angle: float, aspect: float) -> Points:
    """(N, 3) points in the axes of a viewpoint to (N, 2) places, -1..1 from the left and from the bottom."""
    half = math.tan(math.radians(angle) / 2)
    return local[:, :2] / (local[:, 2:] * (half * aspect, half))


def is_drawable(splats: Splats) -> NDArray[np.bool_]:
    """(N,) whether a splat is valid and has a size."""
    drawable: NDArray[np.bool_] = splats.is_valid() & (splats.scale.max(axis=1) > 0)
    return drawable


def bounds(splats: Splats) -> tuple[Points, Points]:
    """The box that a picture shows: 1 % to 99 % of the splats along each axis, or all where the others are near.

    Args:
        splats: at least one, all of them drawable.
    """
    reach = splats.scale.max(axis=1).astype(np.float64)
    ends = np.empty((4, 3))
    for axis in range(3):
        center = splats.center[:, axis].astype(np.float64)
        low, high = np.percentile(center - reach, 1), np.percentile(center + reach, 99)
        ends[:, axis] = min(low, center.min()), low, high, max(high, center.max())
    least, low, high, most = ends
    near = NEAR * float((high - low).max())
    low, high = np.where(low - least < near, least, low), np.where(most - high < near, most, high)
    # A speck, far out, is no larger than the steps of the numbers there.
    margin = max(0.02 * float((high - low).max()), 1e-6 * float(np.abs([low, high]).max()))
    return low - margin, high + margin
