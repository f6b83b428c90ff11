"""Rules for the headers of RAD files: one list for reports and for readers, which stop at a fatal violation."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping

from ...model import MAX_SH_DEGREE
from ...model.lod_tree import CHUNK_NODES
from ...system.untrusted import quoted_value
from ..quantize import LARGEST
from ..rules import RuleViolation
from .property_codings import BY_NAME, CODINGS, PROPERTIES, Row
from .rad_header import ALIGNMENT, GZ, Property, RadChunkEntry, RadChunkHeader, RadHeader, padding

#: Meaning of each code; the text of a violation has the values. Other formats break some of
#: these rules, too: their codes are "container.cut-short", "container.trailing" and "container.version".
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

#: Bytes of a file in which Spark looks for the header at first, and at most.
FIRST_LOOK, LAST_LOOK = 1 << 16, 1 << 20


def broken(code: str, text: str, *, fatal: bool = True) -> RuleViolation:
    """Return a violation by the last part of its code."""
    return RuleViolation(f"rad.{code}", text, fatal)


def expected_chunks(header: RadHeader) -> int:
    """Return how many chunks the splats of a file take."""
    return -(-header.count // max(header.chunk_size, 1))


def expected_count(header: RadHeader, number: int) -> int:
    """Return how many splats a chunk has."""
    return max(0, min(header.chunk_size, header.count - number * header.chunk_size))


def violations(
    header: RadHeader, file_size: int | None = None, files: Mapping[str, int | str] | None = None
) -> Iterator[RuleViolation]:
    """Yield the broken rules of a file's header.

    Args:
        file_size: bytes of the file that it was read from; without, nothing is said about where its chunks are.
        files: sizes of the files that it names for chunks, or why one cannot be opened. Without, they are not looked
            at.
    """
    if header.bytes > LAST_LOOK:
        text = f"its header has {header.bytes:,} bytes; Spark pages files with at most {LAST_LOOK:,}"
        yield broken("header-limit", text, fatal=False)
    elif header.bytes > FIRST_LOOK:
        text = f"its header has {header.bytes:,} bytes; Spark asks for {FIRST_LOOK:,} at first"
        yield broken("header-large", text, fatal=False)
    wanted = expected_chunks(header)
    if len(header.chunks) != wanted or (header.count and not header.chunk_size):
        yield broken(
            "chunks",
            f"{len(header.chunks):,} chunks of {header.chunk_size:,} splats; {header.count:,} splats need {wanted:,}",
        )
    if header.max_sh > MAX_SH_DEGREE:
        yield RuleViolation("container.version", f"it has SH degree {header.max_sh}; RAD has 0 to {MAX_SH_DEGREE}")
    total = sum(entry.bytes for entry in header.chunks)
    if total != header.all_chunk_bytes:
        text = f"allChunkBytes is {header.all_chunk_bytes:,}, but its chunks have {total:,} bytes"
        yield broken("total", text, fatal=False)
    if file_size is not None:
        yield from _places(header, file_size, files)
    if not header.padded_with_zeros:
        yield broken("padding", "the padding of its header is not zeros", fatal=False)
    if 0 < header.chunk_size != CHUNK_NODES and header.count > min(header.chunk_size, CHUNK_NODES):
        text = f"its chunks have {header.chunk_size:,} splats; Spark streams only chunks of {CHUNK_NODES:,}"
        yield broken("chunk-size", text, fatal=False)
    if header.sh_code_count is not None and header.sh_code_count != expected_count(header, 0):
        yield broken(
            "palette",
            f"its palette has {header.sh_code_count:,} codes, but its first chunk {expected_count(header, 0):,} splats;"
            " Spark reads only as many codes",
        )
    if header.lod_tree and header.encoding is not None and not header.encoding.lod_opacity:
        yield broken("opacity", "it has a tree, but its splatEncoding has no lodOpacity", fatal=False)


def _places(header: RadHeader, file_size: int, files: Mapping[str, int | str] | None) -> Iterator[RuleViolation]:
    """Yield the violations of chunks in their files."""
    by_file: dict[str | None, list[tuple[int, RadChunkEntry]]] = defaultdict(list)
    for number, entry in enumerate(header.chunks):
        by_file[entry.filename].append((number, entry))
    for name, entries in by_file.items():
        at, in_order = 0, True
        for number, entry in entries:
            if entry.offset < at:
                yield broken("offsets", f"chunk {number:,} begins at {entry.offset:,}, inside the one before it")
            elif entry.offset > at:
                text = f"chunk {number:,} begins at {entry.offset:,}, but the one before it ends at {at:,}"
                yield broken("offsets", text, fatal=name is None)
            in_order &= entry.offset == at
            if entry.bytes % ALIGNMENT:
                text = f"chunk {number:,} has {entry.bytes:,} bytes, which is no multiple of {ALIGNMENT}"
                yield broken("padding", text, fatal=False)
            at = max(at, entry.offset + entry.bytes)
        if name is not None and files is not None:
            yield from _end_of_file(name, files[name], at, entries[-1][0])
        elif name is None and in_order:
            yield from _end(file_size - header.bytes, at, entries[-1][0])


def _end(size: int, end: int, last: int) -> Iterator[RuleViolation]:
    """Check the end of the header's file, which has `size` bytes behind the header."""
    if size < end:
        yield RuleViolation("container.cut-short", f"cut short: it lacks {end - size:,} bytes of chunk {last:,}")
    elif size > end:
        yield RuleViolation("container.trailing", f"{size - end:,} bytes follow its last chunk", fatal=False)


