"""Moves a camera to where it sees a whole scene."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from ..render.camera import Camera
from ..render.framing import framing
from ..render.look import Look

#: What is farther from the middle than so many times the ball that most splats are in does not belong to what is shown:
#: a sky, and what training leaves far out.
OUTSIDE = 1.5

#: The share of the picture's width, or height, that is filled.
FILLED = 0.92


def fitted(camera: Camera, centers: NDArray[np.floating]) -> Camera:
    """A camera of the same direction that has a scene just inside its picture.

    Args:
        camera: whose principal point is the middle of its picture.
        centers: (N, 3) of splats.

    Raises:
        InvalidSplatsError: there are no finite centres.
    """
    middle, radius = framing(centers)
    axes = camera.camera_to_world[:3, :3]
    local = (np.asarray(centers, np.float64) - middle) @ axes
    with np.errstate(invalid="ignore"):
        local = local[np.linalg.norm(local, axis=1) <= OUTSIDE * radius]
    low, high = local.min(axis=0), local.max(axis=0)
    local -= (low + high) / 2
    half = FILLED * np.array([camera.width, camera.height]) / (2 * np.asarray(camera.focal))
    # A point is inside where its offset to the side is at most that share of its depth.
    distance = float((local[:, 2:] + np.abs(local[:, :2]) / half).max())
    pose = camera.camera_to_world.copy()
    pose[:3, 3] = middle + axes @ ((low + high) / 2 + [0, 0, max(distance, radius)])
    return dataclasses.replace(camera, camera_to_world=pose)


def with_reach(look: Look, camera: Camera, centers: NDArray[np.floating]) -> Look:
    """A look that leaves nothing out of a scene, however small or large it is, because of near and far."""
    away = np.linalg.norm(np.asarray(centers, np.float64) - camera.position, axis=1)
    away = away[np.isfinite(away)]
    near = min(look.near, float(np.median(away)) / 100)
    return dataclasses.replace(look, near=near, far=max(look.far, 2 * float(away.max())))
