"""Files of a scene at several detail levels, a manifest and folders beside it: their sizes, and writing all or none.

They are those of a Streamed SOG, or of 3D Tiles, as the name of the manifest tells.
"""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from ..codecs.file_names import (
    MANIFEST,
    META,
    TILES,
    TILESET,
    chunk_folder,
    folders_of,
    is_chunk_folder,
    is_in_manifest,
    is_of_streamed_sog,
    is_of_tileset,
)
from ..codecs.reader import OpenCompanion, size_of
from ..codecs.sog.sog_container import MAX_META, companion_names
from ..codecs.streamed_sog.manifest import MAX_MANIFEST, Manifest, parse
from ..codecs.streamed_sog.manifest_rules import files_of_chunk
from ..codecs.tiles_3d import tileset
from ..system.addresses import Address, Place
from ..system.errors import FormatError, OutputError
from .local_files import reason_of
from .reading import opened
from .writing import Files, SinkTogether, check_header, real_target, write_set


@dataclass(frozen=True)
class FileSet:
    """Names of the files of an output beside its manifest.

    Attributes:
        first: the folder that every output has.
        is_folder: whether a folder has the name of one of an output.
        is_member: whether a file in such a folder, by its path from the manifest's on, has the name of one.
        named: the files that a manifest and what it names name, whatever they are called; `OSError` or `FormatError`
            where it cannot be read.
    """

    first: str
    is_folder: Callable[[str], bool]
    is_member: Callable[[str], bool]
    named: Callable[[Place], Iterable[str]]


def _of_streamed_sog(target: Place) -> Iterator[str]:
    for meta in parse(_content(target, MAX_MANIFEST)).names():
        folder = target.parent / meta.partition("/")[0]
        if is_in_manifest(meta) and not (isinstance(folder, Path) and folder.is_symlink()):
            yield meta
            with contextlib.suppress(OSError):
                images = companion_names(_content(target.parent / meta, MAX_META))
                yield from (meta.removesuffix(META) + image for image in images)


def _of_tileset(target: Place) -> Iterator[str]:
    for name in tileset.parse(_content(target, tileset.MAX_TILESET)).names():
        yield name
        if is_of_tileset(name) and name.endswith(tileset.NESTED):
            with contextlib.suppress(OSError, FormatError):
                inner = tileset.parse(_content(target.parent / name, tileset.MAX_TILESET))
                yield from (f"{TILES}/{each}" for each in inner.names())


#: By the name of the manifest.
FILE_SETS = {
    MANIFEST: FileSet(chunk_folder(0, 0), is_chunk_folder, is_of_streamed_sog, _of_streamed_sog),
    TILESET: FileSet(TILES, lambda name: name == TILES, is_of_tileset, _of_tileset),
}


def detail_sink(path: Place, *, overwrite: bool) -> SinkTogether:
    """Return the function that writes a manifest and its files. Fail now if they cannot be written later.

    It is given names, with their folders, and contents, the manifest last, and returns the size of all. With
    `overwrite`, the files of the output that was there before are replaced or removed: those that its manifest, and
    what that names, name. A folder that is called as one of the output and is not one of the former is never touched.
    See `atomic_set.write` for what an interruption leaves.

    Args:
        path: of the manifest, whose name tells the format (`FILE_SETS`); where it is a symbolic link, all files go to
            where that leads.

    Raises:
        OutputError: it is no place for several files, a folder is in the way, or see `check_writable`.
    """
    target, files = real_target(path), _files_of(path)
    check_header(path, overwrite=overwrite)
    former = _former(target, files)
    folders = [] if isinstance(target, Path) else folders_of(_standing(target, files))
    for folder in [files.first, *folders]:
        _check_folder(target, folder, former)  # at an address all of them now: nothing can be undone there later
    return functools.partial(_write, path, overwrite=overwrite)


def detail_files(path: Place) -> list[Place]:
    """Return the files beside a manifest that are called as those of an output there, whether it names them or not."""
    target = real_target(path)
    return [target.parent / name for name in _standing(target, _files_of(path))]


