"""Facts of a RAD file that its headers tell, and findings about the promises that they break."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import BinaryIO

from ..codecs.rad.property_codings import LARGEST_F16
from ..codecs.rad.rad_header import ENCODING_KEYS, RadChunkHeader, RadHeader
from ..codecs.rad.rad_layout import BY_NAME, PROPERTIES, SIZES
from ..codecs.rad.rad_reader import scan_chunks, scan_header
from ..codecs.reader import OpenCompanion
from ..codecs.splat_encoding import log_scale_table
from ..system.printable import MOST, printable
from .findings import ChunkBytes, Head, HeaderScan
from .value_checks import Ends


@dataclass(frozen=True)
class PropertyFacts:
    """A property of all chunks, see `schema.json`."""

    encoding: str
    bytes: int
    share: float
    min: float | None
    max: float | None


@dataclass(frozen=True)
class RadFacts:
    """Facts from the headers of a RAD file; `schema.json` describes the fields."""

    chunked: bool
    bytes: int
    header_bytes: int
    first_bytes: int
    chunk_size: int
    chunk_bytes: ChunkBytes | None
    palette: int
    ranges: dict[str, float | bool] | None
    comment: str | None
    properties: dict[str, PropertyFacts]


def survey(file: BinaryIO, open_companion: OpenCompanion, *, check: bool) -> HeaderScan:
    """Read the headers of a RAD file and of its chunks.

    Args:
        check: look at the padding of properties, too.

    Raises:
        FormatError: the header of the file cannot be read.
    """
    header, violations = scan_header(file, open_companion)
    gathered = _Gathered()
    if not any(each.fatal for each in violations):
        for chunk in scan_chunks(file, open_companion, header, paddings=check):
            violations += chunk.violations
            if chunk.header is not None:
                gathered.add(chunk.header)
    if any(each.fatal for each in violations):
        return HeaderScan("rad", violations)
    facts, noted = _facts(header, gathered), header.noted
    head = Head(header.format, facts.bytes, header.count, header.max_sh, noted.antialiased, noted.up)
    return HeaderScan("rad", violations, head, facts)


@dataclass
class _Gathered:
    """Properties of the chunks so far, by name."""

    encodings: dict[str, dict[str, None]] = field(default_factory=dict)
    bytes: Counter[str] = field(default_factory=Counter)
    low: dict[str, float] = field(default_factory=dict)
    high: dict[str, float] = field(default_factory=dict)

    def add(self, chunk: RadChunkHeader) -> None:
        for each in chunk.properties:
            if each.name not in BY_NAME or each.encoding not in SIZES:
                continue  # a finding says so
            self.encodings.setdefault(each.name, {})[each.encoding] = None
            self.bytes[each.name] += each.bytes
            if each.min is not None:
                self.low[each.name] = min(each.min, self.low.get(each.name, each.min))
            if each.max is not None:
                self.high[each.name] = max(each.max, self.high.get(each.name, each.max))


def _facts(header: RadHeader, gathered: _Gathered) -> RadFacts:
    sizes = [entry.bytes for entry in header.chunks]
    total = header.bytes + sum(sizes)
    ranges = None
    if header.encoding is not None:
        ranges = {key: getattr(header.encoding, name) for key, name in ENCODING_KEYS.items()}
    comment = None if header.comment is None else printable(" ".join(header.comment.split()), MOST)
    names = [row.name for row in PROPERTIES if row.name in gathered.encodings]
    return RadFacts(
        chunked=header.chunked,
        bytes=total,
        header_bytes=header.bytes,
        first_bytes=header.bytes + (sizes[0] if sizes else 0),
        chunk_size=header.chunk_size,
        chunk_bytes=ChunkBytes.of(sizes),
        palette=header.sh_code_count or 0,
        ranges=ranges,
        comment=comment,
        properties={
            name: PropertyFacts(
                encoding=", ".join(gathered.encodings[name]),
                bytes=gathered.bytes[name],
                share=round(gathered.bytes[name] / total, 4),
                min=gathered.low.get(name),
                max=gathered.high.get(name),
            )
            for name in names
        },
    )


def ends_of(facts: RadFacts) -> Ends:
    """Return the ends of the codes of a file; there are none where chunks have several encodings."""
    center, scales = facts.properties.get("center"), facts.properties.get("scales")
    ends = Ends()
    if center is not None and center.encoding in ("f16", "f16_lebytes"):
        ends = replace(ends, center=float(LARGEST_F16))
    if scales is not None and scales.encoding == "ln_0r8" and scales.min is not None and scales.max is not None:
        table = log_scale_table(scales.min, scales.max)
        ends = replace(ends, scale=(float(table[1]), float(table[-1])))
    return ends
