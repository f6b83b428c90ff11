"""Reads RAD files: whole, by ranges of splats, chunk by chunk, or as packed chunks."""

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
from .. import compression, spark_codings
from ..compression import INFLATE_ERRORS, raw_unpacker
from ..format_rules import RuleViolation, check_rules, error_of
from ..quantize import Bytes, quat_of_xyz
from ..reader import OpenCompanion, OpenFile, Reader, RowBuffer, size_of
from .property_codings import BY_NAME, CODINGS, Property, Row, encodings_of
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


@contextlib.contextmanager
def file_of(entry: RadChunkEntry, file: BinaryIO, open_companion: OpenCompanion | None) -> Iterator[BinaryIO]:
    """Open the file that has a chunk: `file`, which has the header, or one of its own."""
    if entry.filename is None:
        yield file
        return
    with _open_companion(entry.filename, open_companion) as own:
        yield own


def _open_companion(name: str, open_companion: OpenCompanion | None) -> BinaryIO:
    if open_companion is None:
        raise FormatError("its chunks are in files beside it; give it as a file in their folder")
    return open_companion(name)


def bytes_of(entry: RadChunkEntry, header: RadHeader, file: BinaryIO) -> bytes:
    """Return the bytes of a chunk from the file that has it; raises `TruncatedError` where that ends before."""
    start = entry.start(header)
    lacking = start + entry.bytes - size_of(file)
    if lacking > 0:  # before so much memory is asked for
        raise TruncatedError(f"cut short: {lacking:,} of {entry.bytes:,} bytes of a chunk are missing")
    file.seek(start)
    return file.read(entry.bytes)


@dataclass(frozen=True, eq=False)
class RadReader:
    """RAD file whose header has been read and checked; `palette` is (codes, K, 3) of SH, None without one."""

    header: RadHeader
    file: BinaryIO
    open_companion: OpenCompanion | None = None
    palette: FloatArray | None = None

    @classmethod
    def open(cls, file: BinaryIO, open_companion: OpenCompanion | None = None) -> RadReader:
        """Read the header of a file, and its palette.

        Raises:
            FormatError: the file is not RAD, breaks a fatal rule, or its first chunk is damaged.
        """
        size = size_of(file)
        header = read_header(file)
        sizes = {}
        for name in header.filenames:
            with _open_companion(name, open_companion) as own:
                sizes[name] = size_of(own)
        check_rules(header_violations(header, size, sizes))
        _check_promise(header.count, header, size + sum(sizes.values()))
        reader = cls(header, file, open_companion)
        first = reader.first()
        return reader if first is None else dataclasses.replace(reader, palette=first.palette(header))

    @property
    def facts(self) -> dict[str, int]:
        """As `Scene.header`: chunks, their size in splats, whether they are files of their own, and codes of SH."""
        header = self.header
        facts = {"version": 1, "chunks": len(header.chunks), "chunk_size": header.chunk_size}
        facts |= {"header_bytes": header.bytes, "chunked": int(header.chunked)}
        return facts | ({"sh_codes": len(self.palette)} if self.palette is not None else {})

    @property
    def encodings(self) -> dict[str, str]:
        """Encodings of the properties of the first chunk, by the field of `RadOptions`."""
        first = self.first()
        return {} if first is None else encodings_of(first.header.properties)

    def in_one_file(self) -> Iterator[bytes]:
        """Return the bytes of one file that holds all chunks unchanged."""
        return in_one_file(self.header, [entry.bytes for entry in self.header.chunks], self.raw())

    def in_files(self, stem: str) -> Files:
        """Return a file for each unchanged chunk, and their header; see `rad_header.in_files`."""
        return in_files(self.header, self.raw(), stem)

    def first(self) -> PackedChunk | None:
        """Read the first chunk; None where there is none."""
        return next(self.packed(range(min(1, len(self.header.chunks)))), None)

    def raw(self, numbers: range | None = None) -> Iterator[bytes]:
        """Read the bytes of chunks, all by default, when they are asked for."""
        for number in range(len(self.header.chunks)) if numbers is None else numbers:
            entry = self.header.chunks[number]
            with file_of(entry, self.file, self.open_companion) as source:
                yield bytes_of(entry, self.header, source)

    def packed(self, numbers: range | None = None) -> Iterator[PackedChunk]:
        """Read chunks, all by default, when they are asked for."""
        numbers = range(len(self.header.chunks)) if numbers is None else numbers
        for number, data in zip(numbers, self.raw(numbers), strict=True):
            yield PackedChunk.of(data, number, self.header)

    def decode(
        self,
        packed: PackedChunk,
        columns: Collection[str] = COLUMNS,
        target: tuple[Splats, LodTree | None] | None = None,
        *,
        thorough: bool = True,
    ) -> tuple[Splats, LodTree | None]:
        """Decode a chunk: its splats, and its nodes where there is a tree, whose children have the file's numbers.

        Args:
            target: rows to fill; None for new ones.
            thorough: unpack the other columns, too, which finds corrupt ones.
        """
        splats, tree = target or _new_rows(packed.header.count, self.header)
        if fill(packed, self.header, splats, tree, self.palette, columns, thorough=thorough) is not None:
            raise error_of("rad.palette", f"chunk {packed.number:,} has labels of SH, but there is no palette")
        return splats, tree

    def chunks(
        self, columns: Collection[str], *, thorough: bool, threads: int
    ) -> Iterator[tuple[int, Splats, LodTree | None]]:
        """Decode all chunks in order, a few at a time: the index of the first splat of each, splats and nodes."""

        def work(packed: PackedChunk) -> tuple[int, Splats, LodTree | None]:
            return packed.header.base, *self.decode(packed, columns, thorough=thorough)

        return ordered_map(work, self.packed(), threads)

    def chunk(self, number: int, columns: Collection[str]) -> tuple[Splats, LodTree | None, FileCoding]:
        """Decode these columns of a chunk by its number from 0, and return its splats, nodes and coding."""
        (packed,) = self.packed(range(number, number + 1))
        return *self.decode(packed, columns, thorough=False), self.coding([packed.scale_coding()])

    def coding(self, scales: list[ScaleCoding]) -> FileCoding:
        """Return how a file holds its scales, by those of its chunks."""
        ranges = self.header.encoding
        packed_range = None if ranges is None else (ranges.ln_scale_min, ranges.ln_scale_max)
        return FileCoding(tuple(scales), self.header.chunk_size, packed_range)

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
                for done in ordered_map(work, self.packed(numbers), threads):
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
            lambda: self.coding(codings),
            max(size, 1),
        )

    def about(self) -> Scene:
        """Return the scene as it is known before any chunk is read: without splats, and without its tree."""
        return dataclasses.replace(self.content(), count=0, has_tree=False, coding=None).scene()


