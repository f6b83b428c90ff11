"""Facts from the headers of formats with several parts (RAD, Streamed SOG, 3D Tiles), and their broken rules."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..codecs import tileset as tilesets
from ..codecs.format_rules import RuleViolation
from ..codecs.merging import Chunk
from ..codecs.rad.property_codings import BY_NAME, CODINGS, LARGEST_F16
from ..codecs.rad.rad_header import RadChunkHeader, encoding_fields
from ..codecs.rad.rad_reader import RadReader, scan_header
from ..codecs.reader import OpenCompanion, size_of
from ..codecs.spark_codings import log_scale_table
from ..codecs.streamed_manifest import VERSION as STREAMED_SOG_VERSION
from ..codecs.streamed_manifest import scan_files, scan_splats
from ..codecs.streamed_sog import RegionLayout, layout_of
from ..codecs.tiles_3d import tile_files
from ..codecs.tileset import MAX_TILESET, Tileset, read_whole
from ..model.scene import common_axis
from ..model.transforms import EarthPlace, place_of
from ..system.progress import Progress, silent
from ..system.untrusted import LARGEST, MOST, printable
from .values import Box, Ends


@dataclass(frozen=True)
class ChunkBytes:
    """Sizes of chunks, bytes."""

    min: int
    median: int
    max: int

    @classmethod
    def of(cls, sizes: Sequence[int]) -> ChunkBytes | None:
        """Return the smallest, median and largest size; None without chunks."""
        return cls(min(sizes), round(statistics.median(sizes)), max(sizes)) if sizes else None


#: Quantiles, by name.
QUANTILES = {"min": 0.0, "p25": 0.25, "p50": 0.5, "p75": 0.75, "max": 1.0}


def quantiles_of(values: ArrayLike, weights: ArrayLike | None = None) -> dict[str, float]:
    """Return the quantiles, without interpolation, and the mean of one or more values; not all weights may be 0."""
    numbers = np.asarray(values, np.float64)
    order = np.argsort(numbers, kind="stable")
    weighed = np.ones(len(numbers)) if weights is None else np.asarray(weights, np.float64)
    below = np.cumsum(weighed[order])
    places = np.searchsorted(below, [share * below[-1] for share in QUANTILES.values()])
    found = numbers[order][places]
    mean = float(numbers @ (weighed / below[-1]))
    return {name: float(f"{each:.6g}") for name, each in [*zip(QUANTILES, found, strict=True), ("mean", mean)]}


def _line(text: object) -> str | None:
    return printable(" ".join(text.split()), MOST) if isinstance(text, str) else None


class HeaderScan(NamedTuple):
    """Rules broken by the headers of a file and of the files that it names, and what they say of the file.

    Attributes:
        fields: of the `Report`: "rad", "streamed_sog" or "tiles", "format", "bytes" of all files together, "splats",
            "sh_degree", "antialiased", "up", "up_by"; None if a fatal rule is broken.
    """

    violations: Sequence[RuleViolation]
    fields: dict[str, Any] | None = None


@dataclass(frozen=True)
class PropertyFacts:
    """Storage of a property in all chunks, see `schema.json`."""

    encoding: str
    bytes: int
    share: float
    min: float | None
    max: float | None


@dataclass(frozen=True)
class RadFacts:
    """Facts from the headers of a RAD file, see `schema.json`."""

    chunked: bool
    bytes: int
    header_bytes: int
    first_bytes: int
    chunk_size: int
    chunk_bytes: ChunkBytes | None
    palette: int
    ranges: dict[str, float | bool] | None
    comment: str | None
    properties: dict[str, PropertyFacts]


def survey_rad(file: BinaryIO, open_companion: OpenCompanion, *, check: bool) -> HeaderScan:
    """Read the headers of a RAD file and of its chunks; `check` reads the padding of properties, too."""
    header, violations = scan_header(file, open_companion)
    chunks: list[RadChunkHeader] = []
    if not any(each.fatal for each in violations):
        for chunk, broken in RadReader(header, file, open_companion).scan_chunks(paddings=check):
            violations += broken
            chunks += [] if chunk is None else [chunk]
    if any(each.fatal for each in violations):
        return HeaderScan(violations)
    sizes = [entry.bytes for entry in header.chunks]
    total = header.bytes + sum(sizes)
    properties = {}
    for name in BY_NAME:  # a finding reports unknown names and encodings
        stored = (each for chunk in chunks for each in chunk.properties if each.name == name)
        found = [each for each in stored if each.encoding in CODINGS]
        if found:
            size = sum(each.bytes for each in found)
            properties[name] = PropertyFacts(
                encoding=", ".join(dict.fromkeys(each.encoding for each in found)),
                bytes=size,
                share=round(size / total, 4),
                min=min((each.min for each in found if each.min is not None), default=None),
                max=max((each.max for each in found if each.max is not None), default=None),
            )
    facts = RadFacts(
        chunked=header.chunked,
        bytes=total,
        header_bytes=header.bytes,
        first_bytes=header.bytes + (sizes[0] if sizes else 0),
        chunk_size=header.chunk_size,
        chunk_bytes=ChunkBytes.of(sizes),
        palette=header.sh_code_count or 0,
        ranges=encoding_fields(header.encoding),
        comment=_line(header.comment),
        properties=properties,
    )
    fields = {"format": header.format, "bytes": total, "splats": header.count, "sh_degree": header.max_sh}
    fields |= {"antialiased": header.noted.antialiased, "up": header.noted.up}
    return HeaderScan(violations, fields | {"rad": facts})


def ends_of_rad(facts: RadFacts) -> Ends:
    """Return the limits of the codes of a file; infinite if chunks have several encodings."""
    center, scales = facts.properties.get("center"), facts.properties.get("scales")
    ends = Ends()
    if center is not None and center.encoding in ("f16", "f16_lebytes"):
        ends = replace(ends, center=float(LARGEST_F16))
    if scales is not None and scales.encoding == "ln_0r8" and scales.min is not None and scales.max is not None:
        table = log_scale_table(scales.min, scales.max)
        ends = replace(ends, scale=(float(table[1]), float(table[-1])))
    return ends


@dataclass(frozen=True)
class LevelFacts:
    """Size of a detail level, see `schema.json`."""

    splats: int
    share: float | None
    regions: int
    files: int
    bytes: int
    errors: dict[str, float] | None


@dataclass(frozen=True)
class EnvironmentFacts:
    """Size of the splats that are drawn at all detail levels, and of their files."""

    splats: int
    bytes: int


@dataclass(frozen=True)
class StreamedSogFacts:
    """Facts from the manifest and the headers of the chunk files, see `schema.json`."""

    generator: str | None
    bytes: int
    manifest_bytes: int
    first_bytes: int
    splats: int
    levels: list[LevelFacts]
    regions: int
    depth: int
    region_splats: dict[str, float]
    region_edge: dict[str, float]
    bound: Box
    files: int
    file_bytes: ChunkBytes | None
    environment: EnvironmentFacts | None


def survey_streamed_sog(
    file: BinaryIO, open_companion: OpenCompanion, *, check: bool, threads: int = 1, progress: Progress = silent
) -> HeaderScan:
    """Read a manifest and the headers of its chunk files; `check` reads their splats, too."""
    size = size_of(file)
    manifest, files, violations = scan_files(file, open_companion)
    if any(each.fatal for each in violations):
        return HeaderScan(violations)
    chunks = {name: chunk for name, chunk in files.items() if isinstance(chunk, Chunk)}
    if check:
        violations += scan_splats(open_companion, manifest, chunks, threads=threads, progress=progress)
    layout = layout_of(manifest)
    facts = _detail_facts(layout, chunks, size)
    # A reader of the file reads level 0 and the environment.
    read, count = _chunks_of(layout, chunks, 0), facts.levels[0].splats
    if manifest.environment is not None:
        read.append(chunks[manifest.environment])
        count += chunks[manifest.environment].count
    fields = {"format": f"Streamed SOG {STREAMED_SOG_VERSION}", "bytes": facts.bytes, "splats": count}
    fields |= _kind_of(read) | {"up": manifest.noted.up, "streamed_sog": facts}
    return HeaderScan(violations, fields)


def _kind_of(read: Sequence[Chunk]) -> dict[str, Any]:
    """Return the SH degree and the antialiasing of chunks that are read together."""
    degree = max((chunk.sh_degree for chunk in read), default=0)
    return {"sh_degree": degree, "antialiased": any(chunk.antialiased for chunk in read)}


def _chunks_of(layout: RegionLayout, chunks: Mapping[str, Chunk], level: int) -> list[Chunk]:
    held = np.unique(layout.file[layout.level == level]).tolist()
    return [chunks[layout.manifest.filenames[number]] for number in held]


def _detail_facts(layout: RegionLayout, chunks: Mapping[str, Chunk], size: int) -> StreamedSogFacts:
    manifest = layout.manifest
    levels = [_detail_level(layout, chunks, level) for level in range(manifest.levels)]
    environment = None
    if manifest.environment is not None:
        chunk = chunks[manifest.environment]
        environment = EnvironmentFacts(chunk.count, chunk.bytes)
    beyond = 0 if environment is None else environment.bytes
    sizes = [chunks[name].bytes for name in manifest.filenames]
    asset = manifest.head.get("asset")
    edges = [max(map(_edge, *node.bound)) for _, node in manifest.regions() if node.bound is not None]
    depths = [0]
    for node in manifest.nodes[1:]:
        depths.append(depths[node.parent] + 1)
    bound = manifest.nodes[0].bound
    assert bound is not None
    return StreamedSogFacts(
        generator=_line(asset.get("generator") if isinstance(asset, dict) else None),
        bytes=size + sum(sizes) + beyond,
        manifest_bytes=size,
        first_bytes=size + levels[-1].bytes + beyond,
        splats=int(layout.counts.sum()),
        levels=levels,
        regions=len(layout.counts),
        depth=max(depths),
        region_splats=quantiles_of(layout.counts[:, 0]),
        region_edge=quantiles_of(edges),
        bound=Box(list(bound[0]), list(bound[1])),
        files=len(sizes),
        file_bytes=ChunkBytes.of(sizes),
        environment=environment,
    )


def _detail_level(layout: RegionLayout, chunks: Mapping[str, Chunk], level: int) -> LevelFacts:
    files, held = _chunks_of(layout, chunks, level), layout.counts[:, level] > 0
    nodes = [node for (_, node), has in zip(layout.manifest.regions(), held, strict=True) if has]
    errors = [node.errors[level] for node in nodes if node.errors is not None]
    splats, full, weights = int(layout.counts[:, level].sum()), int(layout.counts[:, 0].sum()), layout.counts[held, 0]
    known = bool(errors) and len(errors) == len(nodes) and bool(weights.any())
    return LevelFacts(
        splats=splats,
        share=round(splats / full, 4) if full else None,
        regions=len(nodes),
        files=len(files),
        bytes=sum(chunk.bytes for chunk in files),
        errors=quantiles_of(errors, weights) if known else None,
    )


def _edge(low: float, high: float) -> float:
    """Return the difference of two finite numbers, without an overflow."""
    return min(max(high - low, -LARGEST), LARGEST)


#: Distance of an origin from the centre of the Earth, metres, from which on a tileset lies on the Earth. Chosen.
ON_EARTH = 1e6


@dataclass(frozen=True)
class TileLevelFacts:
    """Size of the tiles of one depth, see `schema.json`."""

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


def survey_tiles(
    file: BinaryIO, open_companion: OpenCompanion, *, check: bool, threads: int = 1, progress: Progress = silent
) -> HeaderScan:
    """Read a tileset and the headers of its tiles; `check` reads their splats, too."""
    tileset = read_whole(file.read(MAX_TILESET + 1), open_companion)
    found = list(tilesets.read_violations(tileset))
    if not found:
        found += tilesets.violations(tileset)
    if any(each.fatal for each in found):
        return HeaderScan(found)
    matrices = tilesets.matrices_of(tileset)
    named = {name: matrices[at] for at, tile in enumerate(tileset.tiles) if (name := tile.name) is not None}
    files = tile_files(open_companion, named)
    chunks, about_files = tilesets.scan_files(tileset, files)
    found += about_files
    if any(each.fatal for each in found):
        return HeaderScan(found)
    if check:
        found += tilesets.scan_splats(tileset, files, chunks, threads=threads, progress=progress)
    # A reader of the file reads the tiles without children.
    read, facts = (
        [chunk for at, chunk in chunks.items() if not tileset.tiles[at].children],
        _tile_facts(tileset, chunks),
    )
    fields = {
        "format": f"3D Tiles {facts.version} of {read[0].format}" if read else "3D Tiles",
        "bytes": facts.bytes,
        "splats": sum(chunk.count for chunk in read),
        "up": common_axis(chunk.up for chunk in read),
        "up_by": common_axis(chunk.up_by for chunk in read) or "",
        "tiles": facts,
    }
    return HeaderScan(found, fields | _kind_of(read))


def _tile_facts(tileset: Tileset, chunks: Mapping[int, Chunk]) -> TileFacts:
    asset = tileset.head["asset"]
    extras = asset.get("extras")
    depths = tilesets.depths_of(tileset)
    sizes = [chunk.bytes for chunk in chunks.values()]
    by_depth = [[at for at in range(len(depths)) if depths[at] == depth] for depth in range(max(depths) + 1)]
    total, error = tileset.bytes + sum(sizes), tileset.head.get("geometricError")
    first = next((chunk.bytes for number, chunk in chunks.items() if depths[number] == 0), 0)
    return TileFacts(
        generator=_line(extras.get("generator") if isinstance(extras, dict) else None),
        version=asset["version"],
        bytes=total,
        tileset_bytes=tileset.bytes,
        first_bytes=tileset.bytes + first,
        splats=sum(chunk.count for chunk in chunks.values()),
        tiles=len(chunks),
        levels=[_tile_level(tileset, chunks, numbers) for numbers in by_depth],
        tilesets=len(tileset.heads),
        geometric_error=float(error) if isinstance(error, (int, float)) else None,
        tile_splats=quantiles_of([chunk.count for chunk in chunks.values()] or [0]),
        file_bytes=ChunkBytes.of(sizes),
        georeference=_place(tileset),
    )


def _tile_level(tileset: Tileset, chunks: Mapping[int, Chunk], numbers: Sequence[int]) -> TileLevelFacts:
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
    """Return the place on the Earth to which the root's transform moves the origin; None if it is not on the Earth."""
    matrix = tilesets.matrix_of(tileset.tiles[0].record)
    if float(np.linalg.norm(matrix[:3, 3])) < ON_EARTH:
        return None
    found = place_of(tuple(matrix.T.ravel().tolist()))
    latitude, longitude = round(found.latitude, 9) + 0.0, round(found.longitude, 9) + 0.0  # no -0
    return EarthPlace(latitude, longitude, round(found.height, 4) + 0.0, round(found.heading, 6) % 360)
