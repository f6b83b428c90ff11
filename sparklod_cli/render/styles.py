"""Simplified drawing styles, and overdraw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..model.falloff import MIN_ALPHA
from ..model.gaussian import size_factor
from . import rasterizer
from .backends import BACKENDS
from .kernels import bands
from .rasterizer import Image
from .settings import CLIP, RasterSettings
from .shading import ShadedSplats

#: How opaque a billboard is.
BILLBOARD_ALPHA = 0.5


@dataclass(frozen=True)
class VisibleCentres:
    """Splats whose centres a camera sees; M of them.

    Attributes:
        index: (M,) which of those that are shaded.
        x, y: (M,) float32 pixels from the upper left corner.
        depth: (M,) float32 along the axis.
        distance: (M,) float32 from the camera.
    """

    index: NDArray[np.intp]
    x: NDArray[np.float32]
    y: NDArray[np.float32]
    depth: NDArray[np.float32]
    distance: NDArray[np.float32]


def draw(
    style: str,
    backend: str,
    splats: ShadedSplats,
    camera: Camera,
    settings: RasterSettings,
    options: Mapping[str, Any] | None = None,
) -> Image:
    """Draw what a camera sees, as `rasterizer.draw` does.

    Args:
        style: one of `settings.STYLES`. "points" are opaque, a pixel each, "billboards" discs of one opacity, as wide
            as the splats; both are drawn in the order of the file. "sorted-billboards" are drawn from far to near, as
            "splats" are.

    Raises:
        BackendError: the backend cannot draw here.
    """
    if not len(splats.center):  # no chunk has arrived yet
        return np.zeros((camera.height, camera.width, 4), np.float32)
    if style == "splats":
        return BACKENDS[backend].draw(splats, camera, settings, **(options or {}))
    seen = on_screen(splats, camera, settings)
    image: Image = np.zeros((camera.height, camera.width, 4), np.float32)
    if style == "points":
        inside = (seen.x >= 0) & (seen.x < camera.width) & (seen.y >= 0) & (seen.y < camera.height)
        row, column = seen.y[inside].astype(np.intp), seen.x[inside].astype(np.intp)
        image[row, column, :3] = np.minimum(splats.rgb[seen.index[inside]], 1)  # of several, the last one stays
        image[row, column, 3] = 1
        return image
    order = np.arange(len(seen.index))
    if style == "sorted-billboards":
        order = np.argsort(-(seen.distance if settings.sort == "radial" else seen.depth), kind="stable")
    index, depth = seen.index[order], seen.depth[order]
    width = splats.scale[index].mean(axis=1) * size_factor(splats.lod_opacity[index])
    radius = np.clip(width * np.float32(camera.focal[1]) / depth, 0.5, settings.max_radius)
    rgb = np.minimum(splats.rgb[index], 1)
    bands.draw_discs(
        np.ascontiguousarray(seen.x[order]),
        np.ascontiguousarray(seen.y[order]),
        radius.astype(np.float32),
        rgb,
        np.float32(BILLBOARD_ALPHA),
        image,
    )
    return image


def on_screen(splats: ShadedSplats, camera: Camera, settings: RasterSettings) -> VisibleCentres:
    """Return the splats between near and far whose centres are inside the picture, or within `CLIP` of it."""
    local = (splats.center - camera.position.astype(np.float32)) @ camera.camera_to_world[:3, :3].astype(np.float32)
    depth = -local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        dx, dy = camera.focal[0] * local[:, 0] / depth, -camera.focal[1] * local[:, 1] / depth
        seen = (depth > settings.near) & (depth < settings.far) & (splats.lod_opacity >= MIN_ALPHA)
        seen &= (abs(dx) <= CLIP * camera.width / 2) & (abs(dy) <= CLIP * camera.height / 2)
    index = np.flatnonzero(seen)
    return VisibleCentres(
        index,
        (dx[index] + camera.principal[0]).astype(np.float32),
        (dy[index] + camera.principal[1]).astype(np.float32),
        depth[index],
        np.linalg.norm(local[index], axis=1),
    )


def overdraw(splats: ShadedSplats, camera: Camera, settings: RasterSettings) -> NDArray[np.float32]:
    """Return (height, width) number of splats blended into each pixel, including hidden ones.

    Splats are those that the backend numba draws.
    """
    counts = np.zeros((camera.height, camera.width), np.int32)
    if len(splats.center):
        seen = rasterizer.project_splats(splats, camera, settings)
        is_design = settings.profile == "shifted"
        bands.count_fragments(seen.screen, seen.keys, is_design, np.float32(MIN_ALPHA), counts)
    return counts.astype(np.float32)
