"""SPZ, Niantic's compressed splats, and Spark's extension of it for Level-of-Detail trees.

Reads versions 1 to 3 (a header and streams in one gzip member) and 4 (a plain header, a zstd frame a stream); writes
versions 2 and 3. `docs/format.md` lays the extension out byte by byte.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError, TreeError
from ..gaussian import linear_opacity, lod_opacity
from ..limits import DEFAULT_COMPRESSION, DEFAULT_SPZ_VERSION, MAX_FRACTIONAL_BITS, MAX_SH_DEGREE, SPZ_VERSIONS
from ..parallel import chunks_of, for_chunks, ordered_map
from ..progress import Progress, silent
from ..scene import Scene
from ..sh import COEFFICIENTS, notes_on_degree
from ..splats import FloatArray, Splats
from ..tree import LodTree
from . import compression, quantize

MAGIC = 0x5053474E  # "NGSP"
HEADER = struct.Struct("<IIIBBBx")  # magic, version, splats, SH degree, fractional bits, flags, reserved
HEADER_V4 = struct.Struct("<IIIBBBBI12x")  # ..., streams, offset of the table of streams, reserved
STREAM_SIZES = struct.Struct("<QQ")  # of a version 4 stream: compressed, uncompressed

ANTIALIASED, EXTENSIONS, LOD = 0x01, 0x02, 0x80
READABLE = (1, 2, 3, 4)

#: What "far below the smallest splats" means for the step of a position: see `fractional_bits`.
STEPS_A_SPLAT, SMALL_QUANTILE = 16, 0.01


@dataclass(frozen=True)
class Layout:
    """What a header says that decides which streams follow it."""

    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    flags: int

    def streams(self) -> dict[str, int]:
        """Bytes a splat of each stream, in file order."""
        sizes = {
            "positions": 6 if self.version == 1 else 9,  # 3 x float16, or 3 x 24-bit fixed point
            "alphas": 1,  # 0..255 for 0..1; in an LoD file for D = 0..5
            "colors": 3,  # SH DC coefficients
            "scales": 3,  # logarithms
            "rotations": 4 if self.version >= 3 else 3,  # smallest three, or x y z
            "sh": 3 * COEFFICIENTS[self.sh_degree],  # coefficient-major, r g b innermost
        }
        if self.flags & LOD:
            sizes |= {"child_counts": 2, "child_starts": 4}  # uint16, uint32
        return {name: size for name, size in sizes.items() if size}

    @property
    def total(self) -> int:
        """Bytes of all streams."""
        return self.count * sum(self.streams().values())


@dataclass(frozen=True)
class Options:
    """How to write.

    Attributes:
        version: 2 (rotations in 3 bytes) or 3 (in 4, ten times as exact).
        fractional_bits: of positions, 0 to 24; None takes what suits the scene, see `fractional_bits`.
        compression_level: 1 (fast) to 9 (small).
        threads: to encode and compress with.
    """

    version: int = DEFAULT_SPZ_VERSION
    fractional_bits: int | None = None
    compression_level: int = DEFAULT_COMPRESSION
    threads: int = 1


def largest_fractional_bits(center: NDArray[np.float32]) -> int:
    """The most fractional bits, 0 to 24, with which every coordinate fits 24-bit fixed point.

    Raises:
        FormatError: not even whole units fit.
    """
    largest = float(np.abs(center).max(initial=0))
    if np.rint(largest) > quantize.FIXED24_MAX:
        raise FormatError(f"coordinates reach {largest:.3g}, SPZ holds at most {quantize.FIXED24_MAX}: scale the scene")
    bits = MAX_FRACTIONAL_BITS
    while bits and np.rint(largest * 2.0**bits) > quantize.FIXED24_MAX:
        bits -= 1
    return bits


def fractional_bits(splats: Splats, options: Options) -> int:
    """The fractional bits that these splats get with these options.

    Raises:
        FormatError: a coordinate does not fit the fractional bits; the text names the most that would.
    """
    if options.version not in SPZ_VERSIONS:
        raise ValueError(f"SPZ version {options.version} is not one of {SPZ_VERSIONS}")
    most = largest_fractional_bits(splats.center)
    if options.fractional_bits is None:
        return _enough_bits(splats, most)
    if options.fractional_bits > most:
        raise FormatError(
            f"a coordinate does not fit {options.fractional_bits} fractional bits, at most {most} would do"
        )
    return options.fractional_bits


def _enough_bits(splats: Splats, most: int) -> int:
    """As many bits as the extent allows, up to where a step is far below the smallest splats.

    Small splats are measured by the 1 % quantile of their largest scales; a step is at most 1/16 of that.
    """
    small = float(np.quantile(splats.scale.max(axis=1), SMALL_QUANTILE))
    return max(0, min(most, math.ceil(math.log2(STEPS_A_SPLAT / small))))


def clamped(splats: Splats, threads: int = 1) -> dict[str, int]:
    """How many splats have a value that its code cannot hold, by the column (scale, rgb, sh) where there are any."""
    counts = {}
    for name, (low, high) in quantize.CLAMPS.items():
        column = getattr(splats, name).reshape(len(splats), -1)

        def outside(part: slice, column: FloatArray = column, low: float = low, high: float = high) -> int:
            values = column[part]
            return int(np.count_nonzero(((values < low) | (values > high)).any(axis=1)))

        counts[name] = sum(ordered_map(outside, chunks_of(len(splats)), threads))
    return {name: count for name, count in counts.items() if count}


def decode(file: BinaryIO, *, threads: int = 1, progress: Progress = silent) -> Scene:
    """Reads any SPZ file, plain or LoD.

    Raises:
        FormatError: it is not SPZ, not a version or degree that is known, cut short, corrupt, or claims far more splats
            than its size can hold; an LoD file whose tree is not one.
    """
    data = file.read()
    layout, columns = _read_v4(data) if data[:4] == struct.pack("<I", MAGIC) else _read_gzip(data)
    splats = Splats.empty(layout.count, min(layout.sh_degree, MAX_SH_DEGREE))
    for_chunks(
        lambda part: _decode_chunk(layout, columns, splats, part),
        layout.count,
        threads,
        lambda done: progress("reading", done, layout.count, "splat"),
    )
    tree = None
    if layout.flags & LOD:
        tree = LodTree(columns["child_counts"].view("<u2")[:, 0], columns["child_starts"].view("<u4")[:, 0])
        try:
            tree.validate()
        except TreeError as error:
            raise FormatError(f"its LoD tree is broken: {error}") from error
    name = f"SPZ {layout.version}" + (" LoD" if tree else "")
    return Scene(splats, tree, bool(layout.flags & ANTIALIASED), name, notes_on_degree(layout.sh_degree))


def _decode_chunk(layout: Layout, columns: dict[str, quantize.Bytes], out: Splats, part: slice) -> None:
    positions = columns["positions"][part]
    if layout.version == 1:
        out.center[part] = positions.view("<f2")
    else:
        out.center[part] = quantize.decode_fixed24(positions.reshape(-1, 3, 3), layout.fractional_bits)
    alphas = columns["alphas"][part, 0]
    if layout.flags & LOD:
        out.opacity[part] = linear_opacity(quantize.decode_lod_opacity(alphas))
    else:
        out.opacity[part] = quantize.decode_opacity(alphas)
    out.rgb[part] = quantize.decode_color(columns["colors"][part])
    out.scale[part] = quantize.decode_log_scale(columns["scales"][part])
    rotations = columns["rotations"][part]
    smallest_three = layout.version >= 3
    decode_quat = quantize.decode_quat_smallest_three if smallest_three else quantize.decode_quat_first_three
    out.quat_xyzw[part] = decode_quat(rotations)
    if out.sh.shape[1]:
        sh = columns["sh"][part].reshape(-1, COEFFICIENTS[layout.sh_degree], 3)
        out.sh[part] = quantize.decode_sh(sh[:, : out.sh.shape[1]])


def encode(scene: Scene, options: Options, *, progress: Progress = silent) -> Iterator[bytes]:
    """The bytes of a file, piece by piece: an LoD file where the scene has a tree, else a plain one.

    The same scene and options give the same bytes for any number of threads.

    Raises:
        FormatError: a coordinate does not fit the fractional bits; the text names the most that would.
    """
    splats, tree = scene.splats, scene.tree
    bits = fractional_bits(splats, options)
    flags = (ANTIALIASED if scene.antialiased else 0) | (LOD if tree else 0)
    layout = Layout(options.version, len(splats), splats.sh_degree, bits, flags)
    data = np.empty(HEADER.size + layout.total, np.uint8)
    data[: HEADER.size] = np.frombuffer(
        HEADER.pack(MAGIC, layout.version, layout.count, layout.sh_degree, bits, flags), np.uint8
    )
    columns = _split(layout, data[HEADER.size :])
    for_chunks(
        lambda part: _encode_chunk(layout, splats, columns, part),
        layout.count,
        options.threads,
        lambda done: progress("encoding", done, layout.count, "splat"),
    )
    if tree:
        columns["child_counts"][:] = tree.child_count.astype("<u2").view(np.uint8).reshape(-1, 2)
        columns["child_starts"][:] = tree.child_start.astype("<u4").view(np.uint8).reshape(-1, 4)
    yield from compression.gzip_member(data, options.compression_level, options.threads, progress)


def _encode_chunk(layout: Layout, splats: Splats, columns: dict[str, quantize.Bytes], part: slice) -> None:
    fixed = quantize.encode_fixed24(splats.center[part], layout.fractional_bits)
    columns["positions"][part] = fixed.reshape(-1, 9)
    opacity = splats.opacity[part]
    if layout.flags & LOD:
        columns["alphas"][part, 0] = quantize.encode_lod_opacity(lod_opacity(opacity))
    else:
        columns["alphas"][part, 0] = quantize.encode_opacity(opacity)
    columns["colors"][part] = quantize.encode_color(splats.rgb[part])
    columns["scales"][part] = quantize.encode_log_scale(splats.scale[part])
    smallest_three = layout.version >= 3
    encode_quat = quantize.encode_quat_smallest_three if smallest_three else quantize.encode_quat_first_three
    columns["rotations"][part] = encode_quat(splats.quat_xyzw[part])
    if "sh" in columns:
        columns["sh"][part] = quantize.encode_sh(splats.sh[part]).reshape(-1, splats.sh.shape[1] * 3)


def _split(layout: Layout, data: quantize.Bytes) -> dict[str, quantize.Bytes]:
    """Views of the streams that lie one after the other in `data`, (count, bytes a splat) each."""
    columns, at = {}, 0
    for name, size in layout.streams().items():
        columns[name] = data[at : at + size * layout.count].reshape(layout.count, size)
        at += size * layout.count
    return columns


def _checked(layout: Layout, file_size: int) -> Layout:
    """The layout, if it is one we read and the file's size makes its claims believable."""
    if layout.version not in READABLE:
        raise FormatError(f"SPZ version {layout.version} is not known, only 1 to 4 are")
    if layout.sh_degree > (4 if layout.version == 4 else MAX_SH_DEGREE):
        raise FormatError(f"SH degree {layout.sh_degree} is not one that SPZ version {layout.version} has")
    if layout.fractional_bits > 31:
        raise FormatError(f"{layout.fractional_bits} fractional bits are more than a position has")
    compression.check_promise(layout.total, file_size)
    return layout


