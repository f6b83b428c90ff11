"""The headers of RAD files and of their chunks: JSON between a magic word and the bytes that it describes.

A file is a header and its chunks, one after the other; or a header alone that names a file for each chunk. Every chunk
has a header of its own, so that it can be decoded by itself. `docs/formats/rad.md` describes both. Reports list all
violations of the rules for headers; readers stop at a fatal one.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import struct
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO

from ...model import MAX_SH_DEGREE
from ...model.lod_tree import CHUNK_NODES
from ...system.errors import FormatError, NotSplatsError, PromiseError, TruncatedError, VersionError
from ...system.untrusted import Json, Origin, quoted_value
from ..format_rules import RuleViolation, violation
from ..formats import RAD_SUFFIX, rad_chunk_name
from ..quantize import LARGEST
from ..reader import FileNote, read_comment
from ..spark_codings import SplatEncoding
from .property_codings import BY_NAME, CODINGS, GZ, PROPERTIES, Property, Row

#: First bytes of a file, and of a chunk.
MAGIC, CHUNK_MAGIC = b"RAD0", b"RADC"

#: Magic word and length of the JSON, which zeros pad to `ALIGNMENT`; length of the payload, at the end of a chunk's
#: header.
PREFIX, PAYLOAD = struct.Struct("<4sI"), struct.Struct("<Q")
ALIGNMENT = 8

VERSION, TYPE = 1, "gsplat"

#: Largest JSON of a file, and of a chunk, in bytes. The entry of a chunk takes 50 to 100 bytes, so that the JSON of
#: 10,000 chunks, 655 million nodes, has 1 MB; that of a chunk has about 1,500 bytes.
MAX_JSON, MAX_CHUNK_JSON = 1 << 24, 1 << 20

#: Name and content of each file; the header comes last.
Files = Iterator[tuple[str, Iterable[bytes]]]

#: Fields of `SplatEncoding` by their keys in "splatEncoding".
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


@dataclass(frozen=True)
class RadChunkEntry:
    """Place of a chunk with its header; `offset` counts from the end of the file's header, or in the chunk's file."""

    offset: int
    bytes: int
    filename: str | None = None

    def start(self, header: RadHeader) -> int:
        """Return the position of the chunk in its file."""
        return self.offset + (header.bytes if self.filename is None else 0)


@dataclass(frozen=True)
class RadHeader:
    """Header of a file.

    Attributes:
        count: number of splats; with a tree, of nodes.
        chunk_size: number of splats of each chunk but the last.
        encoding: ranges of the codes.
        sh_code_count: number of entries of the SH palette.
        bytes: size of the header with its padding; the first chunk follows.
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
        """Names of the chunk files, without repetition."""
        return tuple(dict.fromkeys(entry.filename for entry in self.chunks if entry.filename is not None))

    @property
    def format(self) -> str:
        """Name of the format, as in `Scene.format`."""
        return "RAD" + " LoD" * self.lod_tree

    @property
    def chunked(self) -> bool:
        """Whether the chunks are in files of their own."""
        return bool(self.filenames)

    @functools.cached_property
    def noted(self) -> FileNote:
        return read_comment(self.comment)


@dataclass(frozen=True)
class RadChunkHeader:
    """Header of a chunk.

    Attributes:
        base: index of its first splat in the file.
        payload_bytes: size of its padded properties, as the JSON says.
        stored_payload_bytes: the same size, as the bytes before the payload say.
        bytes: size of the padded header with the length of the payload; the payload follows.
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
    """Return the number of zeros that follow `size` bytes."""
    return -size % ALIGNMENT


def read_header(file: BinaryIO) -> RadHeader:
    """Read the header of a file; `header_violations` checks what it says."""
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
    """Read the header of a chunk; `chunk_violations` checks what it says."""
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
    """Encode the header of a file with its padding; `bytes` and `padded_with_zeros` are ignored."""
    fields = {
        "version": VERSION,
        "type": TYPE,
        "count": header.count,
        "maxSh": header.max_sh,
        "lodTree": header.lod_tree or None,
        "chunkSize": header.chunk_size,
        "allChunkBytes": header.all_chunk_bytes,
        "chunks": [_present(vars(each)) for each in header.chunks],
        "splatEncoding": encoding_fields(header.encoding),
        "shCodeCount": header.sh_code_count,
        "comment": header.comment,
    }
    return _pack_json(MAGIC, fields)


def pack_chunk_header(header: RadChunkHeader) -> bytes:
    """Encode the header of a chunk; the fields after `encoding`, which describe a file that was read, are ignored."""
    properties = [
        _present({"property" if key == "name" else key: value for key, value in vars(each).items()})
        for each in header.properties
    ]
    fields = {
        "version": VERSION,
        "base": header.base,
        "count": header.count,
        "payloadBytes": header.payload_bytes,
        "maxSh": header.max_sh,
        "lodTree": header.lod_tree or None,
        "splatEncoding": encoding_fields(header.encoding),
        "properties": properties,
    }
    return _pack_json(CHUNK_MAGIC, fields) + PAYLOAD.pack(header.payload_bytes)


def _present(fields: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in fields.items() if value is not None}


def _pack_json(magic: bytes, fields: dict[str, Any]) -> bytes:
    data = json.dumps(_present(fields), separators=(",", ":")).encode()
    return PREFIX.pack(magic, len(data)) + data + bytes(padding(len(data)))


def encoding_fields(encoding: SplatEncoding | None) -> dict[str, float | bool] | None:
    """Return the "splatEncoding" of a header; None without ranges."""
    return None if encoding is None else {key: getattr(encoding, name) for key, name in ENCODING_KEYS.items()}


def _read_json(file: BinaryIO, magic: bytes, limit: int, subject: str) -> tuple[Json, int, bool]:
    """Return the JSON after a magic word, the number of bytes read, and whether the padding is zeros."""
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
    """Return the ranges of the codes, None if the header has none; single missing ranges are Spark's defaults."""
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
    """Yield the bytes of one file with all chunks, of these `sizes`."""
    yield _packed(header, map(RadChunkEntry, itertools.accumulate(sizes, initial=0), sizes))
    yield from chunks


