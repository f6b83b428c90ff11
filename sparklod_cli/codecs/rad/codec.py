"""RAD, the file of Spark 2 whose Level-of-Detail tree a viewer streams in chunks of 65,536 nodes.

A file is a header and its chunks, or a header that names a file for each chunk; `docs/formats.md` lays them out.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...model.lod_tree import LodTree
from ...model.scene import Scene
from ...model.sh import COEFFICIENTS
from ...model.splats import COLUMNS, FloatArray, Splats
from ...model.streams import NodeStream
from ...support.defaults import MAX_SH_DEGREE
from ...support.parallel import ordered_map
from ...support.progress import Progress, silent
from .. import compression
from ..encoder import Kept, results, rows_of
from ..options import DEFAULTS, WriteOptions
from ..sound import with_sound_tree
from ..stream import size_of
from . import promises
from .decoding import Packed, fill
from .encoding import CHUNK, RadEncoder, encoder
from .header import read_header
from .options import needed as needed
from .options import settled as settled
from .places import Beside, bytes_of, file_of, size_beside
from .records import RadChunkEntry, RadChunkHeader, RadHeader

#: Bytes of chunks that wait in memory for their header; beyond, they wait on disk.
SPOOLED = 1 << 26


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
    size = size_of(file)
    header = read_header(file)
    files = {name: size_beside(name, beside) for name in header.filenames}
    promises.check(promises.violations(header, size, files))
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
        part = rows_of(splats, tree, slice(start, stop))
        if fill(packed, header, *part, palette, columns) is not None:
            text = f"chunk {packed.number:,} has labels of SH, but there is no palette"
            raise promises.error_of("rad.palette", text)
        return stop

    def all_chunks() -> Iterator[Packed]:
        if first is not None:
            yield first
            yield from chunks

    for done in ordered_map(run, all_chunks(), threads):
        progress("reading", done, header.count, "splat")
    facts = {"version": 1, "chunks": len(header.chunks), "chunk_size": header.chunk_size}
    facts |= {"header_bytes": header.bytes, "chunked": int(header.chunked)}
    facts |= {"sh_codes": len(palette)} if palette is not None else {}
    sizes = tuple(entry.bytes for entry in header.chunks)
    return Scene(splats, tree, header.antialiased, name_of(header), header=facts, chunk_bytes=sizes)


def name_of(header: RadHeader) -> str:
    """The format of a file for people, as `Scene.format` has it."""
    return "RAD" + " LoD" * header.lod_tree


def encode(
    scene: Scene | NodeStream,
    options: WriteOptions = DEFAULTS,
    *,
    threads: int = 1,
    progress: Progress = silent,
    scratch: Path | None = None,
) -> Iterator[bytes]:
    """The bytes of one file, piece by piece; the chunks wait in a temporary file for the header, which has their sizes.

    The same scene and options give the same bytes for any number of threads, and for a stream of the same nodes. Nodes
    keep their order; that of `lod.chunk_order` is for streaming.

    Args:
        scene: what is written.
        options: settled where the scene is a stream; otherwise they may leave choices open.
        threads: to encode on.
        progress: told of the splats.
        scratch: folder for the temporary file; None for that of the system.

    Raises:
        FormatError, ValueError: see `options.settled`.
    """
    made = _encoder(scene, options, threads, progress)
    with Kept(scratch, SPOOLED) as kept:
        for result in results(made, scene, threads, progress, "encoding"):
            kept.put(result)
        yield from made.pieces(kept.get, threads=threads, progress=progress)


def encode_chunked(
    scene: Scene | NodeStream, options: WriteOptions, stem: str, *, threads: int = 1, progress: Progress = silent
) -> Iterator[tuple[str, Iterable[bytes]]]:
    """The files of a scene whose chunks are files of their own: the name of each, and its bytes; the header is last.

    Args:
        scene, options, threads, progress: as for `encode`.
        stem: of the names: the header's is "stem.rad", and those of the chunks are "stem-0.radc" and so on.

    Raises:
        FormatError, ValueError: see `options.settled`.
    """
    made = _encoder(scene, options, threads, progress)
    found = results(made, scene, threads, progress, "writing")
    yield from made.files((result[CHUNK] for result in found), stem)


def _encoder(scene: Scene | NodeStream, options: WriteOptions, threads: int, progress: Progress) -> RadEncoder:
    options = settled(scene, options) if isinstance(scene, Scene) else options
    return encoder(scene, options, threads=threads, progress=progress)


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
    promises.check(promises.violations(header))
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


def _chunks(file: BinaryIO, header: RadHeader, beside: Beside | None) -> Iterator[Packed]:
    """The chunks in order, read when they are asked for."""
    for number, entry in enumerate(header.chunks):
        with file_of(entry, file, beside) as source:
            data = bytes_of(entry, header, source)
        yield Packed.of(data, number, header)


def _check_promise(count: int, header: RadHeader, size: int) -> None:
    """Raises `PromiseError` if a file or a chunk of this size can hardly have so many splats."""
    compression.check_promise(count * 4 * (14 + 3 * COEFFICIENTS[header.max_sh]), size)
