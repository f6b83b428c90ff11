"""Outputs of scenes: the files beside the first one, and the encoding of a scene into files."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

from ..codecs.formats import (
    MANIFEST,
    META,
    TILES,
    TILESET,
    Format,
    is_chunk_folder,
    is_in_manifest,
    is_of_streamed_sog,
    is_of_tileset,
    rad_chunk_number,
    sog_image_number,
)
from ..model.scene import Scene
from ..system.addresses import Address, Place
from ..system.errors import FormatError
from ..system.output import Files, Output, Siblings
from ..system.progress import Progress, silent

if TYPE_CHECKING:
    from ..codecs.formats import WriteOptions


def _named_by_manifest(target: Place) -> Iterator[str]:
    from ..codecs.sog import MAX_META, companion_names
    from ..codecs.streamed_manifest import MAX_MANIFEST, parse

    for meta in parse(_content(target, MAX_MANIFEST)).names():
        folder = target.parent / meta.partition("/")[0]
        if is_in_manifest(meta) and not (isinstance(folder, Path) and folder.is_symlink()):
            yield meta
            with contextlib.suppress(OSError):
                images = companion_names(_content(target.parent / meta, MAX_META))
                yield from (meta.removesuffix(META) + image for image in images)


def _named_by_tileset(target: Place) -> Iterator[str]:
    from ..codecs import tileset

    for name in tileset.parse(_content(target, tileset.MAX_TILESET)).names():
        yield name
        if is_of_tileset(name) and name.endswith(tileset.NESTED):
            with contextlib.suppress(OSError, FormatError):
                inner = tileset.parse(_content(target.parent / name, tileset.MAX_TILESET))
                yield from (f"{TILES}/{each}" for each in inner.names())


def _content(path: Place, most: int) -> bytes:
    with path.open("rb") as file:
        return file.read(most + 1)


#: Files beside the manifest of a Streamed SOG, and beside the tileset of 3D Tiles.
_STREAMED_SOG = Siblings(is_of_streamed_sog, is_chunk_folder, "0_0", _named_by_manifest)
_TILES_3D = Siblings(is_of_tileset, lambda name: name == TILES, TILES, _named_by_tileset)


def siblings_of(path: Place) -> Siblings:
    """Return the files that belong to a header: parts of its format, images of a meta.json, or chunks of RAD."""
    if path.name in (MANIFEST, TILESET):
        return _TILES_3D if path.name == TILESET else _STREAMED_SOG
    name = path.name if isinstance(path, Address) else Path(os.path.realpath(path)).name
    if META in (path.name.lower(), name.lower()):
        return Siblings(lambda name: sog_image_number(name) is not None)
    return Siblings(lambda each: rad_chunk_number(each, PurePath(name).stem) is not None)


def parts_output(path: Place, *, overwrite: bool) -> Output:
    """Return the output of a manifest and its folders: 3D Tiles for a tileset.json, else a Streamed SOG."""
    return Output(path, overwrite=overwrite, siblings=_TILES_3D if path.name == TILESET else _STREAMED_SOG)


def scene_output(path: Place, form: Format, *, chunked: bool = False, overwrite: bool) -> Output:
    """Return the output of a scene in a format; - is standard output.

    If the scene becomes several files, as `form.unbundled` or `chunked` RAD, the path is that of the header.
    """
    several = chunked or path.name.lower() == form.unbundled
    return Output(path, overwrite=overwrite, siblings=siblings_of(path) if several else None)


def encoded(
    out: Output, form: Format, scene: Scene, options: WriteOptions, *, threads: int = 1, progress: Progress = silent
) -> Files:
    """Encode a scene as the files of an output: one, a header and chunks, or those of an unbundled format."""
    codec: Any = form.codec()
    name = out.target.name
    if out.siblings is None:
        return [(name, codec.encode(scene, options, threads=threads, progress=progress))]
    if form.unbundled is not None:
        files = codec.encode_files(scene, options, threads=threads, progress=progress)
        return ((name, [content]) for name, content in files)
    files_of_chunks: Files = codec.encode_chunked(
        scene, options, PurePath(name).stem, threads=threads, progress=progress
    )
    return files_of_chunks


def write_scene(
    out: Output, form: Format, scene: Scene, options: WriteOptions, *, threads: int = 1, progress: Progress = silent
) -> int:
    """Write a scene to an output of `scene_output`, and return the size of all files in bytes."""
    with out:
        return sum(out.write(*file) for file in encoded(out, form, scene, options, threads=threads, progress=progress))
