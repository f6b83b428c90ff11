"""In which order splats are drawn, and when that is worked out anew."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...cameras.camera import Camera
from ...model.splats import FloatArray
from ..rasterizer import world_to_camera
from ..settings import CLIP, MIN_ALPHA, RasterSettings
from ..shading import ShadedSplats

Indices = NDArray[np.uint32]


class Order:
    """Which splats to draw, from near to far, for a camera that moves.

    Args:
        sorting: one of `settings.SORTINGS`.
        throttle: splats are not sorted again while the cosine between where the camera looked when they were and where
            it looks now is above 1 - throttle; antimatter15's viewer has 0.01, an angle of 8.1 degrees. 0 sorts for
            each camera. With `RasterSettings.sort` "radial", where what counts is the camera's place, they are also
            sorted when it has moved so far that the middle one of the splats appears turned by that angle.
    """

    def __init__(self, sorting: str, throttle: float = 0.0) -> None:
        self.sorting, self.throttle = sorting, throttle
        self._sorted: tuple[Camera, RasterSettings, float] | None = None

    def forget(self) -> None:
        """The splats are others now."""
        self._sorted = None

    def update(self, shown: ShadedSplats, camera: Camera, look: RasterSettings) -> Indices | None:
        """Rows of `shown`, as many as may be seen; or None while those of the last time will do."""
        if self._sorted is not None and self._close(camera, look, *self._sorted):
            return None
        with np.errstate(over="ignore", invalid="ignore"):  # what is that far out is not drawn
            u, v, depth = _into_camera(shown.center, camera)
            key = np.sqrt(u * u + v * v + depth * depth) if look.sort == "radial" else depth
            if self.throttle:
                # What is out of sight now may not be so when this order is used again.
                seen = np.flatnonzero(np.isfinite(key)).astype(np.uint32)
            else:
                seen = _in_sight(shown, u, v, depth, camera, look)
        key = key[seen]
        self._sorted = camera, look, float(np.median(np.abs(key))) if len(key) else 0.0
        return seen[SORT[self.sorting](key)]

    def _close(
        self, camera: Camera, look: RasterSettings, old: Camera, old_look: RasterSettings, middle: float
    ) -> bool:
        if not self.throttle or look.sort != old_look.sort or 1 - float(camera.forward @ old.forward) >= self.throttle:
            return False
        if look.sort != "radial":
            return True  # moving the camera adds the same to all depths
        return float(np.linalg.norm(camera.position - old.position)) < np.sqrt(2 * self.throttle) * middle


def _into_camera(center: FloatArray, camera: Camera) -> tuple[FloatArray, FloatArray, FloatArray]:
    """To the right, down and ahead, (N,) float32 each, rounded as in the rasterizer's kernel, to sort alike."""
    m = world_to_camera(camera)
    x, y, z = center.T
    u, v, w = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in m)
    return u, v, w


def _in_sight(
    shown: ShadedSplats, u: FloatArray, v: FloatArray, depth: FloatArray, camera: Camera, look: RasterSettings
) -> Indices:
    """Those that the vertex shader would not throw out by their centres, or a hair more."""
    seen = (depth > look.near) & (depth < look.far) & (shown.lod_opacity >= np.float32(MIN_ALPHA))
    for across, focal, principal, pixels in zip(
        (u, v), camera.focal, camera.principal, (camera.width, camera.height), strict=True
    ):
        # Times the depth, from the middle of the picture.
        off = np.abs(np.float32(focal) * across + np.float32(principal - pixels / 2) * depth)
        seen &= off <= np.float32(1.0001 * CLIP * pixels / 2) * depth
    return np.flatnonzero(seen).astype(np.uint32)


def sort_exact(key: FloatArray) -> NDArray[np.int64]:
    """(N,) rows by (N,) float32 keys, of equal ones the last first, as in the rasterizer and in Spark.

    As one 64 bit number each, which sorts several times faster than indices do.
    """
    bits = (key + np.float32(0)).view(np.uint32)  # -0 equals 0
    # Flips what makes negative floats sort the other way around.
    ordered = bits ^ np.where(bits >> 31, np.uint32(0xFFFFFFFF), np.uint32(0x80000000))
    both = (ordered.astype(np.uint64) << np.uint64(32)) | np.arange(len(key), dtype=np.uint64)[::-1]
    both.sort()
    return len(key) - 1 - (both & np.uint64(0xFFFFFFFF)).astype(np.int64)


def sort_counting16(key: FloatArray) -> NDArray[np.int64]:
    """(N,) rows by (N,) float32 keys in 65,536 equal steps from least to greatest; in each, the last first."""
    if not len(key):
        return np.zeros(0, np.int64)
    above = key.astype(np.float64) - float(key.min())
    step = (above * (65535 / (above.max() or 1))).astype(np.uint16)
    return len(key) - 1 - np.argsort(step[::-1], kind="stable")  # of 16 bits, a counting sort by each of two bytes


SORT = {"exact": sort_exact, "counting16": sort_counting16}
