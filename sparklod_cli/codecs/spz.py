"""SPZ, Niantic's compressed splats, and Spark's extension of it for Level-of-Detail trees.

Versions 1 to 3 are one gzip member with a header and streams, version 4 a plain header and a zstd frame per stream.
Extension records follow the streams, in version 4 the header; the coordinate system is read and written.

All versions are read. Versions 2 and 3 are written, and 4 without a tree, for which Spark's extension is not defined.
`docs/formats/spz.md` documents the extension byte by byte.
"""

from __future__ import annotations

import dataclasses
import itertools
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..model import MAX_SH_DEGREE
from ..model.gaussian import linear_opacity, lod_opacity
from ..model.lod_tree import LodTree
from ..model.scene import SPZ_SCALES, FileCoding, Scene
from ..model.sh import COEFFICIENTS, notes_on_degree
from ..model.splats import COLUMNS, FloatArray, Splats
from ..system.errors import FormatError, MembersError, NotSplatsError, TruncatedError, VersionError
from ..system.progress import Progress, silent
from ..system.threads import blocks_of, ordered_map
from . import compression, quantize
from .compression import Inflate, Unzstd
from .encoder import CLAMPED, SPZ_RANGES, CodeRange, Encoded, Windows, results, tally, windows_of
from .formats import DEFAULT_SPZ_VERSION, DEFAULTS, MAX_FRACTIONAL_BITS, TREE_SPZ_VERSIONS, WriteOptions
from .quantize import ALL_BITS, Bytes
from .reader import FileNote, OpenFile, Read, Reader, RowBuffer, comment_of, read_comment, rows_of
from .statistics import Statistics, enough, fine_bits

MAGIC = 0x5053474E  # "NGSP"
HEADER = struct.Struct("<IIIBBBB")  # magic, version, splats, SH degree, fractional bits, flags, reserved

#: Of version 4: ..., streams, offset of the table of streams, reserved.
HEADER_V4 = struct.Struct("<IIIBBBBI12s")
STREAM_SIZES = struct.Struct("<QQ")  # of a version 4 stream: compressed, uncompressed

#: Flags of the header.
ANTIALIASED, EXTENSIONS, LOD = 0x01, 0x02, 0x80
KNOWN_FLAGS = ANTIALIASED | EXTENSIONS | LOD


class SpzStream(NamedTuple):
    """One stream of a file: a column of `Splats` or `LodTree`, `size` bytes per splat.

    `decode` turns (n, size) bytes into n rows of the column, in any shape; `encode` turns rows into bytes.
    """

    name: str
    size: int
    column: str
    decode: Callable[[quantize.Bytes], NDArray[Any]]
    encode: Callable[[NDArray[Any]], NDArray[Any]]

    @property
    def row_type(self) -> np.dtype[Any]:
        """Type of the bytes of a splat."""
        return np.dtype((np.uint8, (self.size,)))


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
                lambda sh: q.encode_sh(sh, ALL_BITS),  # with fewer bits already, see `sh_codes`
            ),
        ]
        if self.flags & LOD:
            table += [
                SpzStream("child_counts", 2, "child_count", lambda codes: codes.view("<u2"), lambda n: n.astype("<u2")),
                SpzStream("child_starts", 4, "child_start", lambda codes: codes.view("<u4"), lambda n: n.astype("<u4")),
            ]
        return [stream for stream in table if stream.size]

    @property
    def total(self) -> int:
        """Bytes of all streams."""
        return self.count * sum(stream.size for stream in self.streams())


#: A block of rows of a stream: the stream, a slice of row numbers, and (n, size) bytes.
StreamRows = tuple[SpzStream, slice, Bytes]

#: Versions that are read.
READABLE = (1, 2, 3, 4)


