"""Color scales of pictures: numbers of splats, or of pixels, as colours."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..model.gaussian import lod_opacity, moved, spark_size
from ..model.splats import FloatArray
from ..system.errors import SparklodError
from ..system.progress import Progress, silent
from ..viewers.loaded_scene import TREE, Index, LoadedScene
from ..viewers.scenes import CutFinder, Part
from .color_scales import CLIPPED, MAGMA, PLASMA, Coloring, linear, opacity_scale, size_scale, whole_numbers
from .settings import RasterSettings

#: Sample sizes, splats and cameras, to find the ends of a scale.
SAMPLE, CAMERAS = 1 << 18, 64

#: The most cuts that are found for it, which takes longer.
CUTS = 16

#: Marks nearer to an end of a scale than this would touch its own.
APART = 0.05


def values_of(by: str, part: Part) -> FloatArray:
    """Return (M,) the numbers that some splats are coloured by: "level", "lod-opacity", "size" or "chunk".

    A level is a depth in a tree, or a detail level. Sizes are in world units; splats of files without either are of
    level 0.
    """
    if by in ("level", "chunk"):
        return numbers_of(by, part.scene, part.index).astype(np.float64)
    if by == "lod-opacity":
        return lod_opacity(np.maximum(part.splats.opacity, 0))
    return spark_size(part.splats) * np.float32(np.cbrt(np.linalg.det(part.object_to_world[:3, :3])))


def scale_of_splats(by: str, source: CutFinder, cameras: Sequence[Camera], progress: Progress = silent) -> Coloring:
    """Return the scale of a quantity of `values_of`, for all splats that cameras may see; of whole numbers, do see.

    `SparklodError` by level, where no file has any.
    """
    candidates = source.candidates().parts
    if by == "level" and not any(part.scene.kind for part in candidates):
        raise SparklodError("there are no levels to colour by: no file is a Level-of-Detail tree, or Streamed SOG")
    if by == "level":
        detail = not any(part.scene.kind == TREE for part in candidates)
        return _whole(by, "detail level" if detail else "tree depth", source, cameras, progress)
    if by == "chunk":
        return _whole(by, by, source, cameras, progress)
    every = max(1, sum(len(part.index) for part in candidates) // SAMPLE)
    values = np.concatenate([values_of(by, part)[::every] for part in candidates])
    return (
        opacity_scale("LoD opacity", values, APART) if by == "lod-opacity" else size_scale(values, APART, sampled=True)
    )


def scale_of_depth(source: CutFinder, cameras: Sequence[Camera], settings: RasterSettings) -> Coloring:
    """Return the scale from the nearest splats to the farthest that cameras see, but for a few."""
    parts = source.candidates().parts
    every = max(1, sum(len(part.index) for part in parts) // SAMPLE)
    centers = np.concatenate([moved(part.splats.center[::every], part.object_to_world) for part in parts])
    seen = [np.empty(0)]
    for camera in cameras[:: max(1, len(cameras) // CAMERAS)]:
        local = (centers - camera.position) @ camera.camera_to_world[:3, :3]
        depth = -local[:, 2]
        with np.errstate(all="ignore"):
            inside = (depth > settings.near) & (depth < settings.far)
            inside &= abs(camera.focal[0] * local[:, 0] / depth) <= camera.width / 2
            inside &= abs(camera.focal[1] * local[:, 1] / depth) <= camera.height / 2
        seen.append(depth[inside])
    depths = np.concatenate(seen)
    low, high = np.percentile(depths, [CLIPPED, 100 - CLIPPED]) if len(depths) else (settings.near, settings.near + 1)
    # The depth of a nearly flat scene is not stretched over all colours.
    high = max(high, low + 1e-3 * abs(low))
    return linear("depth", tuple(reversed(PLASMA)), float(low), float(high), APART)


def scale_of_overdraw(counts: Sequence[FloatArray]) -> Coloring:
    """Return the scale from none to the most that all but a few pixels of some pictures have."""
    most = max(float(np.percentile(count, 99.9)) for count in counts)
    return linear("overdraw", MAGMA, 0.0, max(1.0, float(math.ceil(most))), APART)


def _whole(by: str, title: str, source: CutFinder, cameras: Sequence[Camera], progress: Progress) -> Coloring:
    """Return the scale from the least to the most that some cameras see; others may see less, or more."""
    every = -(-len(cameras) // CUTS)
    some = cameras[::every]
    ends = []
    for done, camera in enumerate(some, 1):
        seen = (numbers_of(by, part.scene, part.index) for part in source.cut(camera).parts)
        ends += [(int(numbers.min()), int(numbers.max())) for numbers in seen if len(numbers)]
        progress("colours", done, len(some), "cut")
    ends = ends or [(0, 0)]
    low, high = min(low for low, _ in ends), max(high for _, high in ends)
    beyond = int(every > 1)
    return whole_numbers(title, low, high, least=low - beyond, most=high + beyond)


def numbers_of(by: str, scene: LoadedScene, index: Index) -> NDArray[np.int64]:
    """Return (M,) the "level" or the "chunk" of some splats of a file; without levels, all are of level 0."""
    return scene.chunk_of(index) if by == "chunk" else scene.depth[index].astype(np.int64)
