"""Sizes of the files of a Streamed SOG: its manifest, chunks and environment."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..codecs.reader import OpenCompanion, size_of
from ..codecs.streamed_sog.manifest import MAX_MANIFEST, Manifest, parse
from ..codecs.streamed_sog.manifest_rules import files_of_chunk
from ..system.errors import FormatError
from .reading import opened


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
