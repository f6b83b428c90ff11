"""SPZ, Niantic's compressed splats, and Spark's extension of it for Level-of-Detail trees.

Reads versions 1 to 4, see `spz_reader`; writes versions 2 and 3. `docs/formats.md` lays the extension out byte by
byte.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..model.scene import Scene
from ..model.splats import COLUMNS
from ..model.streams import NodeStream
from ..support.defaults import MAX_FRACTIONAL_BITS
from ..support.progress import Progress, silent
from . import clamps
from .clamps import Range
from .content import Source, decoder
from .encoder import Kept, results
from .options import DEFAULTS, WriteOptions
from .quantize import Bytes
from .spz_encoder import SpzEncoder, like
from .spz_encoder import encoder as encoder
from .spz_encoder import needed as needed
from .spz_encoder import settled as settled
from .spz_layout import Layout, Stream
from .spz_reader import open_content as open_content
from .spz_reader import read_codes

decode = decoder(open_content)


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
    """Return the bytes of a file, piece by piece: an LoD file if the scene has a tree, otherwise a plain one.

    The same scene and options give the same bytes for any number of threads, and for a stream of the same nodes.

    Args:
        scene: to write.
        options: settled where the scene is a stream; otherwise they may leave choices open.
        threads: to encode on.
        progress: called with the splats, and then the bytes.
        scratch: folder for a temporary file of the bytes before they are compressed; None to keep them in memory.

    Raises:
        FormatError: a coordinate does not fit the fractional bits; the text names the most that would.
    """
    made = encoder(scene, settled(scene, options) if isinstance(scene, Scene) else options)
    windows = results(made, scene, threads, progress, "encoding")
    if scratch is None:
        in_memory = list(windows)
        yield from made.pieces(lambda number, name: in_memory[number][name], threads=threads, progress=progress)
        return
    with Kept(scratch) as spilled:
        for window in windows:
            spilled.put(window)
        yield from made.pieces(spilled.get, threads=threads, progress=progress)


@dataclass(frozen=True, eq=False)
class StoredSpz:
    """Codes of a file, see `encoder.Stored`.

    Decoding and encoding again would nearly do: but a rotation whose two largest components are equal, but for
    rounding, may get another code.
    """

    layout: Layout
    codes: Mapping[str, Bytes]

    def like(self, options: WriteOptions) -> WriteOptions:
        """Return the options, and where they leave a choice open, that of the file."""
        layout = self.layout
        if layout.version == 1 or layout.fractional_bits > MAX_FRACTIONAL_BITS:
            return options  # its positions are in no coding that is written
        return like({"version": layout.version, "fractional_bits": layout.fractional_bits}, options)

    def keeping(self, encoder: SpzEncoder, kept: NDArray[np.bool_]) -> SpzEncoder:
        """Return an encoder of as many nodes that gives some the codes of the file, where its coding is the same."""
        streams = encoder.layout.streams()
        codes = {each.name: self.codes[each.name] for each in streams if self._is_alike(each, encoder.layout)}
        return dataclasses.replace(encoder, stored=codes, kept=kept)

    def _is_alike(self, stream: Stream, other: Layout) -> bool:
        """Return True if a layout has a stream of splats in the coding of the file."""
        own = self.layout
        if stream.column not in COLUMNS:
            return False
        if stream.name == "positions":
            return own.version > 1 and own.fractional_bits == other.fractional_bits
        if stream.name == "rotations":
            return (own.version >= 3) == (other.version >= 3)
        return stream.name != "alphas" or own.has_tree == other.has_tree


def stored(file: BinaryIO) -> StoredSpz:
    """Read the codes of a file; raises `FormatError` as `open_content`."""
    return StoredSpz(*read_codes(Source(file)))
