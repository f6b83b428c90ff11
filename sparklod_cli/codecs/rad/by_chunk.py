"""Decodes a RAD file chunk by chunk, in any order and as often as it takes: what does not fit into memory."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from ...model.lod_tree import LodTree
from ...model.scene import FileCoding
from ...model.sh import COEFFICIENTS
from ...model.splats import FloatArray, Splats
from ...support.parallel import ordered_map
from .decoding import Packed
from .places import Beside
from .reading import checked_header, chunks_of, coding_of, facts_of, fill_known
from .records import RadHeader


def bytes_decoded(header: RadHeader) -> int:
    """Bytes of all columns of splats in memory."""
    return header.count * 4 * (14 + 3 * COEFFICIENTS[header.max_sh])


@dataclass(frozen=True, eq=False)
class ByChunk:
    """How the chunks of a file are decoded.

    Attributes:
        header: of the file.
        palette: (codes, K, 3) of SH; None without one.
    """

    header: RadHeader
    palette: FloatArray | None

    @classmethod
    def of(cls, file: BinaryIO, beside: Beside | None) -> ByChunk:
        """Reads the header of a file, and its palette.

        Raises:
            FormatError: see `reading.examine`.
        """
        header = checked_header(file, beside)
        first = next(chunks_of(file, header, beside, range(min(1, len(header.chunks)))), None)
        return cls(header, None if first is None else first.palette(header))

    @property
    def facts(self) -> dict[str, int]:
        """As `Scene.header`."""
        return facts_of(self.header, self.palette)

    def read(
        self, number: int, file: BinaryIO, beside: Beside | None, columns: Collection[str], *, thorough: bool = True
    ) -> tuple[Splats, LodTree | None, FileCoding]:
        """One chunk: its splats, its nodes where there is a tree, whose children have the numbers of the file, and its
        coding.

        Args:
            number: of the chunk, from 0.
            file: with the header.
            beside: opens the files of chunks.
            columns: of `Splats`; the others are 0.
            thorough: unpack the others, too, which finds what is corrupt.

        Raises:
            FormatError: the chunk is cut short, corrupt, or not the one that the header means.
        """
        (packed,) = chunks_of(file, self.header, beside, range(number, number + 1))
        coding = coding_of(self.header, [packed.scale_coding()])
        return *self._decoded(packed, columns, thorough=thorough), coding

    def read_all(
        self, file: BinaryIO, beside: Beside | None, columns: Collection[str], *, thorough: bool, threads: int
    ) -> Iterator[tuple[int, Splats, LodTree | None]]:
        """All chunks in order, with the index of the first splat of each; a few of them are in memory at a time."""

        def decoded(packed: Packed) -> tuple[int, Splats, LodTree | None]:
            return packed.header.base, *self._decoded(packed, columns, thorough=thorough)

        numbers = range(len(self.header.chunks))
        return ordered_map(decoded, chunks_of(file, self.header, beside, numbers), threads)

    def _decoded(self, packed: Packed, columns: Collection[str], *, thorough: bool) -> tuple[Splats, LodTree | None]:
        count = packed.header.count
        splats, tree = Splats.zeros(count, self.header.max_sh), None
        if self.header.lod_tree:
            tree = LodTree(np.empty(count, np.uint16), np.empty(count, np.uint32))
        fill_known(packed, self.header, splats, tree, self.palette, columns, thorough=thorough)
        return splats, tree
