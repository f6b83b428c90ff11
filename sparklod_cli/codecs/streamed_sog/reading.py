"""Reads Streamed SOG: full detail as a scene, whole or as a stream, or all detail levels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import BinaryIO

import numpy as np

from ...model.scene import DetailScene, Scene
from ...model.sh import COEFFICIENTS
from ...model.splats import Splats
from ...model.streams import BLOCK_SPLATS, SceneStream
from ...support.errors import FormatError
from ...support.progress import Progress, silent
from ...support.untrusted import quoted_value
from ..compression import check_promise
from ..content import Scratch
from ..noted import Noted
from ..promises import check
from ..stream import size_of
from .chunks import Beside, Chunk, Piece, check_count, filled, open_chunk
from .layout import Layout, layout_of
from .manifest import MAX_MANIFEST, VERSION, parse
from .names import MANIFEST
from .promises import run_violations, violations


def decode(file: BinaryIO, *, threads: int = 1, progress: Progress = silent, beside: Beside | None = None) -> Scene:
    """Reads level 0, chunk after chunk, and then the environment.

    Args:
        file: the manifest.
        threads: to decode with.
        progress: called when a chunk is decoded.
        beside: opens the files that a manifest names, which may be in folders; None if there are none to open.

    Raises:
        FormatError: it is no such manifest, a chunk is missing or no SOG, or the runs do not tile the chunks.
    """
    opened = _open(file, beside, full_detail=True)
    splats = filled(beside, opened.chunks, opened.sh_degree, threads, progress)
    return Scene(splats, None, *opened.about, up=opened.noted.up)


def decode_levels(
    file: BinaryIO, *, threads: int = 1, progress: Progress = silent, beside: Beside | None = None
) -> DetailScene:
    """Reads all detail levels, in whatever order the runs lie in the chunks; arguments as of `decode`.

    Regions are in the order of the tree, depth first.

    Raises:
        FormatError: as `decode`; also where another rule of `promises` is broken that is fatal.
    """
    opened = _open(file, beside, full_detail=False)
    layout = opened.layout
    bounds, children, errors = layout.bounds(), layout.children(), layout.errors()
    splats = filled(beside, opened.chunks, opened.sh_degree, threads, progress)
    environment = None
    if layout.manifest.environment is not None:
        total = int(layout.counts.sum())
        splats, environment = splats.take(slice(0, total)), splats.take(slice(total, None))
    return DetailScene(
        splats,
        layout.counts,
        bounds,
        children,
        errors,
        environment,
        *opened.about,
        opened.noted.up,
    )


def stream(
    file: BinaryIO,
    *,
    scratch: Scratch,
    threads: int = 1,
    progress: Progress = silent,
    beside: Beside | None = None,
) -> SceneStream:
    """The splats of `decode`, block by block; raises as that.

    Nothing is unpacked to `scratch`: one chunk at a time is in memory, until its last splat was read.
    """
    opened = _open(file, beside, full_detail=True)
    kept: dict[int, Splats] = {}

    def decoded(number: int) -> Splats:
        if number not in kept:
            kept.clear()
            chunk = opened.chunks[number]
            rows = np.cumsum([0, *(piece.count for piece in chunk.pieces)]).tolist()
            pieces = tuple(replace(piece, row=row) for piece, row in zip(chunk.pieces, rows, strict=False))
            kept[number] = filled(beside, [replace(chunk, pieces=pieces)], opened.sh_degree, threads, progress)
        return kept[number]

    def read(start: int, stop: int) -> Iterator[Splats]:
        end = 0
        for number, chunk in enumerate(opened.chunks):
            begin, end = end, end + chunk.rows
            for first in range(max(start, begin), min(stop, end), BLOCK_SPLATS):
                yield decoded(number).take(slice(first - begin, min(first + BLOCK_SPLATS, stop, end) - begin))
            if stop >= end:
                kept.pop(number, None)

    return SceneStream(opened.count, opened.sh_degree, read, *opened.about, opened.noted.up)


@dataclass(frozen=True, eq=False)
class _Opened:
    """A manifest, and the chunks that are wanted, each of whose meta.json has been read.

    Attributes:
        layout: of all detail levels.
        chunks: in the order of the files, the environment last.
        bytes: of the manifest and all files of these chunks.
    """

    layout: Layout
    chunks: tuple[Chunk, ...]
    bytes: int

    @property
    def count(self) -> int:
        """The splats that are wanted."""
        return sum(chunk.rows for chunk in self.chunks)

    @property
    def sh_degree(self) -> int:
        """The highest of the chunks."""
        return max(chunk.sh_degree for chunk in self.chunks)

    @property
    def antialiased(self) -> bool:
        """Whether the chunks are."""
        return any(chunk.antialiased for chunk in self.chunks)

    @property
    def noted(self) -> Noted:
        """Note of sparklod in the manifest."""
        return self.layout.manifest.noted

    @property
    def about(self) -> tuple[bool, str, tuple[str, ...], dict[str, int]]:
        """`antialiased`, `format`, `notes` and `header` of `Scene`."""
        return self.antialiased, f"Streamed SOG {VERSION}", self.noted.problems, self.header

    @property
    def header(self) -> dict[str, int]:
        """Numbers of the files for `Scene.header`."""
        regions, levels = self.layout.counts.shape
        return {"version": VERSION, "levels": levels, "regions": regions, "bytes": self.bytes}


def _open(source: BinaryIO, beside: Beside | None, *, full_detail: bool) -> _Opened:
    """A manifest and its chunks: those of level 0, or all."""
    size = size_of(source)
    manifest = parse(source.read(MAX_MANIFEST + 1))
    check(run_violations(manifest) if full_detail else violations(manifest))
    layout = layout_of(manifest)
    runs = layout.runs
    wanted = runs.level == 0 if full_detail else np.ones(len(runs.level), np.bool_)
    rows = np.cumsum(runs.count * wanted) - runs.count if full_detail else layout.starts()
    files, first = np.unique(runs.file, return_index=True)
    names, chunks = set[str](), list[Chunk]()
    ends = np.append(first[1:], len(runs.file))
    for file, begin, end in zip(files.tolist(), first.tolist(), ends.tolist(), strict=False):
        here = begin + np.flatnonzero(wanted[begin:end])
        if not len(here):
            continue
        name = manifest.filenames[file]
        if name in names:
            raise FormatError(f"{MANIFEST} names {quoted_value(name)} twice")
        names.add(name)
        pieces = [Piece(int(runs.offset[run]), int(runs.count[run]), int(rows[run])) for run in here]
        chunks.append(open_chunk(beside, name, pieces))
        check_count(chunks[-1], int(runs.count[begin:end].sum()))
    if not chunks:
        raise FormatError(f"{MANIFEST} has no splats of {'level 0' if full_detail else 'any level'}")
    if manifest.environment is not None:
        chunks.append(open_chunk(beside, manifest.environment, None, sum(chunk.rows for chunk in chunks)))
    opened = _Opened(layout, tuple(chunks), size + sum(chunk.bytes for chunk in chunks))
    check_promise(opened.count * 4 * (14 + 3 * COEFFICIENTS[opened.sh_degree]), opened.bytes)
    return opened
