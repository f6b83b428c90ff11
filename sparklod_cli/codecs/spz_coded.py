"""`CodedSpz`: an SPZ file whose columns stay as codes in memory, a third to a half of what they decode to."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import BinaryIO

import numpy as np

from ..model.gaussian import spark_size
from ..model.lod_tree import LodTree
from ..model.nodes import CHUNK_NODES
from ..model.splats import COLUMNS, FloatArray, Splats
from ..support.progress import Progress, silent
from .content import Content, Source
from .kernels.spz_codes import fill_extremes, fill_sizes, look_up
from .quantize import Bytes
from .spz_layout import LINKS, Layout, StreamRows, column_of
from .spz_reader import read_codes

#: By column of `Splats`, what is called with all of its codes, (n, bytes) at a time, as they are read.
Watch = Mapping[str, Callable[[Bytes], None]]

#: Columns of `Splats` whose numbers are a byte each.
BYTES = ("opacity", "rgb", "scale")


def read_coded(
    file: BinaryIO,
    *,
    columns: Collection[str] = COLUMNS,
    watch: Watch | None = None,
    threads: int = 1,
    progress: Progress = silent,
) -> CodedSpz:
    """Read the codes of a file.

    Args:
        file: open for reading.
        columns: of `Splats` whose codes are kept beside those of the tree; all of a file that may hold invalid splats.
        watch: sees the codes of other columns, too.
        threads: to inflate on.
        progress: called with the bytes that are read.

    Raises:
        FormatError: as `open_content`.
    """

    def see(rows: StreamRows) -> None:
        if watch and rows[0].column in watch:
            watch[rows[0].column](rows[2])

    content, layout, codes = read_codes(Source(file, threads=threads), columns, see)
    progress("reading", layout.total, layout.total, "B")
    return CodedSpz(**vars(content), layout=layout, codes=codes)


@dataclass(frozen=True, eq=False)
class CodedSpz(Content):
    """SPZ file whose columns stay as codes in memory, a third to a half of what they decode to; its tree may be broken.

    Attributes:
        layout: of the file.
        codes: (N, bytes) of streams, by name; of a column that was not requested there are none.
    """

    layout: Layout = field(kw_only=True)
    codes: Mapping[str, Bytes] = field(kw_only=True)

    @property
    def sound(self) -> bool:
        """Whether no code stands for an invalid splat (`splats.INVALID`): positions of version 1 are floats."""
        return self.layout.version > 1

    def decode(self, part: slice, columns: Collection[str] = COLUMNS) -> tuple[Splats, LodTree | None]:
        """Decode some splats, and their part of the tree, if there is one, on any thread.

        Args:
            part: which splats; may end behind the last.
            columns: of `Splats`; the others are 0, and cannot be written to.
        """
        count = len(range(*part.indices(self.count)))
        zeros = self._zeros if count <= len(self._zeros) else Splats.zeros(count, self.sh_degree)
        rows = {name: getattr(zeros, name)[:count] for name in COLUMNS}
        splats = Splats(**{name: np.empty_like(row) if name in columns else row for name, row in rows.items()})
        for stream in self.layout.streams():
            if stream.column in columns:
                out, codes = column_of(splats, None, stream), self.codes[stream.name][part]
                if stream.column in BYTES:
                    look_up(codes, self.table(stream.column), out.reshape(codes.shape))
                else:
                    out[...] = stream.decode(codes).reshape(out.shape)
        tree = self.tree
        return splats, None if tree is None else LodTree(tree.child_count[part], tree.child_start[part])

    def table(self, column: str) -> FloatArray:
        """Return the (256,) values of the bytes of a column of `BYTES`."""
        return self._tables[column]

    @functools.cached_property
    def _tables(self) -> dict[str, FloatArray]:
        every = np.arange(256, dtype=np.uint8)
        return {each.column: each.decode(every) for each in self.layout.streams() if each.column in BYTES}

    @functools.cached_property
    def _zeros(self) -> Splats:
        """Zeros that all blocks share."""
        return Splats.zeros(min(self.count, CHUNK_NODES), self.sh_degree).frozen()

    @functools.cached_property
    def _factors(self) -> FloatArray:
        """(256,) feature size over mean scale, of each code of an opacity."""
        splats = Splats.zeros(256, 0)
        splats.scale[...], splats.opacity[...] = 1, self.table("opacity")
        return spark_size(splats)

    def fill_sizes(self, part: slice, out: FloatArray) -> None:
        """Fill the feature sizes of some splats, as `gaussian.spark_size` computes them."""
        fill_sizes(self.codes["scales"][part], self.codes["alphas"][part], self.table("scale"), self._factors, out)

    def extremes(self, part: slice) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return (n,) opacities, largest scales and largest absolute coordinates of some splats of a sound file."""
        positions, scales, alphas = (self.codes[name][part] for name in ("positions", "scales", "alphas"))
        found = np.empty((3, len(scales)), np.float32)
        tables = self.table("opacity"), self.table("scale")
        fill_extremes(alphas, scales, positions, *tables, np.float32(2.0**-self.layout.fractional_bits), found)
        opacity, largest, furthest = found
        return opacity, largest, furthest

    @functools.cached_property
    def tree(self) -> LodTree | None:
        """Children of all nodes, as views of the codes; None without a tree."""
        if not self.has_tree:
            return None
        links = [stream for stream in self.layout.streams() if stream.name in LINKS]
        return LodTree(**{stream.column: stream.decode(self.codes[stream.name])[:, 0] for stream in links})
