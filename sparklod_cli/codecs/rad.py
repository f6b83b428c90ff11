"""RAD, the file of Spark 2 whose Level-of-Detail tree a viewer streams in chunks of 65,536 nodes.

A file is a header and its chunks, or a header that names a file for each chunk; `docs/formats.md` lays them out.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..model.lod_tree import LodTree
from ..model.scene import Scene
from ..model.sh import COEFFICIENTS
from ..model.splats import COLUMNS, FloatArray, Splats
from ..support.errors import FormatError, NotSplatsError, TreeError, TruncatedError
from ..support.parallel import ordered_map
from ..support.progress import Progress, silent
from . import compression, rad_promises
from .rad_decode import Packed, fill
from .rad_header import CHUNK_MAGIC, ChunkEntry, ChunkHeader, Header, read_header
from .stream import size_of

#: Opens a file that a header names.
Beside = Callable[[str], BinaryIO]


def decode(file: BinaryIO, *, threads: int = 1, progress: Progress = silent, beside: Beside | None = None) -> Scene:
    """Reads a RAD file, whole or with chunks in files of their own.

    Args:
        file: the header's.
        threads: to decode with.
        progress: told of the splats.
        beside: opens the files that the header names; None if there are none to open.

    Raises:
        FormatError: the file is not RAD, cut short or corrupt, breaks a promise of `rad_promises` that is fatal, or has
            a broken tree; a file that it names is missing or damaged.
    """
    scene = examine(file, threads=threads, progress=progress, beside=beside)
    if scene.tree is not None:
        try:
            scene.tree.validate()
        except TreeError as error:
            raise FormatError(f"its Level-of-Detail tree is broken: {error}") from error
    return scene


def examine(
    file: BinaryIO,
    *,
    columns: Collection[str] = COLUMNS,
    threads: int = 1,
    progress: Progress = silent,
    beside: Beside | None = None,
) -> Scene:
    """Reads a file for inspection: the given columns of `Splats`, the others are 0; its tree may be broken.

    The header of the scene has the number of chunks, their size in splats, and the number of codes of SH.

    Raises:
        FormatError: as `decode`, but not for a broken tree.
    """
    size = size_of(file)
    _refuse_chunk(file)
    header = read_header(file)
    files = _sizes_beside(header, beside)
    rad_promises.check(rad_promises.violations(header, size, files))
    _check_promise(header.count, header, size + sum(files.values()))
    make = Splats.empty if set(COLUMNS) <= set(columns) else Splats.zeros
    splats, tree = make(header.count, header.max_sh), None
    if header.lod_tree:
        tree = LodTree(np.empty(header.count, np.uint16), np.empty(header.count, np.uint32))
    chunks = _chunks(file, header, beside)
    first = next(chunks, None)
    palette = first.palette(header) if first is not None else None

    def run(packed: Packed) -> int:
        start, stop = packed.header.base, packed.header.base + packed.header.count
        part = _rows(splats, tree, slice(start, stop))
        if fill(packed, header, *part, palette, columns) is not None:
            raise FormatError(f"chunk {packed.number:,} has labels of SH, but there is no palette")
        return stop

    def all_chunks() -> Iterator[Packed]:
        if first is not None:
            yield first
            yield from chunks

    for done in ordered_map(run, all_chunks(), threads):
        progress("reading", done, header.count, "splat")
    facts = {"version": 1, "chunks": len(header.chunks), "chunk_size": header.chunk_size}
    facts |= {"header_bytes": header.bytes}
    facts |= {"sh_codes": len(palette)} if palette is not None else {}
    name = "RAD" + " LoD" * (tree is not None)
    return Scene(splats, tree, format=name, header=facts, chunk_bytes=tuple(entry.bytes for entry in header.chunks))


@dataclass(frozen=True, eq=False)
class Chunk:
    """One chunk of a file.

    Attributes:
        header: its own.
        splats: of the chunk; SH are 0 where they are labels and the palette is not known.
        tree: the columns of its nodes, whose children have the numbers of the file; None where there is no tree.
        palette: (codes, K, 3) SH coefficients, of the first chunk of a file that has some.
        labels: (N,) into the palette, where that is not known.
    """

    header: ChunkHeader
    splats: Splats
    tree: LodTree | None
    palette: FloatArray | None
    labels: NDArray[np.uint32] | None


def read_chunk(file: BinaryIO, entry: ChunkEntry, header: Header, palette: FloatArray | None = None) -> Chunk:
    """Reads one chunk, and nothing but its bytes.

    Args:
        file: that of the header, or the chunk's own where the entry names one.
        entry: one of the header's.
        header: of the file, see `rad_header.read_header`.
        palette: that of the file's first chunk; labels stay labels without.

    Raises:
        FormatError: the chunk is cut short, corrupt, or not the one that the header means.
    """
    rad_promises.check(rad_promises.violations(header))
    packed = Packed.of(_bytes_of(file, entry, header), header.chunks.index(entry), header)
    count = packed.header.count
    _check_promise(count, header, entry.bytes)
    own = packed.palette(header)
    palette = own if own is not None else palette
    splats, tree = Splats.empty(count, header.max_sh), None
    if header.lod_tree:
        tree = LodTree(np.empty(count, np.uint16), np.empty(count, np.uint32))
    labels = fill(packed, header, splats, tree, palette, COLUMNS)
    if labels is not None:
        splats.sh[:] = 0
    return Chunk(packed.header, splats, tree, own, labels)


def _refuse_chunk(file: BinaryIO) -> None:
    if file.read(len(CHUNK_MAGIC)) == CHUNK_MAGIC:
        raise NotSplatsError("it is one chunk of a RAD file; give the .rad file beside it, which names all chunks")
    file.seek(0)


def _sizes_beside(header: Header, beside: Beside | None) -> dict[str, int]:
    """Sizes of the files that a header names.

    Raises:
        FormatError: one cannot be opened.
    """
    sizes = {}
    for name in dict.fromkeys(entry.filename for entry in header.chunks):
        if name is not None:
            with _open(name, beside) as file:
                sizes[name] = size_of(file)
    return sizes


def _open(name: str, beside: Beside | None) -> BinaryIO:
    if beside is None:
        raise FormatError("its chunks are in files beside it; give it as a file in their folder")
    return beside(name)


def _chunks(file: BinaryIO, header: Header, beside: Beside | None) -> Iterator[Packed]:
    """The chunks in order, read when they are asked for."""
    for number, entry in enumerate(header.chunks):
        with contextlib.ExitStack() as stack:
            where = file if entry.filename is None else stack.enter_context(_open(entry.filename, beside))
            data = _bytes_of(where, entry, header)
        yield Packed.of(data, number, header)


def _bytes_of(file: BinaryIO, entry: ChunkEntry, header: Header) -> bytes:
    start = entry.offset + (header.bytes if entry.filename is None else 0)
    lacking = start + entry.bytes - size_of(file)
    if lacking > 0:  # before so much memory is asked for
        raise TruncatedError(f"cut short: {lacking:,} of {entry.bytes:,} bytes of a chunk are missing")
    file.seek(start)
    return file.read(entry.bytes)


def _check_promise(count: int, header: Header, size: int) -> None:
    """Raises `PromiseError` if a file or a chunk of this size can hardly have so many splats."""
    compression.check_promise(count * 4 * (14 + 3 * COEFFICIENTS[header.max_sh]), size)


def _rows(splats: Splats, tree: LodTree | None, part: slice) -> tuple[Splats, LodTree | None]:
    """Views of some rows."""
    views = Splats(**{name: getattr(splats, name)[part] for name in COLUMNS})
    return views, None if tree is None else LodTree(tree.child_count[part], tree.child_start[part])
