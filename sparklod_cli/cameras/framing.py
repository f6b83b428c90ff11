"""The place and size of a scene, and cameras that have it in view."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model import FARTHEST
from ..model.splats import Splats
from ..system.errors import InvalidSplatsError
from .camera import Camera, Matrix

#: Radius of the bounding sphere of an opaque splat, standard deviations: its opacity there is exp(-2). The sphere of a
#: fainter splat ends where it has the same opacity.
SEEN = 2.0

#: Columns of `Splats` that `balls_of` reads.
USED = ("center", "scale", "opacity")

#: The share of the splats in the ball around the middle whose radius is the size of a scene.
SHARE = 0.9

#: The share of the dense splats that must be in view, each with all that it covers: trained scenes have a few that are
#: very far away, or very large.
COVERED = 0.999

#: Side of the cells in which splats are dense or sparse, as a share of the size of the scene; splats for each cube of
#: that size below which cells are larger, as a few splats are not dense anywhere; and the share of what the splats of a
#: typical cell cover below which a cell is sparse: stray splats, haze and stars, which are not framed.
CELL, FEW, SPARSE = 1 / 8, 256, 0.05

#: Splats farther from the middle than this multiple of the size of the scene are backdrop, such as a sky, or stray, and
#: are not framed.
OUTSIDE = 3.0

#: Sample size, in splats; a larger one makes no visible difference.
SAMPLE = 1 << 18

#: The share of the picture's width, or height, that is filled.
FILLED = 0.92

#: No splat counts as smaller than this share of the scene.
SPECK = 0.005

#: Steps of float32, as a share of the number, with room for rounding in what is computed from it.
STEPS = 1e-6

#: Sample size, in cameras of a path; those between them see nearly the same.
CAMERAS = 64


@dataclass(frozen=True)
class Balls:
    """N bounding spheres of splats.

    Attributes:
        center: (N, 3) float64 world units.
        radius: (N,) float64 world units.
        box: (2, 3) lowest and highest coordinates of all centres, if the N spheres are a sample; else None.
        largest: largest radius of all, if the N spheres are a sample; else None.
    """

    center: Matrix
    radius: Matrix
    box: Matrix | None = None
    largest: float | None = None

    @classmethod
    def concat(cls, parts: Iterable[Balls]) -> Balls:
        """Concatenate the spheres of several parts, at least one."""
        every = list(parts)
        return cls(np.concatenate([part.center for part in every]), np.concatenate([part.radius for part in every]))


def balls_of(splats: Splats, index: NDArray[Any] | slice, object_to_world: Matrix) -> Balls:
    """Return the bounding spheres, in the world, of an object's splats; splats with numbers not finite are left out."""
    with np.errstate(all="ignore"):
        center = splats.center[index].astype(np.float64) @ object_to_world[:3, :3].T + object_to_world[:3, 3]
        times = float(np.cbrt(np.linalg.det(object_to_world[:3, :3])))
        seen = np.sqrt(np.clip(SEEN**2 + 2 * np.log(splats.opacity[index].astype(np.float64)), 0, SEEN**2))
        radius = seen * times * splats.scale[index].max(axis=1, initial=0).astype(np.float64)
        finite = np.isfinite(center).all(axis=1) & np.isfinite(radius)
    return Balls(center[finite], radius[finite])


