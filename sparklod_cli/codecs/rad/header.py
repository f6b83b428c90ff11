"""The headers of RAD files and of their chunks: JSON between a magic word and the bytes that it describes.

A file is a header and its chunks, one after the other; or a header alone that names a file for each chunk. Every chunk
has a header of its own, so that it can be decoded by itself. `docs/formats.md` lays both out.
"""

from __future__ import annotations

import json
import struct
from typing import Any, BinaryIO

from ...support.errors import FormatError, NotSplatsError, PromiseError, TruncatedError, VersionError
from ...support.untrusted import parse_json, quoted_value
from ..splat_encoding import SplatEncoding
from .fields import Fields
from .records import Property, RadChunkEntry, RadChunkHeader, RadHeader

#: The first bytes of a file, and of a chunk.
MAGIC, CHUNK_MAGIC = b"RAD0", b"RADC"

#: Magic and bytes of the JSON, after which zeros pad the header to `ALIGNMENT`; payload bytes, after a chunk's header.
PREFIX, PAYLOAD = struct.Struct("<4sI"), struct.Struct("<Q")
ALIGNMENT = 8

VERSION, TYPE = 1, "gsplat"

#: Largest JSON of a file, and of a chunk, in bytes. An entry of a chunk takes 50 to 100 bytes, so that a file of
#: 10,000 chunks, 655 million nodes, has a JSON of 1 MB; a chunk's has about 1,500 bytes.
MAX_JSON, MAX_CHUNK_JSON = 1 << 24, 1 << 20

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


def padding(size: int) -> int:
    """How many zeros follow `size` bytes."""
    return -size % ALIGNMENT


def read_header(file: BinaryIO) -> RadHeader:
    """Reads the header of a file, and nothing behind it; the file is left where its first chunk would begin.

    Raises:
        FormatError: it is not that of a RAD file, cut short, or lacks something; what it promises is not checked.
    """
    fields, size, zeros = _read_json(file, MAGIC, MAX_JSON, "RAD header")
    if fields.text("type") != TYPE:
        raise NotSplatsError(f"a RAD file of {quoted_value(fields.text('type'))}, not of {TYPE}")
    count = fields.whole("count")
    chunks = tuple(
        RadChunkEntry(entry.whole("offset"), entry.whole("bytes"), entry.text_or_none("filename"))
        for entry in fields.items("chunks")
    )
    return RadHeader(
        count,
        fields.whole("maxSh", 0),
        fields.flag("lodTree"),
        fields.whole("chunkSize", count),
        fields.whole("allChunkBytes"),
        chunks,
        _encoding(fields),
        fields.whole("shCodeCount") if fields.has("shCodeCount") else None,
        fields.text_or_none("comment"),
        size,
        zeros,
    )


def read_chunk_header(file: BinaryIO) -> RadChunkHeader:
    """Reads the header of a chunk; the file is left at its payload.

    Raises:
        FormatError: as for `read_header`.
    """
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
            entry.text_or_none("compression"),
            entry.number_or_none("min"),
            entry.number_or_none("max"),
        )
        for entry in fields.items("properties")
    )
    return RadChunkHeader(
        fields.whole("base"),
        fields.whole("count"),
        fields.whole("payloadBytes"),
        fields.whole("maxSh", 0),
        fields.flag("lodTree"),
        properties,
        _encoding(fields),
        PAYLOAD.unpack(stored)[0],
        size + PAYLOAD.size,
        zeros,
    )


def pack_header(header: RadHeader) -> bytes:
    """The bytes of a file's header, padding included; `bytes` and `padded_with_zeros` of the argument are ignored."""
    chunks = [
        {"offset": entry.offset, "bytes": entry.bytes} | ({"filename": entry.filename} if entry.filename else {})
        for entry in header.chunks
    ]
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
    """The bytes of a chunk's header up to its payload; the fields about what was read are ignored."""
    properties = [
        {
            key: value
            for key, value in (
                ("offset", each.offset),
                ("bytes", each.bytes),
                ("property", each.name),
                ("encoding", each.encoding),
                ("compression", each.compression),
                ("min", each.min),
                ("max", each.max),
            )
            if value is not None
        }
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


def _pack_json(magic: bytes, fields: dict[str, Any]) -> bytes:
    text = json.dumps({key: value for key, value in fields.items() if value is not None}, separators=(",", ":"))
    data = text.encode()
    return PREFIX.pack(magic, len(data)) + data + bytes(padding(len(data)))


def _encoding_fields(encoding: SplatEncoding | None) -> dict[str, float | bool] | None:
    return None if encoding is None else {key: getattr(encoding, name) for key, name in ENCODING_KEYS.items()}


def _read_json(file: BinaryIO, magic: bytes, limit: int, what: str) -> tuple[Fields, int, bool]:
    """The JSON after a magic word, how many bytes it takes with its padding, and whether that is zeros."""
    prefix = file.read(PREFIX.size)
    if len(prefix) < PREFIX.size:
        raise TruncatedError(f"cut short inside the {what}")
    found, length = PREFIX.unpack(prefix)
    if found == CHUNK_MAGIC != magic:
        raise NotSplatsError("it is one chunk of a RAD file; give the .rad file beside it, which names all chunks")
    if found != magic:
        raise NotSplatsError(f"no {what}: it begins with {quoted_value(found)}, not {quoted_value(magic)}")
    if length > limit:
        raise PromiseError(f"its {what} announces {length:,} bytes of JSON; at most {limit:,} are read")
    data = file.read(length)
    pad = file.read(padding(length))
    if len(data) < length or len(pad) < padding(length):
        raise TruncatedError(f"cut short inside the {what}")
    try:
        value = parse_json(data)
    except ValueError as error:
        raise FormatError(f"its {what} is not JSON: {error}") from None
    fields = Fields(value, what)
    if fields.whole("version") != VERSION:
        raise VersionError(f"RAD version {fields.whole('version')} is unknown, only {VERSION} is read")
    return fields, PREFIX.size + length + len(pad), not any(pad)


def _encoding(fields: Fields) -> SplatEncoding | None:
    """The ranges of the codes, where the header has them; what it leaves out is Spark's default."""
    if not fields.has("splatEncoding"):
        return None
    inner = fields.inner("splatEncoding")
    given: dict[str, Any] = {}
    for key, name in ENCODING_KEYS.items():
        if inner.has(key):
            given[name] = inner.flag(key) if name == "lod_opacity" else inner.number_or_none(key)
    try:
        return SplatEncoding(**given)
    except ValueError as error:
        raise FormatError(f"its splatEncoding is not possible: {error}") from None
