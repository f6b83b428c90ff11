"""The two containers of a RAD file's chunks: one file, or a header that names a file for each chunk."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Sequence

from .header import pack_header
from .names import SUFFIX, chunk_name
from .records import RadChunkEntry, RadHeader

#: The name and the content of each file; the header is the last.
Files = Iterator[tuple[str, Iterable[bytes]]]


def in_one_file(header: RadHeader, sizes: Sequence[int], chunks: Iterable[bytes]) -> Iterator[bytes]:
    """Return the bytes of one file, piece by piece.

    Args:
        header: of the file; the places of its chunks are filled in.
        sizes: of the chunks, in bytes.
        chunks: in order, asked for one by one.
    """
    yield _packed(header, map(RadChunkEntry, itertools.accumulate(sizes, initial=0), sizes))
    yield from chunks


def in_files(header: RadHeader, chunks: Iterable[bytes], stem: str) -> Files:
    """Return the files of a scene whose chunks are files of their own.

    Args:
        header, chunks: as for `in_one_file`.
        stem: of the names: the header's is "stem.rad", and those of the chunks are "stem-0.radc" and so on.
    """
    entries = []
    for number, chunk in enumerate(chunks):
        entries.append(RadChunkEntry(0, len(chunk), chunk_name(stem, number)))
        yield chunk_name(stem, number), [chunk]
    yield stem + SUFFIX, [_packed(header, entries)]


def _packed(header: RadHeader, entries: Iterable[RadChunkEntry]) -> bytes:
    chunks = tuple(entries)
    size = sum(entry.bytes for entry in chunks)
    return pack_header(dataclasses.replace(header, chunks=chunks, all_chunk_bytes=size))