def open_content(source: OpenFile) -> Reader:
    """Open a file of any version, with a tree or without.

    The header of its scene has the fields of `Layout`, the reserved byte and, after all splats have been read, the
    number of bytes behind the data.

    Raises:
        FormatError: the file is not SPZ, of an unknown version or SH degree, cut short or corrupt, or announces far
            more splats than its size can hold.
    """
    layout, rows, header, note, (axis, notes, has_system) = open_streams(source.file, source.size)

    def fill(target: RowBuffer, threads: int, progress: Progress) -> None:
        def decode(item: StreamRows) -> int:
            stream, part, codes = item
            if stream.column in target.columns or stream.column not in COLUMNS:
                columns = target.splats if stream.column in COLUMNS else target.tree
                out = getattr(columns, stream.column)[part.start - target.start : part.stop - target.start]
                out[...] = stream.decode(codes).reshape(out.shape)
            return codes.size

        blocks, done = rows, 0
        if source.scratch is not None and not target.once:
            unpacked = source.scratch(lambda: (codes.tobytes() for _, _, codes in rows))
            blocks = _unpacked_rows(layout, unpacked, target)
        for count in ordered_map(decode, blocks, threads):
            done += count
            progress("reading", done, layout.total, "B")

    notes = notes_on_degree(layout.sh_degree) + note.problems + notes
    if header.get("unknown_streams"):
        notes += (f"{header['unknown_streams']} streams of an unknown kind are left out",)
    has_tree = bool(layout.flags & LOD)
    up, up_by = note.up or axis, ""
    if not has_tree and not has_system:
        up, up_by = dataclasses.replace(note, up=up).axis_of("SPZ")
    return Reader(
        layout.count,
        min(layout.sh_degree, MAX_SH_DEGREE),
        f"SPZ {layout.version}" + " LoD" * has_tree,
        fill,
        bool(layout.flags & ANTIALIASED),
        notes,
        header,
        up,
        has_tree,
        coding=lambda: FileCoding((SPZ_SCALES,)),
        up_by=up_by,
        concurrent=True,
    )


def _rows(stream: SpzStream, read: Read, count: int) -> Iterator[StreamRows]:
    """Read all rows of a stream in order."""
    for part, codes in rows_of(lambda at, size: read(size), 0, stream.row_type, 0, count, count, stream.name):
        yield stream, part, codes


def _unpacked_rows(layout: Layout, file: OpenFile, target: RowBuffer) -> Iterator[StreamRows]:
    """Read the rows of a target from all streams, which lie one after the other in a file."""
    offset, span = 0, (target.start, target.stop, layout.count)
    for stream in layout.streams():
        for part, codes in rows_of(file.read_at, offset, stream.row_type, *span, stream.name):
            yield stream, part, codes
        offset += stream.size * layout.count


#: An open file: its layout; the rows of its streams, which can be read once; its header, to which reading them adds;
#: its note; and its extensions.
OpenStreams = tuple[Layout, Iterator[StreamRows], dict[str, int], FileNote, "Extensions"]


def open_streams(file: BinaryIO, size: int) -> OpenStreams:
    """Open a file of `size` bytes; raises the errors of `open_content`."""
    if file.read(4) == struct.pack("<I", MAGIC):
        file.seek(0)
        return _open_v4(file, size)

    file.seek(0)
    inflate = Inflate(file)
    head = inflate.read(HEADER.size)
    if len(head) < HEADER.size:
        raise TruncatedError("cut short inside the SPZ header")
    magic, *fields, reserved = HEADER.unpack(head)
    if magic != MAGIC:
        raise NotSplatsError("a gzip file, but not of SPZ")
    layout, extensions = Layout(*fields), NO_EXTENSIONS
    header = _checked(layout, size) | {"reserved": reserved}
    if layout.flags & EXTENSIONS:  # extensions follow the streams, which are then read a second time
        extensions = _extensions_behind(inflate, layout)
        file.seek(0)
        inflate = Inflate(file)
        inflate.read(HEADER.size)

    def rows() -> Iterator[StreamRows]:
        try:
            for stream in layout.streams():
                yield from _rows(stream, inflate.read, layout.count)
        except TruncatedError as error:
            if inflate.behind == compression.GZIP_MAGIC:
                raise MembersError(
                    f"{error}; its data continue in a second gzip member, which Spark does not read"
                ) from None
            raise
        if layout.flags & EXTENSIONS:  # they would have to be read to find the end of the member
            return
        inflate.finish()
        assert inflate.end is not None
        header["trailing_bytes"] = size - inflate.end
        header["trailing_members"] = int(inflate.behind == compression.GZIP_MAGIC)

    return layout, rows(), header, read_comment(inflate.comment), extensions


