"""Pictures of a scene: the nodes of a level, the voxel grid that suits it, the boxes of the chunks, and the axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..images.text import BACKGROUND
from ..lod.kernels.tree_links import walk
from ..lod.traversal import CHUNK_NODES
from ..model.gaussian import spark_size
from ..model.scene import Scene
from ..model.splats import FloatArray, Splats
from ..render.color_scales import VIRIDIS, ramp
from ..support.defaults import DEFAULT_BASE, PLOT_BY
from ..support.errors import SparklodError
from ..support.ticks import nice_step
from .ellipsoids import Points, box_lines, cells, evenly, level_of_step, wall_lines
from .labels import write_png
from .node_colors import color_by
from .pyvista_scene import Stage
from .viewpoint import bounds, is_drawable, viewpoint

#: Of more nodes than this, so many are drawn.
MOST_POINTS = 600_000

#: More occupied voxels than this are not outlined one by one; more lines than this an axis are not all drawn.
MOST_CELLS, MOST_LINES = 150, 48

#: The boxes of so many chunks are drawn at most.
MOST_CHUNKS = 16

#: The way it is looked at, from the front, from the right and from above: in scenes of 3DGS y points down.
DIRECTION, UP = np.array([-0.62, 0.5, -1.0]), np.array([0.0, -1.0, 0.0])

#: Left, top, right and bottom of the scene in the picture; the title, the labels and the colours stand around it.
FRAME = (0.09, 0.2, 0.85, 0.93)

GREY, VOXELS, BOXES = "#5b6673", "#6ea8fe", "#dfe7ef"


@dataclass(frozen=True)
class Picture:
    """The bytes of a PNG, and what it shows, in words: for who cannot see it."""

    png: bytes
    description: str


@dataclass(frozen=True)
class _Subject:
    """What is drawn.

    Attributes:
        index: of the splats that are drawn in colour.
        total: how many they are a sample of.
        others: of the leaves that end above the level, drawn as grey dots.
        depth: (N,) level of each node, -1 where the root does not lead to it; None where there is no tree.
        title: what they are, in words.
    """

    index: NDArray[np.int64]
    total: int
    others: NDArray[np.int64]
    depth: NDArray[np.int32] | None
    title: str


@np.errstate(over="ignore", invalid="ignore")  # of numbers that are out of range in the file
def plot(scene: Scene, *, by: str = "level", level: int | None = None, size: tuple[int, int] = (1600, 1000)) -> Picture:
    """Draws a scene. All levels of a scene are seen from the same place.

    Args:
        scene: N splats; those that are invalid are left out, and the tree may be broken.
        by: one of `PLOT_BY`; for a scene that is no tree, "level" is taken for "size".
        level: edges from the root to the nodes that are drawn; None for all leaves, or all splats.
        size: width and height in pixels.

    Raises:
        SparklodError: pyvista is not installed or cannot draw here, there is no such level, or nothing to draw.
    """
    if by not in PLOT_BY:
        raise ValueError(f"by is {by}, not one of {', '.join(PLOT_BY)}")
    splats = scene.splats.with_max_sh(0)
    drawable = is_drawable(splats)
    if not drawable.any():
        raise SparklodError("there is nothing to draw: no splat is valid and has a size")
    subject = _subject(scene, level, drawable)
    by = "size" if by == "level" and subject.depth is None else by
    coloring = color_by(by, splats, subject.index, subject.depth)
    chosen = splats.take(subject.index)
    low, high = bounds(splats.take(drawable))
    eye = viewpoint(box_lines(low[None], high[None]), DIRECTION, UP, aspect=size[0] / size[1], frame=FRAME)
    with Stage(low, high, size, BACKGROUND) as stage:
        drawn = stage.splats(chosen, coloring.rgb, eye)
        if len(subject.index) < subject.total:
            drawn += f", {len(subject.index):,} of them, evenly chosen"
        if len(subject.others):
            stage.dots(splats.center[subject.others], GREY)
            drawn += f"; grey: {len(subject.others):,} leaves of coarser levels"
        voxels = _voxels(stage, chosen, low, high, eye.position)
        boxes = _boxes(stage, scene, subject.index, drawable, by) if scene.tree is not None or by == "chunk" else ""
        pixels = stage.photograph(eye)
    lines = [line for line in (drawn, voxels, boxes) if line]
    png = write_png(pixels, subject.title, lines, coloring, eye, low, high)
    return Picture(png, "; ".join([subject.title, f"coloured by {coloring.title}", *lines]))


def _subject(scene: Scene, level: int | None, drawable: NDArray[np.bool_]) -> _Subject:
    none = np.empty(0, np.int64)
    if scene.tree is None:
        if level is not None:
            raise SparklodError("there are no levels to draw: it is not a Level-of-Detail tree")
        index, others, depth = np.flatnonzero(drawable), none, None
        title = _counted(len(index), "splat")
    else:
        depth = walk(scene.tree.child_count, scene.tree.child_start, spark_size(scene.splats))[0]
        leaf = scene.tree.is_leaf & drawable & (depth >= 0)
        if level is None:
            index, others = np.flatnonzero(leaf), none
            title = f"{_counted(len(index), 'leaf', 'leaves')} of a tree of {_counted(int(depth.max()) + 1, 'level')}"
        else:
            index, others = np.flatnonzero(drawable & (depth == level)), np.flatnonzero(leaf & (depth < level))
            title = f"Level {level} of {depth.max()}: {_counted(len(index), 'node')}"
        if not len(index):
            what = "leaf" if level is None else f"level {level}"
            raise SparklodError(f"there is no {what} to draw: the tree has levels 0 to {depth.max()}")
    chosen, others = (of[evenly(len(of), MOST_POINTS)] for of in (index, others))
    return _Subject(chosen, len(index), others, depth, title)


def _counted(count: int, one: str, many: str = "") -> str:
    return f"{count:,} {one if count == 1 else many or one + 's'}"


def _voxels(stage: Stage, splats: Splats, low: Points, high: Points, eye: Points) -> str:
    """The grid whose cells Quick-LoD would sort splats of this size into; says what is drawn of it.

    A file does not tell the base of its grids, nor which of them a node is of, so it is that of the median size.
    """
    level = level_of_step(2 * float(np.median(splats.scale.max(axis=1))))
    step = DEFAULT_BASE**level
    said = f"of {step:.3g} ({DEFAULT_BASE:g}^{level}, by their median size)"
    inside = ((splats.center >= low) & (splats.center <= high)).all(axis=1)
    occupied = cells(splats.center[inside], step)
    if len(occupied) <= MOST_CELLS:
        stage.lines(box_lines(occupied, occupied + step), VOXELS, 0.4)
        return f"blue: the {_counted(len(occupied), 'voxel')} {said} that they are in"
    every = max(1, round(nice_step(float((high - low).max()) / (MOST_LINES * step))))
    stage.lines(wall_lines(low, high, np.where(eye > (low + high) / 2, low, high), every * step), VOXELS, 0.35)
    line = f", every {every}{'nd' if every == 2 else 'th'} line" if every > 1 else ""
    return f"blue: on the walls, the grid of voxels {said}{line}"


def _boxes(stage: Stage, scene: Scene, index: NDArray[np.int64], drawable: NDArray[np.bool_], by: str) -> str:
    """The boxes around all nodes of the chunks that some nodes are in; says which."""
    count = -(-len(drawable) // CHUNK_NODES)
    chunks = np.unique(index // CHUNK_NODES)
    colors = ramp(VIRIDIS, count)
    for chunk in chunks[:MOST_CHUNKS]:
        rows = slice(chunk * CHUNK_NODES, (chunk + 1) * CHUNK_NODES)
        center: FloatArray = scene.splats.center[rows][drawable[rows]]
        color, opacity = (f"#{bytes(colors[chunk]).hex()}", 0.8) if by == "chunk" else (BOXES, 0.4)
        stage.lines(box_lines(center.min(axis=0)[None], center.max(axis=0)[None]), color, opacity)
    drawn = f", the first {MOST_CHUNKS} of them" if len(chunks) > MOST_CHUNKS else ""
    what = "splats" if scene.tree is None else "nodes"
    return f"boxes: chunks of {CHUNK_NODES:,} {what}, the {len(chunks)} of {count} that these are in{drawn}"
