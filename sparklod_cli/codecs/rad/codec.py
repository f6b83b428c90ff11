"""RAD, the file of Spark 2 whose Level-of-Detail tree a viewer streams in chunks of 65,536 nodes.

A file is a header and its chunks, or a header that names a file for each chunk; `docs/formats/rad.md` lays them out.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...model.lod_tree import LodTree
from ...model.scene import Scene
from ...model.splats import COLUMNS, Splats
from ...system.progress import Progress, silent
from ..encoder import results
from ..options import DEFAULTS, WriteOptions
from ..quantize import Bytes
from ..reader import OpenCompanion
from ..splat_encoding import SplatEncoding
from .property_codings import CODINGS
from .rad_encoder import CHUNK, CodedProperty, RadEncoder
from .rad_encoder import encoder as encoder
from .rad_header import Files, Property, RadHeader
from .rad_layout import AUTO, OPTIONS, PROPERTIES, RANGES, SIZES, Row, encodings_of
from .rad_options import AUTOMATIC
from .rad_options import held as held
from .rad_options import needed as needed
from .rad_options import settled as settled
from .rad_reader import RadChunk as RadChunk
from .rad_reader import RadReader as RadReader
from .rad_reader import open_content as open_content
from .rad_reader import read_chunk as read_chunk

#: Bytes of chunks that wait in memory for their header; beyond, they wait on disk.
SPOOLED = 1 << 26


def encode(
    scene: Scene, options: WriteOptions = DEFAULTS, *, threads: int = 1, progress: Progress = silent
) -> Iterator[bytes]:
    """Return the bytes of one file, piece by piece; chunks wait in a temporary file for the header, which has sizes.

    The same scene and options give the same bytes for any number of threads. Nodes keep their order; that of
    `lod.chunk_order` is for streaming.

    Raises:
        FormatError, ValueError: see `rad_options.settled`.
    """
    of_scene = encoder(scene, settled(scene, options), threads=threads, progress=progress)
    with tempfile.SpooledTemporaryFile(SPOOLED) as file:
        sizes = [file.write(window[CHUNK].data) for window in results(of_scene, scene, threads, progress, "encoding")]
        file.seek(0)
        yield from of_scene.one_file(sizes, map(file.read, sizes), progress)


def encode_chunked(
    scene: Scene, options: WriteOptions, stem: str, *, threads: int = 1, progress: Progress = silent
) -> Files:
    """Return the name and the bytes of each file of a scene with a file a chunk, see `RadEncoder.files`.

    Raises:
        FormatError, ValueError: see `rad_options.settled`.
    """
    of_scene = encoder(scene, settled(scene, options), threads=threads, progress=progress)
    windows = results(of_scene, scene, threads, progress, "writing")
    yield from of_scene.files(windows, stem)


@dataclass(frozen=True, eq=False)
class StoredChunk:
    """Codes of a chunk.

    Attributes:
        start: its first node.
        properties: by name.
        codes: (n, ...) of the properties of splats, by name: the bytes of each splat, of differences their sums.
    """

    start: int
    properties: Mapping[str, Property]
    codes: Mapping[str, Bytes]


@dataclass(frozen=True, eq=False)
class StoredRad:
    """Codes of a file, see `encoder.Stored`: its header, and the chunks in order."""

    header: RadHeader
    chunks: tuple[StoredChunk, ...]

    def like(self, options: WriteOptions) -> WriteOptions:
        """Return the options, and where they leave a choice open, that of the first chunk of the file.

        How centres are rounded stays open where the encoding is that of "auto": it matters for merged splats.
        """
        rad = options.rad
        found = encodings_of(self.chunks[0].properties.values())
        if found.get("center") == AUTOMATIC.center:
            found["center"] = AUTO
        chosen: dict[str, Any] = {name: found.get(name, AUTO) for name in OPTIONS if getattr(rad, name) == AUTO}
        ranges = rad.ranges or self._ranges()
        return dataclasses.replace(options, rad=dataclasses.replace(rad, **chosen, ranges=ranges))

    def _ranges(self) -> SplatEncoding:
        """Return the ranges of the codes of the first chunk."""
        ranges, properties = self.header.encoding or SplatEncoding(lod_opacity=True), self.chunks[0].properties
        for name, low, high in (("rgb", "rgb_min", "rgb_max"), ("scales", "ln_scale_min", "ln_scale_max")):
            each = properties.get(name)
            if each is not None and each.encoding in RANGES and each.min is not None and each.max is not None:
                ends: dict[str, Any] = {low: each.min, high: each.max}
                ranges = dataclasses.replace(ranges, **ends)
        return ranges

    def keeping(self, encoder: RadEncoder, unchanged: NDArray[np.bool_]) -> KeepingEncoder:
        """Return an encoder of as many nodes that gives some the codes of the file, where its encoding is the same."""
        given = {each.name: getattr(encoder, each.name) for each in dataclasses.fields(RadEncoder)}
        return KeepingEncoder(**given, stored=self, unchanged=unchanged)

    def codes(self, name: str, start: int, stop: int) -> tuple[Property, Bytes] | None:
        """Return a property of some nodes and (n, ...) their codes; None where its coding differs between chunks."""
        found, codes = [], []
        for chunk in self.chunks:
            some = chunk.codes.get(name)
            part = slice(max(start - chunk.start, 0), max(stop - chunk.start, 0))
            if some is None:
                return None
            if len(some[part]):
                found.append(chunk.properties[name])
                codes.append(some[part])
        if len({(each.encoding, each.min, each.max) for each in found}) != 1:
            return None
        return found[0], np.concatenate(codes)


def stored(file: BinaryIO, *, open_companion: OpenCompanion | None = None) -> StoredRad:
    """Read the codes of a file and of those that it names; raises `FormatError` as `RadReader.open`."""
    reader, chunks = RadReader.open(file, open_companion), []
    for packed in reader.packed():
        count, properties = packed.header.count, {each.name: each for each in packed.header.properties}
        codes = {}
        for row in PROPERTIES:
            if row.name in properties and row.column in COLUMNS and not row.codes:
                each = properties[row.name]
                flat = _flat(packed.unpacked(each, row, count), each.encoding, count)
                codes[row.name] = np.ascontiguousarray(_by_splat(flat, row, each.encoding))
        chunks.append(StoredChunk(packed.header.base, properties, codes))
    return StoredRad(reader.header, tuple(chunks))


@dataclass(frozen=True, eq=False)
class KeepingEncoder(RadEncoder):
    """Encoder that gives the (N,) `unchanged` nodes their `stored` codes."""

    stored: StoredRad | None = None
    unchanged: NDArray[np.bool_] = dataclasses.field(default_factory=lambda: np.zeros(0, bool))

    def coded(
        self, row: Row, splats: Splats, tree: LodTree | None, labels: NDArray[np.uint32] | None, start: int
    ) -> CodedProperty:
        """Encode a property of a chunk in the range that it had."""
        made, stop = super().coded(row, splats, tree, labels, start), start + len(splats)
        found = None if self.stored is None else self.stored.codes(row.name, start, stop)
        if found is None or found[0].encoding != made.encoding:
            return made
        each, before = found
        low, high = (0.0 if end is None else end for end in (each.min, each.max))
        codes = CODINGS[made.encoding].encode(self.values(row, made.encoding, splats, tree, labels), low, high)
        flat, unchanged = _flat(codes, made.encoding, len(splats)), self.unchanged[start:stop]
        _by_splat(flat, row, made.encoding)[unchanged] = before[unchanged]
        return CodedProperty(made.encoding, _stored(flat, made.encoding, len(splats)), each.min, each.max)


def _flat(codes: NDArray[Any], encoding: str, count: int) -> Bytes:
    """Return the bytes of a property, a copy; those of differences as the codes themselves."""
    flat = np.array(codes).reshape(-1).view(np.uint8)
    return np.cumsum(flat.reshape(-1, count), axis=1, dtype=np.uint8).reshape(-1) if _differs(encoding) else flat


def _stored(flat: Bytes, encoding: str, count: int) -> Bytes:
    """Return the bytes of a property as they are stored."""
    if not _differs(encoding):
        return flat
    planes = flat.reshape(-1, count)
    return np.diff(planes, axis=1, prepend=np.zeros((len(planes), 1), np.uint8))


def _differs(encoding: str) -> bool:
    return encoding.endswith("_delta")


def _by_splat(flat: Bytes, row: Row, encoding: str) -> Bytes:
    """Return an (N, ...) view of the bytes of a property, splat by splat."""
    size, numbers = SIZES[encoding], row.numbers
    if encoding == "oct88r8":
        return flat.reshape(-1, numbers)
    if encoding.endswith("_lebytes"):
        return flat.reshape(size, numbers, -1).transpose(2, 1, 0)
    return flat.reshape(numbers, -1, size).transpose(1, 0, 2)
