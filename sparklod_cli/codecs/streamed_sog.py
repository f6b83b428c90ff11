"""Streamed SOG: a manifest, lod-meta.json, and unpacked SOG scenes beside it, each with runs of one detail level.

Read as a scene, it is full detail, level 0, and the environment; `decode_parts` reads all levels.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..model import morton
from ..model.instances import Bounds, Counts, DetailScene
from ..model.scene import Scene, facts_of
from ..system.errors import FormatError
from ..system.progress import Progress, silent
from ..system.threads import ordered_map
from ..system.units import count_of
from ..system.untrusted import quoted_value
from . import quantize, sog
from .format_rules import check_rules, error_of
from .formats import ENVIRONMENT_FILE, MANIFEST, META, WriteOptions
from .merging import Chunk
from .reader import OpenCompanion, OpenFile, Reader, note_of
from .streamed_manifest import (
    MAX_MANIFEST,
    VERSION,
    Bound,
    Manifest,
    ManifestNode,
    Run,
    chunk_files,
    parse,
    run_violations,
    serialise,
    violations,
)

Index = NDArray[np.int64]


def open_content(source: OpenFile) -> Reader:
    """Open level 0, chunk after chunk, and then the environment; reading blocks keeps one chunk in memory."""
    return _open(source, full_detail=True)[1]


def decode_parts(
    file: BinaryIO, *, threads: int = 1, progress: Progress = silent, open_companion: OpenCompanion | None = None
) -> DetailScene:
    """Read all detail levels; regions are in the order of the tree."""
    layout, content = _open(OpenFile(file, open_companion, threads=threads), full_detail=False)
    regions = [node for _, node in layout.manifest.regions()]
    bounds, children = np.array([node.bound for node in regions], np.float64), layout.children()
    has_errors = all(node.errors is not None for node in regions)
    errors = np.array([node.errors for node in regions], np.float64) if has_errors else None
    scene, environment = replace(content, threads=threads).scene(progress=progress), None
    splats = scene.splats
    if layout.manifest.environment is not None:
        total = int(layout.counts.sum())
        splats, environment = splats.take(slice(0, total)), splats.take(slice(total, None))
    return DetailScene(splats, layout.counts, bounds, children, errors, environment, **facts_of(scene))


@dataclass(frozen=True, eq=False)
class RegionLayout:
    """Manifest as arrays: R regions in the order of the tree, L detail levels.

    Attributes:
        file, offset, count, level, region: (n,) columns of the runs that are not empty, in the order of files and
            offsets.
        counts: (R, L) splats of each region at each level.
    """

    manifest: Manifest
    file: Index
    offset: Index
    count: Index
    level: Index
    region: Index
    counts: Counts

    def children(self) -> Index:
        """Return the binary tree over the regions as (R - 1, 2) `DetailScene.children`."""
        nodes = self.manifest.nodes
        numbers = np.empty(len(nodes), np.int64)
        inner = [number for number, node in enumerate(nodes) if node.children]
        numbers[inner] = np.arange(len(inner))
        numbers[[number for number, _ in self.manifest.regions()]] = -1 - np.arange(len(self.counts))
        return numbers[np.array([nodes[number].children for number in inner], np.int64).reshape(-1, 2)]


def layout_of(manifest: Manifest) -> RegionLayout:
    """Return the layout of a manifest whose runs lie end to end in their files."""
    regions = [node.runs or {} for _, node in manifest.regions()]
    rows = [
        (run.file, run.offset, run.count, level, region)
        for region, runs in enumerate(regions)
        for level, run in runs.items()
        if run.count
    ]
    table = np.array(rows, np.int64).reshape(-1, 5)
    file, offset, count, level, region = np.ascontiguousarray(table[np.lexsort((table[:, 1], table[:, 0]))].T)
    counts = np.zeros((len(regions), manifest.levels), np.int64)
    counts[region, level] = count
    return RegionLayout(manifest, file, offset, count, level, region, counts)


def _open(source: OpenFile, *, full_detail: bool) -> tuple[RegionLayout, Reader]:
    """Read a manifest, and open its chunks: those of level 0, or all."""
    beside, manifest = chunk_files(source.open_companion), parse(source.file.read(MAX_MANIFEST + 1))
    check_rules(run_violations(manifest) if full_detail else violations(manifest))
    layout = layout_of(manifest)
    if full_detail:
        chosen = layout.level == 0
        rows = np.cumsum(layout.count * chosen) - layout.count
    else:  # level after level, as in a `DetailScene`
        chosen, flat = np.ones(len(layout.level), np.bool_), layout.counts.T.ravel()
        rows = (np.cumsum(flat) - flat)[layout.level * len(layout.counts) + layout.region]
    files, first = np.unique(layout.file, return_index=True)
    chunks = dict[str, Chunk]()
    for file, own in zip(files.tolist(), np.split(np.arange(len(rows)), first[1:]), strict=False):
        read = own[chosen[own]]
        if not len(read):
            continue
        name = manifest.filenames[file]
        if name in chunks:
            raise FormatError(f"{MANIFEST} names {quoted_value(name)} twice")
        pieces = np.stack([layout.offset[read], layout.count[read], rows[read]], axis=1).tolist()
        chunk = chunks[name] = beside.open(name, [(offset, count, row) for offset, count, row in pieces])
        if chunk.count != (expected := int(layout.count[own].sum())):
            text = f"{quoted_value(name)} has {count_of(chunk.count, 'splat')}"
            raise error_of("streamed-sog.runs", f"{text}, but its runs in {MANIFEST} have {expected:,}")
    if not chunks:
        raise FormatError(f"{MANIFEST} has no splats of {'level 0' if full_detail else 'any level'}")
    every, note = list(chunks.values()), manifest.noted
    if manifest.environment is not None:
        every.append(beside.open(manifest.environment, row=sum(chunk.rows for chunk in every)))
    regions, levels = layout.counts.shape
    header = {"version": VERSION, "levels": levels, "regions": regions}
    form, notes = f"Streamed SOG {VERSION}", note.problems
    return layout, replace(beside.reader(every, form, header, source.size, notes, source.threads), up=note.up)


#: Chunks that are encoded at a time: each takes some 0.5 KB a splat with SH of degree 2, measured.
TOGETHER = 2


class ChunkPlan(NamedTuple):
    """Chunk to write: its folder, the detail level of its runs, and their consecutive regions."""

    folder: str
    level: int
    regions: range


def encode_files(
    scene: DetailScene,
    options: WriteOptions,
    chunk_splats: int,
    extent: float,
    min_splats: int,
    *,
    threads: int = 1,
    progress: Progress = silent,
) -> Iterator[tuple[str, Iterable[bytes]]]:
    """Yield the files of a scene by path ("0_0/meta.json"); lod-meta.json comes last.

    Within a run, splats are in Morton order. The bytes are the same for any number of threads.

    Args:
        chunk_splats: a chunk ends when it has more splats.
        extent: longest side of undivided regions in world units, for the manifest.
        min_splats: number of splats below which a region is not divided for its extent, for the manifest.

    Raises:
        FormatError: SOG cannot hold the splats, or float32, as viewers have it, not the bounds of the regions.
    """
    reach = float(np.abs(scene.bounds).max())
    if reach > float(quantize.LARGEST):
        raise FormatError(
            f"its regions reach {reach:.3g}, and viewers hold at most {quantize.LARGEST:.3g}; scale it down"
        )
    plans = _planned(scene, chunk_splats)
    total = len(scene.splats) + (0 if scene.environment is None else len(scene.environment))
    together = min(threads, TOGETHER)

    def encoded(plan: ChunkPlan | None) -> tuple[int, list[tuple[str, bytes]]]:
        """Return the number of splats and the files of a chunk; of the environment for None."""
        inside = max(1, threads // together)
        if plan is None:
            assert scene.environment is not None
            one = Scene(scene.environment, antialiased=scene.antialiased, up=scene.up)
            return len(one), [(ENVIRONMENT_FILE, b"".join(sog.encode(one, options, threads=inside)))]
        runs = (scene.run(region, plan.level) for region in plan.regions)
        index = [run.start + morton.order(scene.splats.center[run]) for run in runs if run.start < run.stop]
        one = Scene(scene.splats.take(np.concatenate(index)), antialiased=scene.antialiased, up=scene.up)
        files = sog.encode_files(one, options, threads=inside, in_order=True)
        return len(one), [(f"{plan.folder}/{name}", data) for name, data in files]

    done = 0
    for count, files in ordered_map(encoded, [*plans, *([] if scene.environment is None else [None])], together):
        for name, data in files:
            yield name, [data]
        done += count
        progress("writing", done, total, "splat")
    asset = {
        "chunkGaussians": chunk_splats,
        "chunkExtent": int(extent) if extent == int(extent) else extent,
        "chunkMinGaussians": min_splats,
    }
    yield MANIFEST, [serialise(_manifest_of(scene, plans, asset))]


def _planned(scene: DetailScene, chunk_splats: int) -> list[ChunkPlan]:
    """Divide the runs of each level into chunks, region by region, until a chunk is large enough."""
    plans = list[ChunkPlan]()
    for level in range(scene.levels):
        number = first = size = 0
        for region in range(scene.regions):
            size += int(scene.counts[region, level])
            if size > chunk_splats or (size and region == scene.regions - 1):
                plans.append(ChunkPlan(f"{level}_{number}", level, range(first, region + 1)))
                number, first, size = number + 1, region + 1, 0
    return plans


def _manifest_of(scene: DetailScene, plans: list[ChunkPlan], asset: dict[str, Any]) -> Manifest:
    runs: list[dict[int, Run]] = [{} for _ in range(scene.regions)]
    for number, plan in enumerate(plans):
        offset = 0
        for region in plan.regions:
            count = int(scene.counts[region, plan.level])
            if count:
                runs[region][plan.level] = Run(number, offset, count)
            offset += count
    counts = scene.counts.sum(axis=0).tolist()
    head = {
        "version": VERSION,
        "asset": note_of(up=scene.up) | asset,
        "count": sum(counts),
        "counts": counts,
        "lodErrors": scene.errors is not None,
    }
    environment = None if scene.environment is None else ENVIRONMENT_FILE
    filenames = tuple(f"{plan.folder}/{META}" for plan in plans)
    return Manifest(scene.levels, filenames, tuple(_nodes(scene, runs)), environment, head)


def _nodes(scene: DetailScene, runs: list[dict[int, Run]]) -> list[ManifestNode]:
    """Return the tree of a scene, depth first; the bound of an inner node is the union of its children's."""
    corners = np.empty((len(scene.children), 2, 3))
    for place in reversed(range(len(corners))):  # children come after their parents
        below = [corners[child] if child >= 0 else scene.bounds[-1 - child] for child in scene.children[place]]
        corners[place] = np.minimum(below[0][0], below[1][0]), np.maximum(below[0][1], below[1][1])
    nodes, children = list[ManifestNode](), list[list[int]]()
    waiting = [(0 if len(scene.children) else -1, -1)]
    while waiting:
        place, parent = waiting.pop()
        if parent >= 0:
            children[parent].append(len(nodes))
        number = len(nodes)
        children.append([])
        if place < 0:
            region = -1 - place
            errors = None if scene.errors is None else scene.errors[region].tolist()
            nodes.append(ManifestNode(_bound(scene.bounds[region]), (), runs[region], errors, parent))
        else:
            nodes.append(ManifestNode(_bound(corners[place]), (), None, None, parent))
            waiting += [(int(child), number) for child in scene.children[place][::-1]]
    return [replace(node, children=tuple(below)) for node, below in zip(nodes, children, strict=True)]


def _bound(corners: Bounds) -> Bound:
    (a, b, c), (d, e, f) = corners.tolist()
    return (a, b, c), (d, e, f)
