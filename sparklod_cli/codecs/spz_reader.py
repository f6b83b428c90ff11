"""SPZ: reads versions 1 to 4, plain and with Spark's trees, see `spz`."""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..model import MAX_SH_DEGREE
from ..model.scene import FileCoding, ScaleCoding
from ..model.sh import notes_on_degree
from ..model.splats import COLUMNS
from ..system.errors import FormatError, MembersError, NotSplatsError, TruncatedError, VersionError
from ..system.progress import Progress
from ..system.threads import ordered_map
from .compression import GZIP_MAGIC, check_promise
from .inflate import PIECE, Inflate, Unzstd
from .options import MAX_FRACTIONAL_BITS, WriteOptions
from .quantize import Bytes
from .reader import FileNote, OpenFile, Read, Reader, Target, read_comment, rows_of
from .spz import (
    ANTIALIASED,
    COORDINATE_SYSTEM,
    EXTENSIONS,
    HEADER,
    HEADER_V4,
    MAGIC,
    RECORD,
    STREAM_SIZES,
    SYSTEMS,
    Layout,
    SpzEncoder,
    SpzStream,
    column_of,
    like,
)

#: Some rows of a stream: the stream, which rows, and (n, size) bytes.
StreamRows = tuple[SpzStream, slice, Bytes]

#: Versions that are read.
READABLE = (1, 2, 3, 4)

#: How all versions hold scales.
CODING = FileCoding((ScaleCoding("spz"),), 1)


def open_spz(source: OpenFile) -> tuple[Reader, Layout, Iterator[StreamRows]]:
    """Open any SPZ file, plain or LoD: its content, its layout, and the rows of its streams, which can be read once.

    With `scratch`, its streams are unpacked to that. The header of its scene has the flags, the reserved byte and, once
    all is read, the number of bytes after the data.

    Raises:
        FormatError: the file is not SPZ, of an unknown version or SH degree, cut short or corrupt, or announces far
            more splats than its size can hold.
    """
    file, note, extensions, header = source.file, FileNote(), Extensions(), dict[str, int]()
    size = source.size
    plain = file.read(4) == struct.pack("<I", MAGIC)
    file.seek(0)
    if plain:
        layout, rows, extensions = _read_v4(file, size, header)
    else:
        inflate = Inflate(file)
        layout, rows = _read_gzip(inflate, size, header)
        note = read_comment(inflate.comment)
        if layout.flags & EXTENSIONS:  # they follow the streams, which are read again
            extensions = _extensions_behind(inflate, layout)
            file.seek(0)
            layout, rows = _read_gzip(Inflate(file), size, header)

    def unpacked() -> Iterator[bytes]:
        for _, _, codes in rows:
            yield codes.tobytes()

    def read(target: Target) -> Iterator[StreamRows]:
        if source.scratch is None or target.once:
            yield from rows
            return
        scratch, offset = source.scratch(unpacked), 0
        for each in layout.streams():
            between = rows_of(
                scratch.read_at, offset, each.row_type, target.start, target.stop, layout.count, each.name
            )
            for part, codes in between:
                yield each, part, codes
            offset += each.size * layout.count

    def fill(target: Target, threads: int, progress: Progress) -> None:
        def decode(item: StreamRows) -> int:
            stream, part, codes = item
            if stream.column in target.columns or stream.column not in COLUMNS:
                column = column_of(target.splats, target.tree, stream)
                out = column[part.start - target.start : part.stop - target.start]
                out[...] = stream.decode(codes).reshape(out.shape)
            return codes.size

        done = 0
        for count in ordered_map(decode, read(target), threads):
            done += count
            progress("reading", done, layout.total, "B")

    notes = notes_on_degree(layout.sh_degree) + note.problems + extensions.notes
    if header.get("unknown_streams"):
        notes += (f"{header['unknown_streams']} streams of an unknown kind are left out",)
    note = dataclasses.replace(note, up=note.up or extensions.up)
    up, up_by = (note.up, "") if layout.has_tree or extensions.has_system else note.axis_of("SPZ")
    content = Reader(
        layout.count,
        min(layout.sh_degree, MAX_SH_DEGREE),
        f"SPZ {layout.version}" + " LoD" * layout.has_tree,
        fill,
        bool(layout.flags & ANTIALIASED),
        notes,
        header,
        up,
        layout.has_tree,
        coding=lambda: CODING,
        up_by=up_by,
        concurrent=True,
    )
    return content, layout, rows


