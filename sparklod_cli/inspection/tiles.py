"""Facts of 3D Tiles that the tileset files and the headers of the tiles tell, and findings about both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from ..codecs.merging import Chunk
from ..codecs.reader import OpenCompanion
from ..codecs.tiles_3d.codec import tile_files
from ..codecs.tiles_3d.tileset import MAX_TILESET, Tileset, read_whole
from ..codecs.tiles_3d.tileset_rules import (
    depths_of,
    matrices_of,
    matrix_of,
    read_violations,
    scan_files,
    scan_splats,
    violations,
)
from ..model.axes import common
from ..model.georeference import EarthPlace, place_of
from ..system.printable import MOST, printable
from ..system.progress import Progress, silent
from .findings import ChunkBytes, Head, HeaderScan, quantiles_of

#: Distance from the centre of the Earth, metres, from which on a transform places a tileset on it. Chosen.
ON_EARTH = 1e6


@dataclass(frozen=True)
class TileLevelFacts:
    """The tiles of a depth, see `schema.json`."""

    tiles: int
    splats: int
    bytes: int
    leaves: int
    errors: dict[str, float] | None


@dataclass(frozen=True)
class TileFacts:
    """Facts from the tileset files and the headers of the tiles, see `schema.json`."""

    generator: str | None
    version: str
    bytes: int
    tileset_bytes: int
    first_bytes: int
    splats: int
    tiles: int
    levels: list[TileLevelFacts]
    tilesets: int
    geometric_error: float | None
    tile_splats: dict[str, float]
    file_bytes: ChunkBytes | None
    georeference: EarthPlace | None


def survey(
    file: BinaryIO, open_companion: OpenCompanion, *, check: bool, threads: int = 1, progress: Progress = silent
) -> HeaderScan:
    """Read a tileset and the headers of its tiles.

    Args:
        check: decode the tiles and look at their splats, too.

    Raises:
        FormatError: a tileset file cannot be parsed.
    """
    tileset = read_whole(file.read(MAX_TILESET + 1), open_companion)
    found = list(read_violations(tileset))
    if not found:
        found += violations(tileset)
    if any(each.fatal for each in found):
        return HeaderScan("tiles", found)
    matrices = matrices_of(tileset)
    named = {name: matrices[at] for at, tile in enumerate(tileset.tiles) if (name := tile.name) is not None}
    files = tile_files(open_companion, named)
    chunks, about_files = scan_files(tileset, files)
    found += about_files
    if any(each.fatal for each in found):
        return HeaderScan("tiles", found)
    if check:
        found += scan_splats(tileset, files, chunks, threads=threads, progress=progress)
    return HeaderScan("tiles", found, _head(tileset, chunks), _facts(tileset, chunks))


def _head(tileset: Tileset, chunks: Mapping[int, Chunk]) -> Head:
    """Return what a reader of the tiles without children finds."""
    read = [chunk for number, chunk in chunks.items() if not tileset.tiles[number].children]
    return Head(
        f"3D Tiles {tileset.head['asset']['version']} of {read[0].format}" if read else "3D Tiles",
        tileset.bytes + sum(chunk.bytes for chunk in chunks.values()),
        sum(chunk.count for chunk in read),
        max((chunk.sh_degree for chunk in read), default=0),
        any(chunk.antialiased for chunk in read),
        common(chunk.up for chunk in read),
        common(chunk.up_by for chunk in read) or "",
    )


def _facts(tileset: Tileset, chunks: Mapping[int, Chunk]) -> TileFacts:
    asset = tileset.head["asset"]
    extras = asset.get("extras")
    generator = extras.get("generator") if isinstance(extras, dict) else None
    depths = depths_of(tileset)
    sizes = [chunk.bytes for chunk in chunks.values()]
    by_depth = [[at for at in range(len(depths)) if depths[at] == depth] for depth in range(max(depths) + 1)]
    total, error = tileset.bytes + sum(sizes), tileset.head.get("geometricError")
    first = next((chunk.bytes for number, chunk in chunks.items() if depths[number] == 0), 0)
    return TileFacts(
        generator=printable(" ".join(generator.split()), MOST) if isinstance(generator, str) else None,
        version=asset["version"],
        bytes=total,
        tileset_bytes=tileset.bytes,
        first_bytes=tileset.bytes + first,
        splats=sum(chunk.count for chunk in chunks.values()),
        tiles=len(chunks),
        levels=[_level(tileset, chunks, numbers) for numbers in by_depth],
        tilesets=len(tileset.heads),
        geometric_error=float(error) if isinstance(error, (int, float)) else None,
        tile_splats=quantiles_of([chunk.count for chunk in chunks.values()] or [0]),
        file_bytes=ChunkBytes.of(sizes),
        georeference=_place(tileset),
    )


def _level(tileset: Tileset, chunks: Mapping[int, Chunk], numbers: Sequence[int]) -> TileLevelFacts:
    held = [number for number in numbers if number in chunks]
    inner = [number for number in held if tileset.tiles[number].children]
    errors = [float(tileset.tiles[number].record["geometricError"]) for number in inner]
    return TileLevelFacts(
        tiles=len(held),
        splats=sum(chunks[number].count for number in held),
        bytes=sum(chunks[number].bytes for number in held),
        leaves=len(held) - len(inner),
        errors=quantiles_of(errors) if errors else None,
    )


def _place(tileset: Tileset) -> EarthPlace | None:
    """Return where the transform of the root puts the origin of the scene; None where that is not on the Earth."""
    matrix = matrix_of(tileset.tiles[0].record)
    if float(np.linalg.norm(matrix[:3, 3])) < ON_EARTH:
        return None
    found = place_of(tuple(matrix.T.ravel().tolist()))
    latitude, longitude = round(found.latitude, 9) + 0.0, round(found.longitude, 9) + 0.0  # no -0
    return EarthPlace(latitude, longitude, round(found.height, 4) + 0.0, round(found.heading, 6) % 360)
