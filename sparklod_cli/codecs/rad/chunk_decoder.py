"""Decodes the chunks of a RAD file to columns."""

from __future__ import annotations

import io
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...model.lod_tree import LodTree
from ...model.scene import ScaleCoding
from ...model.sh import COEFFICIENTS
from ...model.splats import FloatArray, Splats
from ...system.errors import FormatError, TooLongError, TruncatedError
from .. import spark_codings
from ..inflate import ERRORS, raw_unpacker
from ..quantize import Bytes, quat_of_xyz
from ..validation import check_rules, error_of
from . import rad_rules
from .property_codings import CODINGS
from .rad_header import Property, RadChunkHeader, RadHeader, read_chunk_header
from .rad_layout import BY_NAME, SIZES, Row


@dataclass(frozen=True)
class PackedChunk:
    """Chunk as it stands in the file: number from 0, its own header, which is checked, and the payload after that."""

    number: int
    header: RadChunkHeader
    payload: memoryview

    @classmethod
    def of(cls, data: bytes, number: int, header: RadHeader) -> PackedChunk:
        """Parse the header of a chunk.

        Raises:
            FormatError: its header is broken, or breaks a fatal rule of `rad_rules`.
        """
        chunk = read_chunk_header(io.BytesIO(data))
        check_rules(rad_rules.chunk_violations(header, number, chunk, len(data)))
        return cls(number, chunk, memoryview(data)[chunk.bytes :])

    def property(self, name: str) -> Property | None:
        """Return a property by its name; None where the chunk has none."""
        return next((each for each in self.header.properties if each.name == name), None)

    def scale_coding(self) -> ScaleCoding:
        """Return how the chunk holds its scales."""
        scales = self.property("scales")
        if scales is None or not scales.encoding.startswith("ln_"):
            return ScaleCoding()
        return ScaleCoding(scales.encoding, scales.min or 0.0, scales.max or 0.0)

    def palette(self, header: RadHeader) -> FloatArray | None:
        """Return (codes, K, 3) SH coefficients that labels point to; None where the chunk has no palette.

        Raises:
            FormatError: it is corrupt, or of another size than the header says.
        """
        codes = {row.degree: each for each in self.header.properties if (row := BY_NAME[each.name]).codes}
        if not codes:
            return None
        count = self.header.count if header.sh_code_count is None else header.sh_code_count
        palette = np.zeros((count, COEFFICIENTS[header.max_sh], 3), np.float32)
        for degree, each in codes.items():
            if degree <= header.max_sh:
                fill_sh(palette, degree, self.values(each, BY_NAME[each.name], count))
        return palette

    def values(self, each: Property, row: Row, count: int) -> NDArray[Any]:
        """Decode a property to (count, numbers) values.

        Raises:
            FormatError: it is corrupt, or has more or fewer bytes than that takes.
        """
        low = 0.0 if each.min is None else each.min
        high = 0.0 if each.max is None else each.max
        codes = self.unpacked(each, row, count)
        return CODINGS[each.encoding].decode(codes, count, row.numbers, low, high)

    def unpacked(self, each: Property, row: Row, count: int) -> Bytes:
        """Return the bytes of a property; raises `FormatError` as `values`."""
        expected = count * row.numbers * SIZES[each.encoding]
        data = self.payload[each.offset : each.offset + each.bytes]
        subject = f"{each.name} of chunk {self.number:,}"
        if each.compression is not None:
            unpacker = raw_unpacker()
            try:
                data = unpacker.decompress(data, expected + 1)  # a byte more, which tells what is too long
            except ERRORS:
                raise FormatError(f"corrupt data in {subject}") from None
            if len(data) == expected and not unpacker.eof:
                raise TruncatedError(f"{subject} is cut short: its compressed data do not end")
        if len(data) > expected:
            raise TooLongError(f"{subject} has more than the {expected:,} bytes of {count:,} splats in {each.encoding}")
        if len(data) < expected:
            raise TruncatedError(
                f"{subject} has {len(data):,} bytes; {count:,} splats in {each.encoding} take {expected:,}"
            )
        return np.frombuffer(data, np.uint8)


def fill_sh(out: FloatArray, degree: int, values: FloatArray) -> None:
    """Fill the coefficients of one degree of (N, K, 3) from (N, numbers), r g b innermost."""
    out[:, COEFFICIENTS[degree - 1] : COEFFICIENTS[degree]] = values.reshape(len(out), -1, 3)


@np.errstate(invalid="ignore", over="ignore")  # any bits may be a float
def fill(
    packed: PackedChunk,
    header: RadHeader,
    splats: Splats,
    tree: LodTree | None,
    palette: FloatArray | None,
    columns: Collection[str],
    *,
    thorough: bool = True,
) -> NDArray[np.uint32] | None:
    """Decode a chunk.

    Args:
        splats: as many as the chunk has; other columns are left as they are.
        palette: of SH that labels point to; None where it is not known, which leaves SH at 0.
        thorough: unpack the others, too, which finds what is corrupt.

    Returns:
        (N,) labels, where the chunk has some, and no palette was given.

    Raises:
        FormatError: a property is corrupt, or a label is beyond the palette.
    """
    count, labels = packed.header.count, None
    present = {each.name for each in packed.header.properties}
    _set_defaults(present, splats, tree, columns)
    for each in packed.header.properties:
        row = BY_NAME[each.name]
        if row.codes:
            continue
        if row.column in ("child_count", "child_start"):
            if tree is not None:
                getattr(tree, row.column)[:] = packed.values(each, row, count)[:, 0]
        elif row.column == "labels":
            if not thorough and "sh" not in columns:
                continue
            labels = packed.values(each, row, count)[:, 0].astype(np.uint32)
        elif row.column not in columns or row.degree > header.max_sh:
            if thorough:
                packed.unpacked(each, row, count)
        else:
            _fill_column(splats, row, packed.values(each, row, count))
    if labels is not None and palette is not None:
        if labels.max(initial=0) >= len(palette):
            where = f"SH label {labels.max():,} of chunk {packed.number:,}"
            raise error_of("rad.palette", f"{where} is beyond the {len(palette):,} codes of the palette")
        if "sh" in columns:
            np.take(palette, labels, axis=0, out=splats.sh)
        return None
    return labels


def _fill_column(splats: Splats, row: Row, values: NDArray[Any]) -> None:
    if row.column == "sh":
        fill_sh(splats.sh, row.degree, values)
    elif row.column == "opacity":
        splats.opacity[:] = spark_codings.decode_lod_alpha(values[:, 0].astype(np.float32))
    elif row.column == "quat_xyzw" and values.shape[1] == 3:
        splats.quat_xyzw[:] = quat_of_xyz(values.astype(np.float32))
    else:
        getattr(splats, row.column)[:] = values


def _set_defaults(present: Collection[str], splats: Splats, tree: LodTree | None, columns: Collection[str]) -> None:
    """Give the columns of missing properties what a viewer's arrays begin with: 0, and no rotation."""
    for row in BY_NAME.values():
        if row.name in present or row.codes or row.column == "labels":
            continue
        if row.column in ("child_count", "child_start"):
            if tree is not None:
                getattr(tree, row.column)[:] = 0
        elif row.column in columns:
            if row.column == "sh":
                splats.sh[:, COEFFICIENTS[row.degree - 1] : COEFFICIENTS[row.degree]] = 0
            else:
                getattr(splats, row.column)[:] = 0
            if row.column == "quat_xyzw":
                splats.quat_xyzw[:, 3] = 1
