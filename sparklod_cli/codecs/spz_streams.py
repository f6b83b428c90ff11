"""The streams of SPZ files: their codings, one table for reading and writing, and the reader.

Versions 1 to 3 are a header and streams in a gzip member, version 4 a plain header and a zstd frame for each stream.
Extension records, of which the coordinate system is read and written, follow the streams, in version 4 the header. A
record has its type, the bytes of its payload, and the payload.
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..model import MAX_SH_DEGREE
from ..model.gaussian import linear_opacity, lod_opacity
from ..model.lod_tree import LodTree
from ..model.scene import FileCoding, ScaleCoding
from ..model.sh import COEFFICIENTS, notes_on_degree
from ..model.splats import Splats
from ..system.errors import FormatError, MembersError, NotSplatsError, TruncatedError, VersionError
from ..system.progress import Progress
from ..system.threads import ordered_map
from . import compression, quantize
from .file_notes import FileNote, read_comment
from .inflate import GZIP_MAGIC, Inflate
from .quantize import Bytes
from .reader import OpenFile, Positioned, Read, Reader, Target, rows_of, size_of
from .statistics import ALL_BITS

MAGIC = 0x5053474E  # "NGSP"
HEADER = struct.Struct("<IIIBBBB")  # magic, version, splats, SH degree, fractional bits, flags, reserved

#: Flags of the header.
ANTIALIASED, EXTENSIONS, LOD = 0x01, 0x02, 0x80
KNOWN_FLAGS = ANTIALIASED | EXTENSIONS | LOD


#: The last streams of a file with a tree: column and type, by name.
LINKS = {"child_counts": ("child_count", "<u2"), "child_starts": ("child_start", "<u4")}


class SpzStream(NamedTuple):
    """One stream of a file: one column of all splats in order.

    Attributes:
        name: for messages.
        size: bytes per splat.
        column: of `Splats` or `LodTree`.
        decode: (n, size) bytes to n rows of the column, of any shape.
        encode: n rows of the column to bytes.
    """

    name: str
    size: int
    column: str
    decode: Callable[[quantize.Bytes], NDArray[Any]]
    encode: Callable[[NDArray[Any]], NDArray[Any]]

    @property
    def row_type(self) -> np.dtype[Any]:
        """(size,) bytes."""
        return np.dtype((np.uint8, (self.size,)))


#: Some rows of a stream: the stream, which rows, and (n, size) bytes.
StreamRows = tuple[SpzStream, slice, quantize.Bytes]


def column_of(splats: Splats, tree: LodTree | None, stream: SpzStream) -> NDArray[Any]:
    """Return the column that a stream holds."""
    column: NDArray[Any] = getattr(splats if hasattr(splats, stream.column) else tree, stream.column)
    return column


@dataclass(frozen=True)
class Layout:
    """The fields of a header on which its streams depend."""

    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    flags: int

    def streams(self) -> list[SpzStream]:
        """Return the streams in file order."""
        q, bits, coefficients = quantize, self.fractional_bits, COEFFICIENTS[self.sh_degree]
        table = [
            SpzStream("positions", 6, "center", lambda codes: codes.view("<f2"), lambda center: center.astype("<f2"))
            if self.version == 1
            else SpzStream(
                "positions",
                9,
                "center",
                lambda codes: q.decode_fixed24(codes.reshape(-1, 3, 3), bits),
                lambda center: q.encode_fixed24(center, bits),
            ),
            SpzStream(
                "alphas",
                1,
                "opacity",
                lambda codes: linear_opacity(q.decode_lod_opacity(codes)),  # D = 0..5
                lambda opacity: q.encode_lod_opacity(lod_opacity(opacity)),
            )
            if self.flags & LOD
            else SpzStream("alphas", 1, "opacity", q.decode_unorm8, q.encode_unorm8),
            SpzStream("colors", 3, "rgb", q.decode_color, q.encode_color),
            SpzStream("scales", 3, "scale", q.decode_log_scale, q.encode_log_scale),
            SpzStream("rotations", 4, "quat_xyzw", q.decode_quat_smallest_three, q.encode_quat_smallest_three)
            if self.version >= 3
            else SpzStream("rotations", 3, "quat_xyzw", q.decode_quat_first_three, q.encode_quat_first_three),
            SpzStream(
                "sh",
                3 * coefficients,  # coefficient-major, r g b innermost
                "sh",
                lambda codes: q.decode_sh(codes.reshape(-1, coefficients, 3)[:, : COEFFICIENTS[MAX_SH_DEGREE]]),
                lambda sh: q.encode_sh(sh, ALL_BITS),  # what is dropped of them is by now, see `spz.sh_codes`
            ),
        ]
        if self.flags & LOD:
            table += [_integers(name, *of_link) for name, of_link in LINKS.items()]
        return [stream for stream in table if stream.size]

    @property
    def has_tree(self) -> bool:
        """Whether the splats are the nodes of a tree."""
        return bool(self.flags & LOD)

    @property
    def total(self) -> int:
        """Bytes of all streams."""
        return self.count * sum(stream.size for stream in self.streams())


def _integers(name: str, column: str, code: str) -> SpzStream:
    size = np.dtype(code).itemsize
    return SpzStream(name, size, column, lambda codes: codes.view(code), lambda values: values.astype(code))


HEADER_V4 = struct.Struct("<IIIBBBBI12s")  # ..., streams, offset of the table of streams, reserved
STREAM_SIZES = struct.Struct("<QQ")  # of a version 4 stream: compressed, uncompressed

#: Versions that are read.
READABLE = (1, 2, 3, 4)

#: How all versions hold scales.
CODING = FileCoding((ScaleCoding("spz"),), 1)


def open_content(source: OpenFile) -> Reader:
    """Open any SPZ file, plain or LoD. With `scratch`, its streams are unpacked to that.

    The header of its scene has the flags, the reserved byte and, once all is read, the number of bytes after the data.

    Raises:
        FormatError: the file is not SPZ, of an unknown version or SH degree, cut short or corrupt, or announces far
            more splats than its size can hold.
    """
    return _open(source)[0]


def read_codes(source: OpenFile) -> tuple[Layout, dict[str, Bytes]]:
    """Read the layout of a file, and (N, bytes) codes of each of its streams, by name; raises as `open_content`."""
    _, layout, rows = _open(source)
    codes = {each.name: np.empty((layout.count, each.size), np.uint8) for each in layout.streams()}
    for each, part, some in rows:
        codes[each.name][part] = some
    return layout, codes


def _open(source: OpenFile) -> tuple[Reader, Layout, Iterator[StreamRows]]:
    """Open a file: its content, its layout, and the rows of its streams, which can be read once."""
    file, note, extensions, header = source.file, FileNote(), Extensions(), dict[str, int]()
    size = size_of(file)
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
        positioned, offset = Positioned(source.scratch(unpacked)), 0
        for each in layout.streams():
            between = rows_of(
                positioned.read, offset, each.row_type, target.start, target.stop, layout.count, each.name
            )
            for part, codes in between:
                yield each, part, codes
            offset += each.size * layout.count

    def fill(target: Target, threads: int, progress: Progress) -> None:
        def decode(item: StreamRows) -> int:
            stream, part, codes = item
            if stream.column in target.columns or stream.name in LINKS:
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
    compression.check_promise(layout.total, file_size)
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
        piece = inflate.read(min(left, compression.PIECE))
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
            unzstd = compression.Unzstd(file, packed, stream.name)
            yield from _rows(layout, unzstd.read, stream)
            unzstd.finish()
            file.seek(end)
        header["trailing_bytes"] = size - end if streams == len(expected) else 0

    return layout, rows(), extensions


#: Type of an extension record, and bytes of its payload.
RECORD = struct.Struct("<II")

#: Record of the coordinate system in which the coordinates stand: a uint32, an index of `SYSTEMS` from 1 on.
COORDINATE_SYSTEM = 0xADBE0003

#: Names of the other types that are published.
TYPES = {0xADBE0002: "SPZ_ADOBE_safe_orbit_camera"}

#: The coordinate systems: where x, y and z point, of left or right, down or up, back or front.
SYSTEMS = (
    *("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"),
    *("LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"),
)

_DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "U": (0, 1, 0), "D": (0, -1, 0), "B": (0, 0, 1), "F": (0, 0, -1)}

#: Bytes of extension records that are read of a file.
MOST_EXTENSION_BYTES = 1 << 20

#: Kinds of unknown records that are named.
MOST_NAMED = 8


#: By the axis that points up, the right-handed system whose x points right. None has x pointing up.
SYSTEM_OF_UP = {"y": "RUB", "-y": "RDF", "z": "RFU", "-z": "RBD"}


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


def extensions_of(up: str | None) -> bytes:
    """Return the extension records of a file in which this axis points up, one of `SYSTEM_OF_UP`; b"" for None."""
    if up is None:
        return b""
    number = SYSTEMS.index(SYSTEM_OF_UP[up]) + 1
    return RECORD.pack(COORDINATE_SYSTEM, 4) + number.to_bytes(4, "little")
