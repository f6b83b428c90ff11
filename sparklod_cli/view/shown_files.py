"""Splat files of a page: the names under which they and their companions are served, extents, and the first view.

A site serves nothing but a closed table of names, so no name can lead out of it.
"""

from __future__ import annotations

import functools
import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from ..cameras import DEFAULT_SIZE, ELEVATION, framing
from ..cameras.camera import DEFAULT_FOV_Y, Settings
from ..cameras.framing import Balls, balls_of
from ..cameras.sources import single_views, whole_scene
from ..codecs.formats import META, ZIP, Format, head_of, sniff
from ..codecs.gltf import open_content as open_glb
from ..codecs.gltf_container import MAGIC as GLB_MAGIC
from ..codecs.losses import MOST_PAGED_DEGREE, sample_loss
from ..codecs.merging import ZipFolder
from ..codecs.rad.rad_header import CHUNK_MAGIC, MAGIC, RadHeader, read_header
from ..codecs.rad.rad_reader import RadReader
from ..codecs.reader import OpenFile
from ..codecs.streamed_manifest import MAX_MANIFEST, files_of_chunk, parse
from ..codecs.tiles_3d import names_of
from ..codecs.tileset import MAX_TILESET
from ..io.files import check_companion, in_folder, open_named, open_plain, reason_unreadable, unknown_format
from ..io.reading import read_parts, read_scene
from ..model.instances import DetailScene, TileScene
from ..model.lod_tree import CHUNK_NODES
from ..model.splats import Splats
from ..system.errors import FormatError, InvalidSplatsError, NotSplatsError, UnreadableError, naming, reason_of
from ..system.progress import Progress, silent
from ..system.untrusted import printable, quoted_value

#: Spark's names of the formats that sparklod reads.
SPARK_TYPES = {
    "compressed PLY": "ply",
    "PLY": "ply",
    "SPZ": "spz",
    "KSPLAT": "ksplat",
    "SPLAT": "splat",
    "SOG": "pcsogszip",
    "RAD": "rad",
}

#: Engines of formats that Spark does not read.
OTHER_ENGINES = {"Streamed SOG": "playcanvas", "GLB": "playcanvas", "3D Tiles": "cesium"}

#: Patterns of the first bytes of files that sparklod reads and Spark 2.2.0 does not, with names of their formats.
UNREAD = (
    (rb"NGSP", "SPZ version 4"),
    (rb"ply\s+((comment|obj_info)\b.*\s+)*format\s+(?!binary_little)", "PLY that is ascii or big-endian"),
)

#: Engines that show files, and their names for display.
ENGINES = {"spark": "Spark", "playcanvas": "PlayCanvas", "cesium": "CesiumJS"}

#: Media types by suffix, and that of other files.
MEDIA_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".mjs": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".json": "application/json",
    ".svg": "image/svg+xml",
    ".webp": "image/webp",
}
BYTES = "application/octet-stream"

#: Suffixes of the files that a splat file may refer to.
PARTS = (".json", ".sog", ".webp", ".glb", ".gltf", ".bin", ".radc", ".rad")

#: Resources of a site by name, with / between folders: bytes, or the real path of a file.
Resources = Mapping[str, bytes | Path]


@dataclass(frozen=True)
class ShownFile:
    """A splat file of a page.

    Attributes:
        url: relative to the page.
        format: name of the format, for display.
        files: paths of the file and its companions, by the names under which they are served.
        note: why Spark will not show it; None if no reason is known.
    """

    path: Path
    url: str
    format: str
    header: RadHeader | None
    files: Mapping[str, Path]
    note: str | None = None

    @property
    def name(self) -> str:
        """Name of the file, for display."""
        return printable(self.path.name)

    @property
    def engine(self) -> str:
        """Engine of the format, one of `ENGINES`."""
        return OTHER_ENGINES.get(self.format, "spark")

    @property
    def paged(self) -> bool:
        """Whether Spark can load the file chunk by chunk."""
        return self.header is not None and self.header.lod_tree and self.header.chunk_size == CHUNK_NODES

    @property
    def bytes(self) -> int:
        """Total size of the files."""
        return sum(path.stat().st_size for path in self.files.values())


def media_type(name: str) -> str:
    """Return the media type of a resource, by its suffix."""
    return MEDIA_TYPES.get(Path(name).suffix.lower(), BYTES)


def shown_files(paths: Sequence[Path]) -> list[ShownFile]:
    """Recognise splat files and find their companions.

    Raises:
        FormatError: a file cannot be read, is of an unknown format, or refers to a file that is missing or outside its
            folder, or the files need different engines. The message names the file.
    """
    shown = [_named(path, f"data/{number}") for number, path in enumerate(paths)]
    other = next((file for file in shown if file.engine != shown[0].engine), None)
    if other is not None:
        names = f"{shown[0].path} by {ENGINES[shown[0].engine]}, {other.path} by {ENGINES[other.engine]}"
        raise NotSplatsError(f"one page cannot show all of these files: {names}; view them one after the other")
    return shown


