"""SPZ, Niantic's compressed splats, and Spark's extension of it for Level-of-Detail trees.

Reads versions 1 to 4, see `spz_reading`; writes versions 2 and 3. `docs/formats.md` lays the extension out byte by
byte.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..model.scene import Scene
from ..support.parallel import for_blocks
from ..support.progress import Progress, silent
from . import compression
from .options import DEFAULTS, WriteOptions
from .spz_layout import ANTIALIASED, HEADER, LOD, MAGIC, Layout
from .spz_options import needed as needed
from .spz_options import settled as settled
from .spz_reading import column_of
from .spz_reading import decode as decode
from .spz_reading import examine as examine
from .spz_reading import stream as stream


def encode(
    scene: Scene, options: WriteOptions = DEFAULTS, *, threads: int = 1, progress: Progress = silent
) -> Iterator[bytes]:
    """The bytes of a file, piece by piece: an LoD file if the scene has a tree, otherwise a plain one.

    The same scene and options give the same bytes for any number of threads.

    Raises:
        FormatError: a coordinate does not fit the fractional bits; the text names the most that would.
    """
    splats, tree = scene.splats, scene.tree
    options = settled(scene, options)
    assert options.spz_version is not None and options.fractional_bits is not None
    bits = options.fractional_bits
    flags = (ANTIALIASED if scene.antialiased else 0) | (LOD if tree is not None else 0)
    layout = Layout(options.spz_version, len(splats), splats.sh_degree, bits, flags)
    data = np.empty(HEADER.size + layout.total, np.uint8)
    data[: HEADER.size] = np.frombuffer(
        HEADER.pack(MAGIC, layout.version, layout.count, layout.sh_degree, bits, flags, 0), np.uint8
    )
    codes, at = {}, HEADER.size
    for each in layout.streams():
        codes[each] = data[at : at + each.size * layout.count].reshape(layout.count, each.size)
        at += codes[each].size

    def fill(part: slice) -> None:
        for each, out in codes.items():
            values = np.ascontiguousarray(each.encode(column_of(splats, tree, each)[part]))
            out[part] = values.view(np.uint8).reshape(-1, each.size)

    for_blocks(fill, layout.count, threads, lambda done: progress("encoding", done, layout.count, "splat"))
    yield from compression.gzip_member(data, options.compression_level, threads, progress)
