"""Readers of RAD files: whole, by ranges of splats, by chunks, or by headers alone."""

from __future__ import annotations

import contextlib
import dataclasses
import io
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...model import MAX_SH_DEGREE
from ...model.lod_tree import LodTree
from ...model.scene import PLAIN_SCALES, FileCoding, ScaleCoding, Scene
from ...model.sh import COEFFICIENTS, width_of
from ...model.splats import COLUMNS, FloatArray, Splats
from ...system.errors import FormatError, TooLongError, TruncatedError
from ...system.machine import available_memory
from ...system.progress import Progress
from ...system.threads import ordered_map
from .. import spark_codings
from ..compression import INFLATE_ERRORS, check_promise, raw_unpacker
from ..format_rules import RuleViolation, check_rules, error_of
from ..quantize import Bytes, quat_of_xyz
from ..reader import OpenCompanion, OpenFile, Reader, RowBuffer, size_of
from .property_codings import BY_NAME, CODINGS, PROPERTIES, Property, Row, encodings_of
from .rad_header import (
    Files,
    RadChunkEntry,
    RadChunkHeader,
    RadHeader,
    broken,
    chunk_violations,
    header_violations,
    in_files,
    in_one_file,
    padding,
    read_chunk_header,
    read_header,
)


@dataclass(frozen=True, eq=False)
class RadReader:
    """RAD file whose header has been read; `palette` is (codes, K, 3) SH coefficients, None without a palette."""

    header: RadHeader
    file: BinaryIO
    open_companion: OpenCompanion | None = None
    palette: FloatArray | None = None

    @classmethod
    def open(cls, file: BinaryIO, open_companion: OpenCompanion | None = None) -> RadReader:
        """Read the header of a file and its palette; `FormatError` if a fatal rule or the first chunk is broken."""
        header, violations = scan_header(file, open_companion)
        check_rules(violations)
        check_promise(decoded_bytes(header), header.bytes + sum(entry.bytes for entry in header.chunks))
        reader = cls(header, file, open_companion)
        return dataclasses.replace(reader, palette=reader.packed(0).palette(header)) if header.chunks else reader

    @property
    def facts(self) -> dict[str, int]:
        """Facts for `Scene.header`: version, number and size of chunks, bytes of the header, codes of SH."""
        header = self.header
        facts = {"version": 1, "chunks": len(header.chunks), "chunk_size": header.chunk_size}
        facts |= {"header_bytes": header.bytes, "chunked": int(header.chunked)}
        return facts | ({"sh_codes": len(self.palette)} if self.palette is not None else {})

    @property
    def encodings(self) -> dict[str, str]:
        """Encodings of the properties of the first chunk, by the field of `RadOptions`."""
        return encodings_of(self.packed(0).header.properties) if self.header.chunks else {}

    def in_one_file(self) -> Iterator[bytes]:
        """Yield the bytes of one file that holds all chunks unchanged."""
        sizes = [entry.bytes for entry in self.header.chunks]
        return in_one_file(self.header, sizes, map(self._bytes_of, range(len(sizes))))

    def in_files(self, stem: str) -> Files:
        """Yield a file for each unchanged chunk, and their header; see `rad_header.in_files`."""
        return in_files(self.header, map(self._bytes_of, range(len(self.header.chunks))), stem)

    @contextlib.contextmanager
    def _opened(self, entry: RadChunkEntry) -> Iterator[tuple[BinaryIO, int]]:
        """Open the file of a chunk; yield it and the position of the chunk."""
        if entry.filename is None:
            yield self.file, entry.start(self.header)
        else:
            with _open_companion(entry.filename, self.open_companion) as file:
                yield file, entry.start(self.header)

    def _bytes_of(self, number: int) -> bytes:
        entry = self.header.chunks[number]
        with self._opened(entry) as (file, start):
            lacking = start + entry.bytes - size_of(file)
            if lacking > 0:  # checked before so much memory is allocated
                raise TruncatedError(f"cut short: {lacking:,} of {entry.bytes:,} bytes of a chunk are missing")
            file.seek(start)
            return file.read(entry.bytes)

    def packed(self, number: int) -> PackedChunk:
        """Read a chunk by its number from 0, without decoding it; `FormatError` if its header breaks a fatal rule."""
        data = self._bytes_of(number)
        header = read_chunk_header(io.BytesIO(data))
        check_rules(chunk_violations(self.header, number, header, len(data)))
        return PackedChunk(number, header, memoryview(data)[header.bytes :])

    def decode(
        self,
        packed: PackedChunk,
        columns: Collection[str] = COLUMNS,
        target: tuple[Splats, LodTree | None] | None = None,
        *,
        thorough: bool = True,
    ) -> tuple[Splats, LodTree | None]:
        """Decode the splats of a chunk, and its nodes in a file with a tree; `child_start` is that of the file.

        Args:
            target: rows to fill; None for new ones.
            thorough: also unpack all other columns, to find corrupt ones.
        """
        splats, tree = target or self._new_rows(packed.header.count)
        if self._fill(packed, splats, tree, columns, thorough=thorough) is not None:
            raise error_of("rad.palette", f"chunk {packed.number:,} has labels of SH, but there is no palette")
        return splats, tree

    def chunks(
        self, columns: Collection[str], *, thorough: bool, threads: int
    ) -> Iterator[tuple[int, Splats, LodTree | None]]:
        """Decode all chunks in order, some ahead of time; yield the index of the first splat, splats and nodes."""

        def work(packed: PackedChunk) -> tuple[int, Splats, LodTree | None]:
            return packed.header.base, *self.decode(packed, columns, thorough=thorough)

        return ordered_map(work, map(self.packed, range(len(self.header.chunks))), threads)

    def chunk(self, number: int, columns: Collection[str]) -> tuple[Splats, LodTree | None, FileCoding]:
        """Decode columns of a chunk by its number from 0; return its splats, nodes and coding."""
        packed = self.packed(number)
        return *self.decode(packed, columns, thorough=False), self._coding([packed.scale_coding()])

    def read_chunk(self, number: int) -> RadChunk:
        """Read one chunk by its number from 0, and no other; SH are 0 if they are labels and the palette is unknown.

        Raises:
            FormatError: the chunk is cut short, corrupt, or not the one that the header means.
            ValueError: the palette is of another SH degree than the file.
        """
        header, palette = self.header, self.palette
        room = COEFFICIENTS[min(header.max_sh, MAX_SH_DEGREE)], 3
        if palette is not None and np.shape(palette)[1:] != room:
            text = f"the palette has the shape {np.shape(palette)}; that of this file has (codes, {room[0]}, 3)"
            raise ValueError(text)
        check_rules(header_violations(header))
        packed = self.packed(number)
        count = packed.header.count
        check_promise(decoded_bytes(dataclasses.replace(header, count=count)), header.chunks[number].bytes)
        own = packed.palette(header)
        palette = own if own is not None or palette is None else np.asarray(palette, np.float32)
        splats, tree = self._new_rows(count)
        labels = dataclasses.replace(self, palette=palette)._fill(packed, splats, tree, COLUMNS)
        return RadChunk(packed.header, splats, tree, own, labels)

    def count_leaves(self) -> int:
        """Count the leaves of a tree, by reading nothing but the numbers of children."""
        leaves = 0
        for number, entry in enumerate(self.header.chunks):
            with self._opened(entry) as (file, start):
                file.seek(start)
                chunk = read_chunk_header(file)
                check_rules(chunk_violations(self.header, number, chunk, entry.bytes))
                leaves += chunk.count
                for each in chunk.properties:
                    if each.name == "child_count":
                        file.seek(start + chunk.bytes + each.offset)
                        packed = PackedChunk(number, chunk, memoryview(file.read(each.bytes)))
                        children = packed.values(dataclasses.replace(each, offset=0), BY_NAME[each.name], chunk.count)
                        leaves -= int(np.count_nonzero(children))
        return leaves

    def scan_chunks(self, *, paddings: bool) -> Iterator[tuple[RadChunkHeader | None, list[RuleViolation]]]:
        """Yield the header of each chunk, None if it is unreadable, and its broken rules, also about `paddings`."""
        for number, entry in enumerate(self.header.chunks):
            with self._opened(entry) as (file, start):
                file.seek(start)
                try:
                    chunk = read_chunk_header(file)
                except FormatError as error:
                    yield None, [broken("chunk-header", f"chunk {number:,}: {error}")]
                    continue
                violations = list(chunk_violations(self.header, number, chunk, entry.bytes))
                if paddings and not any(each.fatal for each in violations):
                    for each in chunk.properties:
                        file.seek(start + chunk.bytes + each.offset + each.bytes)
                        if any(file.read(padding(each.bytes))):
                            text = f"bytes behind {each.name} of chunk {number:,} are not zeros"
                            violations.append(broken("padding", text))
                yield chunk, violations

    def content(self) -> Reader:
        header, size = self.header, self.header.chunk_size
        codings = [PLAIN_SCALES] * max(len(header.chunks), 1)

        def fill_rows(target: RowBuffer, threads: int, progress: Progress) -> None:
            def work(packed: PackedChunk) -> int:
                codings[packed.number] = packed.scale_coding()
                base, stop = packed.header.base, packed.header.base + packed.header.count
                first, last = max(base, target.start), min(stop, target.stop)
                part = slice(first, last)
                if (first, last) == (base, stop):
                    self.decode(packed, target.columns, (target.rows(part), target.nodes(part)))
                else:
                    splats, out = self.decode(packed, target.columns)[0], target.rows(part)
                    for name in COLUMNS:
                        getattr(out, name)[:] = getattr(splats, name)[first - base : last - base]
                return last

            if target.start < target.stop:
                numbers = range(target.start // size, -(-target.stop // size))
                for done in ordered_map(work, map(self.packed, numbers), threads):
                    progress("reading", done, header.count, "splat")

        return Reader(
            header.count,
            header.max_sh,
            header.format,
            fill_rows,
            header.noted.antialiased,
            header.noted.problems,
            self.facts,
            header.noted.up,
            header.lod_tree,
            tuple(entry.bytes for entry in header.chunks),
            lambda: self._coding(codings),
            max(size, 1),
        )

    def about(self) -> Scene:
        """Return the scene without splats and tree, as known before any chunk is read."""
        return dataclasses.replace(self.content(), count=0, has_tree=False, coding=None).scene()

    def _coding(self, scales: list[ScaleCoding]) -> FileCoding:
        """Return the coding of the file by the codings of its chunks' scales."""
        ranges = self.header.encoding
        packed_range = None if ranges is None else (ranges.ln_scale_min, ranges.ln_scale_max)
        return FileCoding(tuple(scales), self.header.chunk_size, packed_range)

    def _new_rows(self, count: int) -> tuple[Splats, LodTree | None]:
        tree = LodTree(np.empty(count, np.uint16), np.empty(count, np.uint32)) if self.header.lod_tree else None
        return Splats.zeros(count, self.header.max_sh), tree

    @np.errstate(invalid="ignore", over="ignore")  # any bits may be a float
    def _fill(
        self,
        packed: PackedChunk,
        splats: Splats,
        tree: LodTree | None,
        columns: Collection[str],
        *,
        thorough: bool = True,
    ) -> NDArray[np.uint32] | None:
        """Decode columns of a chunk into rows; return (N,) labels of SH if there are some and the palette is unknown.

        Columns of missing properties get the initial values of a viewer's arrays: 0, and no rotation.
        """
        count, labels, palette = packed.header.count, None, self.palette
        properties = {each.name: each for each in packed.header.properties}
        for row in PROPERTIES:
            each = properties.get(row.name)
            if row.codes:
                continue
            if row.column in ("child_count", "child_start"):
                if tree is not None:
                    getattr(tree, row.column)[:] = 0 if each is None else packed.values(each, row, count)[:, 0]
            elif row.column == "labels":
                if each is not None and (thorough or "sh" in columns):
                    labels = packed.values(each, row, count)[:, 0].astype(np.uint32)
            elif row.column in columns and row.degree <= self.header.max_sh:
                _fill_column(splats, row, None if each is None else packed.values(each, row, count))
            elif thorough and each is not None:
                packed.unpacked(each, row, count)
        if labels is not None and palette is not None:
            if labels.max(initial=0) >= len(palette):
                where = f"SH label {labels.max():,} of chunk {packed.number:,}"
                raise error_of("rad.palette", f"{where} is beyond the {len(palette):,} codes of the palette")
            if "sh" in columns:
                np.take(palette, labels, axis=0, out=splats.sh)
            return None
        return labels


def _fill_column(splats: Splats, row: Row, values: NDArray[Any] | None) -> None:
    """Set the part of a column that a property has to (N, numbers) values; to the defaults for None."""
    out = getattr(splats, row.column)
    if row.degree:
        out = out[:, COEFFICIENTS[row.degree - 1] : COEFFICIENTS[row.degree]]
    if values is None:
        out[...] = (0, 0, 0, 1) if row.column == "quat_xyzw" else 0
    elif row.column == "opacity":
        out[:] = spark_codings.decode_lod_alpha(values[:, 0].astype(np.float32))
    elif row.column == "quat_xyzw" and values.shape[1] == 3:
        out[:] = quat_of_xyz(values.astype(np.float32))
    else:
        out[...] = values.reshape(out.shape)


def open_content(source: OpenFile) -> Reader:
    """Open a RAD file, whole or with chunks in files of their own; raises `FormatError` as `RadReader.open`."""
    return RadReader.open(source.file, source.open_companion).content()


@dataclass(frozen=True, eq=False)
class RadChunk:
    """One chunk of a file.

    Attributes:
        splats: splats with SH of 0 if they are labels and the palette is unknown.
        tree: nodes, whose `child_start` is that of the file.
        palette: (codes, K, 3) SH coefficients, of the first chunk of a file with a palette.
        labels: (N,) into the palette, if that is unknown.
    """

    header: RadChunkHeader
    splats: Splats
    tree: LodTree | None
    palette: FloatArray | None
    labels: NDArray[np.uint32] | None


def scan_header(file: BinaryIO, open_companion: OpenCompanion | None) -> tuple[RadHeader, list[RuleViolation]]:
    """Read the header of a file; return it and the rules that it breaks, also about its chunk files."""

    def size_or_reason(name: str) -> int | str:
        try:
            with _open_companion(name, open_companion) as own:
                return size_of(own)
        except FormatError as error:
            return str(error)

    size = size_of(file)
    header = read_header(file)
    return header, list(header_violations(header, size, {name: size_or_reason(name) for name in header.filenames}))


def _open_companion(name: str, open_companion: OpenCompanion | None) -> BinaryIO:
    if open_companion is None:
        raise FormatError("its chunks are in files beside it; give it as a file in their folder")
    return open_companion(name)


def decoded_bytes(header: RadHeader) -> int:
    """Return the bytes of all columns of splats in memory."""
    return header.count * 4 * width_of(header.max_sh)


#: Files whose decoded columns take more bytes than this, or than this share of the free memory, are read chunk by
#: chunk: computed values take as much again, and chunk by chunk is no slower (docs/decisions/14-cuts.md).
AT_ONCE, SHARE = 1 << 28, 0.25


def fits(header: RadHeader) -> bool:
    """Return whether a file is small enough to be read at once."""
    free = available_memory()
    return decoded_bytes(header) <= (AT_ONCE if free is None else min(AT_ONCE, SHARE * free))


@dataclass(frozen=True)
class PackedChunk:
    """Chunk of a file: number from 0, its own header, which is checked, and the payload after that."""

    number: int
    header: RadChunkHeader
    payload: memoryview

    def scale_coding(self) -> ScaleCoding:
        scales = next((each for each in self.header.properties if each.name == "scales"), None)
        if scales is None or not scales.encoding.startswith("ln_"):
            return PLAIN_SCALES
        return (scales.encoding, scales.min or 0.0, scales.max or 0.0)

    def palette(self, header: RadHeader) -> FloatArray | None:
        """Decode the (codes, K, 3) SH coefficients that labels point to; None if the chunk has no palette."""
        codes = {row.degree: each for each in self.header.properties if (row := BY_NAME[each.name]).codes}
        if not codes:
            return None
        count = self.header.count if header.sh_code_count is None else header.sh_code_count
        palette = np.zeros((count, COEFFICIENTS[header.max_sh], 3), np.float32)
        for degree, each in codes.items():
            if degree <= header.max_sh:
                part = palette[:, COEFFICIENTS[degree - 1] : COEFFICIENTS[degree]]
                part[...] = self.values(each, BY_NAME[each.name], count).reshape(part.shape)
        return palette

    def values(self, each: Property, row: Row, count: int) -> NDArray[Any]:
        """Decode a property to (count, numbers) values."""
        low, high = (0.0 if end is None else end for end in (each.min, each.max))
        return CODINGS[each.encoding].decode(self.unpacked(each, row, count), count, row.numbers, low, high)

    def unpacked(self, each: Property, row: Row, count: int) -> Bytes:
        """Decompress a property; `FormatError` if it is corrupt, or has more or fewer bytes than `count` splats."""
        expected = count * row.numbers * CODINGS[each.encoding].size
        data = self.payload[each.offset : each.offset + each.bytes]
        subject = f"{each.name} of chunk {self.number:,}"
        if each.compression is not None:
            unpacker = raw_unpacker()
            try:
                data = unpacker.decompress(data, expected + 1)  # one byte more, to find data that are too long
            except INFLATE_ERRORS:
                raise FormatError(f"corrupt data in {subject}") from None
            if len(data) == expected and not unpacker.eof:
                raise TruncatedError(f"{subject} is cut short: its compressed data do not end")
        splats = f"{count:,} splats in {each.encoding}"
        if len(data) > expected:
            raise TooLongError(f"{subject} has more than the {expected:,} bytes of {splats}")
        if len(data) < expected:
            raise TruncatedError(f"{subject} has {len(data):,} bytes; {splats} take {expected:,}")
        return np.frombuffer(data, np.uint8)