def in_files(header: RadHeader, chunks: Iterable[bytes], stem: str) -> Files:
    """Yield a file for each chunk, "stem-0.radc" and so on, and then the header, "stem.rad"."""
    entries = list[RadChunkEntry]()
    for number, chunk in enumerate(chunks):
        entries.append(RadChunkEntry(0, len(chunk), rad_chunk_name(stem, number)))
        yield rad_chunk_name(stem, number), [chunk]
    yield stem + RAD_SUFFIX, [_packed(header, entries)]


def _packed(header: RadHeader, entries: Iterable[RadChunkEntry]) -> bytes:
    chunks = tuple(entries)
    size = sum(entry.bytes for entry in chunks)
    return pack_header(dataclasses.replace(header, chunks=chunks, all_chunk_bytes=size))


#: Meaning of each code; the text of a violation has the values. Violations that all formats share have the codes
#: "container.cut-short", "container.trailing" and "container.version".
ERRORS = {
    "rad.chunks": "the number of chunks, or their size, does not fit the number of splats",
    "rad.offsets": "chunks or properties do not lie one after the other",
    "rad.sizes": "sizes disagree",
    "rad.chunk-files": "the file of a chunk is missing, cut short, or not in the folder",
    "rad.chunk-header": "the header of a chunk cannot be read",
    "rad.bases": "a chunk does not hold the splats that belong at its place in the file",
    "rad.kind": "maxSh or lodTree of a chunk is not that of the file",
    "rad.properties": "a property is unknown, missing, there twice, or does not belong there",
    "rad.encoding": "the encoding or the range of a property is unknown or impossible",
    "rad.palette": "the palette of spherical harmonics and its labels do not belong together",
    "rad.header-limit": "the header is larger than 1 MiB, and Spark does not page the file",
}
WARNINGS = {
    "rad.header-large": "the header is larger than the 64 KiB that Spark asks for at first",
    "rad.chunk-size": "chunks do not have the 65,536 splats by which Spark streams",
    "rad.total": "allChunkBytes is not the sum of the sizes of the chunks",
    "rad.padding": "padding is missing or not zeros",
    "rad.order": "properties are not in the order in which Spark writes them",
    "rad.ranges": "splatEncoding of a chunk is not that of the file",
    "rad.opacity": "splatEncoding does not mark the opacities of a tree as such",
}

#: Rules that a readable file may break.
READABLE = {*WARNINGS, "rad.header-limit", "rad.kind"}
broken = functools.partial(violation, READABLE, "rad")

#: Bytes that Spark reads first to find the header, and at most.
FIRST_LOOK, LAST_LOOK = 1 << 16, 1 << 20


def expected_count(header: RadHeader, number: int) -> int:
    """Return the number of splats of a chunk."""
    return max(0, min(header.chunk_size, header.count - number * header.chunk_size))


