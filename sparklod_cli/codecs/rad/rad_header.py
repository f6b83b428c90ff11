"""The headers of RAD files and of their chunks: JSON between a magic word and the bytes that it describes.

A file is a header and its chunks, one after the other; or a header alone that names a file for each chunk. Every chunk
has a header of its own, so that it can be decoded by itself. `docs/formats/rad.md` lays both out.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO

from ...system.errors import FormatError, NotSplatsError, PromiseError, TruncatedError, VersionError
from ...system.untrusted import Json, Origin, quoted_value
from ..formats import RAD_SUFFIX, rad_chunk_name
from ..reader import FileNote, read_comment
from ..spark_codings import SplatEncoding

#: The first bytes of a file, and of a chunk.
MAGIC, CHUNK_MAGIC = b"RAD0", b"RADC"

#: Magic and bytes of the JSON, after which zeros pad the header to `ALIGNMENT`; payload bytes, after a chunk's header.
PREFIX, PAYLOAD = struct.Struct("<4sI"), struct.Struct("<Q")
ALIGNMENT = 8

VERSION, TYPE = 1, "gsplat"

#: Largest JSON of a file, and of a chunk, in bytes. An entry of a chunk takes 50 to 100 bytes, so that a file of
#: 10,000 chunks, 655 million nodes, has a JSON of 1 MB; a chunk's has about 1,500 bytes.
MAX_JSON, MAX_CHUNK_JSON = 1 << 24, 1 << 20

#: The name and the content of each file; the header is the last.
Files = Iterator[tuple[str, Iterable[bytes]]]

#: Keys of "splatEncoding", and the fields of `SplatEncoding` that they fill.
ENCODING_KEYS = {
    "rgbMin": "rgb_min",
    "rgbMax": "rgb_max",
    "lnScaleMin": "ln_scale_min",
    "lnScaleMax": "ln_scale_max",
    "sh1Max": "sh1_max",
    "sh2Max": "sh2_max",
    "sh3Max": "sh3_max",
    "lodOpacity": "lod_opacity",
}


#: The compression of properties: a raw deflate stream, whatever its name says.
GZ = "gz"


@dataclass(frozen=True)
class RadChunkEntry:
    """Place of a chunk, header included: its `offset` is from the first byte after the header, or in its own file."""

    offset: int
    bytes: int
    filename: str | None = None

    def start(self, header: RadHeader) -> int:
        """Return where the chunk begins in the file that has it."""
        return self.offset + (header.bytes if self.filename is None else 0)


@dataclass(frozen=True)
class RadHeader:
    """The header of a file.

    Attributes:
        count: splats, which are the nodes where there is a tree.
        max_sh: SH degree.
        lod_tree: whether the splats are the nodes of a Level-of-Detail tree.
        chunk_size: splats of each chunk but the last.
        all_chunk_bytes: sum of the chunks' sizes.
        chunks: where they are, in order.
        encoding: ranges of the codes; None where the header has none.
        sh_code_count: entries of the SH palette; None without one.
        comment: free text; None without one.
        bytes: of the header with its padding: where the first chunk begins.
        padded_with_zeros: whether the padding is zeros.
    """

    count: int
    max_sh: int
    lod_tree: bool
    chunk_size: int
    all_chunk_bytes: int
    chunks: tuple[RadChunkEntry, ...]
    encoding: SplatEncoding | None = None
    sh_code_count: int | None = None
    comment: str | None = None
    bytes: int = 0
    padded_with_zeros: bool = True

    @property
    def filenames(self) -> tuple[str, ...]:
        """Names of the files that chunks have of their own, each once."""
        return tuple(dict.fromkeys(entry.filename for entry in self.chunks if entry.filename is not None))

    @property
    def format(self) -> str:
        """Name of the format, see `Scene.format`."""
        return "RAD" + " LoD" * self.lod_tree

    @property
    def chunked(self) -> bool:
        """Whether the chunks are files of their own."""
        return bool(self.filenames)

    @functools.cached_property
    def noted(self) -> FileNote:
        """Note of sparklod in the comment."""
        return read_comment(self.comment)


@dataclass(frozen=True)
class Property:
    """A column of a chunk.

    Attributes:
        offset: from the beginning of the payload.
        name: one of `property_codings.PROPERTIES`, or unknown.
        encoding: one of `property_codings.CODINGS`, or unknown.
        min, max: ends of the range of the codes; None without a range.
    """

    offset: int
    bytes: int
    name: str
    encoding: str
    compression: str | None = GZ
    min: float | None = None
    max: float | None = None


@dataclass(frozen=True)
class RadChunkHeader:
    """The header of a chunk.

    Attributes:
        base: index of its first splat in the file.
        count: its splats.
        payload_bytes: of its properties with their padding, as the JSON has it.
        max_sh, lod_tree: as in `RadHeader`.
        properties: in the order of the file.
        encoding: ranges of the codes; None where the header has none.
        stored_payload_bytes: the same number again, as it stands before the payload.
        bytes: of the header with its padding and the size of the payload: where the payload begins.
        padded_with_zeros: whether the padding is zeros.
    """

    base: int
    count: int
    payload_bytes: int
    max_sh: int
    lod_tree: bool
    properties: tuple[Property, ...]
    encoding: SplatEncoding | None = None
    stored_payload_bytes: int = 0
    bytes: int = 0
    padded_with_zeros: bool = True


def padding(size: int) -> int:
    """Return the number of zeros after `size` bytes."""
    return -size % ALIGNMENT


def read_header(file: BinaryIO) -> RadHeader:
    """Read the header of a file, up to its first chunk; its promises are not checked, see `rad_rules`."""
    fields, size, zeros = _read_json(file, MAGIC, MAX_JSON, "RAD header")
    if fields.text("type") != TYPE:
        raise NotSplatsError(f"a RAD file of {quoted_value(fields.text('type'))}, not of {TYPE}")
    count = fields.whole("count")
    chunks = tuple(
        RadChunkEntry(entry.whole("offset"), entry.whole("bytes"), entry.optional("filename", Json.text))
        for entry in fields.items("chunks")
    )
    return RadHeader(
        count,
        fields.optional("maxSh", Json.whole, 0),
        fields.optional("lodTree", Json.flag, False),
        fields.optional("chunkSize", Json.whole, count),
        fields.whole("allChunkBytes"),
        chunks,
        _encoding(fields),
        fields.optional("shCodeCount", Json.whole),
        fields.optional("comment", Json.text),
        size,
        zeros,
    )


def read_chunk_header(file: BinaryIO) -> RadChunkHeader:
    """Read the header of a chunk, up to its payload."""
    fields, size, zeros = _read_json(file, CHUNK_MAGIC, MAX_CHUNK_JSON, "header of a RAD chunk")
    stored = file.read(PAYLOAD.size)
    if len(stored) < PAYLOAD.size:
        raise TruncatedError("cut short inside the header of a RAD chunk")
    properties = tuple(
        Property(
            entry.whole("offset"),
            entry.whole("bytes"),
            entry.text("property"),
            entry.text("encoding"),
            entry.optional("compression", Json.text),
            entry.optional("min", Json.number),
            entry.optional("max", Json.number),
        )
        for entry in fields.items("properties")
    )
    return RadChunkHeader(
        fields.whole("base"),
        fields.whole("count"),
        fields.whole("payloadBytes"),
        fields.optional("maxSh", Json.whole, 0),
        fields.optional("lodTree", Json.flag, False),
        properties,
        _encoding(fields),
        PAYLOAD.unpack(stored)[0],
        size + PAYLOAD.size,
        zeros,
    )


def pack_header(header: RadHeader) -> bytes:
    """Return the bytes of a file's header, padding included; its `bytes` and `padded_with_zeros` are ignored."""
    chunks = [_present(offset=each.offset, bytes=each.bytes, filename=each.filename) for each in header.chunks]
    fields = {
        "version": VERSION,
        "type": TYPE,
        "count": header.count,
        "maxSh": header.max_sh,
        "lodTree": header.lod_tree or None,
        "chunkSize": header.chunk_size,
        "allChunkBytes": header.all_chunk_bytes,
        "chunks": chunks,
        "splatEncoding": _encoding_fields(header.encoding),
        "shCodeCount": header.sh_code_count,
        "comment": header.comment,
    }
    return _pack_json(MAGIC, fields)


