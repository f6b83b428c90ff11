"""Files that a viewer shows, and the names under which they are served.

A site is a closed table of names: nothing else is served, so no name can lead out of it.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from ..codecs.formats import META, ZIP, head_of, sniff
from ..codecs.gltf import open_content as open_glb
from ..codecs.gltf_container import MAGIC as GLB_MAGIC
from ..codecs.rad.rad_header import CHUNK_MAGIC, MAGIC, RadHeader, read_header
from ..codecs.reader import OpenFile
from ..codecs.streamed_manifest import MAX_MANIFEST, files_of_chunk, parse
from ..codecs.tiles_3d import names_of
from ..codecs.tileset import MAX_TILESET
from ..codecs.zip_folder import ZipFolder
from ..io.local_files import check_companion, in_folder, open_named, open_plain, reason_unreadable
from ..io.opening import unknown_format
from ..model.lod_tree import CHUNK_NODES
from ..system.errors import FormatError, NotSplatsError, UnreadableError, naming
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

#: Engines of the other formats, except formats that no engine shows.
OTHER_ENGINES = {"Streamed SOG": "playcanvas", "GLB": "playcanvas", "3D Tiles": "cesium"}

#: Beginnings of files that sparklod reads and Spark 2.2.0 does not, and names of their formats.
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

#: Suffixes of the files that a splat file may name.
PARTS = (".json", ".sog", ".webp", ".glb", ".gltf", ".bin", ".radc", ".rad")

#: By name, with / between folders: bytes, or the real path of a file.
Resources = Mapping[str, bytes | Path]


@dataclass(frozen=True)
class ShownFile:
    """A splat file that the page shows.

    Attributes:
        url: relative to the page.
        format: for display: "RAD", "SPZ".
        spark_type: Spark's name of its format; None if another engine shows it.
        files: itself and its companions, by the names under which they are served.
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