def _named(path: Path, folder: str) -> ShownFile:
    try:
        with naming(path, FormatError):
            return _shown(path, folder)
    except OSError as error:
        raise UnreadableError(f"{path}: cannot be read: {reason_unreadable(error)}") from None


def _shown(path: Path, folder: str) -> ShownFile:
    if path.is_dir():
        return _shown(path / in_folder(path).name, folder)
    if path.exists() and not path.is_file():
        raise UnreadableError("it is a pipe or a device; save it to a file first")
    name, header = f"{folder}/{path.name}", None
    files = {name: path.resolve()}
    with open_plain(path.resolve()) as file:
        head = head_of(file)
        form = sniff(head, path.suffix)
        if form is None:
            raise unknown_format(head, path)
        if head.startswith(MAGIC):
            header = read_header(file)
        elif head.startswith(GLB_MAGIC) and open_glb(OpenFile(file)).format != "GLB":
            raise NotSplatsError("PlayCanvas does not read the SPZ in it; write it with --glb-profile khronos")
        elif form.unbundled == META and not head.startswith(ZIP):
            raise NotSplatsError("Spark does not read an unpacked SOG; zip its files into a .sog")
        elif form.unbundled == META and (first := ZipFolder(file).first) != META:
            raise NotSplatsError(f"viewers do not read {first} in a zip; unzip it, and give the folder")
        if form.name not in SPARK_TYPES | OTHER_ENGINES:
            raise NotSplatsError(f"Spark does not read {form.name}; bake it first with sparklod build-lod")
        for each in _companions(path, file, form, header):
            files[f"{folder}/{each}"] = _real_path(path, path.parent / each, CHUNK_MAGIC if header is not None else b"")
    return ShownFile(path, quote(os.fsencode(name)), form.name, header, files, _note(path.name, head, header))


def _note(name: str, head: bytes, header: RadHeader | None) -> str | None:
    """Return the reason, visible in the first bytes of a file, why Spark will not show it; None if Spark may."""
    for beginning, what in UNREAD:
        if re.match(beginning, head):
            return f"{name}: Spark 2.2.0 does not read {what}; bake it first with sparklod build-lod"
    if header is not None and header.chunked and not header.lod_tree:
        return f"{name}: Spark streams trees only; bake it first with sparklod build-lod"
    if header is not None and header.chunked and header.chunk_size != CHUNK_NODES:
        return (
            f"{name}: Spark streams chunks of {CHUNK_NODES:,} nodes, not of {header.chunk_size:,}; write it anew with"
            " sparklod build-lod"
        )
    return None


def _companions(path: Path, file: BinaryIO, form: Format, header: RadHeader | None) -> Iterable[str]:
    """Return the names of all files that viewers read with a splat file; `FormatError` if one is missing."""
    open_beside = functools.partial(open_named, path, folders=True)
    file.seek(0)
    if form.parts == "tiles":
        names = dict.fromkeys(names_of(file.read(MAX_TILESET + 1), open_beside))
        for name in names:
            open_beside(name).close()
        return names
    is_manifest, names = form.parts is not None, {}
    chunks = parse(file.read(MAX_MANIFEST + 1)).read_names() if is_manifest else header.filenames if header else ()
    for name in chunks:
        check_companion(name, folders=is_manifest)
        if not (path.parent / name).is_file():
            raise FormatError(f"its chunk file {quoted_value(name)} is missing")
        names |= dict.fromkeys(files_of_chunk(open_beside, name) if is_manifest else [name])
    return names


def _real_path(path: Path, companion: Path, magic: bytes) -> Path:
    """Return the real path of a file that a splat file names; `FormatError` if it must not be published.

    The author of the splat file is untrusted, but chooses which of the files beside it are published: only those that
    are named like a part of a scene and begin with `magic`.
    """
    name = companion.relative_to(path.parent)
    if name.suffix.lower() not in PARTS or any(part.startswith(".") for part in name.parts):
        raise FormatError(
            f"it names {quoted_value(name.as_posix())}, which is not called like a part of a scene"
            f" ({', '.join(PARTS)}); nothing is published"
        )
    real = companion.resolve()
    if real.parent != path.parent.resolve() / name.parent:
        raise FormatError(f"{quoted_value(companion.name)}, which it names, is a link to another folder; copy it there")
    if magic:
        with open_plain(real) as file:
            if file.read(len(magic)) != magic:
                what = quoted_value(companion.name)
                raise FormatError(f"{what}, which it names, is no RAD chunk; nothing is published")
    return real


#: x, y and z in world units.
Point = tuple[float, float, float]

#: Vertical field of view where none is given, degrees.
FOV = round(math.degrees(DEFAULT_FOV_Y), 9)

#: Percentiles of the range of feature sizes; few nodes of a tree are coarse.
SIZES = 1, 99.9