def pack_chunk_header(header: RadChunkHeader) -> bytes:
    """Return the bytes of a chunk's header up to its payload; the fields about what was read are ignored."""
    properties = [
        _present(
            offset=each.offset,
            bytes=each.bytes,
            property=each.name,
            encoding=each.encoding,
            compression=each.compression,
            min=each.min,
            max=each.max,
        )
        for each in header.properties
    ]
    fields = {
        "version": VERSION,
        "base": header.base,
        "count": header.count,
        "payloadBytes": header.payload_bytes,
        "maxSh": header.max_sh,
        "lodTree": header.lod_tree or None,
        "splatEncoding": _encoding_fields(header.encoding),
        "properties": properties,
    }
    return _pack_json(CHUNK_MAGIC, fields) + PAYLOAD.pack(header.payload_bytes)


def _present(**fields: Any) -> dict[str, Any]:
    return {key: value for key, value in fields.items() if value is not None}


def _pack_json(magic: bytes, fields: dict[str, Any]) -> bytes:
    data = json.dumps(_present(**fields), separators=(",", ":")).encode()
    return PREFIX.pack(magic, len(data)) + data + bytes(padding(len(data)))


def _encoding_fields(encoding: SplatEncoding | None) -> dict[str, float | bool] | None:
    return None if encoding is None else {key: getattr(encoding, name) for key, name in ENCODING_KEYS.items()}


