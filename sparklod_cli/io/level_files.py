"""The manifest of a Streamed SOG, and the sizes of the files that it names."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..codecs.streamed_sog.manifest import MAX_MANIFEST, Manifest, parse
from ..support.stdin import DASH
from .beside import companions, in_folder
from .reading import opened


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
    """Whether a file, or what a folder stands for, has a scene at several detail levels.

    Raises:
        FormatError: it cannot be read, or is of no known format.
    """
    if path == DASH:
        return False
    with opened(path) as (_, form, _):
        return form.detailed


def read_level_files(path: Path) -> LevelFiles:
    """The files of a lod-meta.json, or of the folder that holds it.

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