def _checked(layout: Layout, file_size: int) -> dict[str, int]:
    """Check that a layout is supported and that the file is large enough for it; return its header fields."""
    if layout.version not in READABLE:
        raise VersionError(f"SPZ version {layout.version} is unknown, only 1 to 4 are read")
    if layout.sh_degree > (4 if layout.version == 4 else MAX_SH_DEGREE):
        raise VersionError(f"SPZ version {layout.version} has no SH degree {layout.sh_degree}")
    if layout.fractional_bits > 31:
        raise FormatError(f"{layout.fractional_bits} fractional bits; at most 31 can be read")
    compression.check_promise(layout.total, file_size)
    return {"version": layout.version, "fractional_bits": layout.fractional_bits, "flags": layout.flags}


def _extensions_behind(inflate: Inflate, layout: Layout) -> Extensions:
    """Read the extensions behind the streams; none if the streams are cut short, which their reader reports."""
    left = layout.total
    while left:
        piece = inflate.read(min(left, MOST_EXTENSION_BYTES))
        if not piece:
            return NO_EXTENSIONS
        left -= len(piece)
    data = bytes(inflate.read(MOST_EXTENSION_BYTES))
    return read_extensions(data, len(data))


def _open_v4(file: BinaryIO, size: int) -> OpenStreams:
    """Open a file of version 4; raises the errors of `open_content`."""
    head = file.read(HEADER_V4.size)
    if len(head) < HEADER_V4.size:
        raise TruncatedError("cut short inside the SPZ header")
    _, version, count, sh_degree, bits, flags, streams, table, reserved = HEADER_V4.unpack(head)
    if version != 4:
        raise VersionError(f"SPZ version {version} must be gzipped, only version 4 is not")
    layout = Layout(version, count, sh_degree, bits, flags)
    header, expected = _checked(layout, size), layout.streams()
    if streams < len(expected):
        raise FormatError(f"{streams} streams, but SH degree {sh_degree} and flags {flags:#x} need {len(expected)}")
    header |= {"reserved": int(any(reserved)), "unknown_streams": streams - len(expected)}
    if table < HEADER_V4.size:
        raise FormatError(f"its table of streams begins at byte {table}, inside the header")
    at = table + streams * STREAM_SIZES.size
    if at > size:
        raise TruncatedError("cut short inside the table of streams")
    extensions = NO_EXTENSIONS
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
            yield from _rows(stream, unzstd.read, count)
            unzstd.finish()
            file.seek(end)
        header["trailing_bytes"] = size - end if streams == len(expected) else 0

    return layout, rows(), header, FileNote(), extensions


# Extension records.

#: Header of an extension record: its type, and the size of its payload, bytes.
RECORD = struct.Struct("<II")

#: Type of the record of the coordinate system. Its payload is a uint32, the index in `SYSTEMS` plus 1.
COORDINATE_SYSTEM = 0xADBE0003

#: The coordinate systems: the directions of x, y and z, each left or right, down or up, back or front.
SYSTEMS = (
    *("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"),
    *("LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"),
)

#: The right-handed system whose x points right, by the axis that points up. No such system has x pointing up.
SYSTEM_OF_UP = {"y": "RUB", "-y": "RDF", "z": "RFU", "-z": "RBD"}

#: Names of the other published types.
TYPES = {0xADBE0002: "SPZ_ADOBE_safe_orbit_camera"}

_DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "U": (0, 1, 0), "D": (0, -1, 0), "B": (0, 0, 1), "F": (0, 0, -1)}

#: Most bytes of extension records that are read.
MOST_EXTENSION_BYTES = 1 << 20

#: Most types of unknown records that notes name.
MOST_NAMED = 8

#: Contents of the extension records of a file: the axis that points up, from the coordinate system; notes on ignored
#: records; and whether there is a coordinate system, known or unknown.
Extensions = tuple[str | None, tuple[str, ...], bool]
NO_EXTENSIONS: Extensions = (None, (), False)


def read_extensions(data: bytes, size: int) -> Extensions:
    """Parse extension records, `size` bytes or the first `MOST_EXTENSION_BYTES` of them; notes name unknown ones."""
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
    return up, tuple(notes), has_system


# Writing.

#: The largest code of a coordinate, 2 ** 23 - 2. Other writers clamp larger coordinates to the next code, so `inspect`
#: reports coordinates with that code, of either sign, as clamped.
LAST_CODE = quantize.FIXED24_MAX - 1


def largest_fractional_bits(largest: float) -> int:
    """Return the most fractional bits, 0 to 24, with which 24-bit fixed point holds coordinates of this magnitude.

    Raises `FormatError` if not even whole units fit.
    """
    if np.rint(largest) > LAST_CODE:
        reach = f"{largest:.0f}" if largest < 1e7 else f"{largest:.3g}"
        raise FormatError(f"coordinates reach {reach}, SPZ holds at most {LAST_CODE}: scale the scene down")
    return next(bits for bits in range(MAX_FRACTIONAL_BITS, -1, -1) if np.rint(largest * 2.0**bits) <= LAST_CODE)


