"""RAD, the file of Spark 2 whose Level-of-Detail tree a viewer streams in chunks of 65,536 nodes.

A file is a header and its chunks, or a header that names a file for each chunk; `docs/formats.md` lays them out.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...model.scene import Scene
from ...model.streams import NodeStream
from ...support.progress import Progress, silent
from ..encoder import Get, Kept, results, windows_of
from ..options import DEFAULTS, WriteOptions
from .encoding import CHUNK, RadEncoder
from .encoding import encoder as encoder
from .options import held as held
from .options import needed as needed
from .options import settled as settled
from .reading import RadChunk as RadChunk
from .reading import count_leaves as count_leaves
from .reading import decode as decode
from .reading import examine as examine
from .reading import name_of as name_of
from .reading import read_chunk as read_chunk
from .reading import stream as stream
from .repacking import PackedChunks as PackedChunks
from .stored import stored as stored

#: Bytes of chunks that wait in memory for their header; beyond, they wait on disk.
SPOOLED = 1 << 26


def encode(
    scene: Scene | NodeStream,
    options: WriteOptions = DEFAULTS,
    *,
    threads: int = 1,
    progress: Progress = silent,
    scratch: Path | None = None,
) -> Iterator[bytes]:
    """The bytes of one file, piece by piece; the chunks wait in a temporary file for the header, which has their sizes.

    The same scene and options give the same bytes for any number of threads, and for a stream of the same nodes. Nodes
    keep their order; that of `lod.chunk_order` is for streaming.

    Args:
        scene: what is written.
        options: settled where the scene is a stream; otherwise they may leave choices open.
        threads: to encode on.
        progress: told of the splats.
        scratch: folder for the temporary file; None for that of the system.

    Raises:
        FormatError, ValueError: see `options.settled`.
    """
    made = _encoder(scene, options, threads, progress)
    with Kept(scratch, SPOOLED) as kept:
        for result in results(made, scene, threads, progress, "encoding"):
            kept.put(result)
        yield from made.pieces(kept.get, threads=threads, progress=progress)


def encode_chunked(
    scene: Scene | NodeStream, options: WriteOptions, stem: str, *, threads: int = 1, progress: Progress = silent
) -> Iterator[tuple[str, Iterable[bytes]]]:
    """The files of a scene whose chunks are files of their own: the name of each, and its bytes; the header is last.

    Args:
        scene, options, threads, progress: as for `encode`.
        stem: of the names: the header's is "stem.rad", and those of the chunks are "stem-0.radc" and so on.

    Raises:
        FormatError, ValueError: see `options.settled`.
    """
    made = _encoder(scene, options, threads, progress)
    found = results(made, scene, threads, progress, "writing")
    yield from made.files((result[CHUNK] for result in found), stem)


def assemble_chunked(
    made: RadEncoder, get: Get, stem: str, *, progress: Progress = silent
) -> Iterator[tuple[str, Iterable[bytes]]]:
    """The files of a tree whose windows are encoded, as `encode_chunked`.

    Args:
        made: its encoder.
        get: reads the results of the windows.
        stem: of the names.
        progress: told of the splats.
    """

    def chunks() -> Iterator[NDArray[np.uint8]]:
        for number, part in enumerate(windows_of(made.count)):
            yield get(number, CHUNK)
            progress("writing", part.stop, made.count, "splat")

    yield from made.files(chunks(), stem)


def _encoder(scene: Scene | NodeStream, options: WriteOptions, threads: int, progress: Progress) -> RadEncoder:
    options = settled(scene, options) if isinstance(scene, Scene) else options
    return encoder(scene, options, threads=threads, progress=progress)
