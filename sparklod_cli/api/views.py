"""Views of trees and scenes: cuts, pictures, traversals, camera paths."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..cameras import DEFAULT_SIZE, ELEVATION
from ..cameras.camera import MAX_FRAMES, Camera, Settings
from ..cameras.camera_files import read_path, similarity
from ..cameras.camera_formats import FORMATS, Axes
from ..cameras.sources import CameraPath
from ..cameras.sources import orbit as orbit_cameras
from ..codecs.formats import PRECISIONS
from ..images import metrics
from ..model.instances import DetailScene, Instance, names_of
from ..model.scene import Scene
from ..render.rasterizer import Image
from ..render.render_settings import RenderSettings
from ..render.renderer import Renderer
from ..system.errors import CameraPathError, FormatError, memory_errors_translated
from ..system.output import write_file
from ..system.threads import on_threads, thread_count
from ..tables.columns import Table
from ..viewers.loaded_scene import STREAMED_SOG, TILES, UNNAMED
from ..viewers.scenes import Cut, CutFinder, Scenes, read_scenes
from ..viewers.viewer_settings import BLEND, PLAYCANVAS_BUDGET, LodSettings, StreamingSettings
from .arguments import (
    BudgetLike,
    ProgressLike,
    budget_like,
    camera_like,
    file_path,
    path_like,
    progress_callback,
    viewed_like,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..simulation.results import Summary

#: A scene, a tree or a scene at several detail levels, or instances of such scenes.
Viewed = Scene | DetailScene | Instance | Iterable["Scene | DetailScene | Instance"]

#: Attribute in which a scene caches its prepared form.
_PREPARED = "_prepared_scenes"


def cut(
    viewed: Viewed,
    camera: Camera,
    *,
    budget: BudgetLike | None = None,
    settings: LodSettings | None = None,
    continuous: bool | float = False,
    precision: str = PRECISIONS[0],
    threads: int | None = None,
) -> Cut:
    """Find the nodes that a viewer draws for a camera, or the splats of the detail levels that it chooses.

    Args:
        viewed: a tree, a scene at several detail levels, or instances. Other scenes are drawn with all splats.
        budget: largest number of splats; None for that of `settings`.
        settings: foveation, pixel-scale limit and so on; by default those of Spark 2 on a desktop, or of PlayCanvas for
            detail levels.
        continuous: find a cut that fades nodes into their children: the width of the transition, or True for 1.25.
        precision: of centres and sizes of nodes: "float32", or "float16" for half floats; or as they are in Spark, for
            exactly its cut: "ext" with `extSplats`, else "packed", or "packed-pages" if Spark streams a RAD file. A
            tree that was not read from a file has no such rounding.

    Raises:
        ValueError: the budget is out of its range, or less than one splat for each instance; `continuous` is not
            above 1.
    """
    camera_like(camera)
    with on_threads(threads) as count, memory_errors_translated():
        scenes = scenes_of(viewed, count, precision)
        return CutFinder(scenes, _lod(scenes, budget, settings, continuous)).cut(camera)


def render(
    viewed: Viewed | Cut,
    camera: Camera,
    *,
    settings: RenderSettings | None = None,
    backend: str | None = None,
    threads: int | None = None,
) -> Image:
    """Draw a cut, or scenes and trees in full detail.

    Invalid splats of scenes without trees are left out. The picture does not depend on the number of threads.

    Args:
        settings: by default as Spark 2 draws.
        backend: "numba" (the reference), "osmesa" or "open3d"; None for that of `settings`.

    Returns:
        (H, W, 4) float32: red, green and blue, multiplied by alpha, and alpha.

    Raises:
        BackendError: the backend cannot draw here.
        InvalidSplatsError: a scene has nothing to draw.
        ValueError: there is no such backend, or it does not support the device.
    """
    camera_like(camera)
    settings = settings or RenderSettings()
    if backend is not None:
        settings = replace(settings, backend=backend)
    with on_threads(threads) as count, memory_errors_translated():
        source = FixedCut(viewed) if isinstance(viewed, Cut) else FixedCut(scenes_of(viewed, count).full())
        return Renderer(source, settings, [camera]).draw(camera).image


def traverse(
    viewed: Viewed,
    cameras: CameraPath | Iterable[Camera],
    *,
    budget: BudgetLike | None = None,
    settings: LodSettings | None = None,
    streaming: StreamingSettings | None = None,
    by_instance: bool = False,
    precision: str = PRECISIONS[0],
    threads: int | None = None,
    progress: ProgressLike = None,
) -> Frames:
    """Simulate the drawing and fetching of a viewer along a camera path: a row for each frame.

    Only the column `traverse_ms` depends on the number of threads.

    Args:
        viewed: a tree, a scene at several detail levels, or instances of trees or of such scenes.
        budget: largest number of splats; None for that of `settings`.
        settings: foveation, pixel-scale limit and so on; by default those of Spark 2 on a desktop.
        streaming: network and chunk cache; None if every chunk is resident.
        by_instance: make rows of single instances, too.
        precision: see `cut`.

    Raises:
        FormatError: a scene has no tree.
        ValueError: the budget, or the cache, is too small for the roots.
    """
    from ..simulation.frames import Simulation
    from ..simulation.results import COLUMNS

    with on_threads(threads) as count, progress_callback(progress) as callback, memory_errors_translated():
        scenes = trees_of(viewed, count, precision)
        simulation = Simulation(scenes, _lod(scenes, budget, settings, False), streaming)
        frames = simulation.run(path_like(cameras), by_instance=by_instance, threads=count, progress=callback)
        return Frames([row for frame in frames for row in frame.rows], COLUMNS)


def psnr(a: Image, b: Image, *, background: float = 0.0) -> float:
    """Return the peak signal-to-noise ratio of two pictures, dB; 100 for equal pictures.

    Args:
        a, b: floats: (H, W, 3) 0..1, or (H, W, 4) premultiplied by alpha, as `render` draws them.
        background: gray, 0..1, behind pictures with alpha.

    Raises:
        ValueError: the shapes differ, or an array is no picture: it has integers, NaN, or no pixels.
    """
    return metrics.psnr(*_opaque(a, b, background))


def ssim(a: Image, b: Image, *, background: float = 0.0) -> float:
    """Return the structural similarity of two pictures (Wang et al. 2004), 1 for equal ones; arguments as of `psnr`."""
    return metrics.ssim(*_opaque(a, b, background))


def _opaque(a: Image, b: Image, background: float) -> list[Image]:
    a, b = np.asarray(a), np.asarray(b)
    if a.shape != b.shape or a.ndim != 3 or a.shape[2] not in (3, 4):
        raise ValueError(f"the pictures have the shapes {a.shape} and {b.shape}; give two of (H, W, 3) or (H, W, 4)")
    for each in (a, b):
        if not np.issubdtype(each.dtype, np.floating):
            raise ValueError(f"a picture holds {each.dtype}; give floats 0..1, such as bytes / 255")
        if not each.size or not np.isfinite(each).all():
            raise ValueError("a picture has no pixels" if not each.size else "a picture holds NaN or infinity")
    return [metrics.on_background(each, background) if each.shape[2] == 4 else each for each in (a, b)]


class FixedCut(CutFinder):
    """Finder that returns one cut for all cameras."""

    def __init__(self, whole: Cut) -> None:
        self.whole = whole

    def cut(self, camera: Camera) -> Cut:
        return self.whole

    def candidates(self) -> Cut:
        return self.whole


def scenes_of(viewed: Viewed, threads: int | None, precision: str = PRECISIONS[0]) -> Scenes:
    """Prepare scenes for drawing; a single scene caches the result for the next call."""
    if precision not in PRECISIONS:
        raise ValueError(f"there is no precision {precision!r}; give one of {', '.join(PRECISIONS)}")
    count = thread_count(threads)
    if isinstance(viewed, (Scene, DetailScene)):
        kept: dict[str, Scenes] = viewed.__dict__.setdefault(_PREPARED, {})
        if precision not in kept:
            kept[precision] = read_scenes([Instance(viewed, UNNAMED)], precision=precision, threads=count)
        return kept[precision]
    if not isinstance(viewed, Instance):
        viewed_like(viewed)
    every: list[Any] = [viewed] if isinstance(viewed, Instance) else list(viewed)
    instances = [each if isinstance(each, Instance) else Instance(each) for each in every]
    if not instances:
        raise ValueError("there are no scenes; give at least one scene or instance")
    unnamed = [each.file or Path(UNNAMED) for each in instances if not each.name]
    names = iter(names_of(unnamed, [each.name for each in instances if each.name]))
    named = [each if each.name else replace(each, name=next(names)) for each in instances]
    return read_scenes(named, precision=precision, threads=count)


def trees_of(viewed: Viewed, threads: int, precision: str) -> Scenes:
    """Prepare scenes as `scenes_of`; raise `FormatError` if one has neither a tree nor detail levels."""
    scenes = scenes_of(viewed, threads, precision)
    plain = next((loaded.name for loaded in scenes.loaded if loaded.kind is None), None)
    if plain is not None:
        raise FormatError(f"{plain}: it is not a Level-of-Detail tree; build_lod makes one of it")
    return scenes


def _lod(
    scenes: Scenes, budget: BudgetLike | None, settings: LodSettings | None, continuous: bool | float
) -> LodSettings:
    if settings is None:
        settings = LodSettings(PLAYCANVAS_BUDGET) if scenes.kind == STREAMED_SOG else LodSettings()
    if budget is not None:
        if scenes.kind == TILES:
            raise ValueError(
                f"{scenes.with_cuts[0].name} is 3D Tiles, which CesiumJS draws without a budget; leave it out"
            )
        settings = replace(settings, budget=budget_like(budget).of(scenes.leaves))
    if continuous:
        if continuous is not True and not continuous > 1:
            raise ValueError(f"continuous is {continuous}; give a ratio above 1, or True for {BLEND}")
        settings = replace(settings, continuous=BLEND if continuous is True else float(continuous))
    return settings


class Frames(Table):
    """Table of a traversal: a row for each frame and, if requested, one for each of its instances."""

    def summary(self) -> Summary:
        """Return statistics of the frames, totals, and notable frames."""
        from ..simulation.results import summarize

        return summarize(self.rows)


class Picture:
    """Picture that Jupyter shows; `png` is the bytes of the file."""

    def __init__(self, png: bytes) -> None:
        self.png = png

    def __repr__(self) -> str:
        return f"Picture({len(self.png):,} bytes of PNG)"

    def _repr_png_(self) -> bytes:
        return self.png

    def save(self, path: Path | str, *, overwrite: bool = False) -> None:
        """Write the PNG, whole or not at all.

        Raises:
            OutputError: the file exists, or cannot be written.
            ValueError: its name does not end in .png.
        """
        path = file_path(path)
        if path.suffix.lower() != ".png":
            raise ValueError(f"{path}: a picture is saved as .png, which the name does not end in")
        write_file(path, [self.png], overwrite=overwrite)


def show(image: NDArray[np.float32], *, background: tuple[float, float, float] | None = (0.0, 0.0, 0.0)) -> Picture:
    """Return a picture for Jupyter.

    Args:
        image: (H, W, 4) float32 premultiplied by alpha, as `render` draws it.
        background: red, green and blue, 0..1; None keeps alpha.

    Raises:
        ValueError: the image has another shape.
    """
    from ..images import pixels

    if getattr(image, "ndim", 0) != 3 or image.shape[2] != 4:
        raise ValueError(f"the image has the shape {getattr(image, 'shape', ())}; give (H, W, 4), as render draws it")
    return Picture(pixels.encode(pixels.eight_bits(pixels.over(image, background)), "png"))


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
    """Read the cameras of a file, or of a folder that COLMAP wrote; docs/cameras.md lists the formats.

    Args:
        format: as `--camera-format`; "auto" recognises it by the content.
        axes: of the matrices, as `--camera-axes`, if the format does not specify them.
        world_transform: (4, 4) or 16 numbers row by row, from the file's world to that of the splats: a rotation, a
            uniform scale and a translation.
        size: width and height of the images, pixels; None for those of the file.
        fov_y: vertical field of view, degrees; None for that of the file.
        fps: frames a second, which replace the times of the file.
        every: n, to keep every n-th frame.
        up: x, y, z that points up, for cameras of which the file has only eye and target.

    Raises:
        CameraPathError: the file cannot be read, is of no known format, or has an invalid camera.
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
    world = None
    if world_transform is not None:
        numbers = np.asarray(world_transform, np.float64).ravel().tolist()
        world = similarity(",".join(map(repr, numbers)))
    angle = None if fov_y is None else math.radians(fov_y)
    settings = Settings(axes=chosen, world=world, size=size, fov_y=angle, fps=fps, every=every, up=up)
    return read_path(Path(path), None if format == "auto" else format, settings)


