"""Outputs in parts that viewers load as needed: Streamed SOG, with errors of its detail levels, and 3D Tiles."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import FARTHEST, rotation_of
from ..codecs.formats import ENVIRONMENT, WriteOptions
from ..lod.tree_settings import DetailSettings, TileSettings
from ..model.falloff import MAX_STD_DEV, MIN_ALPHA, STD_DEV_PER_D
from ..model.gaussian import lod_opacity
from ..model.instances import DetailScene
from ..model.scene import Scene
from ..model.sh import degree_of
from ..model.splats import Splats
from ..render.kernels.ellipse import Limits
from ..render.kernels.project import TILE, ShadedColumns
from ..render.kernels.region_errors import compare_levels
from ..render.kernels.shade import add_sh
from ..render.render_settings import BLUR, CLIP
from ..system.output import Output
from ..system.progress import Progress, silent
from ..system.threads import on_threads


@dataclass(frozen=True)
class WrittenLevel:
    """Detail level of a Streamed SOG: splats of all regions, their share of level 0, and largest error of a region."""

    splats: int
    share: float
    worst_error: float


@dataclass(frozen=True)
class WrittenDetail:
    """Record of a Streamed SOG.

    Attributes:
        levels: full detail first.
        chunks: number of folders.
        environment: number of splats that are always drawn.
    """

    levels: tuple[WrittenLevel, ...]
    regions: int
    chunks: int
    environment: int


@dataclass(frozen=True)
class WrittenTiles:
    """Record of 3D Tiles.

    Attributes:
        splats: number in the cut of each level, from the root to full detail.
        error: geometric error of the root.
        georeferenced: the tileset has a position on the Earth.
    """

    tiles: int
    levels: int
    splats: tuple[int, ...]
    error: float
    georeferenced: bool


def write_levels(
    scene: Scene,
    environment: Splats | None,
    out: Output,
    settings: DetailSettings,
    options: WriteOptions,
    end: Callable[[str], None],
    threads: int,
    progress: Progress,
) -> tuple[int, WrittenDetail]:
    """Make the detail levels of a tree and write them as a Streamed SOG; return the bytes of its files, and a record.

    Args:
        end: called with the name of each stage but the last, when it is done.
    """
    from ..codecs.streamed_sog import encode_files
    from ..lod.parts import make_levels

    assert scene.tree is not None
    with on_threads(threads):
        made = make_levels(scene.splats, scene.tree, settings, progress=progress)
    end("levels")
    errors = measured(made, threads=threads, progress=progress)
    end("errors")
    antialiased, up = scene.antialiased, scene.up
    made = dataclasses.replace(made, errors=errors, environment=environment, antialiased=antialiased, up=up)
    size, names = 0, list[str]()
    with out:
        division = settings.chunk_splats, settings.extent, settings.min_splats
        for name, pieces in encode_files(made, options, *division, threads=threads, progress=progress):
            size += out.write(name, pieces)
            names.append(name)
    splats, worst = made.counts.sum(axis=0).tolist(), errors.max(axis=0).tolist()
    levels = tuple(
        WrittenLevel(count, round(count / splats[0], 6), error) for count, error in zip(splats, worst, strict=True)
    )
    chunks = len({name.partition("/")[0] for name in names if "/" in name} - {ENVIRONMENT})
    return size, WrittenDetail(levels, made.regions, chunks, 0 if environment is None else len(environment))


def write_tiles(
    scene: Scene,
    out: Output,
    settings: TileSettings,
    options: WriteOptions,
    end: Callable[[str], None],
    threads: int,
    progress: Progress,
) -> tuple[int, WrittenTiles]:
    """Make the tiles of a tree and write them as 3D Tiles; see `write_levels`."""
    from ..codecs.tiles_3d import encode_files
    from ..lod.parts import make_tiles

    assert scene.tree is not None
    with on_threads(threads):
        made = make_tiles(scene.splats, scene.tree, settings, progress=progress)
    made = dataclasses.replace(made, antialiased=scene.antialiased, up=scene.up)
    end("tiles")
    with out:
        files = encode_files(made, options, threads=threads, progress=progress)
        size = sum(out.write(*file) for file in files)
    levels = int(made.level.max()) + 1
    splats = tuple(int(made.counts[made.at_level(level)].sum()) for level in range(levels))
    georeferenced = not np.array_equal(made.transform, np.eye(4))
    return size, WrittenTiles(made.tiles, levels, splats, float(made.errors[0]), georeferenced)


Errors = NDArray[np.float64]

#: Rotation w x y z of the viewing axes, 45, 20 and 35 degrees about x, y and z as in splat-transform 3.7: along the
#: world's axes many spherical harmonics are 0, which would hide their errors.
TURN = (0.8877160, 0.3111847, 0.2663317, 0.2102186)

#: Signs of the axes of a camera that looks in the opposite direction, after two of its axes are exchanged.
BACK = np.array([[1.0], [1.0], [-1.0]])

#: Distance of the camera from the middle of a region, and half the width of the picture there, in radii of the region,
#: as in splat-transform 3.7.
DISTANCE, HALF_WIDTH = 200.0, 1.05

#: Least radius of a region, as a share of its coordinates and 1, so that float32 holds quotients by it. Chosen.
LEAST_RADIUS = 1e-30

#: Least and largest width of a picture, pixels. Measured against 256 and 512 (benchmarks/notes/rounding-and-levels.md).
LEAST_WIDTH, MOST_WIDTH = 64, 128

#: Pixels across the diameter of a small splat: the FINE quantile of a region by the longest axis.
PIXELS, FINE = 4, 0.1

#: Splats of a region from which this quantile is estimated; and splats drawn between two reports of progress.
SAMPLE, BATCH = 4096, 1 << 21


def measured(scene: DetailScene, *, threads: int | None = None, progress: Progress = silent) -> Errors:
    """Measure the (R, L) float64 error of each region at each detail level on pictures.

    As in splat-transform 3.7, each region is drawn alone from six directions, from so far away that there is hardly any
    perspective. The error is the sum of squared differences from the pictures of the first level, in premultiplied
    colours and alpha, over the sum of squares of those: independent of the size and place of the region. See
    benchmarks/notes/rounding-and-levels.md.

    It is 0 at the first level of a region and does not decrease. A missing level has the error of the level before.
    """
    order = np.argsort(scene.counts == 0, axis=1, kind="stable")  # levels that have splats come first
    runs = np.take_along_axis(np.stack([scene.starts, scene.counts], 2), order[:, :, None], 1)
    sums = _differences(scene, runs, threads, progress)
    energy = sums[:, :1].copy()
    sums[:, 0] = 0
    # If the first level is invisible, a visible level has an error of 1.
    errors = np.where(energy > 0, sums / np.where(energy > 0, energy, 1), (sums > 0).astype(np.float64))
    placed = np.zeros_like(errors)
    np.put_along_axis(placed, order, errors, 1)
    return np.maximum.accumulate(placed, axis=1)


def _differences(
    scene: DetailScene, runs: NDArray[np.int64], threads: int | None, progress: Progress
) -> NDArray[np.float64]:
    """Return (R, L) sums of `compare_levels` over all views, level by level as in `runs`."""
    splats = scene.splats
    columns = ShadedColumns(splats.center, splats.scale, splats.quat_xyzw, lod_opacity(splats.opacity), splats.rgb)
    turns = _turns()
    poses, basis, widths = _poses(scene.bounds, turns), _basis(turns, splats.sh.shape[1]), _widths(scene, runs)
    numbers = DISTANCE / 2, 2 * DISTANCE, CLIP, BLUR, MIN_ALPHA, MAX_STD_DEV, STD_DEV_PER_D, math.inf
    limits, focal = Limits(*map(np.float32, numbers)), np.float32(DISTANCE / (2 * HALF_WIDTH))
    sums = np.zeros((scene.regions, len(turns), scene.levels))
    ends = np.cumsum(scene.counts.sum(axis=1)) // BATCH
    batches = np.split(np.arange(scene.regions), np.flatnonzero(np.diff(ends)) + 1)
    with on_threads(threads):
        for batch in batches:
            part = slice(int(batch[0]), int(batch[-1]) + 1)
            jobs = len(batch) * len(turns)
            places = runs[part], poses[part], basis, widths[part]
            compare_levels(jobs, columns, splats.sh, *places, focal, limits, sums[part])
            progress("errors", part.stop, scene.regions, "region")
    return sums.sum(axis=1)


def _turns() -> NDArray[np.float64]:
    """Return (6, 3, 3) rotations from the world to cameras that look along z, y down: along each axis, then back."""
    axes = rotation_of(TURN).T
    return np.array(
        [turn for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)) for turn in (axes[[b, c, a]], axes[[c, b, a]] * BACK)]
    )


def _poses(bounds: NDArray[np.float64], turns: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return (R, 6, 3, 4) world-to-camera matrices in radii of each region, DISTANCE in front of the camera."""
    radius = np.linalg.norm(bounds[:, 1] - bounds[:, 0], axis=1) / 2
    least = LEAST_RADIUS * np.maximum(np.abs(bounds).max(axis=(1, 2)), 1)
    matrices = turns / np.maximum(np.where(radius > 0, radius, 1), least)[:, None, None, None]
    offsets = -np.einsum("rvij,rj->rvi", matrices, bounds.mean(axis=1)) + [0, 0, DISTANCE]
    poses = np.concatenate([matrices, offsets[..., None]], axis=3)
    return np.clip(poses, -FARTHEST, FARTHEST).astype(np.float32)


