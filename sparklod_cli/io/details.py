"""Files of a Streamed SOG, a manifest and folders of chunks: their sizes, and writing all of them or none."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from ..codecs.file_names import META, chunk_folder, folders_of, is_chunk_folder, is_in_manifest, is_of_streamed_sog
from ..codecs.sog.sog_container import MAX_META, companion_names
from ..codecs.streamed_sog.manifest import MAX_MANIFEST, Manifest, parse
from ..support import atomic, atomic_set
from ..support.addresses import Address, Place
from ..support.errors import FormatError, OutputError
from ..support.stdin import DASH
from .local_files import companions, in_folder, reason_of
from .reading import opened
from .writing import Files, SinkTogether, check_header, send_together

#: The folder that every output has.
FIRST = chunk_folder(0, 0)


def detail_sink(path: Place, *, overwrite: bool) -> SinkTogether:
    """Return the function that writes a manifest and its chunk files. Fail now if they cannot be written later.

    It is given names, with their folders, and contents, the manifest last, and returns the size of all. With
    `overwrite`, the chunks of the output that was there before are replaced or removed: those files that its manifest
    and its chunks name. A folder that is called as one of the output and is not one of the former is never touched.
    See `atomic_set.write` for what an interruption leaves.

    Args:
        path: of the manifest; where it is a symbolic link, all files go to where that leads.

    Raises:
        OutputError: it is no place for several files, a folder is in the way, or see `check_writable`.
    """
    target = _target(path)
    check_header(path, overwrite=overwrite)
    former = _former(target)
    for folder in [FIRST] if isinstance(target, Path) else [FIRST, *folders_of(_standing(target))]:
        _check_folder(target, folder, former)  # at an address all of them now: nothing can be undone there later
    return functools.partial(_write, path, overwrite=overwrite)


def detail_files(path: Path) -> list[Path]:
    """Return the files beside a manifest that are called as those of an output there, whether it names them or not."""
    target = Path(os.path.realpath(path))
    return [target.parent / name for name in _standing(target)]


def _write(path: Place, files: Files, *, overwrite: bool) -> int:
    target = _target(path)
    former = _former(target)

    def placed() -> Iterator[tuple[str, Iterable[bytes]]]:
        seen = set[str]()
        for name, pieces in files:
            folders = folders_of([name])
            for folder in folders:
                if folder not in seen:
                    seen.add(folder)
                    _check_folder(target, folder, former)
            yield name if folders else target.name, pieces

    if isinstance(target, Address):
        return send_together(target, placed(), former=[target.parent / name for name in former], overwrite=overwrite)
    try:
        with atomic.created(target.parent):
            return atomic_set.write(
                target.parent,
                placed(),
                overwrite=overwrite,
                outdated=lambda names: [name for name in former if name not in names],
            )
    except FileExistsError as error:
        taken = Path(error.filename or target)
        if taken.exists() and not taken.is_file():
            raise OutputError(f"{taken} is in the way; move it away, or name another output") from None
        raise OutputError(f"{taken} exists, add --overwrite to replace it") from None
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from None


def _target(path: Place) -> Place:
    return path if isinstance(path, Address) else Path(os.path.realpath(path))


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


def _former(target: Place) -> list[str]:
    """Return the files of a former output that its manifest and its chunks name, and that have names of ours."""
    found = list[str]()
    with contextlib.suppress(OSError, FormatError):
        metas = parse(_content(target, MAX_MANIFEST)).names()
        for meta in metas:
            folder = target.parent / meta.partition("/")[0]
            if is_in_manifest(meta) and not (isinstance(folder, Path) and folder.is_symlink()):
                found.append(meta)
                with contextlib.suppress(OSError):
                    images = companion_names(_content(target.parent / meta, MAX_META))
                    names = (meta.removesuffix(META) + image for image in images)
                    found += [name for name in names if is_of_streamed_sog(name)]
    standing = set(_standing(target))
    return [name for name in dict.fromkeys(found) if name in standing]


def _content(path: Place, most: int) -> bytes:
    with path.open("rb") as file:
        return file.read(most + 1)


def _standing(target: Place) -> list[str]:
    """Return the files in folders beside a manifest that are called as those of an output."""
    if isinstance(target, Address):
        return sorted(name for name in target.parent.files() if is_of_streamed_sog(name))
    found = list[str]()
    with contextlib.suppress(OSError):
        for folder in target.parent.iterdir():
            if is_chunk_folder(folder.name) and folder.is_dir() and not folder.is_symlink():
                found += [f"{folder.name}/{file.name}" for file in folder.iterdir()]
    return sorted(name for name in found if is_of_streamed_sog(name))


@dataclass(frozen=True)
class LevelFiles:
    """A manifest and its files.

    Attributes:
        manifest: as parsed.
        bytes: of the manifest.
        sizes: bytes of the chunk files that it names, and then of the environment: each meta.json with its images.
    """

    manifest: Manifest
    bytes: int
    sizes: tuple[int, ...]


def has_levels(path: Path) -> bool:
    """Return whether a file, or what a folder stands for, has a scene at several detail levels.

    Raises:
        FormatError: it cannot be read, or is of no known format.
    """
    if path == DASH:
        return False
    with opened(path) as (_, form, _):
        return form.detailed


def read_level_files(path: Path) -> LevelFiles:
    """Return the files of a lod-meta.json, or of the folder that holds it.

    Raises:
        FormatError: it cannot be read, or is no such manifest.
    """
    first = path if path.is_file() else path / in_folder(path).name
    with opened(first) as (file, _, _):
        data = file.read(MAX_MANIFEST + 1)
    manifest = parse(data)
    sizes: dict[Path, int] = {}
    for each in companions(first, ()):
        sizes[each.parent] = sizes.get(each.parent, 0) + each.stat().st_size
    folders = [(first.parent / name).parent for name in manifest.names()]
    return LevelFiles(manifest, len(data), tuple(sizes.get(folder, 0) for folder in folders))
