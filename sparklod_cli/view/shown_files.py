"""Files that a page shows: the names under which they are served, their extents, and the first view of them.

A site is a closed table of names: nothing else is served, so no name can lead out of it.
"""

from __future__ import annotations

import functools
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from ..cameras import DEFAULT_SIZE, ELEVATION, framing
from ..cameras.camera import DEFAULT_FOV_Y, Matrix, Settings
from ..cameras.framing import Balls, balls_of
from ..cameras.sources import single_views, whole_scene
from ..codecs.formats import META, ZIP, head_of, sniff
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

#: Patterns of the beginnings of files that sparklod reads and Spark 2.2.0 does not, with names of their formats.
UNREAD = (
    (rb"NGSP", "SPZ version 4"),
    (rb"ply\s+((comment|obj_info)\b.*\s+)*format\s+(?!binary_little)", "PLY that is ascii or big-endian"),
)

#: Engines that show files, and their names for display.
ENGINES = {"spark": "Spark", "playcanvas": "PlayCanvas", "cesium": "CesiumJS"}

#: Media types by suffix; anything else is bytes.
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
    """A splat file that the page shows.

    Attributes:
        url: relative to the page.
        format: for display: "RAD", "SPZ".
        spark_type: Spark's name of its format; None if another engine shows it.
        files: paths of the file and its companions, by the names under which they are served.
        note: why Spark will not show it; None if no reason is known.
    """

    path: Path
    name: str
    url: str
    format: str
    spark_type: str | None
    header: RadHeader | None
    files: Mapping[str, Path]
    note: str | None = None

    @property
    def engine(self) -> str:
        """Engine that shows the file, one of `ENGINES`."""
        return OTHER_ENGINES.get(self.format, "spark")

    @property
    def paged(self) -> bool:
        """Whether Spark can load it chunk by chunk."""
        return self.header is not None and self.header.lod_tree and self.header.chunk_size == CHUNK_NODES

    @property
    def bytes(self) -> int:
        """Size of all files together, bytes."""
        return sum(path.stat().st_size for path in self.files.values())


def media_type(name: str) -> str:
    """Return the media type of a resource, by its suffix."""
    return MEDIA_TYPES.get(Path(name).suffix.lower(), BYTES)


def shown_files(paths: Sequence[Path]) -> list[ShownFile]:
    """Return the files that a page shows, each with the files it refers to.

    Raises:
        FormatError: a file cannot be read, is of no known format, or refers to one that is missing or elsewhere; or
            they are for different engines; the text names it.
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
    header = None
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
    name = f"{folder}/{path.name}"
    files = {name: path.resolve()}
    if form.parts is not None:
        companions = _tileset_files(path) if form.parts == "tiles" else _manifest_files(path)
        files |= {f"{folder}/{each}": _inside(path, path.parent / each) for each in companions}
    elif header is not None:
        files |= {f"{folder}/{chunk}": companion for chunk, companion in _chunk_files(path, header)}
    note = _note(path.name, head, header)
    file_type = SPARK_TYPES.get(form.name)
    return ShownFile(path, printable(path.name), quote(os.fsencode(name)), form.name, file_type, header, files, note)


def _note(name: str, head: bytes, header: RadHeader | None) -> str | None:
    """Return why Spark will not show a file, judged by its beginning; None if it may."""
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


def _chunk_files(path: Path, header: RadHeader) -> Iterator[tuple[str, Path]]:
    for name in header.filenames:
        check_companion(name)
        companion = path.parent / name
        if not companion.is_file():
            raise FormatError(f"its chunk file {quoted_value(name)} is missing")
        real = _inside(path, companion)
        with open_plain(real) as file:
            if file.read(len(CHUNK_MAGIC)) != CHUNK_MAGIC:
                raise FormatError(f"{quoted_value(name)}, which it names, is no RAD chunk; nothing is published")
        yield name, real


def _manifest_files(path: Path) -> list[str]:
    """Return the names of all files that readers of a Streamed SOG open; `FormatError` where one is missing."""
    with open_plain(path.resolve()) as file:
        manifest = parse(file.read(MAX_MANIFEST + 1))
    names = dict[str, None]()
    for name in manifest.read_names():
        if not (path.parent / name).is_file():
            raise FormatError(f"its chunk file {quoted_value(name)} is missing")
        names |= dict.fromkeys(files_of_chunk(functools.partial(open_named, path, folders=True), name))
    return list(names)


def _tileset_files(path: Path) -> list[str]:
    """Return the names of all files that a tileset refers to; `FormatError` where one is missing or elsewhere."""
    with open_plain(path.resolve()) as file:
        names = names_of(file.read(MAX_TILESET + 1), functools.partial(open_named, path, folders=True))
    for name in names:
        open_named(path, name, folders=True).close()
    return names


def _inside(path: Path, companion: Path) -> Path:
    """Return the real path of a file that another one names; raises `FormatError` if it must not be published.

    The author of a manifest is untrusted, and chooses which of the files beside it are published.
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
    return real


