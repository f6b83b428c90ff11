"""SPZ, Niantic's compressed splats, and Spark's extension of it for Level-of-Detail trees.

Reads versions 1 to 3 (a header and streams in one gzip member) and 4 (a plain header, a zstd frame a stream); writes
versions 2 and 3. `docs/formats.md` lays the extension out byte by byte.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..model.lod_tree import LodTree
from ..model.scene import Scene
from ..model.sh import notes_on_degree
from ..model.splats import COLUMNS, Splats
from ..model.streams import NodeStream
from ..support.defaults import MAX_SH_DEGREE
from ..support.errors import FormatError, MembersError, NotSplatsError, TruncatedError, VersionError
from ..support.parallel import ordered_map
from ..support.progress import Progress, silent
from . import compression
from .encoder import Kept, results
from .options import DEFAULTS, WriteOptions
from .sound import with_sound_tree
from .spz_encoder import encoder
from .spz_layout import ANTIALIASED, EXTENSIONS, HEADER, LOD, MAGIC, Layout, Stream, StreamRows, column_of
from .spz_options import needed as needed
from .spz_options import settled as settled
from .stream import Read, rows_of, size_of

HEADER_V4 = struct.Struct("<IIIBBBBI12s")  # ..., streams, offset of the table of streams, reserved
STREAM_SIZES = struct.Struct("<QQ")  # of a version 4 stream: compressed, uncompressed

#: Versions that are read.
READABLE = (1, 2, 3, 4)


def decode(file: BinaryIO, *, threads: int = 1, progress: Progress = silent) -> Scene:
    """Reads any SPZ file, plain or LoD.

    Raises:
        FormatError: the file is not SPZ, of an unknown version or SH degree, cut short or corrupt, announces far more
            splats than its size can hold, or has a broken tree.
    """
    return with_sound_tree(examine(file, threads=threads, progress=progress))


def examine(
    file: BinaryIO, *, columns: Collection[str] = COLUMNS, threads: int = 1, progress: Progress = silent
) -> Scene:
    """Reads a file for inspection: the given columns of `Splats`, the others are 0; its tree may be broken.

    The header of the scene has the flags, the reserved byte and the number of bytes after the data.

    Raises:
        FormatError: as `decode`, but not for a broken tree.
    """
    size = size_of(file)
    plain = file.read(4) == struct.pack("<I", MAGIC)
    file.seek(0)
    header: dict[str, int] = {}
    layout, rows = _read_v4(file, size, header) if plain else _read_gzip(file, size, header)
    make = Splats.empty if set(COLUMNS) <= set(columns) else Splats.zeros
    splats = make(layout.count, min(layout.sh_degree, MAX_SH_DEGREE))
    tree = None
    if layout.flags & LOD:
        tree = LodTree(np.empty(layout.count, np.uint16), np.empty(layout.count, np.uint32))
    wanted = {*columns, "child_count", "child_start"}

    def fill(item: StreamRows) -> int:
        stream, part, codes = item
        if stream.column in wanted:
            out = column_of(splats, tree, stream)[part]
            out[...] = stream.decode(codes).reshape(out.shape)
        return codes.size

    done = 0
    for count in ordered_map(fill, rows, threads):
        done += count
        progress("reading", done, layout.total, "B")
    name = f"SPZ {layout.version}" + (" LoD" if tree is not None else "")
    antialiased = bool(layout.flags & ANTIALIASED)
    facts = {"version": layout.version, "fractional_bits": layout.fractional_bits, "flags": layout.flags} | header
    notes = notes_on_degree(layout.sh_degree)
    if header.get("unknown_streams"):
        notes += (f"{header['unknown_streams']} streams of an unknown kind are left out",)
    return Scene(splats, tree, antialiased, name, notes, facts)


def encode(
    scene: Scene | NodeStream,
    options: WriteOptions = DEFAULTS,
    *,
    threads: int = 1,
    progress: Progress = silent,
    scratch: Path | None = None,
) -> Iterator[bytes]:
    """The bytes of a file, piece by piece: an LoD file if the scene has a tree, otherwise a plain one.

    The same scene and options give the same bytes for any number of threads, and for a stream of the same nodes.

    Args:
        scene: what is written.
        options: settled where the scene is a stream; otherwise they may leave choices open.
        threads: to encode on.
        progress: told of the splats, and then of the bytes.
        scratch: folder for a temporary file of the bytes before they are compressed; None to keep them in memory.

    Raises:
        FormatError: a coordinate does not fit the fractional bits; the text names the most that would.
    """
    made = encoder(scene, settled(scene, options) if isinstance(scene, Scene) else options)
    with Kept(scratch, None if scratch is None else 0) as kept:
        for result in results(made, scene, threads, progress, "encoding"):
            kept.put(result)
        yield from made.pieces(kept.get, threads=threads, progress=progress)


def _checked(layout: Layout, file_size: int) -> Layout:
    """The layout, after checks that it can be read and that the file is large enough for what it announces."""
    if layout.version not in READABLE:
        raise VersionError(f"SPZ version {layout.version} is unknown, only 1 to 4 are read")
    if layout.sh_degree > (4 if layout.version == 4 else MAX_SH_DEGREE):
        raise VersionError(f"SPZ version {layout.version} has no SH degree {layout.sh_degree}")
    if layout.fractional_bits > 31:
        raise FormatError(f"{layout.fractional_bits} fractional bits; at most 31 can be read")
    compression.check_promise(layout.total, file_size)
    return layout


def _rows(layout: Layout, read: Read, stream: Stream) -> Iterator[StreamRows]:
    row_type = np.dtype((np.uint8, (stream.size,)))
    for part, codes in rows_of(read, row_type, layout.count, stream.name):
        yield stream, part, codes


def _read_gzip(file: BinaryIO, size: int, header: dict[str, int]) -> tuple[Layout, Iterator[StreamRows]]:
    inflate = compression.Inflate(file)
    head = inflate.read(HEADER.size)
    if len(head) < HEADER.size:
        raise TruncatedError("cut short inside the SPZ header")
    magic, *fields, header["reserved"] = HEADER.unpack(head)
    if magic != MAGIC:
        raise NotSplatsError("a gzip file, but not of SPZ")
    layout = _checked(Layout(*fields), size)

    def rows() -> Iterator[StreamRows]:
        try:
            for stream in layout.streams():
                yield from _rows(layout, inflate.read, stream)
        except TruncatedError as error:
            if inflate.behind() == compression.GZIP_MAGIC:
                raise MembersError(
                    f"{error}; its data continue in a second gzip member, which Spark does not read"
                ) from None
            raise
        inflate.finish(allow_more=bool(layout.flags & EXTENSIONS))
        if layout.flags & EXTENSIONS:  # the end of the member is not searched for
            return
        header["trailing_bytes"] = size - inflate.end()
        header["trailing_members"] = int(inflate.behind() == compression.GZIP_MAGIC)

    return layout, rows()


def _read_v4(file: BinaryIO, size: int, header: dict[str, int]) -> tuple[Layout, Iterator[StreamRows]]:
    head = file.read(HEADER_V4.size)
    if len(head) < HEADER_V4.size:
        raise TruncatedError("cut short inside the SPZ header")
    _, version, count, sh_degree, bits, flags, streams, table, reserved = HEADER_V4.unpack(head)
    if version != 4:
        raise VersionError(f"SPZ version {version} must be gzipped, only version 4 is not")
    layout = _checked(Layout(version, count, sh_degree, bits, flags), size)
    expected = layout.streams()
    if streams < len(expected):
        raise FormatError(f"{streams} streams, but SH degree {sh_degree} and flags {flags:#x} need {len(expected)}")
    header |= {"reserved": int(any(reserved)), "unknown_streams": streams - len(expected)}
    at = table + streams * STREAM_SIZES.size
    if at > size:
        raise TruncatedError("cut short inside the table of streams")
    file.seek(table)
    sizes = list(STREAM_SIZES.iter_unpack(file.read(streams * STREAM_SIZES.size)))
    for stream, (packed, unpacked) in zip(expected, sizes, strict=False):
        if unpacked != stream.size * count:
            raise FormatError(
                f"stream {stream.name} has {unpacked:,} bytes, but {count:,} splats need {stream.size * count:,}"
            )
        at += packed
        if at > size:
            raise TruncatedError(f"cut short inside stream {stream.name}")

    def rows() -> Iterator[StreamRows]:
        for stream, (packed, _) in zip(expected, sizes, strict=False):
            end = file.tell() + packed
            unzstd = compression.Unzstd(file, packed, stream.name)
            yield from _rows(layout, unzstd.read, stream)
            unzstd.finish()
            file.seek(end)
        header["trailing_bytes"] = size - end if streams == len(expected) else 0

    return layout, rows()
