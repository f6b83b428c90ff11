"""A picture of a camera path in its scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..images.pixels import BACKGROUND
from ..model.splats import Splats
from ..render.color_scales import range_of, whole_numbers
from ..system.errors import SparklodError
from ..system.units import count_of
from .pyvista_scene import Points, PyvistaStage, Viewpoint, bounds, box_lines, evenly, is_drawable, viewpoint, write_png

#: Most splats that are drawn; of more, an even sample.
MOST_POINTS = 600_000

#: Most cameras whose frusta are drawn, and most cameras that the line of the path goes through.
MOST_FRUSTA, MOST_STEPS = 24, 5_000

#: Length of a frustum as a share of the extent of what is shown, and that of the frame whose cut is drawn.
LENGTH, CHOSEN_LENGTH = 0.03, 0.075

PATH, CHOSEN = "#ffffff", "#ff5c8a"

#: Opacity of lines where splats hide them.
BEHIND = 0.45

#: Left, top, right and bottom of the scene in the picture, 0..1; title, labels and colour scale are around it.
FRAME = (0.09, 0.17, 0.85, 0.93)


@dataclass(frozen=True)
class PathScene:
    """Content of the picture of a camera path.

    Attributes:
        splats: N splats of the cut of one frame.
        depth: (N,) edges from the root to each node of the cut, or the detail level of each splat.
        frame: index of the camera whose cut it is; that camera is marked. None for none.
        title: which of both the depths are, for display.
    """

    cameras: Sequence[Camera]
    splats: Splats
    depth: NDArray[Any]
    frame: int | None = None
    title: str = "tree depth"


@np.errstate(over="ignore", invalid="ignore")  # of numbers that are out of range in the file
def picture_of_path(scene: PathScene, *, size: tuple[int, int] = (1600, 1000)) -> bytes:
    """Return the PNG of a path, its frusta and a cut, whose splats are left out where they are not finite.

    Raises:
        SparklodError: pyvista is not installed or cannot draw here, or there is nothing to draw.
    """
    cameras, splats, depth, frame = scene.cameras, scene.splats, scene.depth, scene.frame
    index = np.flatnonzero(is_drawable(splats))
    if not len(index):
        raise SparklodError("there is nothing to draw: no splat of the cut is finite and has a size")
    drawable = splats.with_max_sh(0).take(index)
    chosen = index[evenly(len(index), MOST_POINTS)]
    shown = splats.with_max_sh(0).take(chosen)
    coloring = whole_numbers(scene.title, depth[chosen], *range_of(depth[chosen]))
    low, high = bounds(drawable)
    way = np.array([camera.position for camera in cameras])
    low, high = np.minimum(low, way.min(axis=0)), np.maximum(high, way.max(axis=0))
    eye = _above(cameras, low, high, size)
    parts = _path_lines(cameras, way, frame, float((high - low).max()))
    with PyvistaStage(low, high, size, BACKGROUND) as stage:
        drawn = stage.splats(shown, coloring.rgb, eye)
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
    """Return a viewpoint above a corner of the box, with the mean up axis of the cameras upwards."""
    mean = np.sum([camera.camera_to_world[:3, 1] for camera in cameras], axis=0)
    axis = int(np.abs(mean).argmax())
    up = np.zeros(3)
    up[axis] = -1.0 if mean[axis] < 0 else 1.0
    direction = np.insert([-0.62, -1.0], axis, -0.62 * up[axis])
    return viewpoint(box_lines(low[None], high[None]), direction, up, aspect=size[0] / size[1], frame=FRAME)


def _path_lines(cameras: Sequence[Camera], way: Points, frame: int | None, extent: float) -> list[tuple[Points, str]]:
    """Return the ends of the lines of the path and of its frusta, and their colours."""
    steps = np.unique([*evenly(len(way), MOST_STEPS), len(way) - 1])
    path = np.repeat(way[steps], 2, axis=0)[1:-1]
    frusta = [frustum_lines(cameras[at], LENGTH * extent) for at in evenly(len(cameras), MOST_FRUSTA)]
    parts = [(np.concatenate([path, *frusta]), PATH)]
    if frame is not None:
        parts.append((frustum_lines(cameras[frame], CHOSEN_LENGTH * extent), CHOSEN))
    return parts


def frustum_lines(camera: Camera, length: float) -> Points:
    """(20, 3) ends of the lines of a frustum, world units: four edges, the far rectangle and a roof on its upper side.

    Args:
        length: distance of the far rectangle along the optical axis, world units.
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
    """(H, W, 3) a picture in which hidden lines show faintly, mixed in from the same lines on an empty ground."""
    ground = np.array([int(BACKGROUND[at : at + 2], 16) for at in (1, 3, 5)], np.float32)
    covered = np.abs(lines - ground).max(axis=2, keepdims=True) / (255 - ground.min())
    share = BEHIND * np.clip(covered, 0, 1)
    mixed: NDArray[np.uint8] = np.rint((1 - share) * pixels + share * lines).astype(np.uint8)
    return mixed
