"""The geometry of pictures of a scene: ellipsoids, cells, boxes, grids, and the viewpoint that shows them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import rotation_matrix
from ..model.splats import FloatArray, Splats
from ..system.defaults import DEFAULT_BASE

#: (N, 3) points, or pairs of ends of lines; (3,) for a single point.
Points = NDArray[np.floating[Any]]

#: The corners of the unit cube, and the pairs of corners that its twelve edges join.
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float64)
EDGES = np.array([(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)])


@dataclass(frozen=True)
class Mesh:
    """Triangles: (P, 3) points, (P, 3) unit normals, and (T, 3) indices of points."""

    points: FloatArray
    normals: FloatArray
    triangles: NDArray[np.int64]


def sphere(rounds: int) -> Mesh:
    """Return the unit sphere: an icosahedron, each of whose triangles is split into four `rounds` times."""
    golden = (1 + math.sqrt(5)) / 2
    one = np.array([[-1, golden, 0], [1, golden, 0], [-1, -golden, 0], [1, -golden, 0]])
    points = np.concatenate([one, np.roll(one, 1, axis=1), np.roll(one, 2, axis=1)])
    near = np.linalg.norm(points[:, None] - points[None], axis=2) < 2.1  # the edges are 2 long
    found = [(a, b, c) for a, b, c in combinations(range(12), 3) if near[a, b] and near[b, c] and near[a, c]]
    triangles = np.array(found)
    for _ in range(rounds):
        sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        pairs, at = np.unique(sides, axis=0, return_inverse=True)
        middle = at.reshape(-1, 3) + len(points)
        points = np.concatenate([points, points[pairs].mean(axis=1)])
        (a, b, c), (ab, bc, ca) = triangles.T, middle.T
        triangles = np.concatenate(
            [np.stack(corner, 1) for corner in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    unit = points / np.linalg.norm(points, axis=1, keepdims=True)
    p, q, r = unit[triangles].transpose(1, 0, 2)
    inward = np.einsum("ij,ij->i", np.cross(q - p, r - p), p) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return Mesh(unit.astype(np.float32), unit.astype(np.float32), triangles)


def rotation(quat_xyzw: FloatArray) -> FloatArray:
    """(N, 4) unit quaternions to (N, 3, 3) float32 rotations: splat, world axis, local axis."""
    return np.stack(rotation_matrix(*quat_xyzw.T), axis=1).reshape(-1, 3, 3)


def ellipsoids(splats: Splats, deviations: float, of: Mesh, thinnest: float) -> Mesh:
    """Return the surfaces of N splats at some number of standard deviations, in their order.

    Points of the sphere are multiplied by the radii, its normals divided by them.

    Args:
        deviations: the radii, in standard deviations.
        thinnest: smallest radius that is drawn, world units, so that no splat falls between pixels.
    """
    axes = rotation(splats.quat_xyzw)
    radii = np.maximum(splats.scale * np.float32(deviations), np.float32(thinnest))
    points = of.points @ (axes * radii[:, None]).transpose(0, 2, 1) + splats.center[:, None]
    normals = of.points @ (axes * (radii.min(axis=1, keepdims=True) / radii)[:, None]).transpose(0, 2, 1)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    triangles = of.triangles + len(of.points) * np.arange(len(splats))[:, None, None]
    return Mesh(points.reshape(-1, 3), normals.reshape(-1, 3), triangles.reshape(-1, 3))


def evenly(count: int, most: int) -> NDArray[np.int64]:
    """At most `most` of `count` indices, evenly spaced: the same each time, and from all parts of the file."""
    return np.arange(count) if count <= most else np.arange(most) * count // most


def level_of_step(size: float) -> int:
    """Return the voxel level of Quick-LoD for a design size, 2 * max(scale); cells are DEFAULT_BASE ** level wide."""
    return math.ceil(math.log(size, DEFAULT_BASE) - 1e-9)


def cells(center: FloatArray, step: float) -> Points:
    """(C, 3) lowest corners of the cells, with edges of `step`, that hold these (N, 3) centres."""
    return np.unique(np.floor(center.astype(np.float64) / step), axis=0) * step


def box_lines(low: Points, high: Points) -> Points:
    """(24 B, 3) ends of the edges of B boxes with the corners (B, 3) `low` and `high`."""
    corners = low[:, None] + CORNERS * (high - low)[:, None]
    return corners[:, EDGES].reshape(-1, 3)


def wall_lines(low: Points, high: Points, far: Points, spacing: float) -> Points:
    """Return the ends of lines at multiples of `spacing` on the three walls of a box that meet in its corner `far`."""
    lines: list[Points] = []
    for axis in range(3):
        at = spacing * np.arange(math.ceil(low[axis] / spacing - 1e-9), math.floor(high[axis] / spacing + 1e-9) + 1)
        for wall in {0, 1, 2} - {axis}:
            along = 3 - axis - wall
            ends = np.empty((len(at), 2, 3))
            ends[:, :, axis], ends[:, :, wall] = at[:, None], far[wall]
            ends[:, :, along] = low[along], high[along]
            lines.append(ends.reshape(-1, 3))
    return np.concatenate(lines)


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
    """Return the viewpoint that looks along a direction and just fits all points into a frame.

    Args:
        points: (N, 3) points to show.
        direction, up: (3,) world axes.
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
