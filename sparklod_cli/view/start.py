"""Initial camera of a page, and the extent of the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..cameras import DEFAULT_SIZE, ELEVATION, framing
from ..cameras.camera import DEFAULT_FOV_Y, Matrix, Settings
from ..cameras.framing import Balls, balls_of
from ..cameras.sources import single_views, whole_scene
from ..codecs.losses import MOST_PAGED_DEGREE, sample_loss
from ..codecs.rad.rad_header import RadHeader
from ..codecs.rad.rad_reader import count_leaves, file_of, read_chunk
from ..io.local_files import open_plain
from ..io.reading import read_parts, read_scene
from ..model.scene import DetailScene, TileScene
from ..model.splats import Splats
from ..system.errors import InvalidSplatsError, UnreadableError, naming, reason_of
from ..system.progress import Progress, silent
from .files import ShownFile

#: x, y and z in world units.
Point = tuple[float, float, float]

#: Vertical field of view where none is given, degrees.
FOV = round(math.degrees(DEFAULT_FOV_Y), 9)


#: The feature sizes that colours distinguish, as percentiles of all: of trees, few nodes are coarse.
SIZES = 1, 99.9

#: How many times smaller the splats of a large RAD tree are than those of its first chunk: some levels.
BELOW = 8


@dataclass(frozen=True)
class Extent:
    """Extent of a splat file, for the first view.

    Attributes:
        splats: how many, nodes where it is a tree.
        leaves: how many of a tree, or splats of full detail where there are levels; None without either.
        balls: what its splats cover; only the coarsest of a large RAD tree.
        sizes: (2,) the range of the feature sizes of its splats, but for a few at either end, world units.
        up, up_by: as in `Scene`.
        levels: detail levels; None without.
        layout: in which Spark is to hold the splats, "ext" or "packed".
    """

    splats: int
    leaves: int | None
    balls: Balls
    sizes: tuple[float, float]
    up: str | None
    levels: int | None = None
    layout: str = "ext"
    up_by: str = ""


@dataclass(frozen=True)
class Start:
    """The first view of the scene.

    Attributes:
        eye, target: of the camera, world units.
        fov: vertical field of view, degrees.
        center: the middle of the scene, world units.
        radius: of a ball around the middle that most splats are in, world units.
        sizes: the range of the feature sizes, smallest and largest, world units.
        chosen: the view was chosen for the scene, not given.
    """

    eye: Point
    target: Point
    fov: float
    center: Point
    radius: float
    sizes: tuple[float, float]
    chosen: bool


def extent_of(shown: ShownFile, *, threads: int = 1, progress: Progress = silent) -> Extent:
    """Return the extent of a file, for the first view; a `SparklodError` about a broken one names it."""
    try:
        with naming(shown.path):
            if shown.header is not None and shown.header.lod_tree and len(shown.header.chunks) > 1:
                return _coarse_extent(shown, shown.header)
            parts = read_parts(shown.path, threads=threads, progress=progress)
            if parts is not None:
                return _parts_extent(parts)
            scene = read_scene(shown.path, threads=threads, progress=progress)
    except OSError as error:
        raise UnreadableError(f"{shown.path}: cannot be read: {reason_of(error)}") from None
    leaves = None if scene.tree is None else np.flatnonzero(scene.tree.is_leaf)
    index = slice(None) if leaves is None else leaves
    return Extent(
        len(scene.splats),
        None if leaves is None else len(leaves),
        balls_of(scene.splats, index, np.eye(4)),
        _sizes(scene.splats),
        scene.up,
        layout=_layout(shown, scene.splats),
        up_by=scene.up_by,
    )


def _coarse_extent(shown: ShownFile, header: RadHeader) -> Extent:
    """Return the extent of a RAD tree by its first chunk and its leaves, since a file may have gigabytes.

    A cut through the chunk, its nodes that have no children in it, covers the whole scene.
    """
    companions = {Path(key).name: path for key, path in shown.files.items()}

    def opened(name: str) -> BinaryIO:
        return open_plain(companions[name])

    entry = header.chunks[0]
    with opened(shown.path.name) as file:
        with file_of(entry, file, opened) as first:
            chunk = read_chunk(first, entry, header)
        leaves = count_leaves(file, header, opened)
    assert chunk.tree is not None
    start, count = (column.astype(np.int64) for column in (chunk.tree.child_start, chunk.tree.child_count))
    cut = np.flatnonzero((count == 0) | (start + count > len(chunk.splats)))
    smallest, largest = _sizes(chunk.splats)
    balls = balls_of(chunk.splats, cut, np.eye(4))
    sizes = smallest / BELOW, largest
    return Extent(header.count, leaves, balls, sizes, header.noted.up, layout=_layout(shown, chunk.splats))


def _layout(shown: ShownFile, splats: Splats) -> str:
    """Return the layout in which Spark shows these splats of a file best, or at all."""
    if shown.paged and splats.sh_degree > MOST_PAGED_DEGREE:
        return "packed"
    return sample_loss(splats).better


def _parts_extent(scene: DetailScene | TileScene) -> Extent:
    """Return the extent by the coarsest level that has splats; without an environment, which is all around."""
    coarse: NDArray[Any] | slice
    if isinstance(scene, DetailScene):
        coarse, leaves, levels = scene.level(scene.levels - 1), scene.counts[:, 0].sum(), scene.levels
    else:
        first = int(scene.level[np.argmax(scene.counts > 0)])
        coarse = np.repeat(np.isin(np.arange(scene.tiles), scene.at_level(first)), scene.counts)
        leaves, levels = scene.counts[scene.is_leaf].sum(), int(scene.level.max()) + 1
    balls = balls_of(scene.splats, coarse, np.eye(4))
    return Extent(len(scene.splats), int(leaves), balls, _sizes(scene.splats), scene.up, levels, up_by=scene.up_by)


def _sizes(splats: Splats) -> tuple[float, float]:
    """Return the range of the feature sizes of some splats, as if none had a D above 1; both ends are above 0."""
    sizes = 2 * splats.scale[:: max(len(splats) // framing.SAMPLE, 1)].mean(axis=1, dtype=np.float64)
    sizes = sizes[np.isfinite(sizes) & (sizes > 0)]
    if not len(sizes):
        return 1.0, 1.0
    smallest, largest = (float(end) for end in np.percentile(sizes, SIZES))
    return smallest, largest


def start_of(extents: Sequence[Extent], view: tuple[Point, Point] | None, up: Point, fov: float) -> Start:
    """Return the first view of some files together; `CameraPathError` if the camera makes no sense.

    `view` has eye and target, where they are given; else the whole scene is in view, from its front.
    """
    balls = Balls.concat(extent.balls for extent in extents)
    settings = Settings(size=DEFAULT_SIZE, fov_y=math.radians(fov), up=up)
    try:
        middle, radius = framing.framing(balls.center)
    except InvalidSplatsError:  # nothing that could be framed
        middle, radius, view = np.zeros(3), 1.0, view or ((0.0, 0.0, 3.0), (0.0, 0.0, 0.0))
    path = whole_scene(ELEVATION, settings, lambda: balls) if view is None else single_views((view,), settings)
    (camera,) = path.cameras
    sizes = min(extent.sizes[0] for extent in extents), max(extent.sizes[1] for extent in extents)
    target: Sequence[float] | Matrix
    if view is None:  # the point on the axis of the camera that is nearest to the middle
        away = float((middle - camera.position) @ camera.forward)
        target = camera.position + camera.forward * (away if away > 0 else 1.0)
    else:
        target = view[1]
    return Start(_point(camera.position), _point(target), fov, _point(middle), radius, sizes, chosen=view is None)


def _point(values: Sequence[float] | Matrix) -> Point:
    x, y, z = (float(value) for value in values)
    return x, y, z
