"""The chunks of a RAD file as they stand, which go into the other container without a change."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from .containers import Files, in_files, in_one_file
from .places import Beside, bytes_of, file_of
from .reading import checked_header, chunks_of
from .records import RadHeader
from .stored import encodings_of


@dataclass(frozen=True, eq=False)
class PackedChunks:
    """The chunks of an open RAD file.

    Attributes:
        header: of the file.
        encodings: of the properties of its first chunk, by the field of `RadOptions`.
        file: that has the header.
        beside: opens the files that the header names.
    """

    header: RadHeader
    encodings: dict[str, str]
    file: BinaryIO
    beside: Beside | None

    @classmethod
    def of(cls, file: BinaryIO, *, beside: Beside | None = None) -> PackedChunks:
        """Read the headers of a file and of its first chunk.

        Raises:
            FormatError: see `reading.decode`.
        """
        header = checked_header(file, beside)
        first = next(chunks_of(file, header, beside, range(min(1, len(header.chunks)))), None)
        return cls(header, {} if first is None else encodings_of(first.header.properties), file, beside)

    def in_one_file(self) -> Iterator[bytes]:
        """Return the bytes of one file that holds all chunks."""
        return in_one_file(self.header, [entry.bytes for entry in self.header.chunks], self._chunks())

    def in_files(self, stem: str) -> Files:
        """Return a file for each chunk, and their header; see `containers.in_files`."""
        return in_files(self.header, self._chunks(), stem)

    def _chunks(self) -> Iterator[bytes]:
        for entry in self.header.chunks:
            with file_of(entry, self.file, self.beside) as source:
                yield bytes_of(entry, self.header, source)
