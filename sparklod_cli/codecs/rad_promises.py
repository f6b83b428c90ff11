"""What the headers of a RAD file promise: one list of rules, for reports and for readers, which stop at a fatal one."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping

from ..model.nodes import CHUNK_NODES
from ..support.defaults import MAX_SH_DEGREE
from ..support.errors import FormatError
from ..support.untrusted import quoted_value
from .quantize import LARGEST
from .rad_header import ALIGNMENT, GZ, ChunkEntry, ChunkHeader, Header, Property, Violation, padding
from .rad_layout import BY_NAME, RANGES

#: What is wrong with each promise, by its code; the text of a violation has the values.
CODES = {
    "rad.chunks": "the number of chunks or their size is not that of the splats",
    "rad.degree": "the SH degree is unknown",
    "rad.sizes": "sizes disagree",
    "rad.cut-short": "a chunk lies beyond the end of its file",
    "rad.offsets": "chunks or properties do not lie one after the other",
    "rad.padding": "padding is missing or not zeros",
    "rad.trailing": "bytes follow the last chunk",
    "rad.chunk-files": "a file of a chunk is missing, or not of its size",
    "rad.chunk-size": "chunks are not of the size that Spark streams",
    "rad.bases": "a chunk is not of the splats that its place in the file tells",
    "rad.chunk-header": "a chunk's header disagrees with that of the file",
    "rad.properties": "a property is unknown, missing or twice there",
    "rad.encoding": "a property's encoding or its range is unknown or impossible",
    "rad.palette": "the palette of spherical harmonics and its labels do not belong together",
    "rad.opacity": "opacities of a tree are not marked as such",
}


def check(broken: Iterator[Violation]) -> None:
    """Raises a `FormatError` with the code and the text of the first fatal violation."""
    for violation in broken:
        if violation.fatal:
            error = FormatError(violation.text)
            error.code = violation.code
            raise error


def expected_chunks(header: Header) -> int:
    """How many chunks the splats of a file take."""
    return -(-header.count // max(header.chunk_size, 1))


def expected_count(header: Header, number: int) -> int:
    """Splats of a chunk."""
    return max(0, min(header.chunk_size, header.count - number * header.chunk_size))


def violations(
    header: Header, file_size: int | None = None, files: Mapping[str, int | None] | None = None
) -> Iterator[Violation]:
    """The broken promises of a file's header, in the order of `CODES`.

    Args:
        header: as read.
        file_size: bytes of the file that it was read from; without, nothing is said about where its chunks are.
        files: sizes of the files that it names for chunks; None for one that is missing. Without,
            they are not looked at.
    """
    wanted = expected_chunks(header)
    if len(header.chunks) != wanted or (header.count and not header.chunk_size):
        yield Violation(
            "rad.chunks",
            f"{len(header.chunks):,} chunks of {header.chunk_size:,} splats; {header.count:,} splats need {wanted:,}",
        )
    if header.max_sh > MAX_SH_DEGREE:
        yield Violation("rad.degree", f"it has SH degree {header.max_sh}; RAD has 0 to {MAX_SH_DEGREE}")
    total = sum(entry.bytes for entry in header.chunks)
    if total != header.all_chunk_bytes:
        text = f"allChunkBytes is {header.all_chunk_bytes:,}, but its chunks have {total:,} bytes"
        yield Violation("rad.sizes", text, fatal=False)
    if file_size is not None:
        yield from _places(header, file_size, files)
    if not header.padded_with_zeros:
        yield Violation("rad.padding", "the padding of its header is not zeros", fatal=False)
    if header.chunk_size != CHUNK_NODES and header.count > header.chunk_size:
        text = f"its chunks have {header.chunk_size:,} splats; Spark streams only chunks of {CHUNK_NODES:,}"
        yield Violation("rad.chunk-size", text, fatal=False)
    if header.sh_code_count is not None and header.sh_code_count != expected_count(header, 0):
        yield Violation(
            "rad.palette",
            f"its palette has {header.sh_code_count:,} codes, but its first chunk {expected_count(header, 0):,} splats;"
            " Spark reads only as many codes",
        )
    if header.lod_tree and header.encoding is not None and not header.encoding.lod_opacity:
        yield Violation("rad.opacity", "it has a tree, but its splatEncoding has no lodOpacity", fatal=False)


def _places(header: Header, file_size: int, files: Mapping[str, int | None] | None) -> Iterator[Violation]:
    """Of chunks in their files."""
    by_file: dict[str | None, list[tuple[int, ChunkEntry]]] = defaultdict(list)
    for number, entry in enumerate(header.chunks):
        by_file[entry.filename].append((number, entry))
    for name, entries in by_file.items():
        at = 0
        for number, entry in entries:
            if entry.offset < at:
                yield Violation("rad.offsets", f"chunk {number:,} begins at {entry.offset:,}, inside the one before it")
            elif entry.offset > at:
                text = f"chunk {number:,} begins at {entry.offset:,}, but the one before it ends at {at:,}"
                yield Violation("rad.offsets", text, fatal=name is None)
            if entry.bytes % ALIGNMENT:
                text = f"chunk {number:,} has {entry.bytes:,} bytes, which is no multiple of {ALIGNMENT}"
                yield Violation("rad.padding", text, fatal=False)
            at = max(at, entry.offset + entry.bytes)
        if name is None:
            size: int | None = file_size - header.bytes
        elif files is None:
            continue
        else:
            size = files.get(name)
            if size is None:
                yield Violation("rad.chunk-files", f"there is no file {quoted_value(name)}, which it names")
                continue
        if size is not None and size < at:
            where = "it" if name is None else quoted_value(name)
            text = f"cut short: {where} lacks {at - size:,} bytes of chunk {entries[-1][0]:,}"
            yield Violation("rad.cut-short" if name is None else "rad.chunk-files", text)
        elif size is not None and size > at:
            where = "its last chunk" if name is None else f"the chunk in {quoted_value(name)}"
            code = "rad.trailing" if name is None else "rad.chunk-files"
            yield Violation(code, f"{size - at:,} bytes follow {where}", fatal=False)


def chunk_violations(header: Header, number: int, chunk: ChunkHeader, size: int) -> Iterator[Violation]:
    """The broken promises of a chunk's header.

    Args:
        header: of the file.
        number: of the chunk, from 0.
        chunk: its header.
        size: its bytes.
    """
    name = f"chunk {number:,}"
    base, count = number * header.chunk_size, expected_count(header, number)
    if (chunk.base, chunk.count) != (base, count):
        yield Violation(
            "rad.bases",
            f"{name} is of {chunk.count:,} splats from {chunk.base:,} on; in its place are {count:,} from {base:,} on",
        )
    if chunk.stored_payload_bytes != size - chunk.bytes:
        text = f"{name} has {size - chunk.bytes:,} bytes after its header, which says {chunk.stored_payload_bytes:,}"
        yield Violation("rad.sizes", text)
    if chunk.payload_bytes != chunk.stored_payload_bytes:
        text = (
            f"payloadBytes of {name} is {chunk.payload_bytes:,}, but {chunk.stored_payload_bytes:,} before its payload"
        )
        yield Violation("rad.sizes", text, fatal=False)
    if not chunk.padded_with_zeros:
        yield Violation("rad.padding", f"the padding of the header of {name} is not zeros", fatal=False)
    mine, theirs = (chunk.max_sh, chunk.lod_tree, chunk.encoding), (header.max_sh, header.lod_tree, header.encoding)
    if mine != theirs:
        text = f"maxSh, lodTree or splatEncoding of {name} is not that of the file"
        yield Violation("rad.chunk-header", text, fatal=False)
    yield from _properties(header, number, chunk, size - chunk.bytes)


def _properties(header: Header, number: int, chunk: ChunkHeader, payload: int) -> Iterator[Violation]:
    at = 0
    for each in chunk.properties:
        what = f"property {quoted_value(each.name)} of chunk {number:,}"
        if each.offset != at:
            yield Violation(
                "rad.offsets", f"{what} begins at {each.offset:,}, not at {at:,}, where the one before ends"
            )
        at = each.offset + each.bytes + padding(each.bytes)
        if each.offset + each.bytes > payload:
            yield Violation("rad.sizes", f"{what} ends at {each.offset + each.bytes:,}, of {payload:,} bytes")
        yield from _encodings(each, what)
    names = [each.name for each in chunk.properties]
    twice = {name for name in names if names.count(name) > 1} if len(names) <= len(BY_NAME) else set(names)
    if twice:
        yield Violation("rad.properties", f"chunk {number:,} has {quoted_value(min(twice))} more than once")
    needed = ["center", "alpha", "rgb", "scales", "orientation"]
    if "sh_label" in names:
        if "sh1" in names:
            yield Violation("rad.palette", f"chunk {number:,} has both labels and coefficients of SH")
        needed += [f"sh{degree}_code" for degree in range(1, header.max_sh + 1) if number == 0]
    else:
        needed += [f"sh{degree}" for degree in range(1, header.max_sh + 1)]
    missing = [
        name for name in (*needed, *(["child_count", "child_start"] if header.lod_tree else [])) if name not in names
    ]
    if missing:
        text = f"chunk {number:,} has no {', '.join(missing)}; its splats get 0"
        yield Violation("rad.properties", text, fatal=False)
    if number and any(name in BY_NAME and BY_NAME[name].codes for name in names):
        yield Violation("rad.palette", f"chunk {number:,} has a palette of SH; only the first chunk may have one")


def _encodings(each: Property, what: str) -> Iterator[Violation]:
    row = BY_NAME.get(each.name)
    if row is None:
        yield Violation("rad.properties", f"{what} is unknown")
        return
    if each.compression not in (GZ, None):
        yield Violation("rad.encoding", f"{what} has compression {quoted_value(each.compression)}; only {GZ} is known")
    if each.encoding not in row.encodings:
        known = ", ".join(row.encodings)
        yield Violation("rad.encoding", f"{what} is in {quoted_value(each.encoding)}; it may be in {known}")
    ends = {"min": each.min, "max": each.max}
    for key in RANGES.get(each.encoding, ()):
        value = ends[key]
        if value is None or abs(value) > LARGEST:
            yield Violation("rad.encoding", f"{what} is in {each.encoding}, but its {key} is {quoted_value(value)}")