def orbit(
    viewed: Viewed,
    *,
    count: int = 8,
    center: Point | None = None,
    distance: float | None = None,
    elevation: float = ELEVATION,
    up: Point | None = None,
    fov_y: float = 60.0,
    size: tuple[int, int] = DEFAULT_SIZE,
) -> CameraPath:
    """Return cameras once around scenes, as `--orbit` does.

    Args:
        count: number of cameras.
        center: x, y, z that all cameras look at; None for the middle of the scenes.
        distance: from the center, world units; None for the least at which every picture has all scenes.
        elevation: above the center, degrees.
        up: x, y, z that points up; None for the direction that the scenes note, or -y, as after training.
        fov_y: vertical field of view, degrees.
        size: width and height of the images, pixels.

    Raises:
        CameraPathError: a number is out of its range.
        InvalidSplatsError: the scenes have no finite splats.
    """
    if not 1 <= count <= MAX_FRAMES:
        raise CameraPathError(f"count is {count}; give 1 to {MAX_FRAMES:,} cameras")
    scenes = functools.cache(lambda: scenes_of(viewed, None))
    settings = Settings(size=size, fov_y=math.radians(fov_y), up=up, up_of_scene=lambda: scenes().up)
    return orbit_cameras(count, center, distance, elevation, settings, lambda: scenes().balls())
