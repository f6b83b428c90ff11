"""RAD, the file of Spark 2 whose Level-of-Detail tree a viewer streams in chunks of 65,536 nodes.

A file is a header and its chunks, or a header that names a file for each chunk; `docs/formats.md` lays them out.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...model.scene import Scene
from ...model.streams import NodeStream
from ...support.progress import Progress, silent
from ..content import decoder
from ..encoder import Get, Kept, results, windows_of
from ..options import DEFAULTS, WriteOptions
from .rad_encoder import CHUNK, RadEncoder
from .rad_encoder import encoder as encoder
from .rad_header import Files
from .rad_options import held as held
from .rad_options import needed as needed
from .rad_options import settled as settled
from .rad_reader import RadChunk as RadChunk
from .rad_reader import RadReader as RadReader
from .rad_reader import open_content as open_content
from .rad_reader import read_chunk as read_chunk
from .rad_stored import stored as stored

#: Bytes of chunks that wait in memory for their header; beyond, they wait on disk.
SPOOLED = 1 << 26

decode = decoder(open_content)


def encode(
    scene: Scene | NodeStream,
    options: WriteOptions = DEFAULTS,
    *,
    threads: int = 1,
    progress: Progress = silent,
    scratch: Path | None = None,
) -> Iterator[bytes]:
    """Return the bytes of one file, piece by piece; chunks wait in a temporary file for the header, which has sizes.

    The same scene and options give the same bytes for any number of threads, and for a stream of the same nodes. Nodes
    keep their order; that of `lod.chunk_order` is for streaming.

    Args:
        scene: to write.
        options: settled where the scene is a stream; otherwise they may leave choices open.
        threads: to encode on.
        progress: called with the splats.
        scratch: folder for the temporary file; None for that of the system.

    Raises:
        FormatError, ValueError: see `rad_options.settled`.
    """
    made = _encoder(scene, options, threads, progress)
    with Kept(scratch, SPOOLED) as kept:
        for result in results(made, scene, threads, progress, "encoding"):
            kept.put(result)
        yield from made.pieces(kept.get, threads=threads, progress=progress)


def encode_chunked(
    scene: Scene | NodeStream, options: WriteOptions, stem: str, *, threads: int = 1, progress: Progress = silent
) -> Files:
    """Return the name and the bytes of each file of a scene with a file a chunk; the header is last.

    Args:
        scene, options, threads, progress: as for `encode`.
        stem: of the names: the header's is "stem.rad", and those of the chunks are "stem-0.radc" and so on.

    Raises:
        FormatError, ValueError: see `rad_options.settled`.
    """
    made = _encoder(scene, options, threads, progress)
    windows = results(made, scene, threads, progress, "writing")
    yield from made.files((window[CHUNK] for window in windows), stem)


def assemble_chunked(made: RadEncoder, get: Get, stem: str, *, progress: Progress = silent) -> Files:
    """Return the files of a tree whose windows are encoded, as `encode_chunked`; `get` reads their results."""

    def chunks() -> Iterator[NDArray[np.uint8]]:
        for number, part in enumerate(windows_of(made.count)):
            yield get(number, CHUNK)
            progress("writing", part.stop, made.count, "splat")

    yield from made.files(chunks(), stem)


def _encoder(scene: Scene | NodeStream, options: WriteOptions, threads: int, progress: Progress) -> RadEncoder:
    options = settled(scene, options) if isinstance(scene, Scene) else options
    return encoder(scene, options, threads=threads, progress=progress)
