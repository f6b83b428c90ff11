"""The reference backend: splats drawn in tiles on the processor."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import FARTHEST, FLIP, Camera, Matrix
from ..model.falloff import MAX_STD_DEV, MIN_ALPHA, STD_DEV_PER_D
from ..model.gaussian import lod_opacity, placed
from ..model.sh import COEFFICIENTS
from ..model.splats import FloatArray, Splats
from ..system.threads import threads_in_use
from .kernels import ellipse, project, raster
from .kernels.shade import add_sh
from .render_settings import BLUR, CLIP, RasterSettings


@dataclass(frozen=True)
class ShadedSplats:
    """N splats in the world, in the colours that a camera sees, float32."""

    center: FloatArray  # (N, 3) world units
    scale: FloatArray  # (N, 3) standard deviations, world units
    quat_xyzw: FloatArray  # (N, 4) unit quaternions, local to world
    lod_opacity: FloatArray  # (N,) Spark's D
    rgb: FloatArray  # (N, 3) display-referred, at least 0

    def __len__(self) -> int:
        return len(self.center)


def shade(parts: Sequence[tuple[Splats, Matrix]], camera: Camera) -> ShadedSplats:
    """Place splats by their (4, 4) matrices, object to world, and compute the colours that a camera sees.

    Spherical harmonics are evaluated in the direction from the camera to a splat's centre, in the space of its object.
    """
    shaded = []
    for splats, matrix in parts:
        rgb = splats.rgb.copy()
        if splats.sh.shape[1]:
            eye = np.linalg.solve(matrix, np.append(camera.position, 1))[:3].astype(np.float32)
            add_sh(len(rgb), splats.center, splats.sh, eye, COEFFICIENTS.index(splats.sh.shape[1]), rgb)
        np.maximum(rgb, 0, out=rgb)
        there = splats if np.array_equal(matrix, np.eye(4)) else placed(splats, matrix)
        shaded.append((there.center, there.scale, there.quat_xyzw, lod_opacity(there.opacity), rgb))
    return ShadedSplats(*map(np.concatenate, zip(*shaded, strict=True)))


Image = NDArray[np.float32]

#: (N, 4) first and last tile across and down that each splat overlaps; empty for splats that are not drawn.
Boxes = NDArray[np.int16]

#: (M,) keys of `kernels.project.project`, from near to far.
Keys = NDArray[np.uint64]

_working_memory = threading.local()

#: Bytes of a cache line.
CACHE_LINE = 64

#: Most pixels along a side of a picture: int16 holds the numbers of its tiles.
MAX_SIDE = project.TILE * np.iinfo(np.int16).max

#: Blocks per thread in which splats are sorted into tiles.
BLOCKS = 2


def draw(splats: ShadedSplats, camera: Camera, settings: RasterSettings) -> Image:
    """Draw what a camera sees: (height, width, 4) float32 premultiplied red, green and blue, and alpha, 0..1.

    The image does not depend on the number of threads.
    """
    return draw_projected(*project_splats(splats, camera, settings), camera, settings)[0]


def draw_projected(
    screen: NDArray[np.float32], boxes: Boxes, keys: Keys, camera: Camera, settings: RasterSettings
) -> tuple[Image, NDArray[np.int64], NDArray[np.int32], NDArray[np.int64]]:
    """Draw splats of `project_splats`.

    Returns:
        The picture; the starts of T tiles and the list of splats from `sort_into_tiles`; (T,) ends of the splats that
        were drawn in each tile, which is opaque in front of the rest.
    """
    across, down = tiles_across(camera)
    start, order = sort_into_tiles(boxes, keys, across, down, BLOCKS * threads_in_use())
    stop, image = np.empty(across * down, np.int64), np.empty((camera.height, camera.width, 4), np.float32)
    is_design = settings.profile == "shifted"
    raster.draw_tiles(len(stop), screen, start, order, across, is_design, np.float32(MIN_ALPHA), image, stop)
    return image, start, order, stop


def sort_into_tiles(
    boxes: Boxes, keys: Keys, across: int, down: int, blocks: int
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """List the splats of each tile, from near to far; threads process `blocks` ranges of splats.

    Returns:
        (tiles + 1,) positions in the list where tiles begin; (total,) the list of splats.
    """
    counts = np.zeros((blocks, across * down), np.int32)
    drawn = np.empty((len(keys), 4), np.int16)
    raster.count_in_tiles(blocks, keys, boxes, across, drawn, counts)
    ends = np.cumsum(counts.T, dtype=np.int64).reshape(across * down, blocks)
    at = np.ascontiguousarray(ends.T - counts)
    start = np.append(at[0], ends[-1, -1])
    splats = np.empty(start[-1], np.int32)
    raster.list_in_tiles(blocks, keys, drawn, across, at, splats)
    return start, splats


def tiles_across(camera: Camera) -> tuple[int, int]:
    """Return the numbers of tiles across and down a picture; `ValueError` above `MAX_SIDE` pixels."""
    if max(camera.width, camera.height) > MAX_SIDE:
        raise ValueError(f"a picture of {camera.width} x {camera.height} pixels; at most {MAX_SIDE:,} along a side")
    return -(-camera.width // project.TILE), -(-camera.height // project.TILE)


def project_splats(
    splats: ShadedSplats, camera: Camera, settings: RasterSettings
) -> tuple[NDArray[np.float32], Boxes, Keys]:
    """Project N splats onto the screen, of which M are drawn.

    Returns:
        (N, `project.COLUMNS`) rows on the screen, filled for drawn splats; boxes; keys. The next call overwrites rows
        and boxes.
    """
    tiles_across(camera)
    count = len(splats.center)
    memory = _working_memory  # reused by each thread, since the first access to new memory is slow
    if len(getattr(memory, "keys", ())) < count:
        floats = np.empty((count + 1) * project.COLUMNS, np.float32)
        first = -floats.ctypes.data % CACHE_LINE // floats.itemsize  # each row fills one cache line
        memory.screen = floats[first : first + count * project.COLUMNS].reshape(count, project.COLUMNS)
        memory.boxes, memory.keys = np.empty((count, 4), np.int16), np.empty(count, np.uint64)
    screen, boxes, keys = memory.screen[:count], memory.boxes[:count], memory.keys[:count]
    is_radial = settings.sort == "radial"
    project.project(len(keys), *arguments(splats, camera, settings), is_radial, screen, keys, boxes)
    return screen, boxes, np.sort(keys[keys != project.NOT_DRAWN])


def arguments(
    splats: ShadedSplats, camera: Camera, settings: RasterSettings
) -> tuple[project.ShadedColumns, NDArray[np.float32], ellipse.Lens, ellipse.Limits]:
    """Return splats, camera and settings as arguments of kernels."""
    columns = project.ShadedColumns(splats.center, splats.scale, splats.quat_xyzw, splats.lod_opacity, splats.rgb)
    lens = ellipse.Lens(*map(np.float32, (*camera.focal, *camera.principal, camera.width, camera.height)))
    near, far, radius = settings.near, settings.far, settings.max_radius
    limits = ellipse.Limits(*map(np.float32, (near, far, CLIP, BLUR, MIN_ALPHA, MAX_STD_DEV, STD_DEV_PER_D, radius)))
    return columns, world_to_camera(camera), lens, limits


def world_to_camera(camera: Camera) -> NDArray[np.float32]:
    """Return the (3, 4) matrix from the world into axes with y down and z forward, clipped to the range of float32."""
    turned = camera.camera_to_world @ FLIP
    return np.clip(np.linalg.inv(turned)[:3], -FARTHEST, FARTHEST).astype(np.float32)