def needed(options: WriteOptions) -> frozenset[str]:
    """Return the names of the statistics from which `settled` derives the options that are None."""
    chosen = {"reach": None, "leaf_scale": options.fractional_bits, "leaf_sh": options.sh_bits}
    return frozenset(name for name, value in chosen.items() if value is None)


def settled(scene: Scene | Statistics, options: WriteOptions) -> WriteOptions:
    """Return the options with a value for each that is None, chosen for the scene.

    Positions get as many fractional bits as all nodes allow, but no more than make a step small for the smallest leaves
    (`statistics.STEPS_A_SPLAT`); merged splats are larger. SH get as many bits as colours need (`enough`).

    Raises:
        FormatError: a coordinate does not fit the fractional bits; the message says how many would. Version 4 was
            chosen for a tree, or for a scene in which x points up.
        ValueError: `sh_bits` is out of range.
    """
    version = DEFAULT_SPZ_VERSION if options.spz_version is None else options.spz_version
    if version not in TREE_SPZ_VERSIONS:
        if not isinstance(scene, Scene) or scene.tree is not None:  # only trees are given as statistics
            raise FormatError("SPZ version 4 holds no tree that Spark reads; use version 2 or 3, or RAD")
        if scene.up is not None and scene.up not in SYSTEM_OF_UP:
            raise FormatError(f"SPZ version 4 cannot note that {scene.up} points up; use version 3, or turn the scene")
    counts = Statistics.of_scene(scene, needed(options)) if isinstance(scene, Scene) else scene
    assert counts.reach is not None
    bits, most = options.fractional_bits, largest_fractional_bits(counts.reach)
    if bits is None:
        bits = max(0, min(most, fine_bits(counts.values["leaf_scale"])))
    if bits > most:
        raise FormatError(f"a coordinate does not fit {bits} fractional bits; use at most {most}")
    sh_bits = options.sh_bits
    if sh_bits is None:
        sh_bits = quantize.LEAST_SH_BITS if counts.leaf_sh is None else enough(counts.leaf_sh, counts.sh_between)
    if not quantize.LEAST_SH_BITS <= sh_bits <= ALL_BITS:
        raise ValueError(f"sh_bits is {sh_bits}, not {quantize.LEAST_SH_BITS} to {ALL_BITS}")
    return dataclasses.replace(options, spz_version=version, fractional_bits=bits, sh_bits=sh_bits)


def like(header: Mapping[str, int], options: WriteOptions) -> WriteOptions:
    """Set the version and the fractional bits, if they are None, to those of the SPZ file that a scene was read from.

    Its coordinates then stay as they are. Versions 1 and 4, which fewer viewers read, become 3. Options for a scene
    from another format, according to its `Scene.header`, are returned unchanged.
    """
    if "fractional_bits" not in header:
        return options
    version, bits = options.spz_version, options.fractional_bits
    if version is None:
        version = header["version"] if header["version"] in TREE_SPZ_VERSIONS else max(TREE_SPZ_VERSIONS)
    bits = header["fractional_bits"] if bits is None else bits
    return dataclasses.replace(options, spz_version=version, fractional_bits=bits)


#: Ways to deflate streams; other streams have repetitions of all kinds.
WAYS = {
    **dict.fromkeys(("alphas", "scales", "rotations"), compression.NOISE),
    "colors": compression.TRIPLES,
    "child_counts": compression.RUNS,
    "child_starts": compression.LINKS,
}


