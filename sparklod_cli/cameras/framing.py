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

#: Splats farther from the middle than this multiple of the radius of the ball that most splats are in are backdrop,
#: such as a sky or stray splats of training, and are not framed.
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
        """Concatenate the balls of several parts, at least one."""
        every = list(parts)
        return cls(np.concatenate([part.center for part in every]), np.concatenate([part.radius for part in every]))


def balls_of(splats: Splats, index: NDArray[Any] | slice, object_to_world: Matrix) -> Balls:
    """Return the bounding spheres, in the world, of the splats of an object that have finite numbers."""
    with np.errstate(all="ignore"):
        center = splats.center[index].astype(np.float64) @ object_to_world[:3, :3].T + object_to_world[:3, 3]
        times = float(np.cbrt(np.linalg.det(object_to_world[:3, :3])))
        seen = np.sqrt(np.clip(SEEN**2 + 2 * np.log(splats.opacity[index].astype(np.float64)), 0, SEEN**2))
        radius = seen * times * splats.scale[index].max(axis=1, initial=0).astype(np.float64)
        finite = np.isfinite(center).all(axis=1) & np.isfinite(radius)
    return Balls(center[finite], radius[finite])


def framing(center: NDArray[np.floating]) -> tuple[NDArray[np.float64], float]:
    """Return the middle of a scene and the radius of a ball around it that most splats are in.

    Args:
        center: (N, 3) of the splats, world units. What is not finite is left out; `InvalidSplatsError` if nothing is
            left.

    Returns:
        (3,) the median of each coordinate, and a radius above 0.
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
    # Of the cells around the middle, those are dense that splats cover nearly as much of as of a typical cell.
    side = radius * max(CELL, (FEW / len(center)) ** (1 / 3))
    area = np.clip(size, SPECK * radius, side) ** 2
    dense = np.zeros(len(area), np.bool_)
    for shift in (0.0, 0.5):  # of the cells at the border of something, either set may have thin slices
        _, cell = np.unique(np.floor((center - middle) / side + shift).astype(np.int64), axis=0, return_inverse=True)
        cell = cell.reshape(-1)
        cover = np.bincount(cell, area)
        # The typical cell is the one that the middle of all that is covered lies in.
        order = np.argsort(cover)
        typical = cover[order[np.searchsorted(np.cumsum(cover[order]), cover.sum() / 2)]]
        dense |= (cover >= SPARSE * typical)[cell]
    most = float(np.quantile(reach[dense], COVERED, method="higher"))
    framed = dense & (reach <= most)
    center, size = center[framed], size[framed]
    # Nothing is a point: a camera in line with all of them would be in their midst. Nor is anything, far out, smaller
    # than the steps of the numbers there.
    least = max(SPECK * most, STEPS * float(np.abs(center).max())) or radius
    return Balls(center, np.maximum(size, least))


def middle_of(scene: Balls) -> Matrix:
    """(3,) the middle of the bounding box of these balls."""
    radius = scene.radius[:, None]
    middle: Matrix = ((scene.center - radius).min(axis=0) + (scene.center + radius).max(axis=0)) / 2
    return middle


def _support(scene: Balls, camera: Camera) -> tuple[Matrix, Matrix, Matrix]:
    """Return the reach of a scene beyond the sides of a camera's view, if the camera were at the origin.

    A ball is inside where it is behind all four sides, right, left, top and bottom, so the camera sees all of them
    where its position, times the normal of each side, is at least this reach.

    Returns:
        (4,) the reach, world units, and of both pairs of sides, (2,), the share of their normals that is to the side,
        and that is backwards.
    """
    half = FILLED * np.array([camera.width, camera.height]) / (2 * np.asarray(camera.focal))
    back = half / np.hypot(1, half)
    aside = 1 / np.hypot(1, half)
    (across, up), (deep, high) = aside, back
    normals = np.array([[across, 0, deep], [-across, 0, deep], [0, up, high], [0, -up, high]])
    directions = normals @ camera.camera_to_world[:3, :3].T
    return (scene.center @ directions.T + scene.radius[:, None]).max(axis=0), aside, back


def fitted(camera: Camera, scene: Balls) -> Camera:
    """Return a camera, centred on its picture, in the same direction, which has a scene just inside the picture."""
    middle = middle_of(scene)
    reach, aside, back = _support(Balls(scene.center - middle, scene.radius), camera)
    away = float(((reach[::2] + reach[1::2]) / (2 * back)).max())
    sideways = (reach[::2] - reach[1::2]) / (2 * aside)
    pose = camera.camera_to_world.copy()
    pose[:3, 3] = middle + pose[:3, :3] @ [*sideways, away]
    return dataclasses.replace(camera, camera_to_world=pose)


def distance(cameras: Sequence[Camera], center: Matrix, scene: Balls) -> float:
    """Return the distance from their target, in world units, at which cameras have a scene in their pictures.

    Only the directions of the cameras count. `center`, (3,), is in the middle of all pictures.
    """
    local = Balls(scene.center - center, scene.radius)
    needed = []
    for camera in cameras:
        reach, _, back = _support(local, camera)
        needed.append(float((reach / np.repeat(back, 2)).max()))
    return max(needed)


def reach(near: float, far: float, cameras: Sequence[Camera], scene: Balls) -> tuple[float, float]:
    """Near and far distances, moved apart where they would leave out a part of a scene that cameras look at.

    They are along the axis of a camera, world units; `scene` is all that its splats cover.
    """
    sample = scene.center[:: max(len(scene.center) // SAMPLE, 1)]
    corners = scene.box if scene.box is not None else np.stack([scene.center.min(axis=0), scene.center.max(axis=0)])
    largest = scene.largest if scene.largest is not None else float(scene.radius.max())
    for camera in cameras[:: -(-len(cameras) // CAMERAS)]:
        away = np.linalg.norm(sample - camera.position, axis=1)
        farthest = float(np.linalg.norm(np.abs(corners - camera.position).max(axis=0)))
        near, far = min(near, float(np.median(away)) / 100), max(far, 2 * (farthest + largest))
    return near, min(far, FARTHEST)