def _basis(turns: NDArray[np.float64], coefficients: int) -> NDArray[np.float32]:
    """Return (6, K) values of the spherical harmonics of degree 1 and above in the direction of each view."""
    basis = np.zeros((len(turns), coefficients, 3), np.float32)
    ones = np.repeat(np.eye(coefficients, dtype=np.float32)[:, :, None], 3, axis=2)
    if coefficients:
        for turn, values in zip(turns, basis, strict=True):
            ahead = np.tile(turn[2].astype(np.float32), (coefficients, 1))
            add_sh(len(ahead), ahead, ones, np.zeros(3, np.float32), degree_of(coefficients), values)
    return np.ascontiguousarray(basis[:, :, 0])


def _widths(scene: DetailScene, runs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return (R,) widths of the pictures of each region, pixels, at which small splats of its first level show."""
    diameter = np.linalg.norm(scene.bounds[:, 1] - scene.bounds[:, 0], axis=1)
    width = np.empty(scene.regions)
    for region, (start, count) in enumerate(runs[:, 0]):
        longest = scene.splats.scale[start : start + count : max(1, count // SAMPLE)].max(axis=1)
        small = 2 * float(np.quantile(longest, FINE)) if len(longest) else 0.0
        width[region] = PIXELS * diameter[region] / small if small > 0 else MOST_WIDTH
    return (np.ceil(np.clip(width, LEAST_WIDTH, MOST_WIDTH) / TILE) * TILE).astype(np.int64)