def _write(path: Place, files: Files, *, overwrite: bool) -> int:
    target = real_target(path)
    former = _former(target, _files_of(path))

    def placed() -> Iterator[tuple[str, Iterable[bytes]]]:
        seen = set[str]()
        for name, pieces in files:
            folders = folders_of([name])
            for folder in folders:
                if folder not in seen:
                    seen.add(folder)
                    _check_folder(target, folder, former)
            yield name if folders else target.name, pieces

    return write_set(path, placed(), former=former, overwrite=overwrite)


def _files_of(path: Place) -> FileSet:
    """Return the names of the files beside a manifest; a manifest of another name is that of a Streamed SOG."""
    return FILE_SETS.get(path.name, FILE_SETS[MANIFEST])


def _check_folder(target: Place, folder: str, former: Iterable[str]) -> None:
    """Raise `OutputError` where a folder is not empty, and not one of the former output."""
    if folder in folders_of(list(former)):
        return
    place = target.parent / folder
    try:
        if isinstance(place, Path) and os.path.lexists(place):
            in_the_way = place.is_symlink() or not place.is_dir() or any(place.iterdir())
        else:
            in_the_way = isinstance(place, Address) and bool(place.files())
    except OSError as error:
        raise OutputError(f"cannot write {place}: {reason_of(error)}") from None
    if in_the_way:
        raise OutputError(
            f"{place} exists, and {target.name} there does not name it; move it away, or name another output"
        )


def _former(target: Place, files: FileSet) -> list[str]:
    """Return the files of a former output that its manifest, and what that names, name, and that have names of ours."""
    found = list[str]()
    with contextlib.suppress(OSError, FormatError):
        for name in files.named(target):
            found.append(name)
    standing = set(_standing(target, files))
    return [name for name in dict.fromkeys(found) if name in standing]


def _content(path: Place, most: int) -> bytes:
    with path.open("rb") as file:
        return file.read(most + 1)


def _standing(target: Place, files: FileSet) -> list[str]:
    """Return the files in folders beside a manifest that are called as those of an output."""
    if isinstance(target, Address):
        return sorted(name for name in target.parent.files() if files.is_member(name))
    found = list[str]()
    with contextlib.suppress(OSError):
        for folder in target.parent.iterdir():
            if files.is_folder(folder.name) and folder.is_dir() and not folder.is_symlink():
                found += [f"{folder.name}/{file.name}" for file in folder.iterdir()]
    return sorted(name for name in found if files.is_member(name))


@dataclass(frozen=True)
class LevelFiles:
    """A manifest and its files.

    Attributes:
        manifest: as parsed.
        bytes: of the manifest.
        requests: for each chunk file, and then for the environment, bytes of the answers to a viewer: of the meta.json,
            and then of each of its images.
    """

    manifest: Manifest
    bytes: int
    requests: tuple[tuple[int, ...], ...]

    @property
    def sizes(self) -> tuple[int, ...]:
        """Bytes of each chunk file, and of the environment."""
        return tuple(map(sum, self.requests))


def read_level_files(path: Path) -> LevelFiles:
    """Return the files of a lod-meta.json, or of the folder that holds it.

    Raises:
        FormatError: it cannot be read, or is no such manifest.
    """
    with opened(path) as (file, _, more):
        data = file.read(MAX_MANIFEST + 1)
        manifest, open_companion = parse(data), more["open_companion"]
        requests = tuple(_requests_of(open_companion, name) for name in manifest.names())
    return LevelFiles(manifest, len(data), requests)


def _requests_of(open_companion: OpenCompanion, name: str) -> tuple[int, ...]:
    """Return the bytes of the files of a chunk; none where one cannot be read, which reading its splats reports."""
    sizes = list[int]()
    try:
        for each in files_of_chunk(open_companion, name):
            with open_companion(each) as file:
                sizes.append(size_of(file))
    except FormatError:
        return ()
    return tuple(sizes)
