"""The reference backend: splats drawn in tiles on the processor."""

from __future__ import annotations

import threading
from dataclasses import dataclass

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


@dataclass(frozen=True)
class Tiles:
    """Which splats tiles were drawn with.

    Attributes:
        start: (T + 1,) int64 where in `splats` each tile begins.
        splats: (total,) int32 rows of the projected splats, tile by tile, from near to far.
        stop: (T,) int64 up to where in `splats` each tile was drawn; it is opaque before the rest.
    """

    start: NDArray[np.int64]
    splats: NDArray[np.int32]
    stop: NDArray[np.int64]


def draw(splats: ShadedSplats, camera: Camera, settings: RasterSettings) -> Image:
    """What a camera sees: (height, width, 4) float32, red, green, blue, multiplied by alpha, and alpha; 0..1.

    The image is the same for any number of threads.
    """
    return draw_projected(seen(splats, camera, settings), camera, settings)[0]


def draw_projected(screen: NDArray[np.float32], camera: Camera, settings: RasterSettings) -> tuple[Image, Tiles]:
    """The picture of splats on the screen, (M, `project.COLUMNS`) from near to far, and its tiles."""
    across, down = tiles_across(camera)
    start, order = raster.sort_into_tiles(screen, across, down, CHUNKS * threads_in_use())
    tiles = Tiles(start, order, np.empty(across * down, np.int64))
    image = np.empty((camera.height, camera.width, 4), np.float32)
    is_design = settings.profile == "shifted"
    raster.draw_tiles(screen, start, order, across, is_design, np.float32(MIN_ALPHA), image, tiles.stop)
    return image, tiles


def tiles_across(camera: Camera) -> tuple[int, int]:
    """Numbers of tiles across and down the picture of a camera."""
    return -(-camera.width // raster.TILE), -(-camera.height // raster.TILE)


def seen(splats: ShadedSplats, camera: Camera, settings: RasterSettings) -> NDArray[np.float32]:
    """The splats on the screen, (M, `project.COLUMNS`) from near to far; a buffer, which the next call overwrites."""
    return project_splats(splats, camera, settings)[0]


def project_splats(
    splats: ShadedSplats, camera: Camera, settings: RasterSettings
) -> tuple[NDArray[np.float32], NDArray[np.uint64]]:
    """What `seen` returns, and (M,) keys, whose lower half is `project.MAX_INDEX` minus the index of a splat."""
    screen, arranged, keys = _buffers(len(splats))
    project.project(*arguments(splats, camera, settings), settings.sort == "radial", screen, keys)
    keys = np.sort(keys[keys != project.NOT_DRAWN])
    arranged = arranged[: len(keys)]
    project.gather_drawn(screen, keys, arranged)
    return arranged, keys


def arguments(
    splats: ShadedSplats, camera: Camera, settings: RasterSettings
) -> tuple[project.ShadedColumns, NDArray[np.float32], project.Lens, project.Limits]:
    """What the kernels take for splats, a camera and settings: `splats`, `world_to_camera`, `lens` and `limits`."""
    columns = project.ShadedColumns(splats.center, splats.scale, splats.quat_xyzw, splats.lod_opacity, splats.rgb)
    lens = project.Lens(*map(np.float32, (*camera.focal, *camera.principal, camera.width, camera.height)))
    near, far, radius = settings.near, settings.far, settings.max_radius
    limits = project.Limits(*map(np.float32, (near, far, CLIP, BLUR, MIN_ALPHA, MAX_STD_DEV, STD_DEV_PER_D, radius)))
    return columns, world_to_camera(camera), lens, limits


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
