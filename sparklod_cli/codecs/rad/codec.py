"""RAD, the file of Spark 2 whose Level-of-Detail tree a viewer streams in chunks of 65,536 nodes.

A file is a header and its chunks, or a header that names a file for each chunk; `docs/formats.md` lays them out.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Iterable, Iterator

from ...model.scene import Scene
from ...support.progress import Progress, silent
from .. import compression
from ..options import DEFAULTS, WriteOptions
from .encoding import Writing
from .header import pack_header
from .names import SUFFIX, chunk_name
from .options import needed as needed
from .options import settled as settled
from .reading import RadChunk as RadChunk
from .reading import decode as decode
from .reading import examine as examine
from .reading import name_of as name_of
from .reading import read_chunk as read_chunk
from .reading import stream as stream
from .records import RadChunkEntry

#: Bytes of chunks that wait in memory for their header; beyond, they wait on disk.
SPOOLED = 1 << 26


def encode(
    scene: Scene, options: WriteOptions = DEFAULTS, *, threads: int = 1, progress: Progress = silent
) -> Iterator[bytes]:
    """The bytes of one file, piece by piece; the chunks wait in a temporary file for the header, which has their sizes.

    The same scene and options give the same bytes for any number of threads. Nodes keep their order; that of
    `lod.chunk_order` is for streaming.

    Raises:
        FormatError, ValueError: see `options.settled`.
    """
    writing = Writing.of(scene, settled(scene, options), threads, progress)
    sizes = []
    with tempfile.SpooledTemporaryFile(SPOOLED) as spool:
        for chunk in writing.chunks(threads, progress):
            spool.write(chunk)
            sizes.append(len(chunk))
        spool.seek(0)
        offsets = itertools.accumulate(sizes, initial=0)
        yield pack_header(writing.header(map(RadChunkEntry, offsets, sizes)))
        while piece := spool.read(compression.PIECE):
            yield piece


def encode_chunked(
    scene: Scene, options: WriteOptions, stem: str, *, threads: int = 1, progress: Progress = silent
) -> Iterator[tuple[str, Iterable[bytes]]]:
    """The files of a scene whose chunks are files of their own: the name of each, and its bytes; the header is last.

    Args:
        scene, options, threads, progress: as for `encode`.
        stem: of the names: the header's is "stem.rad", and those of the chunks are "stem-0.radc" and so on.

    Raises:
        FormatError, ValueError: see `options.settled`.
    """
    writing = Writing.of(scene, settled(scene, options), threads, progress)
    entries = []
    for number, chunk in enumerate(writing.chunks(threads, progress)):
        name = chunk_name(stem, number)
        entries.append(RadChunkEntry(0, len(chunk), name))
        yield name, [chunk]
    yield stem + SUFFIX, [pack_header(writing.header(entries))]