def _read_gzip(data: bytes) -> tuple[Layout, dict[str, quantize.Bytes]]:
    inflate = compression.Inflate(data)
    head = inflate.read(HEADER.size)
    if len(head) < HEADER.size:
        raise FormatError("cut short inside the SPZ header")
    magic, *fields = HEADER.unpack(head)
    if magic != MAGIC:
        raise FormatError("gzip, but not of an SPZ file")
    layout = _checked(Layout(*fields), len(data))
    body = inflate.read(layout.total)
    if len(body) < layout.total:
        raise FormatError(f"cut short: the header promises {layout.count:,} splats, the streams end before that")
    inflate.finish(allow_more=bool(layout.flags & EXTENSIONS))
    return layout, _split(layout, np.frombuffer(body, np.uint8))


def _read_v4(data: bytes) -> tuple[Layout, dict[str, quantize.Bytes]]:
    if len(data) < HEADER_V4.size:
        raise FormatError("cut short inside the SPZ header")
    _, version, count, sh_degree, bits, flags, streams, table = HEADER_V4.unpack_from(data)
    if version != 4:
        raise FormatError(f"SPZ version {version} is not gzipped, as versions 1 to 3 are")
    layout = _checked(Layout(version, count, sh_degree, bits, flags), len(data))
    expected = layout.streams()
    if streams < len(expected):
        raise FormatError(f"{streams} streams where SH degree {sh_degree} and flags {flags:#x} need {len(expected)}")
    at = table + streams * STREAM_SIZES.size
    if at > len(data):
        raise FormatError("cut short inside the table of streams")
    columns = {}
    for index, (name, size) in enumerate(expected.items()):
        packed, unpacked = STREAM_SIZES.unpack_from(data, table + index * STREAM_SIZES.size)
        if unpacked != size * count:
            raise FormatError(f"stream {name} has {unpacked:,} bytes, {count:,} splats need {size * count:,}")
        if at + packed > len(data):
            raise FormatError(f"cut short inside stream {name}")
        stream = compression.unzstd(data[at : at + packed], unpacked, name)
        columns[name] = np.frombuffer(stream, np.uint8).reshape(count, size)
        at += packed
    return layout, columns
