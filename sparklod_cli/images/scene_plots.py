"""Pictures by pyvista: a scene or one depth of a tree, with voxel grid and boxes of chunks; a camera path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..lod.kernels.tree_links import find_depths
from ..lod.tree_settings import DEFAULT_BASE
from ..model.gaussian import lod_opacity, spark_size
from ..model.lod_tree import CHUNK_NODES
from ..model.scene import ASSUMED, AXES, Scene
from ..model.splats import FloatArray, Splats
from ..render.color_scales import (
    VIRIDIS,
    Coloring,
    depth_scale,
    nice_step,
    opacity_scale,
    ramp,
    size_scale,
    whole_numbers,
)
from ..system.errors import SparklodError
from ..system.units import count_of
from .picture_files import PLOT_BY
from .pixels import BACKGROUND
from .pyvista_scene import (
    Points,
    PyvistaStage,
    Viewpoint,
    bounds,
    box_lines,
    cells,
    evenly,
    is_drawable,
    level_of_step,
    viewpoint,
    wall_lines,
    write_png,
)

#: Least distance of a mark from the ends of a scale, as a share of it; nearer labels would touch.
APART = 0.04


def color_by(
    by: str, splats: Splats, index: NDArray[np.int64], depth: NDArray[np.int32] | None
) -> tuple[Coloring, NDArray[np.uint8]]:
    """Return a colour scale for M of N splats, and their (M, 3) colours.

    Args:
        by: one of `PLOT_BY`; "level" needs `depth`.
        index: (M,) indices of the splats to colour; at least one.
        depth: (N,) edges from the root.
    """
    values: NDArray[Any]
    if by == "level" and depth is not None:
        values = depth[index]
        one = values.min() == values.max()  # its colour then shows how deep in the tree it lies
        scale = whole_numbers("tree depth", 0, int(depth.max())) if one else depth_scale("tree depth", values)
    elif by == "chunk":
        values = index // CHUNK_NODES
        scale = whole_numbers("chunk", 0, (len(splats) - 1) // CHUNK_NODES)
    elif by == "opacity":
        values = lod_opacity(np.maximum(splats.opacity[index], 0))
        scale = opacity_scale("opacity" if values.max() <= 1 else "opacity (D)", values, APART)
    else:
        values = spark_size(splats)[index]
        scale = size_scale(values, APART, sampled=False)
    return scale, scale.rgb(values)


#: Most nodes that are drawn; more are sampled evenly.
MOST_POINTS = 600_000

#: Most occupied voxels that are outlined one by one, and most lines of the voxel grid along an axis.
MOST_CELLS, MOST_LINES = 150, 48

#: Most chunks whose boxes are drawn.
MOST_CHUNKS = 16

#: Viewing direction, from the back, the right and above: components to the right, up, and to the front.
DIRECTION = -0.62, -0.5, 1.0

#: Left, top, right and bottom of the scene in the picture, 0..1; title, labels and colour scale surround it.
FRAME = (0.09, 0.2, 0.85, 0.93)

#: Colours of leaves above the chosen depth, of the voxel grid, and of the boxes of chunks.
GREY, VOXELS, BOXES = "#5b6673", "#6ea8fe", "#dfe7ef"


@dataclass(frozen=True)
class DescribedPicture:
    """The bytes of a PNG, and a description of what it shows."""

    png: bytes
    description: str


@np.errstate(over="ignore", invalid="ignore")  # for numbers out of range in the file
def plot(
    scene: Scene, *, by: str = "level", depth: int | None = None, size: tuple[int, int] = (1600, 1000)
) -> DescribedPicture:
    """Draw the valid splats of a scene. All depths of a tree have the same viewpoint.

    Args:
        scene: may have a broken tree.
        by: one of `PLOT_BY`; without a tree, "level" means "size".
        depth: edges from the root to the nodes to draw; None for all leaves, or all splats.

    Raises:
        SparklodError: pyvista is not installed or cannot draw here, or there is no splat to draw.
    """
    if by not in PLOT_BY:
        raise ValueError(f"by is {by}, not one of {', '.join(PLOT_BY)}")
    splats = scene.splats.with_max_sh(0)
    drawable = is_drawable(splats)
    if not drawable.any():
        raise SparklodError("there is nothing to draw: no splat is valid and has a size")
    chosen, others, depths, title = _subject(scene, depth, drawable)
    index, others = (of[evenly(len(of), MOST_POINTS)] for of in (chosen, others))
    by = "size" if by == "level" and depths is None else by
    coloring, rgb = color_by(by, splats, index, depths)
    shown = splats.take(index)
    low, high = bounds(splats.take(drawable))
    up = np.array(AXES[scene.up or ASSUMED])
    right = np.array([0.0, 1.0, 0.0] if up[0] else [1.0, 0.0, 0.0])
    direction = np.array(DIRECTION) @ np.stack([right, up, np.cross(right, up)])
    eye = viewpoint(box_lines(low[None], high[None]), direction, up, aspect=size[0] / size[1], frame=FRAME)
    with PyvistaStage(low, high, size, BACKGROUND) as stage:
        drawn = stage.splats(shown, rgb, eye)
        if len(index) < len(chosen):
            drawn += f", an even sample of {len(index):,}"
        if len(others):
            stage.dots(splats.center[others], GREY)
            drawn += f"; grey: {len(others):,} leaves of smaller depth"
        voxels = _voxels(stage, shown, low, high, eye.position)
        boxes = _boxes(stage, scene, index, drawable, by) if scene.tree is not None or by == "chunk" else ""
        pixels = stage.photograph(eye)
    lines = [line for line in (drawn, voxels, boxes) if line]
    png = write_png(pixels, title, lines, coloring, eye, low, high)
    return DescribedPicture(png, "; ".join([title, f"coloured by {coloring.title}", *lines]))


def _subject(
    scene: Scene, depth: int | None, drawable: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int32] | None, str]:
    """Choose the splats to draw.

    Returns:
        Indices of the splats in colour, and of leaves above the chosen depth; (N,) depths, -1 for nodes unreachable
        from the root, None without a tree; a title.
    """
    others = np.empty(0, np.int64)
    if scene.tree is None:
        if depth is not None:
            raise SparklodError("it has no depths to draw: it is not a Level-of-Detail tree")
        index = np.flatnonzero(drawable)
        return index, others, None, count_of(len(index), "splat")
    depths = find_depths(scene.tree.child_count, scene.tree.child_start, spark_size(scene.splats))[0]
    leaf = scene.tree.is_leaf & drawable & (depths >= 0)
    if depth is None:
        index = np.flatnonzero(leaf)
        title = f"{count_of(len(index), 'leaf', 'leaves')} of a tree of depth {depths.max()}"
    else:
        index, others = np.flatnonzero(drawable & (depths == depth)), np.flatnonzero(leaf & (depths < depth))
        title = f"Depth {depth} of {depths.max()}: {count_of(len(index), 'node')}"
    if not len(index):
        what = "leaf" if depth is None else f"node of depth {depth}"
        raise SparklodError(f"there is no {what} to draw: the tree has depths 0 to {depths.max()}")
    return index, others, depths, title


def _voxels(stage: PyvistaStage, splats: Splats, low: Points, high: Points, eye: Points) -> str:
    """Draw the voxel grid in which Quick-LoD would merge splats of this size; return a description.

    A file stores neither the base of its grids nor the level of a node, so the grid is that of the median size with the
    default base.
    """
    level = level_of_step(2 * float(np.median(splats.scale.max(axis=1))))
    step = DEFAULT_BASE**level
    said = f"of {step:.3g} ({DEFAULT_BASE:g}^{level}, from the median size)"
    inside = ((splats.center >= low) & (splats.center <= high)).all(axis=1)
    occupied = cells(splats.center[inside], step)
    if len(occupied) <= MOST_CELLS:
        stage.lines(box_lines(occupied, occupied + step), VOXELS, 0.4)
        return f"blue: the {count_of(len(occupied), 'voxel')} {said} that hold them"
    every = max(1, round(nice_step(float((high - low).max()) / (MOST_LINES * step))))
    stage.lines(wall_lines(low, high, np.where(eye > (low + high) / 2, low, high), every * step), VOXELS, 0.35)
    line = f", every {every}{'nd' if every == 2 else 'th'} line" if every > 1 else ""
    return f"blue: on the walls, the grid of voxels {said}{line}"


def _boxes(stage: PyvistaStage, scene: Scene, index: NDArray[np.int64], drawable: NDArray[np.bool_], by: str) -> str:
    """Draw boxes around the chunks of some nodes; return a description."""
    count = -(-len(drawable) // CHUNK_NODES)
    chunks = np.unique(index // CHUNK_NODES)
    colors = ramp(VIRIDIS, count)
    for chunk in chunks[:MOST_CHUNKS]:
        rows = slice(chunk * CHUNK_NODES, (chunk + 1) * CHUNK_NODES)
        center: FloatArray = scene.splats.center[rows][drawable[rows]]
        color, opacity = (f"#{bytes(colors[chunk]).hex()}", 0.8) if by == "chunk" else (BOXES, 0.4)
        stage.lines(box_lines(center.min(axis=0)[None], center.max(axis=0)[None]), color, opacity)
    drawn = f", the first {MOST_CHUNKS} drawn" if len(chunks) > MOST_CHUNKS else ""
    what = "splats" if scene.tree is None else "nodes"
    return f"boxes: the {len(chunks)} of {count} chunks of {CHUNK_NODES:,} {what} that hold these{drawn}"


#: Most cameras whose frusta are drawn, and most points of the line of the path.
MOST_FRUSTA, MOST_STEPS = 24, 5_000

#: Lengths of a frustum, and of that of the chosen frame, as a share of the extent of the picture's content.
LENGTH, CHOSEN_LENGTH = 0.03, 0.075

#: Colours of the path, and of the chosen frame.
PATH, CHOSEN = "#ffffff", "#ff5c8a"

#: Opacity of lines hidden by splats.
BEHIND = 0.45

#: `FRAME` of the picture of a path, whose title is shorter.
PATH_FRAME = (0.09, 0.17, 0.85, 0.93)


@dataclass(frozen=True)
class PathScene:
    """Content of the picture of a camera path.

    Attributes:
        splats: N splats of the cut of one frame.
        depth: (N,) edges from the root to each node of the cut, or the detail level of each splat.
        frame: index of the camera to mark, to which the cut belongs; None for no mark.
        title: name of `depth`, for display.
    """

    cameras: Sequence[Camera]
    splats: Splats
    depth: NDArray[Any]
    frame: int | None = None
    title: str = "tree depth"


@np.errstate(over="ignore", invalid="ignore")  # for numbers out of range in the file
def picture_of_path(scene: PathScene, *, size: tuple[int, int] = (1600, 1000)) -> bytes:
    """Draw a path, its frusta, and the finite splats of a cut; return the PNG.

    `SparklodError` if pyvista is not installed or cannot draw here, or no splat is finite.
    """
    cameras, splats, depth, frame = scene.cameras, scene.splats, scene.depth, scene.frame
    index = np.flatnonzero(is_drawable(splats))
    if not len(index):
        raise SparklodError("there is nothing to draw: no splat of the cut is finite and has a size")
    splats = splats.with_max_sh(0)
    chosen = index[evenly(len(index), MOST_POINTS)]
    coloring = depth_scale(scene.title, depth[chosen])
    low, high = bounds(splats.take(index))
    way = np.array([camera.position for camera in cameras])
    low, high = np.minimum(low, way.min(axis=0)), np.maximum(high, way.max(axis=0))
    eye = _above(cameras, low, high, size)
    parts = _path_lines(cameras, way, frame, float((high - low).max()))
    with PyvistaStage(low, high, size, BACKGROUND) as stage:
        drawn = stage.splats(splats.take(chosen), coloring.rgb(depth[chosen]), eye)
        for ends, color in parts:
            stage.lines(ends, color, 1.0, width=1.5)
        pixels = stage.photograph(eye)
    with PyvistaStage(low, high, size, BACKGROUND) as stage:
        for ends, color in parts:
            stage.lines(ends, color, 1.0, width=1.5)
        pixels = _seen_through(pixels, stage.photograph(eye))
    if len(chosen) < len(splats):
        drawn += f", an even sample of {len(chosen):,}"
    title = f"Cut of {count_of(len(splats), 'splat')}"
    said = [f"{drawn}; white: the path and the frusta of {min(len(cameras), MOST_FRUSTA)} of {len(cameras):,} frames"]
    if frame is not None:
        title += f" of frame {frame} at {cameras[frame].time:.3f} s"
        said.append("pink: its frustum")
    return write_png(pixels, title, ["; ".join(said)], coloring, eye, low, high)


def _above(cameras: Sequence[Camera], low: Points, high: Points, size: tuple[int, int]) -> Viewpoint:
    """Return a viewpoint above a corner of a box, with the mean up axis of the cameras pointing up."""
    mean = np.sum([camera.camera_to_world[:3, 1] for camera in cameras], axis=0)
    axis = int(np.abs(mean).argmax())
    up = np.zeros(3)
    up[axis] = -1.0 if mean[axis] < 0 else 1.0
    direction = np.insert([-0.62, -1.0], axis, -0.62 * up[axis])
    return viewpoint(box_lines(low[None], high[None]), direction, up, aspect=size[0] / size[1], frame=PATH_FRAME)


def _path_lines(cameras: Sequence[Camera], way: Points, frame: int | None, extent: float) -> list[tuple[Points, str]]:
    steps = np.unique([*evenly(len(way), MOST_STEPS), len(way) - 1])
    path = np.repeat(way[steps], 2, axis=0)[1:-1]
    frusta = [frustum_lines(cameras[at], LENGTH * extent) for at in evenly(len(cameras), MOST_FRUSTA)]
    parts = [(np.concatenate([path, *frusta]), PATH)]
    if frame is not None:
        parts.append((frustum_lines(cameras[frame], CHOSEN_LENGTH * extent), CHOSEN))
    return parts


def frustum_lines(camera: Camera, length: float) -> Points:
    """Return the (20, 3) ends of the lines of a frustum: four edges, the far rectangle and a roof on its upper side.

    `length` is the distance of the far rectangle along the optical axis, world units.
    """
    (fx, fy), (cx, cy) = camera.focal, camera.principal
    left, right = -cx / fx, (camera.width - cx) / fx
    top, bottom = cy / fy, (cy - camera.height) / fy
    corners = [(left, top, -1), (right, top, -1), (right, bottom, -1), (left, bottom, -1)]
    ridge = ((left + right) / 2, top + 0.35 * (top - bottom), -1)
    local = length * np.array([(0, 0, 0), *corners, ridge], np.float64)
    points = local @ camera.camera_to_world[:3, :3].T + camera.position
    pairs = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1), (1, 5), (5, 2)]
    return points[np.array(pairs)].reshape(-1, 3)


def _seen_through(pixels: NDArray[np.uint8], lines: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Blend a picture with one of the same lines on an empty background, so that hidden lines show faintly."""
    ground = np.array([int(BACKGROUND[at : at + 2], 16) for at in (1, 3, 5)], np.float32)
    covered = np.abs(lines - ground).max(axis=2, keepdims=True) / (255 - ground.min())
    share = BEHIND * np.clip(covered, 0, 1)
    mixed: NDArray[np.uint8] = np.rint((1 - share) * pixels + share * lines).astype(np.uint8)
    return mixed
