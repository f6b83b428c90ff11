"""Viewpoints of pictures of a whole scene, and the box that they show."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.splats import Splats
from .ellipsoids import Points

#: Outlying splats are shown too if they lie within this share of the extent of the others.
NEAR = 0.35


@dataclass(frozen=True)
class Viewpoint:
    """A perspective viewpoint of a figure; paths are made of `camera.Camera`s.

    Attributes:
        position, target: (3,) world units.
        axes: (3, 3), in rows: right, up, and into the picture.
        angle: vertical field of view, degrees.
        aspect: width over height.
        shift: (2,) place of `target` in the picture: -1 left or bottom, 0 middle, 1 right or top.
    """

    position: Points
    target: Points
    axes: Points
    angle: float
    aspect: float
    shift: Points

    def project(self, points: Points) -> Points:
        """(N, 3) points to (N, 2) places in the picture, 0..1 from the left and from the top."""
        local = (np.asarray(points, np.float64) - self.position) @ self.axes.T
        return (1 + (_seen(local, self.angle, self.aspect) + self.shift) * (1, -1)) / 2


def viewpoint(
    points: Points, direction: Points, up: Points, *, aspect: float, frame: tuple[float, float, float, float]
) -> Viewpoint:
    """The viewpoint that looks along a direction and just fits all points into a frame.

    Args:
        points: (N, 3) points to show.
        direction, up: (3,) world axes.
        aspect: width over height.
        frame: left, top, right and bottom of the frame in the picture, 0..1 from the left and from the top.
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
    for _ in range(60):  # bisects the distance: the picture shrinks as it grows
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
    """(N,) whether each splat is valid and has a size."""
    drawable: NDArray[np.bool_] = splats.is_valid() & (splats.scale.max(axis=1) > 0)
    return drawable


def bounds(splats: Splats) -> tuple[Points, Points]:
    """Lowest and highest corner, (3,) each, of the box that a picture shows.

    Along each axis it spans the 1 % to the 99 % quantile of the splats, or all of them if the rest are within `NEAR`.

    Args:
        splats: at least one; all drawable.
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
    # A tiny scene far from the origin may be smaller than the steps of float32 there.
    margin = max(0.02 * float((high - low).max()), 1e-6 * float(np.abs([low, high]).max()))
    return low - margin, high + margin