@dataclass(frozen=True, eq=False)
class SpzEncoder:
    """`encoder.Encoder` of a file. The result of a window is its part of each stream, by the name of the stream.

    Attributes:
        up: the axis that points up; None if it is unknown.
        stored: (N, bytes) codes of streams in another file, by name. There may be more SH than are written.
        unchanged: (N,) nodes whose codes are copied from `stored`; None if all nodes are encoded.
    """

    layout: Layout
    up: str | None
    options: WriteOptions
    ranges: tuple[CodeRange, ...]
    stored: Mapping[str, Bytes] = field(default_factory=dict)
    unchanged: NDArray[np.bool_] | None = None

    def encode(self, splats: Splats, tree: LodTree | None, start: int) -> Encoded:
        """Encode a window of nodes that begins at node `start`."""
        streams, bits, sh_bits = self.layout.streams(), self.layout.fractional_bits, self.options.sh_bits
        codes = {stream.name: np.empty((len(splats), stream.size), np.uint8) for stream in streams}
        assert sh_bits is not None
        for part in blocks_of(len(splats)):
            block, links = splats.take(part), None if tree is None else tree.rows(part)
            if self.options.covering:
                opacity = quantize.compensated(block.opacity, block.scale, None, 2.0**-bits)
                block = dataclasses.replace(block, opacity=opacity)
            for stream in streams:
                if stream.name == "sh":
                    values = sh_codes(block.sh, None if links is None else links.is_leaf, sh_bits)
                else:
                    column = getattr(block if stream.column in COLUMNS else links, stream.column)
                    values = np.ascontiguousarray(stream.encode(column))
                codes[stream.name][part] = values.view(np.uint8).reshape(-1, stream.size)
        if self.unchanged is not None:
            here = slice(start, start + len(splats))
            unchanged = self.unchanged[here]
            for name, stored in self.stored.items():
                codes[name][unchanged] = stored[here][unchanged, : codes[name].shape[1]]
        if not self.ranges:
            return codes
        return codes | {CLAMPED: tally(splats, self.ranges, None if tree is None else tree.is_leaf)}

    def pieces(self, windows: Windows, *, threads: int, progress: Progress) -> Iterator[bytes]:
        """Yield the bytes of the file: a gzip member of the header and all streams, or those of version 4."""
        layout, streams, count = self.layout, self.layout.streams(), self.layout.count
        if layout.version not in TREE_SPZ_VERSIONS:
            yield from self._pieces_v4(windows, threads, progress)
            return
        fields = layout.version, count, layout.sh_degree, layout.fractional_bits, layout.flags, 0
        numbers = range(len(windows_of(count)))
        data = (windows(number, stream.name) for stream in streams for number in numbers)
        runs = [(stream.size * count, WAYS.get(stream.name, compression.MIXED)) for stream in streams]
        runs[0] = runs[0][0] + HEADER.size, runs[0][1]
        # Without the comment, a plain file would be taken for one of another program, with y up.
        comment = "" if self.up is None and layout.flags & LOD else comment_of(up=self.up)
        yield from compression.gzip_member(
            itertools.chain([HEADER.pack(MAGIC, *fields)], data),
            runs,
            self.options.compression_level,
            threads,
            progress,
            comment=comment.encode(),
        )

    def _pieces_v4(self, windows: Windows, threads: int, progress: Progress) -> Iterator[bytes]:
        """Compress all streams; yield the header, the extensions, the table of streams, and the streams."""
        layout, streams, frames = self.layout, self.layout.streams(), list[bytes]()

        def packed(stream: SpzStream) -> bytes:
            parts = (windows(number, stream.name) for number in range(len(windows_of(layout.count))))
            return compression.zstd_frame(parts, stream.size * layout.count, self.options.compression_level)

        sizes = [stream.size * layout.count for stream in streams]
        for frame in ordered_map(packed, streams, threads):
            frames.append(frame)
            progress("writing", sum(sizes[: len(frames)]), layout.total, "B")
        extensions = b""
        if self.up is not None:
            number = SYSTEMS.index(SYSTEM_OF_UP[self.up]) + 1
            extensions = RECORD.pack(COORDINATE_SYSTEM, 4) + number.to_bytes(4, "little")
        flags = layout.flags | EXTENSIONS * bool(extensions)
        fields = layout.version, layout.count, layout.sh_degree, layout.fractional_bits, flags, len(streams)
        yield HEADER_V4.pack(MAGIC, *fields, HEADER_V4.size + len(extensions), b"") + extensions
        yield b"".join(STREAM_SIZES.pack(len(frame), size) for frame, size in zip(frames, sizes, strict=True))
        yield from frames

    def keeping(self, stored: StoredCodes, unchanged: NDArray[np.bool_]) -> SpzEncoder:
        """Return an encoder that copies the codes of unchanged nodes from a file, for streams of the same coding."""
        (layout, codes), kept = stored, {}
        for stream in self.layout.streams():
            is_alike = stream.column in COLUMNS
            if stream.name == "positions":
                is_alike = layout.version > 1 and layout.fractional_bits == self.layout.fractional_bits
            elif stream.name == "rotations":
                is_alike = (layout.version >= 3) == (self.layout.version >= 3)
            elif stream.name == "alphas":
                is_alike = layout.flags & LOD == self.layout.flags & LOD
            if is_alike:
                kept[stream.name] = codes[stream.name]
        return dataclasses.replace(self, stored=kept, unchanged=unchanged)


