"""Cameras: those of a file, and an orbit around a scene."""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import Any

from ..cameras.formats.table import FORMATS, Axes
from ..cameras.frame import MAX_FRAMES, Settings, direction_of
from ..cameras.path import CameraPath
from ..cameras.sources import Orbit, read_path, similarity
from ..system.defaults import ELEVATION
from ..system.errors import CameraPathError
from .views import Viewed, scenes_of

Point = tuple[float, float, float]


def read_cameras(
    path: Path | str,
    *,
    format: str = "auto",
    axes: str | None = None,
    world_transform: Any = None,
    size: tuple[int, int] | None = None,
    fov_y: float | None = None,
    fps: float | None = None,
    every: int = 1,
    up: Point | None = None,
) -> CameraPath:
    """Return the cameras of a file, or of a folder that COLMAP wrote; docs/cameras.md has the formats.

    Args:
        path: of the file or folder.
        format: its name, as `--camera-format` has it; "auto" recognises it by the content.
        axes: of its matrices, as `--camera-axes` has them, where the format does not say.
        world_transform: (4, 4) or 16 numbers row by row, from the file's world to that of the splats: a rotation, a
            uniform scale and a translation.
        size: width and height of the images, pixels; those of the file unless given.
        fov_y: vertical field of view, degrees; that of the file unless given.
        fps: frames a second; times are then counted anew.
        every: keep only every so many frames.
        up: x, y, z that points up, for cameras of which the file has only eye and target.

    Raises:
        CameraPathError: it cannot be read, is of no known format, or has a camera that makes no sense.
    """
    try:
        chosen = None if axes is None else Axes(axes)
    except ValueError:
        raise CameraPathError(
            f"there are no axes {axes!r}; give one of {', '.join(each.value for each in Axes)}"
        ) from None
    names = [each.name for each in FORMATS]
    if format != "auto" and format not in names:
        raise CameraPathError(f"there is no format {format!r}; give auto or one of {', '.join(names)}")
    if every < 1:
        raise CameraPathError(f"every is {every}; give 1 or more")
    settings = Settings(
        axes=chosen,
        world=None if world_transform is None else _matrix(world_transform),
        size=size,
        fov_y=None if fov_y is None else math.radians(fov_y),
        fps=fps,
        every=every,
        up=up,
    )
    return read_path(Path(path), None if format == "auto" else format, settings)


def _matrix(numbers: Any) -> Any:
    import numpy as np

    flat = np.asarray(numbers, np.float64).ravel()
    return similarity(",".join(map(repr, flat.tolist())))


def orbit(
    viewed: Viewed,
    *,
    count: int = 8,
    center: Point | None = None,
    distance: float | None = None,
    elevation: float = ELEVATION,
    up: Point | None = None,
    fov_y: float = 60.0,
    size: tuple[int, int] = (1280, 720),
) -> CameraPath:
    """Return cameras once around scenes, as `--orbit` makes them.

    Args:
        viewed: a scene or tree, or instances.
        count: of cameras.
        center: x, y, z that they look at; the middle of the scenes unless given.
        distance: from there, world units; as near as all scenes are in every picture unless given.
        elevation: above the center, degrees.
        up: x, y, z that points up; noted in the scenes unless given, or -y, as training leaves scenes.
        fov_y: vertical field of view, degrees.
        size: width and height of the images, pixels.

    Raises:
        CameraPathError: a number is out of its range.
        InvalidSplatsError: the scenes have no finite splats.
    """
    if not 1 <= count <= MAX_FRAMES:
        raise CameraPathError(f"count is {count}; give 1 to {MAX_FRAMES:,} cameras")
    scenes = functools.cache(lambda: scenes_of(viewed, None))
    settings = Settings(size=size, fov_y=math.radians(fov_y), up=up, up_of_scene=lambda: direction_of(scenes().up))
    source = Orbit(count, center, distance, elevation)
    return source.cameras(settings, lambda: scenes().balls())