#: Assumed ratio of the smallest splats in the first chunk of a RAD tree to the smallest of the tree.
BELOW = 8


@dataclass(frozen=True)
class Extent:
    """Extent of a splat file, for the first view.

    Attributes:
        splats: number of splats, or of nodes of a tree.
        leaves: number of leaves of a tree, or of splats at full detail of a file with levels; None without either.
        balls: bounding spheres of the splats, or of the coarsest.
        sizes: range of the feature sizes without outliers, world units.
        up, up_by: as in `Scene`.
        levels: number of detail levels; None without levels.
        layout: layout of the splats in Spark's memory, "ext" or "packed".
    """

    splats: int
    leaves: int | None
    balls: Balls
    sizes: tuple[float, float]
    up: str | None
    levels: int | None = None
    layout: str = "ext"
    up_by: str = ""


def extent_of(shown: ShownFile, *, threads: int = 1, progress: Progress = silent) -> Extent:
    """Measure the extent of a file; a `SparklodError` about a broken file names it."""
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
    balls = balls_of(scene.splats, slice(None) if leaves is None else leaves, np.eye(4))
    sizes, layout, count = _sizes(scene.splats), _layout(shown, scene.splats), None if leaves is None else len(leaves)
    return Extent(len(scene.splats), count, balls, sizes, scene.up, layout=layout, up_by=scene.up_by)


def _coarse_extent(shown: ShownFile, header: RadHeader) -> Extent:
    """Return the extent of a RAD tree by its first chunk and its leaves, since a file may have gigabytes.

    A cut through the chunk, its nodes that have no children in it, covers the whole scene.
    """
    companions = {Path(key).name: path for key, path in shown.files.items()}

    def opened(name: str) -> BinaryIO:
        return open_plain(companions[name])

    with opened(shown.path.name) as file:
        reader = RadReader(header, file, opened)
        chunk, leaves = reader.read_chunk(0), reader.count_leaves()
    assert chunk.tree is not None
    start, count = (column.astype(np.int64) for column in (chunk.tree.child_start, chunk.tree.child_count))
    cut = np.flatnonzero((count == 0) | (start + count > len(chunk.splats)))
    smallest, largest = _sizes(chunk.splats)
    balls = balls_of(chunk.splats, cut, np.eye(4))
    sizes = smallest / BELOW, largest
    return Extent(header.count, leaves, balls, sizes, header.noted.up, layout=_layout(shown, chunk.splats))


def _layout(shown: ShownFile, splats: Splats) -> str:
    """Return the layout in which Spark shows the splats of a file best, or at all."""
    if shown.paged and splats.sh_degree > MOST_PAGED_DEGREE:
        return "packed"
    return sample_loss(splats).better


def _parts_extent(scene: DetailScene | TileScene) -> Extent:
    """Measure the coarsest level that has splats, without an environment, which surrounds everything."""
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
    """Return the range of the feature sizes of splats with opacities of at most 1; both ends are above 0."""
    sizes = 2 * splats.scale[:: max(len(splats) // framing.SAMPLE, 1)].mean(axis=1, dtype=np.float64)
    sizes = sizes[np.isfinite(sizes) & (sizes > 0)]
    if not len(sizes):
        return 1.0, 1.0
    smallest, largest = (float(end) for end in np.percentile(sizes, SIZES))
    return smallest, largest


def start_of(extents: Sequence[Extent], view: tuple[Point, Point] | None, up: Point, fov: float) -> dict[str, Any]:
    """Return the first view of files, for the settings of the page; `CameraPathError` if the camera is invalid.

    Args:
        view: eye and target; None for the whole scene from its front.
        fov: vertical field of view, degrees.

    Returns:
        "eye", "target" and "fov" of the camera; "center" and "radius" of a ball around most splats; "sizes", the
        smallest and the largest feature size; "chosen" if the view was chosen for the scene.
    """
    balls = Balls.concat(extent.balls for extent in extents)
    settings = Settings(size=DEFAULT_SIZE, fov_y=math.radians(fov), up=up)
    try:
        middle, radius = framing.framing(balls.center)
    except InvalidSplatsError:  # there is nothing to frame
        middle, radius, view = np.zeros(3), 1.0, view or ((0.0, 0.0, 3.0), (0.0, 0.0, 0.0))
    path = whole_scene(ELEVATION, settings, lambda: balls) if view is None else single_views((view,), settings)
    (camera,) = path.cameras
    if view is None:  # the point on the axis of the camera that is nearest to the middle
        away = float((middle - camera.position) @ camera.forward)
        target = camera.position + camera.forward * (away if away > 0 else 1.0)
    else:
        target = np.array(view[1], np.float64)
    return {
        "eye": camera.position.tolist(),
        "target": target.tolist(),
        "fov": fov,
        "center": middle.tolist(),
        "radius": radius,
        "sizes": [min(extent.sizes[0] for extent in extents), max(extent.sizes[1] for extent in extents)],
        "chosen": view is None,
    }