def _end_of_file(name: str, size: int | str, end: int, last: int) -> Iterator[RuleViolation]:
    """Check the end of another file."""
    if isinstance(size, str):
        yield broken("chunk-files", size)
    elif size < end:
        text = f"cut short: {quoted_value(name)} lacks {end - size:,} bytes of chunk {last:,}"
        yield broken("chunk-files", text)
    elif size > end:
        text = f"{size - end:,} bytes follow the chunk in {quoted_value(name)}"
        yield RuleViolation("container.trailing", text, fatal=False)


def chunk_violations(header: RadHeader, number: int, chunk: RadChunkHeader, size: int) -> Iterator[RuleViolation]:
    """Yield the broken rules of a chunk's header."""
    name = f"chunk {number:,}"
    base, count = number * header.chunk_size, expected_count(header, number)
    if (chunk.base, chunk.count) != (base, count):
        yield broken(
            "bases",
            f"{name} is of {chunk.count:,} splats from {chunk.base:,} on; in its place are {count:,} from {base:,} on",
        )
    if chunk.stored_payload_bytes != size - chunk.bytes:
        text = f"{name} has {size - chunk.bytes:,} bytes after its header, which says {chunk.stored_payload_bytes:,}"
        yield broken("sizes", text)
    if chunk.payload_bytes != chunk.stored_payload_bytes:
        text = (
            f"payloadBytes of {name} is {chunk.payload_bytes:,}, but {chunk.stored_payload_bytes:,} before its payload"
        )
        yield broken("sizes", text, fatal=False)
    if not chunk.padded_with_zeros:
        yield broken("padding", f"the padding of the header of {name} is not zeros", fatal=False)
    if (chunk.max_sh, chunk.lod_tree) != (header.max_sh, header.lod_tree):
        text = f"{name} has {_kind_of(chunk)}, but the file {_kind_of(header)}"
        yield broken("kind", text, fatal=False)
    if chunk.encoding != header.encoding:
        yield broken("ranges", f"splatEncoding of {name} is not that of the file", fatal=False)
    yield from _payload(number, chunk, size - chunk.bytes)
    yield from _names(header, number, [each.name for each in chunk.properties])
    for each in chunk.properties:
        yield from _encodings(each, f"property {quoted_value(each.name)} of {name}")


def _kind_of(header: RadHeader | RadChunkHeader) -> str:
    return f"SH degree {header.max_sh} and {'a tree' if header.lod_tree else 'no tree'}"


def _payload(number: int, chunk: RadChunkHeader, payload: int) -> Iterator[RuleViolation]:
    at = 0
    for each in chunk.properties:
        subject = f"property {quoted_value(each.name)} of chunk {number:,}"
        if each.offset != at:
            text = f"{subject} begins at {each.offset:,}, not at {at:,}, where the one before ends"
            yield broken("offsets", text)
        at = each.offset + each.bytes + padding(each.bytes)
        if each.offset + each.bytes > payload:
            yield broken("sizes", f"{subject} ends at {each.offset + each.bytes:,}, of {payload:,} bytes")
    if at < payload:
        text = f"the properties of chunk {number:,} end at {at:,}, of {payload:,} bytes"
        yield broken("sizes", text, fatal=False)


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
        yield broken("order", f"the properties of {where} are in the order {', '.join(known)}", fatal=False)


def _belongs(row: Row, header: RadHeader, number: int | None, *, labels: bool) -> bool:
    """Return True if a property belongs into a chunk of this number, or into any."""
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
