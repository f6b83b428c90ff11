"""Encodes the chunks of a RAD file, and makes the header that tells of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from zlib_ng import zlib_ng

from ...model.lod_tree import LodTree
from ...model.nodes import CHUNK_NODES
from ...model.scene import Scene
from ...model.sh import COEFFICIENTS
from ...model.splats import COLUMNS, FloatArray, Splats
from ...model.streams import NodeStream
from ...support.parallel import blocks_of
from ...support.progress import Progress, silent
from .. import clamps, coverage, octahedral
from ..clamps import Range
from ..encoder import CLAMPED, Encoded, Get, windows_of
from ..noted import comment_of
from ..options import WriteOptions
from ..splat_encoding import SplatEncoding
from .containers import in_files, in_one_file
from .encodings import BLOCK, CODINGS
from .header import pack_chunk_header, padding
from .layout import BY_NAME, PROPERTIES, RANGES, SIZES, Row
from .options import code_range
from .palette import Palette
from .records import GZ, Property, RadChunkHeader, RadHeader

#: Names of the arrays of a window's result: the bytes of a chunk, and their number.
CHUNK, SIZE = "chunk", "size"

_RAW = -zlib_ng.MAX_WBITS

#: The largest float32 below 1.
_BELOW_1 = np.nextafter(np.float32(1), np.float32(0))


class Coded(NamedTuple):
    """A property of a chunk.

    Attributes:
        encoding: one of `layout.SIZES`.
        codes: their bytes, of any shape, not compressed.
        min, max: ends of the range of the codes; None where there is none.
    """

    encoding: str
    codes: NDArray[Any]
    min: float | None
    max: float | None


@dataclass(frozen=True, eq=False)
class RadEncoder:
    """The encoder of a file, see `encoder.Encoder`: the result of a window is a chunk.

    Attributes:
        count: splats of the file, which are nodes where there is a tree.
        sh_degree: of them.
        tree: whether there is one.
        antialiased, up: as in `Scene`.
        options: with nothing left open.
        palette: of SH, or None.
        ranges: beyond which values are counted; none unless somebody wants to know.
    """

    count: int
    sh_degree: int
    tree: bool
    antialiased: bool
    options: WriteOptions
    palette: Palette | None = None
    ranges: tuple[Range, ...] = ()
    up: str | None = None

    @property
    def _codes(self) -> SplatEncoding:
        """The ranges of the codes."""
        assert self.options.rad.ranges is not None
        return self.options.rad.ranges

    def encode(self, splats: Splats, tree: LodTree | None, start: int) -> Encoded:
        """The bytes of a chunk, and how many they are."""
        chunk = np.frombuffer(self._chunk(splats, tree, start), np.uint8)
        result = {CHUNK: chunk, SIZE: np.array([len(chunk)])}
        return result | (
            {CLAMPED: clamps.tally(splats, self.ranges, None if tree is None else tree.is_leaf)} if self.ranges else {}
        )

    def pieces(self, get: Get, *, threads: int, progress: Progress) -> Iterator[bytes]:
        """The header and all chunks."""
        windows = windows_of(self.count)
        sizes = [int(get(number, SIZE)[0]) for number in range(len(windows))]

        def chunks() -> Iterator[bytes]:
            for number, part in enumerate(windows):
                yield get(number, CHUNK).tobytes()
                progress("writing", part.stop, self.count, "splat")

        yield from in_one_file(self._header, sizes, chunks())

    def files(self, chunks: Iterable[NDArray[np.uint8]], stem: str) -> Iterator[tuple[str, Iterable[bytes]]]:
        """The files of a scene whose chunks are files of their own, see `codec.encode_chunked`.

        Args:
            chunks: in order, asked for one by one.
            stem: of the names.
        """
        return in_files(self._header, (chunk.tobytes() for chunk in chunks), stem)

    @property
    def _header(self) -> RadHeader:
        """The header of the file, without its chunks."""
        codes = None if self.palette is None else len(self.palette.codes)
        comment = comment_of(antialiased=self.antialiased, up=self.up)
        return RadHeader(self.count, self.sh_degree, self.tree, CHUNK_NODES, 0, (), self._codes, codes, comment)

    def _chunk(self, splats: Splats, tree: LodTree | None, start: int) -> bytes:
        payload, properties, at = [], [], 0
        labels = None if self.palette is None else self.palette.labels_of(splats, start)
        for row in self._rows(first=start == 0):
            made = self.coded(row, splats, tree, labels, start)
            data = self._deflated(made.codes, made.encoding)
            properties.append(Property(at, len(data), row.name, made.encoding, GZ, made.min, made.max))
            payload += [data, bytes(padding(len(data)))]
            at += len(data) + padding(len(data))
        header = RadChunkHeader(start, len(splats), at, self.sh_degree, self.tree, tuple(properties), self._codes)
        return b"".join([pack_chunk_header(header), *payload])

    def coded(
        self, row: Row, splats: Splats, tree: LodTree | None, labels: NDArray[np.uint32] | None, start: int
    ) -> Coded:
        """A property of the chunk that begins with node `start`."""
        encoding = getattr(self.options.rad, row.option) if row.option else row.encodings[0]
        low, high = code_range(row, self._codes)
        codes = CODINGS[encoding].encode(self.values(row, encoding, splats, tree, labels), low, high)
        return Coded(encoding, codes, *((low, high) if RANGES.get(encoding) else (None, None)))

    def _rows(self, *, first: bool) -> Iterator[Row]:
        """The properties of a chunk."""
        for row in PROPERTIES:
            if row.degree:
                own = row.codes and first if self.palette is not None else not row.codes
                present = row.degree <= self.sh_degree and own
            elif row.column == "labels":
                present = self.palette is not None
            else:
                present = row.column in COLUMNS or self.tree
            if present:
                yield row

    def values(
        self, row: Row, encoding: str, splats: Splats, tree: LodTree | None, labels: NDArray[np.uint32] | None
    ) -> NDArray[Any]:
        """(n, numbers) values of a property, as its encoding takes them."""
        if row.degree:
            source = splats.sh if self.palette is None else self.palette.codes
            flat = source.reshape(len(source), 3 * source.shape[1])
            return flat[:, 3 * COEFFICIENTS[row.degree - 1] : 3 * COEFFICIENTS[row.degree]]
        if row.column == "labels":
            assert labels is not None
            return labels[:, None]
        column: NDArray[Any] = getattr(splats if row.column in COLUMNS else tree, row.column)
        if row.column == "opacity":
            return _alpha(self._opacity(splats), encoding, self._codes)[:, None]
        if row.column == "quat_xyzw" and encoding != "oct88r8":
            return column[:, :3] * np.where(column[:, 3:] < 0, np.float32(-1), np.float32(1))
        if row.column == "center" and self.options.rad.center_bits is not None:
            return rounded(column, self.options.rad.center_bits)
        return column if column.ndim == 2 else column[:, None]

    def _opacity(self, splats: Splats) -> FloatArray:
        """(n,) opacities that make up for the rounding of scales."""
        if not self.options.covering:
            return splats.opacity
        ends = code_range(BY_NAME["scales"], self._codes)
        bits = self.options.rad.center_bits
        blur, kept = 0.0 if bits is None else 2.0**-bits, np.empty_like(splats.opacity)
        for part in blocks_of(len(splats), BLOCK):
            scale = splats.scale[part]
            rounded = CODINGS[self.options.rad.scales].rounded(scale, *ends)
            kept[part] = coverage.kept(splats.opacity[part], scale, rounded, blur)
        return kept

    def _deflated(self, codes: NDArray[Any], encoding: str) -> bytes:
        """A raw deflate stream.

        Of codes of a byte, only runs are looked for: longer matches are chance, which makes them longer and slower.
        """
        strategy = zlib_ng.Z_RLE if SIZES[encoding] == 1 else zlib_ng.Z_DEFAULT_STRATEGY
        packer = zlib_ng.compressobj(
            self.options.compression_level, zlib_ng.DEFLATED, _RAW, zlib_ng.DEF_MEM_LEVEL, strategy
        )
        return packer.compress(codes.data.cast("B")) + packer.flush()


def encoder(
    scene: Scene | NodeStream,
    options: WriteOptions,
    ranges: tuple[Range, ...] = (),
    *,
    threads: int = 1,
    progress: Progress = silent,
) -> RadEncoder:
    """The encoder of a scene; finds its palette, if there is to be one.

    Args:
        scene: of which nothing is read but what the palette is made of.
        options: settled.
        ranges: beyond which the results count values, see `clamps.tally`.
        threads, progress: for the palette.

    Raises:
        ValueError: the options are not settled.
    """
    rad = options.rad
    if rad.ranges is None:
        raise ValueError("the options leave choices open; `settled` makes them")
    if isinstance(scene, NodeStream):
        count, sh_degree, tree = scene.count, scene.sh_degree, True
    else:
        count, sh_degree, tree = len(scene), scene.splats.sh_degree, scene.tree is not None
    palette = None
    if rad.sh_codes is not None and sh_degree and count:
        palette = Palette.of(scene, rad.sh_codes, threads, progress)
    return RadEncoder(count, sh_degree, tree, scene.antialiased, options, palette, ranges, scene.up)


def rounded(center: FloatArray, bits: int) -> FloatArray:
    """Centres rounded to multiples of 2 ** -bits."""
    return np.ldexp(np.rint(np.ldexp(center.astype(np.float64), bits)), -bits).astype(np.float32)


def _alpha(opacity: FloatArray, encoding: str, ranges: SplatEncoding) -> FloatArray:
    """Alpha of linear opacities.

    As a code, 1 of 0..2 lies between two of them; it must not become the upper one, which is that of a merged splat.
    """
    alpha = octahedral.encode_lod_alpha(opacity)
    return np.where(alpha == 1, _BELOW_1, alpha) if encoding == "r8" and ranges.lod_opacity else alpha