def _read_json(file: BinaryIO, magic: bytes, limit: int, subject: str) -> tuple[Json, int, bool]:
    """Read the JSON after a magic word; also return its bytes with the padding, and whether that is zeros."""
    prefix = file.read(PREFIX.size)
    if len(prefix) < PREFIX.size:
        raise TruncatedError(f"cut short inside the {subject}")
    found, length = PREFIX.unpack(prefix)
    if found == CHUNK_MAGIC != magic:
        raise NotSplatsError("it is one chunk of a RAD file; give the .rad file beside it, which names all chunks")
    if found != magic:
        raise NotSplatsError(f"no {subject}: it begins with {quoted_value(found)}, not {quoted_value(magic)}")
    if length > limit:
        raise PromiseError(f"its {subject} announces {length:,} bytes of JSON; at most {limit:,} are read")
    data = file.read(length)
    pad = file.read(padding(length))
    if len(data) < length or len(pad) < padding(length):
        raise TruncatedError(f"cut short inside the {subject}")
    fields = Json.parse(data, Origin(f"its {subject}", FormatError))
    if fields.whole("version") != VERSION:
        raise VersionError(f"RAD version {fields.whole('version')} is unknown, only {VERSION} is read")
    return fields, PREFIX.size + length + len(pad), not any(pad)


def _encoding(fields: Json) -> SplatEncoding | None:
    """Return the ranges of the codes, if the header has them; missing ones are Spark's defaults."""
    if not fields.has("splatEncoding"):
        return None
    given: dict[str, Any] = {
        ENCODING_KEYS[key]: value.flag() if key == "lodOpacity" else value.number()
        for key, value in fields.entries("splatEncoding")
        if key in ENCODING_KEYS
    }
    try:
        return SplatEncoding(**given)
    except ValueError as error:
        raise FormatError(f"its splatEncoding is not possible: {error}") from None


def in_one_file(header: RadHeader, sizes: Sequence[int], chunks: Iterable[bytes]) -> Iterator[bytes]:
    """Return the bytes of one file, piece by piece."""
    yield _packed(header, map(RadChunkEntry, itertools.accumulate(sizes, initial=0), sizes))
    yield from chunks


def in_files(header: RadHeader, chunks: Iterable[bytes], stem: str) -> Files:
    """Return the files of a scene with a file a chunk, "stem-0.radc" and so on, and the header, "stem.rad"."""
    entries = list[RadChunkEntry]()
    for number, chunk in enumerate(chunks):
        entries.append(RadChunkEntry(0, len(chunk), rad_chunk_name(stem, number)))
        yield rad_chunk_name(stem, number), [chunk]
    yield stem + RAD_SUFFIX, [_packed(header, entries)]


def _packed(header: RadHeader, entries: Iterable[RadChunkEntry]) -> bytes:
    chunks = tuple(entries)
    size = sum(entry.bytes for entry in chunks)
    return pack_header(dataclasses.replace(header, chunks=chunks, all_chunk_bytes=size))
