"""The reference backend: splats drawn in tiles on the processor."""

from __future__ import annotations

import threading

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..cameras.pose import FLIP
from ..support.jit import threads_in_use
from .kernels import project, raster
from .settings import BLUR, CLIP, MAX_STD_DEV, MIN_ALPHA, STD_DEV_PER_D, RasterSettings
from .shading import ShadedSplats

Image = NDArray[np.float32]

_kept = threading.local()

#: Pieces a thread to sort splats into tiles in.
CHUNKS = 2


def draw(splats: ShadedSplats, camera: Camera, settings: RasterSettings) -> Image:
    """What a camera sees: (height, width, 4) float32, red, green, blue, multiplied by alpha, and alpha; 0..1.

    The image is the same for any number of threads.
    """
    screen = seen(splats, camera, settings)
    across, down = -(-camera.width // raster.TILE), -(-camera.height // raster.TILE)
    start, order = raster.sort_into_tiles(screen, across, down, CHUNKS * threads_in_use())
    image = np.empty((camera.height, camera.width, 4), np.float32)
    raster.draw_tiles(screen, start, order, across, down, settings.profile == "shifted", np.float32(MIN_ALPHA), image)
    return image


def seen(splats: ShadedSplats, camera: Camera, settings: RasterSettings) -> NDArray[np.float32]:
    """The splats on the screen, (M, `project.COLUMNS`) from near to far; a buffer, which the next call overwrites."""
    screen, arranged, keys = _buffers(len(splats))
    columns = project.ShadedColumns(splats.center, splats.scale, splats.quat_xyzw, splats.lod_opacity, splats.rgb)
    lens = project.Lens(*map(np.float32, (*camera.focal, *camera.principal, camera.width, camera.height)))
    near, far, radius = settings.near, settings.far, settings.max_radius
    limits = project.Limits(*map(np.float32, (near, far, CLIP, BLUR, MIN_ALPHA, MAX_STD_DEV, STD_DEV_PER_D, radius)))
    project.project(columns, world_to_camera(camera), lens, limits, settings.sort == "radial", screen, keys)
    keys = np.sort(keys[keys != project.NOT_DRAWN])
    arranged = arranged[: len(keys)]
    project.gather_drawn(screen, keys, arranged)
    return arranged


def _buffers(count: int) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint64]]:
    """Working memory for projected splats, reused by each thread, because the first access to new memory is slow."""
    if len(getattr(_kept, "keys", ())) < count:
        _kept.screens = [np.empty((count, project.COLUMNS), np.float32) for _ in range(2)]
        _kept.keys = np.empty(count, np.uint64)
    first, second = _kept.screens
    return first[:count], second[:count], _kept.keys[:count]


def world_to_camera(camera: Camera) -> NDArray[np.float32]:
    """(3, 4): into axes with y down, looking along z."""
    turned = camera.camera_to_world @ FLIP
    return np.linalg.inv(turned)[:3].astype(np.float32)
