"""SPZ, Niantic's compressed splats, and Spark's extension of it for Level-of-Detail trees.

Reads versions 1 to 4, see `spz_reading`; writes versions 2 and 3. `docs/formats.md` lays the extension out byte by
byte.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from ..model.scene import Scene
from ..model.streams import NodeStream
from ..support.progress import Progress, silent
from . import clamps
from .clamps import Range
from .encoder import Kept, results
from .options import DEFAULTS, WriteOptions
from .spz_encoder import encoder as encoder
from .spz_options import needed as needed
from .spz_options import settled as settled
from .spz_reading import decode as decode
from .spz_reading import examine as examine
from .spz_reading import read_coded as read_coded
from .spz_reading import stream as stream
from .spz_stored import stored as stored


def held(options: WriteOptions, sh_degree: int) -> Sequence[Range]:
    """Return the values that SPZ holds without clamping them."""
    return clamps.SPZ


def encode(
    scene: Scene | NodeStream,
    options: WriteOptions = DEFAULTS,
    *,
    threads: int = 1,
    progress: Progress = silent,
    scratch: Path | None = None,
) -> Iterator[bytes]:
    """The bytes of a file, piece by piece: an LoD file if the scene has a tree, otherwise a plain one.

    The same scene and options give the same bytes for any number of threads, and for a stream of the same nodes.

    Args:
        scene: what is written.
        options: settled where the scene is a stream; otherwise they may leave choices open.
        threads: to encode on.
        progress: told of the splats, and then of the bytes.
        scratch: folder for a temporary file of the bytes before they are compressed; None to keep them in memory.

    Raises:
        FormatError: a coordinate does not fit the fractional bits; the text names the most that would.
    """
    made = encoder(scene, settled(scene, options) if isinstance(scene, Scene) else options)
    found = results(made, scene, threads, progress, "encoding")
    if scratch is None:
        kept = list(found)
        yield from made.pieces(lambda number, name: kept[number][name], threads=threads, progress=progress)
        return
    with Kept(scratch) as spilled:
        for result in found:
            spilled.put(result)
        yield from made.pieces(spilled.get, threads=threads, progress=progress)