def _checked(layout: Layout, file_size: int, header: dict[str, int]) -> Layout:
    """Check that a layout can be read and that the file is large enough for it, and add its fields to a header."""
    if layout.version not in READABLE:
        raise VersionError(f"SPZ version {layout.version} is unknown, only 1 to 4 are read")
    if layout.sh_degree > (4 if layout.version == 4 else MAX_SH_DEGREE):
        raise VersionError(f"SPZ version {layout.version} has no SH degree {layout.sh_degree}")
    if layout.fractional_bits > 31:
        raise FormatError(f"{layout.fractional_bits} fractional bits; at most 31 can be read")
    check_promise(layout.total, file_size)
    header |= {"version": layout.version, "fractional_bits": layout.fractional_bits, "flags": layout.flags}
    return layout


def _rows(layout: Layout, read: Read, stream: SpzStream) -> Iterator[StreamRows]:
    for part, codes in rows_of(
        lambda at, size: read(size), 0, stream.row_type, 0, layout.count, layout.count, stream.name
    ):
        yield stream, part, codes


def _read_gzip(inflate: Inflate, size: int, header: dict[str, int]) -> tuple[Layout, Iterator[StreamRows]]:
    head = inflate.read(HEADER.size)
    if len(head) < HEADER.size:
        raise TruncatedError("cut short inside the SPZ header")
    magic, *fields, reserved = HEADER.unpack(head)
    if magic != MAGIC:
        raise NotSplatsError("a gzip file, but not of SPZ")
    layout = _checked(Layout(*fields), size, header)
    header["reserved"] = reserved

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


def _extensions_behind(inflate: Inflate, layout: Layout) -> Extensions:
    """Return the extensions behind the streams; none where the streams are cut short, which reading these reports."""
    left = layout.total
    while left:
        piece = inflate.read(min(left, PIECE))
        if not piece:
            return Extensions()
        left -= len(piece)
    data = bytes(inflate.read(MOST_EXTENSION_BYTES))
    return read_extensions(data, len(data))


def _read_v4(file: BinaryIO, size: int, header: dict[str, int]) -> tuple[Layout, Iterator[StreamRows], Extensions]:
    head = file.read(HEADER_V4.size)
    if len(head) < HEADER_V4.size:
        raise TruncatedError("cut short inside the SPZ header")
    _, version, count, sh_degree, bits, flags, streams, table, reserved = HEADER_V4.unpack(head)
    if version != 4:
        raise VersionError(f"SPZ version {version} must be gzipped, only version 4 is not")
    layout = _checked(Layout(version, count, sh_degree, bits, flags), size, header)
    expected = layout.streams()
    if streams < len(expected):
        raise FormatError(f"{streams} streams, but SH degree {sh_degree} and flags {flags:#x} need {len(expected)}")
    header |= {"reserved": int(any(reserved)), "unknown_streams": streams - len(expected)}
    if table < HEADER_V4.size:
        raise FormatError(f"its table of streams begins at byte {table}, inside the header")
    at = table + streams * STREAM_SIZES.size
    if at > size:
        raise TruncatedError("cut short inside the table of streams")
    extensions = Extensions()
    if flags & EXTENSIONS:
        between = table - HEADER_V4.size
        extensions = read_extensions(file.read(min(between, MOST_EXTENSION_BYTES)), between)
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
            unzstd = Unzstd(file, packed, stream.name)
            yield from _rows(layout, unzstd.read, stream)
            unzstd.finish()
            file.seek(end)
        header["trailing_bytes"] = size - end if streams == len(expected) else 0

    return layout, rows(), extensions


#: Names of the other types that are published.
TYPES = {0xADBE0002: "SPZ_ADOBE_safe_orbit_camera"}

_DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "U": (0, 1, 0), "D": (0, -1, 0), "B": (0, 0, 1), "F": (0, 0, -1)}

#: Bytes of extension records that are read of a file.
MOST_EXTENSION_BYTES = 1 << 20

#: Kinds of unknown records that are named.
MOST_NAMED = 8