def open_content(source: OpenFile) -> Reader:
    """Open a RAD file, whole or with chunks in files of their own; raises `FormatError` as `RadReader.open`."""
    return RadReader.open(source.file, source.open_companion).content()


@dataclass(frozen=True, eq=False)
class RadChunk:
    """One chunk of a file.

    Attributes:
        splats: with SH of 0 if they are labels and the palette is unknown.
        tree: its children have the numbers of the file.
        palette: (codes, K, 3) SH coefficients, of the first chunk of a file with a palette.
        labels: (N,) into the palette, if that is unknown.
    """

    header: RadChunkHeader
    splats: Splats
    tree: LodTree | None
    palette: FloatArray | None
    labels: NDArray[np.uint32] | None


def read_chunk(file: BinaryIO, entry: RadChunkEntry, header: RadHeader, palette: FloatArray | None = None) -> RadChunk:
    """Read one chunk, and nothing but its bytes.

    Raises:
        FormatError: the chunk is cut short, corrupt, or not the one that the header means.
        ValueError: the palette is of another SH degree than the file.
    """
    room = COEFFICIENTS[min(header.max_sh, MAX_SH_DEGREE)], 3
    if palette is not None and np.shape(palette)[1:] != room:
        raise ValueError(f"the palette has the shape {np.shape(palette)}; that of this file has (codes, {room[0]}, 3)")
    check_rules(header_violations(header))
    packed = PackedChunk.of(bytes_of(entry, header, file), header.chunks.index(entry), header)
    _check_promise(packed.header.count, header, entry.bytes)
    own = packed.palette(header)
    palette = own if own is not None or palette is None else np.asarray(palette, np.float32)
    splats, tree = _new_rows(packed.header.count, header)
    labels = fill(packed, header, splats, tree, palette, COLUMNS)
    return RadChunk(packed.header, splats, tree, own, labels)


def count_leaves(file: BinaryIO, header: RadHeader, open_companion: OpenCompanion | None) -> int:
    """Return the number of leaves of a tree, of which only the numbers of children are read."""
    leaves = 0
    for number, entry in enumerate(header.chunks):
        with file_of(entry, file, open_companion) as source:
            start = entry.start(header)
            source.seek(start)
            chunk = read_chunk_header(source)
            check_rules(chunk_violations(header, number, chunk, entry.bytes))
            leaves += chunk.count
            for each in chunk.properties:
                if each.name == "child_count":
                    source.seek(start + chunk.bytes + each.offset)
                    packed = PackedChunk(number, chunk, memoryview(source.read(each.bytes)))
                    children = packed.values(dataclasses.replace(each, offset=0), BY_NAME[each.name], chunk.count)
                    leaves -= int(np.count_nonzero(children))
    return leaves


