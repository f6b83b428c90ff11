"""Reads RAD files, whole, chunk after chunk, or a single chunk."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...model.lod_tree import LodTree
from ...model.scene import FileCoding, ScaleCoding, Scene
from ...model.sh import COEFFICIENTS
from ...model.splats import COLUMNS, FloatArray, Splats
from ...model.streams import SceneStream
from ...support.defaults import MAX_SH_DEGREE
from ...support.errors import HasTreeError
from ...support.parallel import ordered_map
from ...support.progress import Progress, silent
from .. import compression
from ..content import HAS_TREE, Scratch, rows_in
from ..promises import check, error_of
from ..sound import with_sound_tree
from ..stream import size_of
from . import promises
from .decoding import Packed, fill
from .header import read_chunk_header, read_header
from .layout import BY_NAME
from .places import Beside, bytes_of, file_of, size_beside, start_of
from .records import RadChunkEntry, RadChunkHeader, RadHeader


def decode(file: BinaryIO, *, threads: int = 1, progress: Progress = silent, beside: Beside | None = None) -> Scene:
    """Reads a RAD file, whole or with chunks in files of their own.

    Args:
        file: the header's.
        threads: to decode with.
        progress: told of the splats.
        beside: opens the files that the header names; None if there are none to open.

    Raises:
        FormatError: the file is not RAD, cut short or corrupt, breaks a promise of `promises` that is fatal, or has
            a broken tree; a file that it names is missing or damaged.
    """
    return with_sound_tree(examine(file, threads=threads, progress=progress, beside=beside))


def examine(
    file: BinaryIO,
    *,
    columns: Collection[str] = COLUMNS,
    threads: int = 1,
    progress: Progress = silent,
    beside: Beside | None = None,
) -> Scene:
    """Reads a file for inspection: the given columns of `Splats`, the others are 0; its tree may be broken.

    The header of the scene has the number of chunks, their size in splats, whether they are files of their own, and
    the number of codes of SH where there is a palette.

    Raises:
        FormatError: as `decode`, but not for a broken tree.
    """
    header = checked_header(file, beside)
    make = Splats.empty if set(COLUMNS) <= set(columns) else Splats.zeros
    splats, tree = make(header.count, header.max_sh), None
    if header.lod_tree:
        tree = LodTree(np.empty(header.count, np.uint16), np.empty(header.count, np.uint32))
    chunks = chunks_of(file, header, beside, range(len(header.chunks)))
    first = next(chunks, None)
    palette = first.palette(header) if first is not None else None

    codings: list[ScaleCoding] = [ScaleCoding()] * max(len(header.chunks), 1)

    def run(packed: Packed) -> int:
        codings[packed.number] = packed.scale_coding()
        part = slice(packed.header.base, packed.header.base + packed.header.count)
        nodes = None if tree is None else LodTree(tree.child_count[part], tree.child_start[part])
        fill_known(packed, header, rows_in(splats, part), nodes, palette, columns)
        return part.stop

    def all_chunks() -> Iterator[Packed]:
        if first is not None:
            yield first
            yield from chunks

    for done in ordered_map(run, all_chunks(), threads):
        progress("reading", done, header.count, "splat")
    sizes = tuple(entry.bytes for entry in header.chunks)
    facts = facts_of(header, palette)
    coding = coding_of(header, codings)
    noted, name = header.noted, name_of(header)
    return Scene(splats, tree, noted.antialiased, name, noted.problems, facts, sizes, coding, noted.up)


def stream(
    file: BinaryIO,
    *,
    scratch: Scratch,
    threads: int = 1,
    progress: Progress = silent,
    beside: Beside | None = None,
) -> SceneStream:
    """The splats of a file without a tree, chunk after chunk.

    Raises:
        HasTreeError: it has a tree.
        FormatError: as `decode`; what is wrong with a chunk, when it is read.
    """
    header = checked_header(file, beside)
    if header.lod_tree:
        raise HasTreeError(HAS_TREE)
    first = next(chunks_of(file, header, beside, range(min(1, len(header.chunks)))), None)
    palette = first.palette(header) if first is not None else None

    def read(start: int, stop: int) -> Iterator[Splats]:
        def run(packed: Packed) -> Splats:
            base, count = packed.header.base, packed.header.count
            splats = Splats.empty(count, header.max_sh)
            fill_known(packed, header, splats, None, palette, COLUMNS)
            part = slice(max(start - base, 0), min(stop - base, count))
            return splats if part == slice(0, count) else splats.take(part)

        if start < stop:
            numbers = range(start // header.chunk_size, -(-stop // header.chunk_size))
            yield from ordered_map(run, chunks_of(file, header, beside, numbers), threads)

    facts = facts_of(header, palette)
    noted, name = header.noted, name_of(header)
    about = noted.antialiased, name, noted.problems, facts, noted.up
    return SceneStream(header.count, header.max_sh, read, *about)


def checked_header(file: BinaryIO, beside: Beside | None) -> RadHeader:
    """The header of a file that keeps the promises of its header, as far as they are fatal."""
    size = size_of(file)
    header = read_header(file)
    files = {name: size_beside(name, beside) for name in header.filenames}
    check(promises.violations(header, size, files))
    _check_promise(header.count, header, size + sum(files.values()))
    return header


def facts_of(header: RadHeader, palette: FloatArray | None) -> dict[str, int]:
    """What `Scene.header` has of a file."""
    facts = {"version": 1, "chunks": len(header.chunks), "chunk_size": header.chunk_size}
    facts |= {"header_bytes": header.bytes, "chunked": int(header.chunked)}
    return facts | ({"sh_codes": len(palette)} if palette is not None else {})


def coding_of(header: RadHeader, scales: Sequence[ScaleCoding]) -> FileCoding:
    """How a file holds its scales, of those of its chunks, or of a single chunk."""
    found = header.encoding
    ranges = None if found is None else (found.ln_scale_min, found.ln_scale_max)
    return FileCoding(tuple(scales), header.chunk_size, ranges)


def fill_known(
    packed: Packed,
    header: RadHeader,
    splats: Splats,
    tree: LodTree | None,
    palette: FloatArray | None,
    columns: Collection[str],
    *,
    thorough: bool = True,
) -> None:
    """Decodes a chunk of a file whose palette is known, if it has one: as `decoding.fill`, but labels need one."""
    if fill(packed, header, splats, tree, palette, columns, thorough=thorough) is not None:
        text = f"chunk {packed.number:,} has labels of SH, but there is no palette"
        raise error_of("rad.palette", text)


def name_of(header: RadHeader) -> str:
    """The format of a file for people, as `Scene.format` has it."""
    return "RAD" + " LoD" * header.lod_tree


@dataclass(frozen=True, eq=False)
class RadChunk:
    """One chunk of a file.

    Attributes:
        header: its own.
        splats: of the chunk; SH are 0 where they are labels and the palette is not known.
        tree: the columns of its nodes, whose children have the numbers of the file; None where there is no tree.
        palette: (codes, K, 3) SH coefficients, of the first chunk of a file that has some.
        labels: (N,) into the palette, where that is not known.
    """

    header: RadChunkHeader
    splats: Splats
    tree: LodTree | None
    palette: FloatArray | None
    labels: NDArray[np.uint32] | None


def read_chunk(file: BinaryIO, entry: RadChunkEntry, header: RadHeader, palette: FloatArray | None = None) -> RadChunk:
    """Reads one chunk, and nothing but its bytes.

    Args:
        file: that of the header, or the chunk's own where the entry names one.
        entry: one of the header's.
        header: of the file, see `header.read_header`.
        palette: that of the file's first chunk; labels stay labels without.

    Raises:
        FormatError: the chunk is cut short, corrupt, or not the one that the header means.
        ValueError: the palette is of another SH degree than the file.
    """
    room = COEFFICIENTS[min(header.max_sh, MAX_SH_DEGREE)], 3
    if palette is not None and np.shape(palette)[1:] != room:
        raise ValueError(f"the palette has the shape {np.shape(palette)}; that of this file has (codes, {room[0]}, 3)")
    check(promises.violations(header))
    packed = Packed.of(bytes_of(entry, header, file), header.chunks.index(entry), header)
    count = packed.header.count
    _check_promise(count, header, entry.bytes)
    own = packed.palette(header)
    palette = own if own is not None or palette is None else np.asarray(palette, np.float32)
    splats, tree = Splats.empty(count, header.max_sh), None
    if header.lod_tree:
        tree = LodTree(np.empty(count, np.uint16), np.empty(count, np.uint32))
    labels = fill(packed, header, splats, tree, palette, COLUMNS)
    if labels is not None:
        splats.sh[:] = 0
    return RadChunk(packed.header, splats, tree, own, labels)


def chunks_of(file: BinaryIO, header: RadHeader, beside: Beside | None, numbers: range) -> Iterator[Packed]:
    """Chunks in order, read when they are asked for."""
    for number in numbers:
        entry = header.chunks[number]
        with file_of(entry, file, beside) as source:
            data = bytes_of(entry, header, source)
        yield Packed.of(data, number, header)


def count_leaves(file: BinaryIO, header: RadHeader, beside: Beside | None) -> int:
    """Return the number of leaves of a tree, of which only the numbers of children are read.

    Args:
        file: that of the header.
        header: of a tree.
        beside: opens the files that the header names; None if there are none to open.

    Raises:
        FormatError: a chunk is cut short, corrupt, or not the one that the header means.
    """
    leaves = 0
    for number, entry in enumerate(header.chunks):
        with file_of(entry, file, beside) as source:
            start = start_of(entry, header)
            source.seek(start)
            chunk = read_chunk_header(source)
            check(promises.chunk_violations(header, number, chunk, entry.bytes))
            leaves += chunk.count
            for each in chunk.properties:
                if each.name == "child_count":
                    source.seek(start + chunk.bytes + each.offset)
                    packed = Packed(number, chunk, memoryview(source.read(each.bytes)))
                    children = packed.values(replace(each, offset=0), BY_NAME[each.name], chunk.count)
                    leaves -= int(np.count_nonzero(children))
    return leaves


def _check_promise(count: int, header: RadHeader, size: int) -> None:
    """Raises `PromiseError` if a file or a chunk of this size can hardly have so many splats."""
    compression.check_promise(count * 4 * (14 + 3 * COEFFICIENTS[header.max_sh]), size)