@dataclass(frozen=True)
class Extensions:
    """Contents of the extension records of a file.

    Attributes:
        up: as in `Scene`, by the coordinate system.
        has_system: they name a coordinate system, be it an unknown one.
        notes: what is left out of them, as sentences for `Scene.notes`.
    """

    up: str | None = None
    notes: tuple[str, ...] = ()
    has_system: bool = False


def read_extensions(data: bytes, size: int) -> Extensions:
    """Parse extension records; unknown ones are skipped, and what is broken is noted.

    Args:
        data: the records, or their first `MOST_EXTENSION_BYTES`.
        size: bytes of all of them.
    """
    at, up, notes, unknown, has_system = 0, None, list[str](), dict[str, int](), False
    while at + RECORD.size <= len(data):
        kind, length = RECORD.unpack_from(data, at)
        payload = at + RECORD.size
        if length > size - payload:
            break
        at = payload + length
        has_system |= kind == COORDINATE_SYSTEM
        if kind != COORDINATE_SYSTEM:
            name = TYPES.get(kind, f"{kind:#010x}")
            unknown[name] = unknown.get(name, 0) + length
        elif up is None:
            system = int.from_bytes(data[payload : payload + 4], "little") if length >= 4 else 0
            if 1 <= system <= len(SYSTEMS):
                name = SYSTEMS[system - 1]
                place = next(at for at, letter in enumerate(name) if letter in "UD")
                up = "-" * (name[place] == "D") + "xyz"[place]
                if np.linalg.det([_DIRECTIONS[letter] for letter in name]) < 0:
                    notes.append(f"its axes are left-handed ({name}) and stay as they are: viewers mirror the scene")
            elif not notes:
                notes.append(f"its coordinate system {system} is unknown, and ignored")
    names = list(unknown)
    notes += [f"extension {name} ({unknown[name]:,} bytes) is left out" for name in names[:MOST_NAMED]]
    if names[MOST_NAMED:]:
        notes.append(f"{len(names) - MOST_NAMED:,} more kinds of extensions are left out")
    if at < size:
        notes.append(f"the last {size - at:,} bytes of its extensions are no records that can be read")
    return Extensions(up, tuple(notes), has_system)


@dataclass(frozen=True, eq=False)
class StoredSpz:
    """Codes of a file, see `encoder.Stored`.

    Decoding and encoding again would nearly do: but a rotation whose two largest components are equal, but for
    rounding, may get another code.
    """

    layout: Layout
    codes: Mapping[str, Bytes]

    @classmethod
    def of(cls, file: BinaryIO) -> StoredSpz:
        """Read the codes of a file: (N, bytes) of each of its streams, by name."""
        _, layout, rows = open_spz(OpenFile(file))
        codes = {each.name: np.empty((layout.count, each.size), np.uint8) for each in layout.streams()}
        for each, part, some in rows:
            codes[each.name][part] = some
        return cls(layout, codes)

    def like(self, options: WriteOptions) -> WriteOptions:
        """Return the options, and where they leave a choice open, that of the file."""
        layout = self.layout
        if layout.version == 1 or layout.fractional_bits > MAX_FRACTIONAL_BITS:
            return options  # its positions are in no coding that is written
        return like({"version": layout.version, "fractional_bits": layout.fractional_bits}, options)

    def keeping(self, encoder: SpzEncoder, unchanged: NDArray[np.bool_]) -> SpzEncoder:
        """Return an encoder of as many nodes that gives some the codes of the file, where its coding is the same."""
        streams = encoder.layout.streams()
        codes = {each.name: self.codes[each.name] for each in streams if self._is_alike(each, encoder.layout)}
        return dataclasses.replace(encoder, stored=codes, unchanged=unchanged)

    def _is_alike(self, stream: SpzStream, other: Layout) -> bool:
        """Return True if a layout has a stream of splats in the coding of the file."""
        own = self.layout
        if stream.column not in COLUMNS:
            return False
        if stream.name == "positions":
            return own.version > 1 and own.fractional_bits == other.fractional_bits
        if stream.name == "rotations":
            return (own.version >= 3) == (other.version >= 3)
        return stream.name != "alphas" or own.has_tree == other.has_tree
