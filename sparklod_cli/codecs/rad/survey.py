"""The headers of a RAD file's chunks and the promises that they break, without the data: what a report needs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from ...support.errors import FormatError
from ..promises import Violation
from ..stream import size_of
from .header import padding, read_chunk_header, read_header
from .places import Beside, file_of, size_beside, start_of
from .promises import chunk_violations, violations
from .records import RadChunkHeader, RadHeader


@dataclass(frozen=True)
class ChunkSurvey:
    """A chunk.

    Attributes:
        number: from 0.
        header: as read; None where it cannot be.
        violations: of its promises.
    """

    number: int
    header: RadChunkHeader | None
    violations: tuple[Violation, ...]


def survey_file(file: BinaryIO, beside: Beside) -> tuple[RadHeader, tuple[Violation, ...]]:
    """The header of a file and the promises that it breaks, those about the files of its chunks among them.

    Raises:
        FormatError: the header cannot be read.
    """
    size = size_of(file)
    header = read_header(file)
    files = {name: _size_or_reason(name, beside) for name in header.filenames}
    return header, tuple(violations(header, size, files))


def _size_or_reason(name: str, beside: Beside) -> int | str:
    """Bytes of a file that the header names, or why it cannot be opened."""
    try:
        return size_beside(name, beside)
    except FormatError as error:
        return str(error)


def survey_chunks(file: BinaryIO, beside: Beside, header: RadHeader, *, paddings: bool) -> Iterator[ChunkSurvey]:
    """The headers of the chunks, one after the other.

    Args:
        file: with the header.
        beside: opens the files of chunks.
        header: of the file, with chunks where it says.
        paddings: look at the padding of properties, too.
    """
    for number, entry in enumerate(header.chunks):
        with file_of(entry, file, beside) as source:
            at = start_of(entry, header)
            source.seek(at)
            try:
                chunk = read_chunk_header(source)
            except FormatError as error:
                yield ChunkSurvey(number, None, (Violation("rad.chunk-header", f"chunk {number:,}: {error}"),))
                continue
            found = list(chunk_violations(header, number, chunk, entry.bytes))
            if paddings and not any(each.fatal for each in found):
                found += _paddings(source, at + chunk.bytes, chunk, number)
            yield ChunkSurvey(number, chunk, tuple(found))


def _paddings(file: BinaryIO, payload: int, chunk: RadChunkHeader, number: int) -> Iterator[Violation]:
    for each in chunk.properties:
        file.seek(payload + each.offset + each.bytes)
        if any(file.read(padding(each.bytes))):
            text = f"bytes behind {each.name} of chunk {number:,} are not zeros"
            yield Violation("rad.padding", text, fatal=False)