def header_violations(
    header: RadHeader, file_size: int | None = None, files: Mapping[str, int | str] | None = None
) -> Iterator[RuleViolation]:
    """Yield the rules that the header of a file breaks.

    Args:
        file_size: size of the file in bytes; None to leave the places of chunks unchecked.
        files: size in bytes of each chunk file by name, or why it cannot be opened; None to leave them unchecked.
    """
    if header.bytes > LAST_LOOK:
        yield broken("header-limit", f"its header has {header.bytes:,} bytes; Spark pages at most {LAST_LOOK:,}")
    elif header.bytes > FIRST_LOOK:
        yield broken("header-large", f"its header has {header.bytes:,} bytes; Spark asks for {FIRST_LOOK:,} at first")
    wanted = -(-header.count // max(header.chunk_size, 1))
    if len(header.chunks) != wanted or (header.count and not header.chunk_size):
        text = f"{len(header.chunks):,} chunks of {header.chunk_size:,} splats; {header.count:,} splats need {wanted:,}"
        yield broken("chunks", text)
    if header.max_sh > MAX_SH_DEGREE:
        yield RuleViolation("container.version", f"it has SH degree {header.max_sh}; RAD has 0 to {MAX_SH_DEGREE}")
    total = sum(entry.bytes for entry in header.chunks)
    if total != header.all_chunk_bytes:
        yield broken("total", f"allChunkBytes is {header.all_chunk_bytes:,}, but its chunks have {total:,} bytes")
    if file_size is not None:
        yield from _places(header, file_size, files)
    if not header.padded_with_zeros:
        yield broken("padding", "the padding of its header is not zeros")
    if 0 < header.chunk_size != CHUNK_NODES and header.count > min(header.chunk_size, CHUNK_NODES):
        text = f"its chunks have {header.chunk_size:,} splats; Spark streams only chunks of {CHUNK_NODES:,}"
        yield broken("chunk-size", text)
    first = expected_count(header, 0)
    if header.sh_code_count is not None and header.sh_code_count != first:
        text = f"its palette has {header.sh_code_count:,} codes, but its first chunk {first:,} splats"
        yield broken("palette", f"{text}; Spark reads only as many codes")
    if header.lod_tree and header.encoding is not None and not header.encoding.lod_opacity:
        yield broken("opacity", "it has a tree, but its splatEncoding has no lodOpacity")


def _places(header: RadHeader, file_size: int, files: Mapping[str, int | str] | None) -> Iterator[RuleViolation]:
    by_file: dict[str | None, list[tuple[int, RadChunkEntry]]] = defaultdict(list)
    for number, entry in enumerate(header.chunks):
        by_file[entry.filename].append((number, entry))
    for name, entries in by_file.items():
        at, in_order, size = 0, True, 0 if files is None or name is None else files[name]
        for number, entry in entries:
            if entry.offset < at:
                yield broken("offsets", f"chunk {number:,} begins at {entry.offset:,}, inside the one before it")
            elif entry.offset > at:
                text = f"chunk {number:,} begins at {entry.offset:,}, but the one before it ends at {at:,}"
                yield broken("offsets", text, fatal=name is None)
            in_order &= entry.offset == at
            if entry.bytes % ALIGNMENT:
                yield broken("padding", f"chunk {number:,} has {entry.bytes:,} bytes, no multiple of {ALIGNMENT}")
            at = max(at, entry.offset + entry.bytes)
        if name is not None and files is not None:
            code, subject = "rad.chunk-files", quoted_value(name)
            followed = f"the chunk in {subject}"
        elif name is None and in_order:
            size, code, subject = file_size - header.bytes, "container.cut-short", "it"
            followed = "its last chunk"
        else:
            continue
        if isinstance(size, str):
            yield RuleViolation(code, size)
        elif size < at:
            yield RuleViolation(code, f"cut short: {subject} lacks {at - size:,} bytes of chunk {entries[-1][0]:,}")
        elif size > at:
            yield RuleViolation("container.trailing", f"{size - at:,} bytes follow {followed}", fatal=False)


def chunk_violations(header: RadHeader, number: int, chunk: RadChunkHeader, size: int) -> Iterator[RuleViolation]:
    """Yield the rules that the header of a chunk of `size` bytes breaks."""
    name = f"chunk {number:,}"
    base, count = number * header.chunk_size, expected_count(header, number)
    if (chunk.base, chunk.count) != (base, count):
        text = f"{name} is of {chunk.count:,} splats from {chunk.base:,} on"
        yield broken("bases", f"{text}; in its place are {count:,} from {base:,} on")
    if chunk.stored_payload_bytes != size - chunk.bytes:
        text = f"{name} has {size - chunk.bytes:,} bytes after its header, which says {chunk.stored_payload_bytes:,}"
        yield broken("sizes", text)
    if chunk.payload_bytes != chunk.stored_payload_bytes:
        text = f"payloadBytes of {name} is {chunk.payload_bytes:,}, but its header ends with"
        yield broken("sizes", f"{text} {chunk.stored_payload_bytes:,}", fatal=False)
    if not chunk.padded_with_zeros:
        yield broken("padding", f"the padding of the header of {name} is not zeros")
    if (chunk.max_sh, chunk.lod_tree) != (header.max_sh, header.lod_tree):
        yield broken("kind", f"{name} has {_kind_of(chunk)}, but the file {_kind_of(header)}")
    if chunk.encoding != header.encoding:
        yield broken("ranges", f"splatEncoding of {name} is not that of the file")
    at, payload = 0, size - chunk.bytes
    for each in chunk.properties:
        subject, end = f"property {quoted_value(each.name)} of {name}", each.offset + each.bytes
        if each.offset != at:
            yield broken("offsets", f"{subject} begins at {each.offset:,}, not at {at:,}, where the one before ends")
        at = end + padding(each.bytes)
        if end > payload:
            yield broken("sizes", f"{subject} ends at {end:,}, of {payload:,} bytes")
    if at < payload:
        yield broken("sizes", f"the properties of {name} end at {at:,}, of {payload:,} bytes", fatal=False)
    yield from _names(header, number, [each.name for each in chunk.properties])
    for each in chunk.properties:
        yield from _encodings(each, f"property {quoted_value(each.name)} of {name}")


def _kind_of(header: RadHeader | RadChunkHeader) -> str:
    return f"SH degree {header.max_sh} and {'a tree' if header.lod_tree else 'no tree'}"


def _names(header: RadHeader, number: int, names: list[str]) -> Iterator[RuleViolation]:
    where = f"chunk {number:,}"
    twice = {name for name in names if names.count(name) > 1} if len(names) <= len(BY_NAME) else set(names)
    if twice:
        yield broken("properties", f"{where} has {quoted_value(min(twice))} more than once")
    labels = "sh_label" in names
    if labels and any(name in BY_NAME and BY_NAME[name].column == "sh" and not BY_NAME[name].codes for name in names):
        yield broken("palette", f"{where} has both labels and coefficients of SH")
    if header.max_sh and labels != (header.sh_code_count is not None):
        text = f"{where} has {'' if labels else 'no '}labels of SH, but the file {'no' if labels else 'a'} palette"
        yield broken("palette", text, fatal=False)
    if number and any(name in BY_NAME and BY_NAME[name].codes for name in names):
        yield broken("palette", f"{where} has a palette of SH; only the first chunk may have one")
    wanted = [row.name for row in PROPERTIES if _belongs(row, header, number, labels=labels)]
    missing = [name for name in wanted if name not in names]
    if missing:
        yield broken("properties", f"{where} has no {', '.join(missing)}; its splats get 0", fatal=False)
    extra = [name for name in names if name in BY_NAME and not _belongs(BY_NAME[name], header, None, labels=labels)]
    if extra:
        yield broken("properties", f"{where} has {', '.join(extra)}, which does not belong there", fatal=False)
    known = [name for name in names if name in BY_NAME]
    if not twice and known != [name for name in BY_NAME if name in known]:
        yield broken("order", f"the properties of {where} are in the order {', '.join(known)}")


def _belongs(row: Row, header: RadHeader, number: int | None, *, labels: bool) -> bool:
    """Return whether a property belongs into a chunk of this number; None for any chunk."""
    if row.column in ("child_count", "child_start"):
        return header.lod_tree
    if row.codes and number:
        return False
    if row.column == "labels":
        return labels and header.max_sh > 0
    if row.degree:
        return row.degree <= header.max_sh and (row.codes == labels or number is None)
    return True


def _encodings(each: Property, subject: str) -> Iterator[RuleViolation]:
    row = BY_NAME.get(each.name)
    if row is None:
        yield broken("properties", f"{subject} is unknown")
        return
    if each.compression not in (GZ, None):
        yield broken("encoding", f"{subject} has compression {quoted_value(each.compression)}; only {GZ} is known")
    if each.encoding not in row.encodings:
        known = ", ".join(row.encodings)
        yield broken("encoding", f"{subject} is in {quoted_value(each.encoding)}; it may be in {known}")
    ends = CODINGS[each.encoding].ends if each.encoding in CODINGS else ()
    for key in ends:
        value = getattr(each, key)
        if value is None or abs(value) > float(LARGEST):
            yield broken("encoding", f"{subject} is in {each.encoding}, but its {key} is {quoted_value(value)}")
            return
    low = each.min if "min" in ends else 0.0
    if ends and low is not None and each.max is not None and not low < each.max:
        text = f"{subject} is in {each.encoding}, but its max, {each.max:g}, is not above {low:g}"
        yield broken("encoding", text, fatal=False)
