"""The drawing order of splats, and when it is recomputed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...cameras.camera import Camera
from ...model.falloff import MIN_ALPHA
from ...model.splats import FloatArray
from ..rasterizer import world_to_camera
from ..settings import CLIP, RasterSettings
from ..shading import ShadedSplats

Indices = NDArray[np.uint32]


class Order:
    """Finds the splats to draw, from near to far, for a moving camera.

    Args:
        sorting: one of `settings.SORTINGS`.
        throttle: splats are sorted again only when the cosine between the camera's direction at the last sort and its
            current direction is at most 1 - throttle; antimatter15's viewer uses 0.01, an angle of 8.1 degrees. 0 sorts
            for each camera. With `RasterSettings.sort` "radial", which depends on the camera's position, they are also
            sorted when it has moved so far that the splat of median distance appears rotated by that angle.
    """

    def __init__(self, sorting: str, throttle: float = 0.0) -> None:
        self.sorting, self.throttle = sorting, throttle
        self._sorted: tuple[Camera, RasterSettings, float] | None = None

    def forget(self) -> None:
        """Discard the last order, because the splats have changed."""
        self._sorted = None

    def update(self, splats: ShadedSplats, camera: Camera, raster: RasterSettings) -> Indices | None:
        """Return indices of the splats that may be visible, in order; None while the last order is still valid."""
        if self._sorted is not None and self._close(camera, raster, *self._sorted):
            return None
        with np.errstate(over="ignore", invalid="ignore"):  # splats that far away are not drawn
            u, v, depth = _into_camera(splats.center, camera)
            key = np.sqrt(u * u + v * v + depth * depth) if raster.sort == "radial" else depth
            if self.throttle:
                # Splats that are invisible now may be visible when this order is reused.
                seen = np.flatnonzero(np.isfinite(key)).astype(np.uint32)
            else:
                seen = _in_sight(splats, u, v, depth, camera, raster)
        key = key[seen]
        self._sorted = camera, raster, float(np.median(np.abs(key))) if len(key) else 0.0
        return seen[SORT[self.sorting](key)]

    def _close(
        self, camera: Camera, raster: RasterSettings, old: Camera, old_raster: RasterSettings, middle: float
    ) -> bool:
        if not self.throttle or raster.sort != old_raster.sort:
            return False
        if 1 - float(camera.forward @ old.forward) >= self.throttle:
            return False
        if raster.sort != "radial":
            return True  # moving the camera adds the same to all depths
        return float(np.linalg.norm(camera.position - old.position)) < np.sqrt(2 * self.throttle) * middle


def _into_camera(center: FloatArray, camera: Camera) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return camera coordinates right, down and forward, (N,) float32 each, rounded as in the rasterizer's kernel."""
    m = world_to_camera(camera)
    x, y, z = center.T
    u, v, w = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in m)
    return u, v, w


def _in_sight(
    splats: ShadedSplats, u: FloatArray, v: FloatArray, depth: FloatArray, camera: Camera, raster: RasterSettings
) -> Indices:
    """Return indices of the splats whose centres the vertex shader does not cull, with a small margin."""
    seen = (depth > raster.near) & (depth < raster.far) & (splats.lod_opacity >= np.float32(MIN_ALPHA))
    for across, focal, principal, pixels in zip(
        (u, v), camera.focal, camera.principal, (camera.width, camera.height), strict=True
    ):
        # Times the depth, from the middle of the picture.
        off = np.abs(np.float32(focal) * across + np.float32(principal - pixels / 2) * depth)
        seen &= off <= np.float32(1.0001 * CLIP * pixels / 2) * depth
    return np.flatnonzero(seen).astype(np.uint32)


def sort_exact(key: FloatArray) -> NDArray[np.int64]:
    """Return (N,) indices sorted by (N,) float32 keys, equal keys by descending index, as in Spark.

    Sorts 64-bit numbers of key and index, which is several times faster than sorting indices.
    """
    bits = (key + np.float32(0)).view(np.uint32)  # -0 equals 0
    # Flips the bits that make negative floats sort in reverse.
    ordered = bits ^ np.where(bits >> 31, np.uint32(0xFFFFFFFF), np.uint32(0x80000000))
    both = (ordered.astype(np.uint64) << np.uint64(32)) | np.arange(len(key), dtype=np.uint64)[::-1]
    both.sort()
    return len(key) - 1 - (both & np.uint64(0xFFFFFFFF)).astype(np.int64)


def sort_counting16(key: FloatArray) -> NDArray[np.int64]:
    """Return (N,) indices sorted by (N,) float32 keys quantized to 65,536 steps; within a step by descending index."""
    if not len(key):
        return np.zeros(0, np.int64)
    above = key.astype(np.float64) - float(key.min())
    step = (above * (65535 / (above.max() or 1))).astype(np.uint16)
    return len(key) - 1 - np.argsort(step[::-1], kind="stable")  # numpy sorts uint16 by radix


SORT = {"exact": sort_exact, "counting16": sort_counting16}
