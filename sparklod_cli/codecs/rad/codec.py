"""RAD, the file of Spark 2 whose Level-of-Detail tree a viewer streams in chunks of 65,536 nodes.

A file is a header and its chunks, or a header that names a file for each chunk; `docs/formats.md` lays them out.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ... import __version__
from ...model.lod_tree import LodTree
from ...model.nodes import CHUNK_NODES
from ...model.scene import Scene
from ...model.sh import COEFFICIENTS
from ...model.splats import COLUMNS, FloatArray, Splats
from ...support.defaults import MAX_SH_DEGREE
from ...support.errors import FormatError, NotSplatsError, TreeError, TruncatedError
from ...support.parallel import blocks_of, ordered_map
from ...support.progress import Progress, silent
from .. import compression, sh_palette
from ..options import DEFAULTS, WriteOptions
from ..stream import size_of
from . import promises
from .decoding import Packed, fill
from .encoding import Palette, Writing
from .header import CHUNK_MAGIC, RadChunkEntry, RadChunkHeader, RadHeader, pack_header, read_header
from .names import SUFFIX, chunk_name
from .options import settled as settled

#: Bytes of chunks that wait in memory for their header; beyond, they wait on disk.
SPOOLED = 1 << 26

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
        FormatError: the file is not RAD, cut short or corrupt, breaks a promise of `promises` that is fatal, or has
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

    The header of the scene has the number of chunks, their size in splats, whether they are files of their own, and
    the number of codes of SH where there is a palette.

    Raises:
        FormatError: as `decode`, but not for a broken tree.
    """
    size = size_of(file)
    refuse_chunk(file)
    header = read_header(file)
    files = _sizes_beside(header, beside)
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
        part = _rows(splats, tree, slice(start, stop))
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
    return Scene(splats, tree, format=name_of(header), header=facts, chunk_bytes=sizes)


def name_of(header: RadHeader) -> str:
    """The format of a file for people, as `Scene.format` has it."""
    return "RAD" + " LoD" * header.lod_tree


def encode(
    scene: Scene, options: WriteOptions = DEFAULTS, *, threads: int = 1, progress: Progress = silent
) -> Iterator[bytes]:
    """The bytes of one file, piece by piece; the chunks wait in a temporary file for the header, which has their sizes.

    The same scene and options give the same bytes for any number of threads. Nodes keep their order; that of
    `lod.chunk_order` is for streaming.

    Raises:
        FormatError, ValueError: see `options.settled`.
    """
    writing = _writing(scene, options, threads, progress)
    sizes = []
    with tempfile.SpooledTemporaryFile(SPOOLED) as spool:
        for chunk in _encoded(writing, threads, progress):
            spool.write(chunk)
            sizes.append(len(chunk))
        spool.seek(0)
        offsets = itertools.accumulate(sizes, initial=0)
        yield pack_header(_header(writing, tuple(map(RadChunkEntry, offsets, sizes))))
        while piece := spool.read(compression.PIECE):
            yield piece


def encode_chunked(
    scene: Scene, options: WriteOptions, stem: str, *, threads: int = 1, progress: Progress = silent
) -> Iterator[tuple[str, Iterable[bytes]]]:
    """The files of a scene whose chunks are files of their own: the name of each, and its bytes; the header is last.

    Args:
        scene, options, threads, progress: as for `encode`.
        stem: of the names: the header's is "stem.rad", and those of the chunks are "stem-0.radc" and so on.

    Raises:
        FormatError, ValueError: see `options.settled`.
    """
    writing = _writing(scene, options, threads, progress)
    entries = []
    for number, chunk in enumerate(_encoded(writing, threads, progress)):
        name = chunk_name(stem, number)
        entries.append(RadChunkEntry(0, len(chunk), name))
        yield name, [chunk]
    yield stem + SUFFIX, [pack_header(_header(writing, tuple(entries)))]