def framing(center: NDArray[np.floating]) -> tuple[NDArray[np.float64], float]:
    """Return the (3,) middle of a scene, the median of each coordinate, and its size, the radius of most splats.

    `center`, (N, 3), and the size, above 0, are in world units. Centres that are not finite are left out;
    `InvalidSplatsError` if all are.
    """
    sample = np.asarray(center[:: max(len(center) // SAMPLE, 1)], np.float64)
    sample = sample[np.isfinite(sample).all(axis=1)]
    if not len(sample):
        raise InvalidSplatsError("the scene has no finite centres for cameras to look at")
    middle = np.median(sample, axis=0)
    radius = float(np.quantile(np.linalg.norm(sample - middle, axis=1), SHARE))
    return middle, radius or 1.0


def covered(scene: Balls) -> Balls:
    """Return the splats that cameras must have in view: 99.9 % of those that are neither backdrop nor sparse.

    `InvalidSplatsError` if there are no splats with finite numbers.
    """
    middle, radius = framing(scene.center)
    every = max(len(scene.center) // SAMPLE, 1)
    center, size = scene.center[::every], scene.radius[::every]
    reach = np.linalg.norm(center - middle, axis=1) + size
    # The nearest is always kept, however large it is.
    near = reach <= max(OUTSIDE * radius, float(reach.min()))
    center, size, reach = center[near], size[near], reach[near]
    # A cell is dense if splats cover nearly as much of it as of a typical cell.
    side = radius * max(CELL, (FEW / len(center)) ** (1 / 3))
    area = np.clip(size, SPECK * radius, side) ** 2
    dense = np.zeros(len(area), np.bool_)
    for shift in (0.0, 0.5):  # cells at the border of an object may have thin slices of it in either set
        _, cell = np.unique(np.floor((center - middle) / side + shift).astype(np.int64), axis=0, return_inverse=True)
        cell = cell.reshape(-1)
        cover = np.bincount(cell, area)
        # The typical cell is the median, weighted by cover.
        order = np.argsort(cover)
        typical = cover[order[np.searchsorted(np.cumsum(cover[order]), cover.sum() / 2)]]
        dense |= (cover >= SPARSE * typical)[cell]
    most = float(np.quantile(reach[dense], COVERED, method="higher"))
    framed = dense & (reach <= most)
    center, size = center[framed], size[framed]
    # No ball is a point: a camera in line with several would be among them. Far out, none is smaller than the steps of
    # float32 there.
    least = max(SPECK * most, STEPS * float(np.abs(center).max())) or radius
    return Balls(center, np.maximum(size, least))


def middle_of(scene: Balls) -> Matrix:
    """Return the (3,) middle of the bounding box of balls."""
    radius = scene.radius[:, None]
    middle: Matrix = ((scene.center - radius).min(axis=0) + (scene.center + radius).max(axis=0)) / 2
    return middle


def _support(scene: Balls, camera: Camera) -> tuple[Matrix, Matrix, Matrix]:
    """Return the reach of a scene beyond the sides of a camera's view, if the camera were at the origin.

    A ball is in view if it is behind all four sides, right, left, top and bottom. So the camera sees all balls if its
    position times the normal of each side is at least this reach.

    Returns:
        (4,) the reach, world units; and (2,) the sideways and (2,) the backward components of the normals of both
        pairs of sides.
    """
    half = FILLED * np.array([camera.width, camera.height]) / (2 * np.asarray(camera.focal))
    back = half / np.hypot(1, half)
    aside = 1 / np.hypot(1, half)
    (across, up), (deep, high) = aside, back
    normals = np.array([[across, 0, deep], [-across, 0, deep], [0, up, high], [0, -up, high]])
    directions = normals @ camera.camera_to_world[:3, :3].T
    return (scene.center @ directions.T + scene.radius[:, None]).max(axis=0), aside, back


def fitted(camera: Camera, scene: Balls) -> Camera:
    """Return a camera in the same direction, moved so that a scene is centred in its picture and just fits."""
    middle = middle_of(scene)
    reach, aside, back = _support(Balls(scene.center - middle, scene.radius), camera)
    away = float(((reach[::2] + reach[1::2]) / (2 * back)).max())
    sideways = (reach[::2] - reach[1::2]) / (2 * aside)
    pose = camera.camera_to_world.copy()
    pose[:3, 3] = middle + pose[:3, :3] @ [*sideways, away]
    return dataclasses.replace(camera, camera_to_world=pose)


def distance(cameras: Sequence[Camera], center: Matrix, scene: Balls) -> float:
    """Return the distance from their target, (3,) `center`, at which the pictures of all cameras contain a scene.

    Only the directions of the cameras have an effect, not their positions.
    """
    local = Balls(scene.center - center, scene.radius)
    needed = []
    for camera in cameras:
        reach, _, back = _support(local, camera)
        needed.append(float((reach / np.repeat(back, 2)).max()))
    return max(needed)


def reach(near: float, far: float, cameras: Sequence[Camera], scene: Balls) -> tuple[float, float]:
    """Return near and far distances along the axes of cameras, world units, moved apart to enclose a scene."""
    sample = scene.center[:: max(len(scene.center) // SAMPLE, 1)]
    corners = scene.box if scene.box is not None else np.stack([scene.center.min(axis=0), scene.center.max(axis=0)])
    largest = scene.largest if scene.largest is not None else float(scene.radius.max())
    for camera in cameras[:: -(-len(cameras) // CAMERAS)]:
        away = np.linalg.norm(sample - camera.position, axis=1)
        farthest = float(np.linalg.norm(np.abs(corners - camera.position).max(axis=0)))
        near, far = min(near, float(np.median(away)) / 100), max(far, 2 * (farthest + largest))
    return near, min(far, FARTHEST)
