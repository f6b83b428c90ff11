"""The job of `sparklod view`: splat files become a site, which is served or written into a folder."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..cameras.frame import Settings, direction_of
from ..cameras.sources import read_path
from ..model.transforms import common
from ..support.errors import memory_errors_translated
from ..support.progress import Progress, silent
from ..view.export import check_folder as check_folder
from ..view.export import export as export
from ..view.files import ShownFile, shown_files
from ..view.libraries import from_cdn, from_folder
from ..view.server import LOOPBACK as LOOPBACK
from ..view.server import Server as Server
from ..view.site import Look, Site, site_of
from ..view.start import FOV, Point, extent_of, start_of


@dataclass(frozen=True)
class ViewSettings:
    """Initial view of a page, and the sources of its camera path and scripts.

    Attributes:
        look_at: eye and target of the camera; None for one that sees the whole scene.
        fov: its vertical field of view, degrees; None for 60.
        up: direction that is up; None for what the files note, or -y.
        budget: splats; None for Spark's default on the device.
        camera_path: file of cameras that the page plays; None for none.
        spark_dir: folder whose node_modules has Spark, or PlayCanvas, and three.js; None for a CDN.
    """

    look_at: tuple[Point, Point] | None
    fov: float | None
    up: Point | None
    budget: int | None
    camera_path: Path | None
    spark_dir: Path | None


@dataclass(frozen=True)
class Prepared:
    """A site, ready to be served or written.

    Attributes:
        site: all of it.
        shown: its splat files.
        notes: what a person should know.
    """

    site: Site
    shown: Sequence[ShownFile]
    notes: Sequence[str]


def prepare(
    paths: Sequence[Path], settings: ViewSettings, *, served: bool, threads: int, progress: Progress = silent
) -> Prepared:
    """Return the site of some splat files.

    Args:
        paths: of the files, at least one.
        served: by a `Server`; otherwise it is written.

    Raises:
        SparklodError: a file or a library is missing or broken, or the camera makes no sense.
    """
    shown = shown_files(paths)
    engine = shown[0].engine
    libraries = from_cdn(engine) if settings.spark_dir is None else from_folder(settings.spark_dir, engine)
    # Files are read only after the camera path, unless its cameras need their up axis.
    extents = functools.cache(lambda: [extent_of(file, threads=threads, progress=progress) for file in shown])
    cameras = Settings(up=settings.up, up_of_scene=lambda: direction_of(common(extent.up for extent in extents())))
    path = None
    with memory_errors_translated():
        if settings.camera_path is not None:
            path = read_path(settings.camera_path, settings=cameras)
        up = cameras.up_axis
        start = start_of(extents(), settings.look_at, up, FOV if settings.fov is None else settings.fov)
    look = Look(start, up, settings.budget, path)
    site = site_of(shown, extents(), look, libraries, cameras=cameras, served=served)
    notes = [file.note for file in shown if file.note is not None]
    return Prepared(site, shown, [*libraries.notes(), *notes, *(path.notes if path else ())])
