"""The streams of an SPZ file and their codings: one table for reading and writing."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import linear_opacity, lod_opacity
from ..model.lod_tree import LodTree
from ..model.sh import COEFFICIENTS
from ..model.splats import Splats
from ..support.defaults import MAX_SH_DEGREE
from . import quantize
from .statistics import ALL_BITS

MAGIC = 0x5053474E  # "NGSP"
HEADER = struct.Struct("<IIIBBBB")  # magic, version, splats, SH degree, fractional bits, flags, reserved

#: Flags of the header.
ANTIALIASED, EXTENSIONS, LOD = 0x01, 0x02, 0x80
KNOWN_FLAGS = ANTIALIASED | EXTENSIONS | LOD


#: The last streams of a file with a tree: column and type, by name.
LINKS = {"child_counts": ("child_count", "<u2"), "child_starts": ("child_start", "<u4")}


class Stream(NamedTuple):
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
StreamRows = tuple[Stream, slice, quantize.Bytes]


def column_of(splats: Splats, tree: LodTree | None, stream: Stream) -> NDArray[Any]:
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

    def streams(self) -> list[Stream]:
        """Return the streams in file order."""
        q, bits, coefficients = quantize, self.fractional_bits, COEFFICIENTS[self.sh_degree]
        table = [
            Stream("positions", 6, "center", lambda codes: codes.view("<f2"), lambda center: center.astype("<f2"))
            if self.version == 1
            else Stream(
                "positions",
                9,
                "center",
                lambda codes: q.decode_fixed24(codes.reshape(-1, 3, 3), bits),
                lambda center: q.encode_fixed24(center, bits),
            ),
            Stream(
                "alphas",
                1,
                "opacity",
                lambda codes: linear_opacity(q.decode_lod_opacity(codes)),  # D = 0..5
                lambda opacity: q.encode_lod_opacity(lod_opacity(opacity)),
            )
            if self.flags & LOD
            else Stream("alphas", 1, "opacity", q.decode_unorm8, q.encode_unorm8),
            Stream("colors", 3, "rgb", q.decode_color, q.encode_color),
            Stream("scales", 3, "scale", q.decode_log_scale, q.encode_log_scale),
            Stream("rotations", 4, "quat_xyzw", q.decode_quat_smallest_three, q.encode_quat_smallest_three)
            if self.version >= 3
            else Stream("rotations", 3, "quat_xyzw", q.decode_quat_first_three, q.encode_quat_first_three),
            Stream(
                "sh",
                3 * coefficients,  # coefficient-major, r g b innermost
                "sh",
                lambda codes: q.decode_sh(codes.reshape(-1, coefficients, 3)[:, : COEFFICIENTS[MAX_SH_DEGREE]]),
                lambda sh: q.encode_sh(sh, ALL_BITS),  # what is dropped of them is by now, see `spz_encoder.sh_codes`
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


def _integers(name: str, column: str, code: str) -> Stream:
    size = np.dtype(code).itemsize
    return Stream(name, size, column, lambda codes: codes.view(code), lambda values: values.astype(code))