def encoder(
    scene: Scene | Reader,
    options: WriteOptions,
    *,
    counting: bool = False,
    threads: int = 1,
    progress: Progress = silent,
) -> SpzEncoder:
    """Return the encoder of a scene, whose splats are not read; raises ValueError unless the options are settled.

    With `counting`, the encoder counts the values that it clamps.
    """
    if options.spz_version is None or options.fractional_bits is None or options.sh_bits is None:
        raise ValueError("the options leave choices open; `settled` makes them")
    if isinstance(scene, Scene):
        count, sh_degree, has_tree = len(scene), scene.splats.sh_degree, scene.tree is not None
    else:
        count, sh_degree, has_tree = scene.count, scene.sh_degree, scene.has_tree
    flags = ANTIALIASED * scene.antialiased | LOD * has_tree
    layout = Layout(options.spz_version, count, sh_degree, options.fractional_bits, flags)
    return SpzEncoder(layout, scene.up, options, SPZ_RANGES if counting else ())


def to_code(
    splats: Splats, is_leaf: NDArray[np.bool_] | None, fractional_bits: int, sh_bits: int, *, covering: bool
) -> Splats:
    """Return splats with the opacities and SH that are encoded; those read from a file stay as they are.

    Args:
        is_leaf: (N,) mask of the leaves of a tree; None without a tree.
        fractional_bits: fractional bits of positions.
        sh_bits: bits kept of the SH bytes of leaves; merged splats keep `quantize.LEAST_SH_BITS`.
        covering: opacities compensate for the rounding of scales.
    """
    sh = splats.sh
    if sh.shape[1] and len(sh):
        sh = quantize.decode_sh(sh_codes(sh, is_leaf, sh_bits))
    opacity = splats.opacity
    if covering:
        opacity = quantize.compensated(opacity, splats.scale, None, 2.0**-fractional_bits)
    return dataclasses.replace(splats, opacity=opacity, sh=sh)


def sh_codes(sh: FloatArray, is_leaf: NDArray[np.bool_] | None, sh_bits: int) -> Bytes:
    """Encode (N, K, 3) SH as bytes; merged splats keep fewer bits."""
    codes = quantize.encode_sh(sh, sh_bits)
    if is_leaf is not None and sh_bits > quantize.LEAST_SH_BITS:
        codes[~is_leaf] = quantize.encode_sh(sh[~is_leaf], quantize.LEAST_SH_BITS)
    return codes


def held(options: WriteOptions, sh_degree: int) -> Sequence[CodeRange]:
    """Return the ranges of values that SPZ stores without clamping."""
    return SPZ_RANGES


def encode(
    scene: Scene, options: WriteOptions = DEFAULTS, *, threads: int = 1, progress: Progress = silent
) -> Iterator[bytes]:
    """Yield the bytes of a file, with a tree if the scene has one; the same for any number of threads.

    Raises the errors of `settled`.
    """
    of_scene = encoder(scene, settled(scene, options))
    windows = list(results(of_scene, scene, threads, progress, "encoding"))
    yield from of_scene.pieces(lambda number, name: windows[number][name], threads=threads, progress=progress)


#: Codes of a file: its layout, and (N, bytes) of each stream by name. Decoding and encoding again may change them: a
#: rotation whose two largest components differ only by rounding may get another code.
StoredCodes = tuple[Layout, Mapping[str, Bytes]]


def stored(source: OpenFile, options: WriteOptions) -> tuple[StoredCodes, WriteOptions]:
    """Read the codes of a file; raises the errors of `open_content`.

    Returns:
        the codes, and the options, in which the values of the file replace None, see `like`.
    """
    layout, rows, header, *_ = open_streams(source.file, source.size)
    codes = {stream.name: np.empty((layout.count, stream.size), np.uint8) for stream in layout.streams()}
    for stream, part, block in rows:
        codes[stream.name][part] = block
    if layout.version > 1 and layout.fractional_bits <= MAX_FRACTIONAL_BITS:  # such positions can be written
        options = like(header, options)
    return (layout, codes), options