def scan_header(file: BinaryIO, open_companion: OpenCompanion) -> tuple[RadHeader, list[RuleViolation]]:
    """Read the header of a file, and its violations, those about the files of chunks among them."""
    size = size_of(file)
    header = read_header(file)
    sizes = {name: _size_or_reason(name, open_companion) for name in header.filenames}
    return header, list(header_violations(header, size, sizes))


def _size_or_reason(name: str, open_companion: OpenCompanion) -> int | str:
    """Return the bytes of a file that the header names, or why it cannot be opened."""
    try:
        with open_companion(name) as file:
            return size_of(file)
    except FormatError as error:
        return str(error)


def scan_chunks(
    file: BinaryIO, open_companion: OpenCompanion, header: RadHeader, *, paddings: bool
) -> Iterator[tuple[RadChunkHeader | None, list[RuleViolation]]]:
    """Read the headers of the chunks, one after the other; None for one that cannot be read. Also their violations."""
    for number, entry in enumerate(header.chunks):
        with file_of(entry, file, open_companion) as source:
            start = entry.start(header)
            source.seek(start)
            try:
                chunk = read_chunk_header(source)
            except FormatError as error:
                yield None, [broken("chunk-header", f"chunk {number:,}: {error}")]
                continue
            violations = list(chunk_violations(header, number, chunk, entry.bytes))
            if paddings and not any(each.fatal for each in violations):
                for each in chunk.properties:
                    source.seek(start + chunk.bytes + each.offset + each.bytes)
                    if any(source.read(padding(each.bytes))):
                        text = f"bytes behind {each.name} of chunk {number:,} are not zeros"
                        violations.append(broken("padding", text, fatal=False))
            yield chunk, violations


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


def _new_rows(count: int, header: RadHeader) -> tuple[Splats, LodTree | None]:
    tree = LodTree(np.empty(count, np.uint16), np.empty(count, np.uint32)) if header.lod_tree else None
    return Splats.zeros(count, header.max_sh), tree


def _check_promise(count: int, header: RadHeader, size: int) -> None:
    """Raise `PromiseError` if a file or a chunk of this size can hardly have so many splats."""
    compression.check_promise(decoded_bytes(dataclasses.replace(header, count=count)), size)


@dataclass(frozen=True)
class PackedChunk:
    """Chunk of a file: number from 0, its own header, which is checked, and the payload after that."""

    number: int
    header: RadChunkHeader
    payload: memoryview

    @classmethod
    def of(cls, data: bytes, number: int, header: RadHeader) -> PackedChunk:
        """Parse the header of a chunk; `FormatError` if it breaks a fatal rule."""
        chunk = read_chunk_header(io.BytesIO(data))
        check_rules(chunk_violations(header, number, chunk, len(data)))
        return cls(number, chunk, memoryview(data)[chunk.bytes :])

    def scale_coding(self) -> ScaleCoding:
        scales = next((each for each in self.header.properties if each.name == "scales"), None)
        if scales is None or not scales.encoding.startswith("ln_"):
            return PLAIN_SCALES
        return (scales.encoding, scales.min or 0.0, scales.max or 0.0)

    def palette(self, header: RadHeader) -> FloatArray | None:
        """Return (codes, K, 3) SH coefficients that labels point to; None where the chunk has no palette."""
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
        """Return the bytes of a property; `FormatError` if it is corrupt, or has more or fewer than it should."""
        expected = count * row.numbers * CODINGS[each.encoding].size
        data = self.payload[each.offset : each.offset + each.bytes]
        subject = f"{each.name} of chunk {self.number:,}"
        if each.compression is not None:
            unpacker = raw_unpacker()
            try:
                data = unpacker.decompress(data, expected + 1)  # a byte more, to find what is too long
            except INFLATE_ERRORS:
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
    """Decode these columns of a chunk, and return its (N,) labels of SH if it has some and `palette` is None.

    Args:
        palette: of SH that labels point to; None if it is not known, which leaves SH at 0.
        thorough: unpack the other columns, too, which finds corrupt ones.
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
        part = splats.sh[:, COEFFICIENTS[row.degree - 1] : COEFFICIENTS[row.degree]]
        part[...] = values.reshape(part.shape)
    elif row.column == "opacity":
        splats.opacity[:] = spark_codings.decode_lod_alpha(values[:, 0].astype(np.float32))
    elif row.column == "quat_xyzw" and values.shape[1] == 3:
        splats.quat_xyzw[:] = quat_of_xyz(values.astype(np.float32))
    else:
        getattr(splats, row.column)[:] = values


def _set_defaults(present: Collection[str], splats: Splats, tree: LodTree | None, columns: Collection[str]) -> None:
    """Give the columns of missing properties the initial values of a viewer's arrays: 0, and no rotation."""
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
