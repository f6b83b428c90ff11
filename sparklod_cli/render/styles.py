"""Simplified drawing styles, and overdraw."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..model.falloff import MIN_ALPHA
from ..model.gaussian import size_factor
from . import rasterizer
from .kernels import bands
from .rasterizer import Image, ShadedSplats
from .settings import BACKENDS, CLIP, RasterSettings

#: How opaque a billboard is.
BILLBOARD_ALPHA = 0.5


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
    index, x, y, depth, distance = on_screen(splats, camera, settings)
    image: Image = np.zeros((camera.height, camera.width, 4), np.float32)
    if style == "points":
        inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        row, column = y[inside].astype(np.intp), x[inside].astype(np.intp)
        image[row, column, :3] = np.minimum(splats.rgb[index[inside]], 1)  # of several, the last one stays
        image[row, column, 3] = 1
        return image
    order = np.arange(len(index))
    if style == "sorted-billboards":
        order = np.argsort(-(distance if settings.sort == "radial" else depth), kind="stable")
    index, depth = index[order], depth[order]
    width = splats.scale[index].mean(axis=1) * size_factor(splats.lod_opacity[index])
    radius = np.clip(width * np.float32(camera.focal[1]) / depth, 0.5, settings.max_radius)
    rgb = np.minimum(splats.rgb[index], 1)
    bands.draw_discs(
        camera.height,
        np.ascontiguousarray(x[order]),
        np.ascontiguousarray(y[order]),
        radius.astype(np.float32),
        rgb,
        np.float32(BILLBOARD_ALPHA),
        image,
    )
    return image


def on_screen(splats: ShadedSplats, camera: Camera, settings: RasterSettings) -> tuple[NDArray[Any], ...]:
    """Return the splats between near and far whose centres are inside the picture, or within `CLIP` of it.

    Returns:
        (M,) indices; (M,) float32 x and y in pixels from the upper left corner, depths along the axis, and distances.
    """
    local = (splats.center - camera.position.astype(np.float32)) @ camera.camera_to_world[:3, :3].astype(np.float32)
    depth = -local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        dx, dy = camera.focal[0] * local[:, 0] / depth, -camera.focal[1] * local[:, 1] / depth
        seen = (depth > settings.near) & (depth < settings.far) & (splats.lod_opacity >= MIN_ALPHA)
        seen &= (abs(dx) <= CLIP * camera.width / 2) & (abs(dy) <= CLIP * camera.height / 2)
    index = np.flatnonzero(seen)
    return (
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
        bands.count_fragments(len(counts), seen.screen, seen.keys, is_design, np.float32(MIN_ALPHA), counts)
    return counts.astype(np.float32)
