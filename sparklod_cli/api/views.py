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
from ..system.threads import on_threads, thread_count
from ..tables.columns import Table
from ..viewers.loaded_scene import STREAMED_SOG, TILES, UNNAMED
from ..viewers.scenes import Cut, CutFinder, Scenes, read_scenes
from ..viewers.viewer_settings import BLEND, PLAYCANVAS_BUDGET, LodSettings
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

    from ..cameras.sources import CameraPath
    from ..render.render_settings import RenderSettings
    from ..simulation.results import Summary
    from ..viewers.scenes import Scenes
    from ..viewers.viewer_settings import LodSettings, StreamingSettings

#: A scene, a tree or a scene at several detail levels, or several of them, each with where it stands.
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
    """Return the nodes that a viewer draws for a camera, or the splats of the detail levels that it chooses.

    Args:
        viewed: a tree, a scene at several detail levels, or instances. Of other scenes all splats are drawn.
        camera: that sees them.
        budget: the most splats that are drawn; that of `settings` unless given.
        settings: foveation, pixel-scale limit and so on; Spark 2's on a desktop unless given, and for detail levels
            those of PlayCanvas.
        continuous: a cut that fades nodes into their children; the width of that, or True for 1.25.
        precision: of the centres and sizes of a tree: "float32", or their half floats, "float16"; or what Spark has of
            it, for the same cut to the last node: "ext" with `extSplats`, else "packed", or "packed-pages" where Spark
            streams a RAD file. Of a tree that was not read from a file, Spark's are taken to be its own numbers.

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
    """Return the picture of a camera: of a cut, or of scenes and trees in full detail.

    Splats of scenes without trees that cannot be drawn are left out.

    Args:
        viewed: a cut, or scenes and trees.
        camera: that sees it.
        settings: how it is drawn; as Spark 2 does unless given.
        backend: "numba" (the reference), "osmesa" or "open3d"; that of `settings` unless given.
        threads: to draw on; None for all processors. The picture does not depend on it.

    Returns:
        (H, W, 4) float32: red, green and blue, multiplied by alpha, and alpha.

    Raises:
        BackendError: the backend cannot draw here.
        InvalidSplatsError: a scene has nothing to draw.
        ValueError: there is no such backend, or it does not draw on the device.
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
    """Return what a viewer draws and fetches along a camera path: a row for each frame.

    Args:
        viewed: a tree, a scene at several detail levels, or instances of trees or of such scenes.
        cameras: the path.
        budget: the most splats that are drawn; that of `settings` unless given.
        settings: foveation, pixel-scale limit and so on; Spark 2's on a desktop unless given.
        streaming: network and chunk cache; everything is there unless given.
        by_instance: rows of single instances, too.
        precision: see `cut`.
        threads: to find cuts on; None for all processors. Only `traverse_ms` depends on it.

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
    """Return peak signal-to-noise ratio of two pictures, in dB; 100 where they are the same.

    Args:
        a, b: floats: (H, W, 3) 0..1, or (H, W, 4) with alpha multiplied in, as `render` draws them.
        background: gray, 0..1, behind pictures with alpha.

    Raises:
        ValueError: they have different shapes, or are no pictures: whole numbers, NaN, or no pixels.
    """
    return metrics.psnr(*_opaque(a, b, background))


def ssim(a: Image, b: Image, *, background: float = 0.0) -> float:
    """Return structural similarity of two pictures (Wang et al. 2004), 1 where they are the same; see `psnr`.

    Raises:
        ValueError: they have different shapes, or are no pictures.
    """
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
    """One cut for all cameras."""

    def __init__(self, whole: Cut) -> None:
        self.whole = whole

    def cut(self, camera: Camera) -> Cut:
        return self.whole

    def candidates(self) -> Cut:
        return self.whole


def scenes_of(viewed: Viewed, threads: int | None, precision: str = PRECISIONS[0]) -> Scenes:
    """Return the scenes, prepared for views; a single scene keeps them for the next call."""
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
    """Return scenes as `scenes_of`; raise a `FormatError` where one has neither a tree nor detail levels."""
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
    """The rows of a traversal: one for each frame and, if requested, one for each of its instances."""

    def summary(self) -> Summary:
        """Return statistics of the frames, totals, and notable frames."""
        from ..simulation.results import summarize

        return summarize(self.rows)


class Picture:
    """A picture that Jupyter shows.

    Attributes:
        png: the bytes of the file.
    """

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
        from ..system.output import write_file

        path = file_path(path)
        if path.suffix.lower() != ".png":
            raise ValueError(f"{path}: a picture is saved as .png, which the name does not end in")

        write_file(path, [self.png], overwrite=overwrite)


def show(image: NDArray[np.float32], *, background: tuple[float, float, float] | None = (0.0, 0.0, 0.0)) -> Picture:
    """Return a picture of floats as one that Jupyter shows.

    Args:
        image: (H, W, 4) float32 with alpha multiplied in, as `render` draws it.
        background: red, green and blue, 0..1, behind it; None keeps alpha.

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
        every: n, to keep every n-th frame.
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
    world = None
    if world_transform is not None:
        numbers = np.asarray(world_transform, np.float64).ravel().tolist()
        world = similarity(",".join(map(repr, numbers)))
    settings = Settings(
        axes=chosen,
        world=world,
        size=size,
        fov_y=None if fov_y is None else math.radians(fov_y),
        fps=fps,
        every=every,
        up=up,
    )
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
    settings = Settings(size=size, fov_y=math.radians(fov_y), up=up, up_of_scene=lambda: scenes().up)
    return orbit_cameras(count, center, distance, elevation, settings, lambda: scenes().balls())