def _writing(scene: Scene, options: WriteOptions, threads: int, progress: Progress) -> Writing:
    options = settled(scene, options)
    ranges, codes, palette = options.rad.ranges, options.rad.sh_codes, None
    assert ranges is not None
    if codes is not None and scene.splats.sh_degree and len(scene):
        palette = _palette(scene.splats, codes, threads, progress)
    return Writing(scene, options.rad, ranges, palette, options.compression_level)


def _palette(splats: Splats, codes: int, threads: int, progress: Progress) -> Palette:
    """A palette of SH, and zeros behind it up to as many codes as Spark reads."""
    room = min(len(splats), CHUNK_NODES)
    weight = sh_palette.visible_weight(splats)
    found = sh_palette.cluster(splats.sh, min(codes, room), weight=weight, threads=threads, progress=progress)
    padded = np.zeros((room, *found.codes.shape[1:]), np.float32)
    padded[: len(found.codes)] = found.codes
    return Palette(padded, found.labels)


def _encoded(writing: Writing, threads: int, progress: Progress) -> Iterator[bytes]:
    """The chunks in order, a few encoded ahead."""
    parts = blocks_of(len(writing.scene), CHUNK_NODES)
    for part, chunk in zip(parts, ordered_map(writing.chunk, parts, threads), strict=True):
        progress("writing", part.stop, len(writing.scene), "splat")
        yield chunk


def _header(writing: Writing, entries: tuple[RadChunkEntry, ...]) -> RadHeader:
    scene = writing.scene
    return RadHeader(
        len(scene),
        scene.splats.sh_degree,
        scene.tree is not None,
        CHUNK_NODES,
        sum(entry.bytes for entry in entries),
        entries,
        writing.ranges,
        None if writing.palette is None else len(writing.palette.codes),
        json.dumps({"generator": f"sparklod {__version__}"}),
    )


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
    packed = Packed.of(_bytes_of(file, entry, header), header.chunks.index(entry), header)
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


def refuse_chunk(file: BinaryIO) -> None:
    """Raises `NotSplatsError`, which says what to give, where a file is a single chunk; leaves it at its beginning."""
    if file.read(len(CHUNK_MAGIC)) == CHUNK_MAGIC:
        raise NotSplatsError("it is one chunk of a RAD file; give the .rad file beside it, which names all chunks")
    file.seek(0)


def _sizes_beside(header: RadHeader, beside: Beside | None) -> dict[str, int]:
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


def _chunks(file: BinaryIO, header: RadHeader, beside: Beside | None) -> Iterator[Packed]:
    """The chunks in order, read when they are asked for."""
    for number, entry in enumerate(header.chunks):
        with contextlib.ExitStack() as stack:
            where = file if entry.filename is None else stack.enter_context(_open(entry.filename, beside))
            data = _bytes_of(where, entry, header)
        yield Packed.of(data, number, header)


def _bytes_of(file: BinaryIO, entry: RadChunkEntry, header: RadHeader) -> bytes:
    start = entry.offset + (header.bytes if entry.filename is None else 0)
    lacking = start + entry.bytes - size_of(file)
    if lacking > 0:  # before so much memory is asked for
        raise TruncatedError(f"cut short: {lacking:,} of {entry.bytes:,} bytes of a chunk are missing")
    file.seek(start)
    return file.read(entry.bytes)


def _check_promise(count: int, header: RadHeader, size: int) -> None:
    """Raises `PromiseError` if a file or a chunk of this size can hardly have so many splats."""
    compression.check_promise(count * 4 * (14 + 3 * COEFFICIENTS[header.max_sh]), size)


def _rows(splats: Splats, tree: LodTree | None, part: slice) -> tuple[Splats, LodTree | None]:
    """Views of some rows."""
    views = Splats(**{name: getattr(splats, name)[part] for name in COLUMNS})
    return views, None if tree is None else LodTree(tree.child_count[part], tree.child_start[part])