#: x, y and z in world units.
Point = tuple[float, float, float]

#: Vertical field of view where none is given, degrees.
FOV = round(math.degrees(DEFAULT_FOV_Y), 9)

#: Percentiles of feature sizes between which colours differ; few nodes of a tree are coarse.
SIZES = 1, 99.9

#: Assumed ratio of the smallest splats in the first chunk of a large RAD tree to the smallest of the tree.
BELOW = 8


@dataclass(frozen=True)
class Extent:
    """Extent of a splat file, for the first view.

    Attributes:
        splats: number of splats, or of nodes of a tree.
        leaves: number of leaves of a tree, or of splats at full detail of a file with levels; None without either.
        balls: bounding spheres of its splats; of a large RAD tree, of the coarsest only.
        sizes: (2,) range of the feature sizes of its splats without outliers, world units.
        up, up_by: as in `Scene`.
        levels: number of detail levels; None for a file without.
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


@dataclass(frozen=True)
class Start:
    """The first view of the scene.

    Attributes:
        fov: vertical field of view, degrees.
        radius: of a ball around `center` that most splats are in, world units.
        sizes: smallest and largest feature size, world units.
        chosen: the view was chosen for the scene, not given.
    """

    eye: Point
    target: Point
    fov: float
    center: Point
    radius: float
    sizes: tuple[float, float]
    chosen: bool


def extent_of(shown: ShownFile, *, threads: int = 1, progress: Progress = silent) -> Extent:
    """Return the extent of a file, for the first view; a `SparklodError` about a broken one names it."""
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
    index = slice(None) if leaves is None else leaves
    return Extent(
        len(scene.splats),
        None if leaves is None else len(leaves),
        balls_of(scene.splats, index, np.eye(4)),
        _sizes(scene.splats),
        scene.up,
        layout=_layout(shown, scene.splats),
        up_by=scene.up_by,
    )


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
    """Return the layout in which Spark shows these splats of a file best, or at all."""
    if shown.paged and splats.sh_degree > MOST_PAGED_DEGREE:
        return "packed"
    return sample_loss(splats).better


def _parts_extent(scene: DetailScene | TileScene) -> Extent:
    """Return the extent by the coarsest level that has splats; without an environment, which is all around."""
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
    """Return the range of the feature sizes of splats, with opacity taken as at most 1; both ends are above 0."""
    sizes = 2 * splats.scale[:: max(len(splats) // framing.SAMPLE, 1)].mean(axis=1, dtype=np.float64)
    sizes = sizes[np.isfinite(sizes) & (sizes > 0)]
    if not len(sizes):
        return 1.0, 1.0
    smallest, largest = (float(end) for end in np.percentile(sizes, SIZES))
    return smallest, largest


def start_of(extents: Sequence[Extent], view: tuple[Point, Point] | None, up: Point, fov: float) -> Start:
    """Return the first view of some files together; `CameraPathError` if the camera makes no sense.

    `view` is an eye and a target; None for the whole scene from its front.
    """
    balls = Balls.concat(extent.balls for extent in extents)
    settings = Settings(size=DEFAULT_SIZE, fov_y=math.radians(fov), up=up)
    try:
        middle, radius = framing.framing(balls.center)
    except InvalidSplatsError:  # nothing that could be framed
        middle, radius, view = np.zeros(3), 1.0, view or ((0.0, 0.0, 3.0), (0.0, 0.0, 0.0))
    path = whole_scene(ELEVATION, settings, lambda: balls) if view is None else single_views((view,), settings)
    (camera,) = path.cameras
    sizes = min(extent.sizes[0] for extent in extents), max(extent.sizes[1] for extent in extents)
    target: Sequence[float] | Matrix
    if view is None:  # the point on the axis of the camera that is nearest to the middle
        away = float((middle - camera.position) @ camera.forward)
        target = camera.position + camera.forward * (away if away > 0 else 1.0)
    else:
        target = view[1]
    return Start(_point(camera.position), _point(target), fov, _point(middle), radius, sizes, chosen=view is None)


def _point(values: Sequence[float] | Matrix) -> Point:
    x, y, z = (float(value) for value in values)
    return x, y, z
