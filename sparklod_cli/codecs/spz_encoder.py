"""Encodes the windows of an SPZ file, whose streams hold one column of all splats each."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model.lod_tree import LodTree
from ..model.scene import Scene
from ..model.splats import Splats
from ..model.streams import NodeStream
from ..support.parallel import blocks_of
from ..support.progress import Progress, silent
from . import clamps, compression
from .clamps import Range
from .compression import Run
from .encoder import CLAMPED, Encoded, Get, rows_of, windows_of
from .noted import comment_of
from .options import WriteOptions
from .spz_layout import ANTIALIASED, HEADER, LOD, MAGIC, Layout, column_of
from .spz_values import opacities, sh_codes

#: How streams are deflated; the others have repetitions of all kinds.
WAYS = {
    **dict.fromkeys(("alphas", "scales", "rotations"), compression.NOISE),
    "colors": compression.TRIPLES,
    "child_counts": compression.RUNS,
    "child_starts": compression.LINKS,
}


@dataclass(frozen=True)
class SpzEncoder:
    """The encoder of a file, see `encoder.Encoder`: the result of a window has its part of each stream, by its name.

    Attributes:
        layout: of the file.
        options: with nothing left open.
        ranges: beyond which values are counted; none unless somebody wants to know.
        up: as in `Scene`.
    """

    layout: Layout
    options: WriteOptions
    ranges: tuple[Range, ...] = ()
    up: str | None = None

    @property
    def count(self) -> int:
        """Splats of the file."""
        return self.layout.count

    @property
    def sh_degree(self) -> int:
        """SH degree of the file."""
        return self.layout.sh_degree

    def encode(self, splats: Splats, tree: LodTree | None, start: int) -> Encoded:
        """The result of a window, wherever it begins."""
        streams = self.layout.streams()
        codes = {stream.name: np.empty((len(splats), stream.size), np.uint8) for stream in streams}
        bits, sh_bits = self.layout.fractional_bits, self.options.sh_bits
        assert sh_bits is not None
        for part in blocks_of(len(splats)):
            some, links = rows_of(splats, tree, part)
            is_leaf = None if links is None else links.is_leaf
            some = dataclasses.replace(some, opacity=opacities(some, bits, covering=self.options.covering))
            for stream in streams:
                if stream.name == "sh":
                    values = sh_codes(some.sh, is_leaf, sh_bits)
                else:
                    values = np.ascontiguousarray(stream.encode(column_of(some, links, stream)))
                codes[stream.name][part] = values.view(np.uint8).reshape(-1, stream.size)
        return codes | (
            {CLAMPED: clamps.tally(splats, self.ranges, None if tree is None else tree.is_leaf)} if self.ranges else {}
        )

    def pieces(self, get: Get, *, threads: int, progress: Progress) -> Iterator[bytes]:
        """The header and all streams, as one gzip member."""
        layout = self.layout
        fields = layout.version, layout.count, layout.sh_degree, layout.fractional_bits, layout.flags, 0

        def data() -> Iterator[bytes | NDArray[Any]]:
            yield HEADER.pack(MAGIC, *fields)
            for stream in layout.streams():
                for number in range(len(windows_of(layout.count))):
                    yield get(number, stream.name)

        runs = [
            Run(stream.size * layout.count, WAYS.get(stream.name, compression.MIXED)) for stream in layout.streams()
        ]
        runs[0] = runs[0]._replace(size=runs[0].size + HEADER.size)
        comment = "" if self.up is None else comment_of(up=self.up)
        level = self.options.compression_level
        yield from compression.gzip_member(data(), runs, level, threads, progress, comment=comment.encode())


def encoder(
    scene: Scene | NodeStream,
    options: WriteOptions,
    ranges: tuple[Range, ...] = (),
    *,
    threads: int = 1,
    progress: Progress = silent,
) -> SpzEncoder:
    """The encoder of a scene.

    Args:
        scene: of which nothing is read.
        options: settled.
        ranges: beyond which the results count values, see `clamps.tally`.
        threads, progress: not needed.

    Raises:
        ValueError: the options are not settled.
    """
    if options.spz_version is None or options.fractional_bits is None or options.sh_bits is None:
        raise ValueError("the options leave choices open; `settled` makes them")
    if isinstance(scene, NodeStream):
        count, sh_degree, tree = scene.count, scene.sh_degree, True
    else:
        count, sh_degree, tree = len(scene), scene.splats.sh_degree, scene.tree is not None
    flags = (ANTIALIASED if scene.antialiased else 0) | (LOD if tree else 0)
    layout = Layout(options.spz_version, count, sh_degree, options.fractional_bits, flags)
    return SpzEncoder(layout, options, ranges, scene.up)
