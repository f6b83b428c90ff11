"""Reads SPZ: versions 1 to 3 (a header and streams in a gzip member) and 4 (a plain header, a zstd frame a stream)."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Collection, Iterator
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..model.lod_tree import LodTree
from ..model.scene import FileCoding, ScaleCoding, Scene
from ..model.sh import notes_on_degree
from ..model.splats import COLUMNS, Splats
from ..model.streams import SceneStream
from ..support.defaults import MAX_SH_DEGREE
from ..support.errors import FormatError, HasTreeError, MembersError, NotSplatsError, TruncatedError, VersionError
from ..support.parallel import ordered_map
from ..support.progress import Progress, silent
from . import compression, quantize
from .content import HAS_TREE, Content, Scratch
from .inflate import GZIP_MAGIC, Inflate
from .noted import Noted, read_comment
from .sound import with_sound_tree
from .spz_coded import CodedSpz, Watch, sound
from .spz_layout import ANTIALIASED, EXTENSIONS, HEADER, LOD, MAGIC, Layout, Stream, StreamRows, column_of
from .stream import Positioned, Read, rows_between, rows_of, size_of

HEADER_V4 = struct.Struct("<IIIBBBBI12s")  # ..., streams, offset of the table of streams, reserved
STREAM_SIZES = struct.Struct("<QQ")  # of a version 4 stream: compressed, uncompressed

#: Versions that are read.
READABLE = (1, 2, 3, 4)

#: How all versions hold scales.
CODING = FileCoding((ScaleCoding("spz"),), 1)


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
    layout, rows, header, noted = _opened(file, threads)
    make = Splats.empty if set(COLUMNS) <= set(columns) else Splats.zeros
    splats = make(layout.count, min(layout.sh_degree, MAX_SH_DEGREE))
    tree = None
    if layout.flags & LOD:
        tree = LodTree(np.empty(layout.count, np.uint16), np.empty(layout.count, np.uint32))
    wanted = {*columns, "child_count", "child_start"}

    def fill(item: StreamRows) -> int:
        stream, part, codes = item
        if stream.column in wanted:
            _decode(stream, codes, column_of(splats, tree, stream)[part])
        return codes.size

    done = 0
    for count in ordered_map(fill, rows, threads):
        done += count
        progress("reading", done, layout.total, "B")
    antialiased, notes, facts = bool(layout.flags & ANTIALIASED), _notes(layout, header, noted), _facts(layout) | header
    return Scene(splats, tree, antialiased, _name_of(layout), notes, facts, coding=CODING, up=noted.up)


def stream(file: BinaryIO, *, scratch: Scratch, threads: int = 1, progress: Progress = silent) -> SceneStream:
    """The splats of a file without a tree, block by block. Its streams are unpacked to `scratch` first.

    Raises:
        HasTreeError: it has a tree.
        FormatError: as `decode`; what is wrong with the data, at the first block.
    """
    layout, rows, header, noted = _opened(file, threads)
    if layout.flags & LOD:
        raise HasTreeError(HAS_TREE)
    if not layout.count:  # there is nothing to read, but what follows may be wrong
        deque(rows, maxlen=0)

    def unpacked() -> Iterator[bytes]:
        done = 0
        for _, _, codes in rows:
            yield codes.tobytes()
            done += codes.size
            progress("reading", done, layout.total, "B")

    def fill(out: Splats, start: int, threads: int, progress: Progress) -> None:
        source, stop = Positioned(scratch(unpacked)), start + len(out)

        def codes() -> Iterator[StreamRows]:
            offset = 0
            for stream in layout.streams():
                for part, some in rows_between(source, offset, stream.row_type, start, stop, layout.count, stream.name):
                    yield stream, part, some
                offset += stream.size * layout.count

        def decode_part(item: StreamRows) -> None:
            stream, part, some = item
            _decode(stream, some, column_of(out, None, stream)[part.start - start : part.stop - start])

        for _ in ordered_map(decode_part, codes(), threads):
            pass

    degree, antialiased = min(layout.sh_degree, MAX_SH_DEGREE), bool(layout.flags & ANTIALIASED)
    notes, facts = _notes(layout, header, noted), _facts(layout) | header
    return Content(layout.count, degree, fill, _name_of(layout), antialiased, notes, facts, noted.up).stream(threads)


def read_codes(file: BinaryIO) -> tuple[Layout, dict[str, quantize.Bytes]]:
    """The layout of a file, and (N, bytes) codes of each of its streams, by its name.

    Raises:
        FormatError: as `decode`.
    """
    layout, rows, *_ = _opened(file, 1)
    codes = {each.name: np.empty((layout.count, each.size), np.uint8) for each in layout.streams()}
    for each, part, some in rows:
        codes[each.name][part] = some
    return layout, codes


def read_coded(
    file: BinaryIO,
    *,
    columns: Collection[str] = COLUMNS,
    watch: Watch | None = None,
    threads: int = 1,
    progress: Progress = silent,
) -> CodedSpz:
    """The codes of a file for inspection, see `examine`.

    Those of the given columns of `Splats`, and of the tree; of a file that may hold invalid splats, those of all.
    """
    watch = watch or {}
    layout, rows, header, noted = _opened(file, threads)
    columns = columns if sound(layout) else COLUMNS
    streams = [each for each in layout.streams() if each.column in {*columns, "child_count", "child_start"}]
    codes = {each.name: np.empty((layout.count, each.size), np.uint8) for each in streams}
    done = 0
    for each, part, some in rows:
        if each.name in codes:
            codes[each.name][part] = some
        if each.column in watch:
            watch[each.column](some)
        done += some.size
        progress("reading", done, layout.total, "B")
    facts, degree = _facts(layout) | header, min(layout.sh_degree, MAX_SH_DEGREE)
    antialiased, notes = bool(layout.flags & ANTIALIASED), _notes(layout, header, noted)
    return CodedSpz(layout, codes, degree, antialiased, _name_of(layout), notes, facts, noted.up)


def _opened(file: BinaryIO, threads: int) -> tuple[Layout, Iterator[StreamRows], dict[str, int], Noted]:
    """The layout of a file, the rows of its streams, more numbers, the last of which come with the rows; its note."""
    size = size_of(file)
    plain = file.read(4) == struct.pack("<I", MAGIC)
    file.seek(0)
    header: dict[str, int] = {}
    if plain:
        return *_read_v4(file, size, header), header, Noted()
    inflate = Inflate(file, threads)
    return *_read_gzip(inflate, size, header), header, read_comment(inflate.comment)


def _facts(layout: Layout) -> dict[str, int]:
    return {"version": layout.version, "fractional_bits": layout.fractional_bits, "flags": layout.flags}


def _name_of(layout: Layout) -> str:
    return f"SPZ {layout.version}" + " LoD" * bool(layout.flags & LOD)


def _notes(layout: Layout, header: dict[str, int], noted: Noted) -> tuple[str, ...]:
    notes = notes_on_degree(layout.sh_degree) + noted.problems
    if header.get("unknown_streams"):
        notes += (f"{header['unknown_streams']} streams of an unknown kind are left out",)
    return notes


def _decode(stream: Stream, codes: quantize.Bytes, out: NDArray[Any]) -> None:
    out[...] = stream.decode(codes).reshape(out.shape)


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
    for part, codes in rows_of(read, stream.row_type, layout.count, stream.name):
        yield stream, part, codes


def _read_gzip(inflate: Inflate, size: int, header: dict[str, int]) -> tuple[Layout, Iterator[StreamRows]]:
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
            if inflate.behind() == GZIP_MAGIC:
                raise MembersError(
                    f"{error}; its data continue in a second gzip member, which Spark does not read"
                ) from None
            raise
        inflate.finish(allow_more=bool(layout.flags & EXTENSIONS))
        if layout.flags & EXTENSIONS:  # the end of the member is not searched for
            return
        header["trailing_bytes"] = size - inflate.end()
        header["trailing_members"] = int(inflate.behind() == GZIP_MAGIC)

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
