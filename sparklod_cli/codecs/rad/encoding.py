"""Encodes the chunks of a RAD file, and makes the header that tells of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from zlib_ng import zlib_ng

from ...model.nodes import CHUNK_NODES
from ...model.scene import Scene
from ...model.sh import COEFFICIENTS
from ...model.splats import FloatArray, Splats
from ...support.parallel import blocks_of, ordered_map
from ...support.progress import Progress
from .. import octahedral, sh_palette
from ..options import RadOptions, WriteOptions
from ..splat_encoding import SplatEncoding
from .comment import comment_of
from .encodings import CODINGS
from .header import pack_chunk_header, padding
from .layout import PROPERTIES, RANGES, SIZES, Row
from .options import code_range
from .records import GZ, Property, RadChunkEntry, RadChunkHeader, RadHeader

_RAW = -zlib_ng.MAX_WBITS

#: The largest float32 below 1.
_BELOW_1 = np.nextafter(np.float32(1), np.float32(0))


@dataclass(frozen=True, eq=False)
class Palette:
    """Spherical harmonics that splats share.

    Attributes:
        codes: (codes, K, 3) coefficients, as many codes as the first chunk has splats: Spark reads no other number.
        labels: (N,) the code of each splat.
    """

    codes: FloatArray
    labels: NDArray[np.uint32]

    @classmethod
    def of(cls, splats: Splats, most: int, threads: int, progress: Progress) -> Palette:
        """A palette of at most so many codes, with zeros behind them up to as many as Spark reads."""
        room = min(len(splats), CHUNK_NODES)
        weight = sh_palette.visible_weight(splats)
        found = sh_palette.cluster(splats.sh, min(most, room), weight=weight, threads=threads, progress=progress)
        padded = np.zeros((room, *found.codes.shape[1:]), np.float32)
        padded[: len(found.codes)] = found.codes
        return cls(padded, found.labels)


@dataclass(frozen=True)
class Writing:
    """What the chunks of a file have in common.

    Attributes:
        scene: as it is written.
        options: with nothing left open.
        ranges: of the codes.
        palette: of SH, or None.
        level: of compression.
    """

    scene: Scene
    options: RadOptions
    ranges: SplatEncoding
    palette: Palette | None
    level: int

    @classmethod
    def of(cls, scene: Scene, options: WriteOptions, threads: int, progress: Progress) -> Writing:
        """That of a scene with settled options; finds the palette, if there is to be one."""
        rad, palette = options.rad, None
        assert rad.ranges is not None
        if rad.sh_codes is not None and scene.splats.sh_degree and len(scene):
            palette = Palette.of(scene.splats, rad.sh_codes, threads, progress)
        return cls(scene, rad, rad.ranges, palette, options.compression_level)

    def header(self, entries: Iterable[RadChunkEntry]) -> RadHeader:
        """The header of the file whose chunks are there."""
        scene, chunks = self.scene, tuple(entries)
        return RadHeader(
            len(scene),
            scene.splats.sh_degree,
            scene.tree is not None,
            CHUNK_NODES,
            sum(entry.bytes for entry in chunks),
            chunks,
            self.ranges,
            None if self.palette is None else len(self.palette.codes),
            comment_of(antialiased=scene.antialiased),
        )

    def chunks(self, threads: int, progress: Progress) -> Iterator[bytes]:
        """The bytes of each chunk in order, a few encoded ahead."""
        parts = blocks_of(len(self.scene), CHUNK_NODES)
        for part, chunk in zip(parts, ordered_map(self.chunk, parts, threads), strict=True):
            progress("writing", part.stop, len(self.scene), "splat")
            yield chunk

    def chunk(self, part: slice) -> bytes:
        """The bytes of the chunk of these splats."""
        payload, properties, at = [], [], 0
        for row in self._rows(first=part.start == 0):
            encoding = getattr(self.options, row.option) if row.option else row.encodings[0]
            low, high = code_range(row, self.ranges)
            data = self._deflated(CODINGS[encoding].encode(self._values(row, encoding, part), low, high), encoding)
            ends = (low, high) if RANGES.get(encoding) else (None, None)
            properties.append(Property(at, len(data), row.name, encoding, GZ, *ends))
            payload += [data, bytes(padding(len(data)))]
            at += len(data) + padding(len(data))
        splats, tree = self.scene.splats, self.scene.tree
        header = RadChunkHeader(
            part.start, part.stop - part.start, at, splats.sh_degree, tree is not None, tuple(properties), self.ranges
        )
        return b"".join([pack_chunk_header(header), *payload])

    def _rows(self, *, first: bool) -> Iterator[Row]:
        """The properties of a chunk."""
        degree = self.scene.splats.sh_degree
        for row in PROPERTIES:
            if row.degree:
                present = row.degree <= degree and (row.codes and first if self.palette is not None else not row.codes)
            elif row.column == "labels":
                present = self.palette is not None
            else:
                present = hasattr(self.scene.splats, row.column) or self.scene.tree is not None
            if present:
                yield row

    def _values(self, row: Row, encoding: str, part: slice) -> NDArray[Any]:
        """(n, numbers) values of a property, as its encoding takes them."""
        splats, tree = self.scene.splats, self.scene.tree
        if row.degree:
            source = splats.sh[part] if self.palette is None else self.palette.codes
            return source[:, COEFFICIENTS[row.degree - 1] : COEFFICIENTS[row.degree]].reshape(len(source), -1)
        if row.column == "labels":
            assert self.palette is not None
            return self.palette.labels[part, None]
        column: NDArray[Any] = getattr(splats if hasattr(splats, row.column) else tree, row.column)[part]
        if row.column == "opacity":
            return _alpha(column, encoding, self.ranges)[:, None]
        if row.column == "quat_xyzw" and encoding != "oct88r8":
            return column[:, :3] * np.where(column[:, 3:] < 0, np.float32(-1), np.float32(1))
        if row.column == "center" and self.options.center_bits is not None:
            return rounded(column, self.options.center_bits)
        return column if column.ndim == 2 else column[:, None]

    def _deflated(self, codes: NDArray[Any], encoding: str) -> bytes:
        """A raw deflate stream.

        Of codes of a byte, only runs are looked for: longer matches are chance, which makes them longer and slower.
        """
        strategy = zlib_ng.Z_RLE if SIZES[encoding] == 1 else zlib_ng.Z_DEFAULT_STRATEGY
        packer = zlib_ng.compressobj(self.level, zlib_ng.DEFLATED, _RAW, zlib_ng.DEF_MEM_LEVEL, strategy)
        return packer.compress(codes.data.cast("B")) + packer.flush()


def rounded(center: FloatArray, bits: int) -> FloatArray:
    """Centres rounded to multiples of 2 ** -bits."""
    return np.ldexp(np.rint(np.ldexp(center.astype(np.float64), bits)), -bits).astype(np.float32)


def _alpha(opacity: FloatArray, encoding: str, ranges: SplatEncoding) -> FloatArray:
    """Alpha of linear opacities.

    As a code, 1 of 0..2 lies between two of them; it must not become the upper one, which is that of a merged splat.
    """
    alpha = octahedral.encode_lod_alpha(opacity)
    return np.where(alpha == 1, _BELOW_1, alpha) if encoding == "r8" and ranges.lod_opacity else alpha
