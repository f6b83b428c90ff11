"""The codes of an SPZ file as they stand, so that nodes can be written again bit for bit.

Decoding and encoding again would nearly do: but a rotation whose two largest components are equal, but for rounding,
may get another code.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..model.lod_tree import LodTree
from ..model.splats import COLUMNS, Splats
from ..support.defaults import MAX_FRACTIONAL_BITS
from ..support.progress import Progress
from .clamps import Range
from .encoder import Encoded, Get
from .options import WriteOptions
from .quantize import Bytes
from .spz_encoder import SpzEncoder
from .spz_layout import Layout, Stream
from .spz_options import like
from .spz_reading import read_codes


@dataclass(frozen=True, eq=False)
class StoredSpz:
    """What a file stores.

    Attributes:
        layout: of the file.
        codes: (N, bytes) of each stream, by its name.
    """

    layout: Layout
    codes: Mapping[str, Bytes]

    def like(self, options: WriteOptions) -> WriteOptions:
        """These options, and where they leave a choice open, that of the file."""
        if self.layout.version == 1 or self.layout.fractional_bits > MAX_FRACTIONAL_BITS:
            return options  # its positions are in no coding that is written
        return like({"version": self.layout.version, "fractional_bits": self.layout.fractional_bits}, options)

    def keeping(self, encoder: SpzEncoder, kept: NDArray[np.bool_]) -> KeepingEncoder:
        """An encoder of as many nodes that gives some the codes of the file, where its coding is the same."""
        streams = encoder.layout.streams()
        codes = {each.name: self.codes[each.name] for each in streams if self._is_alike(each, encoder.layout)}
        return KeepingEncoder(encoder, codes, kept)

    def _is_alike(self, stream: Stream, other: Layout) -> bool:
        """Whether a layout has a stream of splats in the coding of the file."""
        mine = self.layout
        if stream.column not in COLUMNS:
            return False
        if stream.name == "positions":
            return mine.version > 1 and mine.fractional_bits == other.fractional_bits
        if stream.name == "rotations":
            return (mine.version >= 3) == (other.version >= 3)
        return stream.name != "alphas" or mine.has_tree == other.has_tree


def stored(file: BinaryIO) -> StoredSpz:
    """Reads the codes of a file.

    Raises:
        FormatError: see `spz_reading.decode`.
    """
    return StoredSpz(*read_codes(file))


@dataclass(frozen=True, eq=False)
class KeepingEncoder:
    """An encoder, see `encoder.Encoder`, some of whose nodes have codes that are given.

    Attributes:
        made: encodes all nodes.
        codes: (N, bytes or more) of each stream, by its name. Of SH, the file may have more coefficients than are
            written.
        kept: (N,) the nodes that have these.
    """

    made: SpzEncoder
    codes: Mapping[str, Bytes]
    kept: NDArray[np.bool_]

    @property
    def count(self) -> int:
        """Nodes of the file."""
        return self.made.count

    @property
    def sh_degree(self) -> int:
        """SH degree of the file."""
        return self.made.sh_degree

    @property
    def options(self) -> WriteOptions:
        """With nothing left open."""
        return self.made.options

    @property
    def ranges(self) -> tuple[Range, ...]:
        """Beyond which values are counted."""
        return self.made.ranges

    def encode(self, splats: Splats, tree: LodTree | None, start: int) -> Encoded:
        """The result of a window."""
        result, part = self.made.encode(splats, tree, start), slice(start, start + len(splats))
        kept = self.kept[part]
        for name, codes in self.codes.items():
            out: NDArray[Any] = result[name]
            out[kept] = codes[part][kept, : out.shape[1]]
        return result

    def pieces(self, get: Get, *, threads: int, progress: Progress) -> Iterator[bytes]:
        """The header and all streams."""
        return self.made.pieces(get, threads=threads, progress=progress)
