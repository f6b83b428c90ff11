"""Sites of `sparklod view`: a page that shows splat files, served or written into a folder."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path

from ..cameras.camera import Settings
from ..cameras.camera_files import read_path
from ..model.scene import common_axis
from ..system.errors import NotSplatsError, SparklodError, memory_errors_translated
from ..system.progress import Progress, silent
from ..view.server import LOOPBACK as LOOPBACK
from ..view.server import Server as Server
from ..view.shown_files import FOV, Point, extent_of, shown_files, start_of
from ..view.site import Site as Site
from ..view.site import check_folder as check_folder
from ..view.site import export as export
from ..view.site import from_cdn, from_folder, site_of


def prepare(
    paths: Sequence[Path],
    *,
    served: bool,
    threads: int,
    look_at: tuple[Point, Point] | None = None,
    fov: float | None = None,
    up: Point | None = None,
    budget: int | None = None,
    camera_path: Path | None = None,
    spark_dir: Path | None = None,
    progress: Progress = silent,
) -> Site:
    """Make the site that shows splat files, at least one.

    Args:
        served: a `Server` will serve the site; otherwise `export` will write it.
        look_at: eye and target of the camera; None for one that sees the whole scene.
        fov: vertical field of view, degrees; None for 60.
        up: None for the direction that the files note, or -y.
        budget: splats; None for Spark's default on the device.
        camera_path: file of cameras that the page plays.
        spark_dir: folder whose node_modules has Spark, PlayCanvas or CesiumJS, and three.js; None for a CDN, which has
            no CesiumJS.

    Raises:
        SparklodError: a file or a library is missing or broken, the camera is invalid, or Spark does not read a file of
            a site to be written.
    """
    shown = shown_files(paths)
    for file in shown:
        if file.note is not None and not served:  # a served page shows the note
            raise NotSplatsError(f"{file.path.parent / file.note}")
    engine = shown[0].engine
    if budget is not None and engine == "cesium":
        raise SparklodError(f"{shown[0].path}: CesiumJS has no budget of splats; leave out --budget")
    libraries = from_cdn(engine) if spark_dir is None else from_folder(spark_dir, engine)
    # Files are read after the camera path, unless its cameras need the files' up axis.
    extents = functools.cache(lambda: [extent_of(file, threads=threads, progress=progress) for file in shown])
    cameras = Settings(up=up, up_of_scene=lambda: common_axis(extent.up for extent in extents()))
    path = None
    with memory_errors_translated():
        if camera_path is not None:
            path = read_path(camera_path, settings=cameras)
        start = start_of(extents(), look_at, cameras.up_axis, FOV if fov is None else fov)
    return site_of(shown, extents(), start, budget, path, libraries, cameras=cameras, served=served)
