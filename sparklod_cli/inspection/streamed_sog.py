"""Facts of a Streamed SOG that its manifest and the headers of its chunk files tell, and findings about both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import BinaryIO

from ..codecs.merging import Chunk
from ..codecs.reader import OpenCompanion, size_of
from ..codecs.streamed_sog.manifest import VERSION, Manifest, ManifestNode
from ..codecs.streamed_sog.manifest_rules import level_counts, scan_files, scan_splats
from ..system.printable import MOST, printable
from ..system.progress import Progress, silent
from ..system.untrusted import LARGEST
from .findings import ChunkBytes, Head, HeaderScan, quantiles_of
from .values import Box


@dataclass(frozen=True)
class LevelFacts:
    """A detail level, see `schema.json`."""

    splats: int
    share: float | None
    regions: int
    files: int
    bytes: int
    errors: dict[str, float] | None


@dataclass(frozen=True)
class EnvironmentFacts:
    """The splats that are drawn whatever the detail levels are: how many, and the bytes of their files."""

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


def survey(
    file: BinaryIO, open_companion: OpenCompanion, *, check: bool, threads: int = 1, progress: Progress = silent
) -> HeaderScan:
    """Read a manifest and the headers of its chunk files.

    Args:
        check: decode the chunk files and look at their splats, too.

    Raises:
        FormatError: the manifest cannot be parsed.
    """
    size = size_of(file)
    manifest, files, violations = scan_files(file, open_companion)
    if any(each.fatal for each in violations):
        return HeaderScan("streamed_sog", violations)
    if check:
        violations += scan_splats(open_companion, manifest, files, threads=threads, progress=progress)
    chunks = {name: chunk for name, chunk in files.items() if isinstance(chunk, Chunk)}
    facts = _facts(manifest, chunks, size)
    return HeaderScan("streamed_sog", violations, _head(manifest, chunks, facts), facts)


def _head(manifest: Manifest, chunks: Mapping[str, Chunk], facts: StreamedSogFacts) -> Head:
    """Return what a reader of level 0 and the environment finds."""
    read = [chunks[name] for name in _names_of(manifest, 0)]
    count = facts.levels[0].splats
    if manifest.environment is not None:
        read.append(chunks[manifest.environment])
        count += chunks[manifest.environment].count
    degree = max((chunk.sh_degree for chunk in read), default=0)
    antialiased = any(chunk.antialiased for chunk in read)
    return Head(f"Streamed SOG {VERSION}", facts.bytes, count, degree, antialiased, manifest.noted.up)


def _names_of(manifest: Manifest, level: int) -> list[str]:
    """Return the chunk files with splats of a level."""
    held = {node.runs[level].file for _, node in manifest.regions() if node.runs and _count(node, level)}
    return [manifest.filenames[number] for number in sorted(held)]


def _facts(manifest: Manifest, chunks: Mapping[str, Chunk], size: int) -> StreamedSogFacts:
    counts = level_counts(manifest)
    levels = [_level(manifest, chunks, level, counts) for level in range(manifest.levels)]
    environment = None
    if manifest.environment is not None:
        chunk = chunks[manifest.environment]
        environment = EnvironmentFacts(chunk.count, chunk.bytes)
    beyond = 0 if environment is None else environment.bytes
    sizes = [chunks[name].bytes for name in manifest.filenames]
    asset = manifest.head.get("asset")
    generator = asset.get("generator") if isinstance(asset, dict) else None
    regions = [node for _, node in manifest.regions()]
    edges = [max(map(_edge, *node.bound)) for node in regions if node.bound is not None]
    full = [_count(node, 0) for node in regions]
    bound = manifest.nodes[0].bound
    assert bound is not None
    return StreamedSogFacts(
        generator=printable(" ".join(generator.split()), MOST) if isinstance(generator, str) else None,
        bytes=size + sum(sizes) + beyond,
        manifest_bytes=size,
        first_bytes=size + levels[-1].bytes + beyond,
        splats=sum(counts),
        levels=levels,
        regions=len(regions),
        depth=_depth(manifest),
        region_splats=quantiles_of(full),
        region_edge=quantiles_of(edges),
        bound=Box(list(bound[0]), list(bound[1])),
        files=len(sizes),
        file_bytes=ChunkBytes.of(sizes),
        environment=environment,
    )


def _level(manifest: Manifest, chunks: Mapping[str, Chunk], level: int, counts: Sequence[int]) -> LevelFacts:
    names = _names_of(manifest, level)
    held = [node for _, node in manifest.regions() if _count(node, level)]
    errors = [node.errors[level] for node in held if node.errors is not None]
    weights = [_count(node, 0) for node in held]
    known = bool(errors) and len(errors) == len(held) and any(weights)
    return LevelFacts(
        splats=counts[level],
        share=round(counts[level] / counts[0], 4) if counts[0] else None,
        regions=len(held),
        files=len(names),
        bytes=sum(chunks[name].bytes for name in names),
        errors=quantiles_of(errors, weights) if known else None,
    )


def _count(node: ManifestNode, level: int) -> int:
    """Return the splats of a region at a level."""
    return node.runs[level].count if node.runs and level in node.runs else 0


def _depth(manifest: Manifest) -> int:
    """Edges to the deepest node; each node comes after its parent."""
    depths = [0] * len(manifest.nodes)
    for number, node in enumerate(manifest.nodes[1:], 1):
        depths[number] = depths[node.parent] + 1
    return max(depths)


def _edge(low: float, high: float) -> float:
    """Return the length between two numbers, which are finite but may be as large as numbers are."""
    return min(max(high - low, -LARGEST), LARGEST)
