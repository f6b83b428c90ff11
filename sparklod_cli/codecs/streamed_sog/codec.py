"""Streamed SOG: a manifest, lod-meta.json, and unpacked SOG scenes beside it, each with runs of one detail level.

As a scene it is full detail, level 0, and the environment; `decode_parts` reads all levels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...model.scene import Bounds, Counts, DetailScene, facts_of
from ...model.sh import width_of
from ...system.errors import FormatError
from ...system.progress import Progress, silent
from ...system.units import count_of
from ...system.untrusted import quoted_value
from ..compression import check_promise
from ..file_names import MANIFEST
from ..reader import OpenCompanion, OpenFile, Reader, size_of
from ..scene_files import Chunk, Piece
from ..validation import check_rules, error_of
from .manifest import MAX_MANIFEST, VERSION, Manifest, parse
from .manifest_rules import chunk_files, run_violations, violations
from .streamed_writer import encode_files as encode_files

Index = NDArray[np.int64]


def open_content(source: OpenFile) -> Reader:
    """Open level 0, chunk after chunk, and then the environment.

    Nothing is unpacked to `scratch`: where blocks are read, one chunk at a time stays in memory.

    Raises:
        FormatError: the file is no manifest, a chunk is missing or no SOG, or the runs do not tile the chunks.
    """
    return _open(source, full_detail=True)[1]


def decode_parts(
    file: BinaryIO, *, threads: int = 1, progress: Progress = silent, open_companion: OpenCompanion | None = None
) -> DetailScene:
    """Read all detail levels, in whatever order the runs lie in the chunks.

    Regions are in the order of the tree, depth first.

    Raises:
        FormatError: as `open_content`; also where another fatal rule of `manifest_rules` is broken.
    """
    layout, content = _open(OpenFile(file, open_companion, threads=threads), full_detail=False)
    bounds, children, errors = layout.bounds(), layout.children(), layout.errors()
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
        manifest: as parsed.
        file, offset, count, level, region: (n,) int64, of the runs that are not empty, in the order of the files, which
            they tile.
        counts: (R, L) splats of each region at each level.
    """

    manifest: Manifest
    file: Index
    offset: Index
    count: Index
    level: Index
    region: Index
    counts: Counts

    def starts(self) -> Counts:
        """Return (n,) the first splat of each run in a `DetailScene`, where they lie level after level."""
        flat = self.counts.T.ravel()
        before = np.cumsum(flat) - flat
        return before[self.level * len(self.counts) + self.region]

    def bounds(self) -> Bounds:
        """Return (R, 2, 3) lowest and highest corner of each region; all must have a bound."""
        return np.array([node.bound for _, node in self.manifest.regions()], np.float64)

    def children(self) -> Index:
        """Return (R - 1, 2) the tree as in `DetailScene`; it must be a binary one."""
        nodes = self.manifest.nodes
        numbers = np.empty(len(nodes), np.int64)
        inner = [number for number, node in enumerate(nodes) if node.children]
        numbers[inner] = np.arange(len(inner))
        numbers[[number for number, _ in self.manifest.regions()]] = -1 - np.arange(len(self.counts))
        return numbers[np.array([nodes[number].children for number in inner], np.int64).reshape(-1, 2)]

    def errors(self) -> NDArray[np.float64] | None:
        """Return (R, L) the error of each region at each level, as numbers; None unless all regions have some."""
        found = [node.errors for _, node in self.manifest.regions()]
        return None if None in found else np.array(found, np.float64)


def layout_of(manifest: Manifest) -> RegionLayout:
    """Return the layout of a manifest, whose runs must tile the files that they are in."""
    rows = [
        (run.file, run.offset, run.count, level, region)
        for region, (_, node) in enumerate(manifest.regions())
        for level, run in (node.runs or {}).items()
        if run.count
    ]
    table = np.array(rows, np.int64).reshape(-1, 5)
    file, offset, count, level, region = np.ascontiguousarray(table[np.lexsort((table[:, 1], table[:, 0]))].T)
    counts = np.zeros((sum(1 for _ in manifest.regions()), manifest.levels), np.int64)
    counts[region, level] = count
    return RegionLayout(manifest, file, offset, count, level, region, counts)


def _open(source: OpenFile, *, full_detail: bool) -> tuple[RegionLayout, Reader]:
    """Read a manifest, and open its chunks: those of level 0, or all."""
    size, beside = size_of(source.file), chunk_files(source.open_companion)
    manifest = parse(source.file.read(MAX_MANIFEST + 1))
    check_rules(run_violations(manifest) if full_detail else violations(manifest))
    layout = layout_of(manifest)
    chosen = layout.level == 0 if full_detail else np.ones(len(layout.level), np.bool_)
    rows = np.cumsum(layout.count * chosen) - layout.count if full_detail else layout.starts()
    files, first = np.unique(layout.file, return_index=True)
    names, chunks = set[str](), list[Chunk]()
    ends = np.append(first[1:], len(layout.file))
    for file, begin, end in zip(files.tolist(), first.tolist(), ends.tolist(), strict=False):
        here = begin + np.flatnonzero(chosen[begin:end])
        if not len(here):
            continue
        name = manifest.filenames[file]
        if name in names:
            raise FormatError(f"{MANIFEST} names {quoted_value(name)} twice")
        names.add(name)
        pieces = [Piece(int(layout.offset[run]), int(layout.count[run]), int(rows[run])) for run in here]
        chunks.append(beside.open(name, pieces))
        if chunks[-1].count != (expected := int(layout.count[begin:end].sum())):
            has = count_of(chunks[-1].count, "splat")
            text = f"{quoted_value(name)} has {has}, but its runs in {MANIFEST} have {expected:,}"
            raise error_of("streamed-sog.runs", text)
    if not chunks:
        raise FormatError(f"{MANIFEST} has no splats of {'level 0' if full_detail else 'any level'}")
    if manifest.environment is not None:
        chunks.append(beside.open(manifest.environment, row=sum(chunk.rows for chunk in chunks)))
    count, degree = sum(chunk.rows for chunk in chunks), max(chunk.sh_degree for chunk in chunks)
    size += sum(chunk.bytes for chunk in chunks)
    check_promise(count * 4 * width_of(degree), size)
    regions, levels = layout.counts.shape
    header = {"version": VERSION, "levels": levels, "regions": regions, "bytes": size}
    antialiased, note = any(chunk.antialiased for chunk in chunks), manifest.noted
    notes = dict.fromkeys((*note.problems, *(text for chunk in chunks for text in chunk.notes)))
    form = f"Streamed SOG {VERSION}"
    fill = beside.fill(chunks, degree, source.threads)
    return layout, Reader(count, degree, form, fill, antialiased, tuple(notes), header, note.up)
