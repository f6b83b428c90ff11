"""`CodedSpz`: an SPZ file whose columns stay as codes in memory, a third to a half of what they decode to."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field

import numpy as np

from ..model.gaussian import spark_size
from ..model.lod_tree import LodTree
from ..model.nodes import CHUNK_NODES
from ..model.splats import COLUMNS, FloatArray, Splats
from .kernels.spz_codes import fill_extremes, fill_sizes, look_up
from .quantize import Bytes
from .spz_layout import LINKS, Layout, column_of

#: By column of `Splats`, what is called with all of its codes, (n, bytes) at a time, as they are read.
Watch = Mapping[str, Callable[[Bytes], None]]

#: Columns of `Splats` whose numbers are a byte each.
BYTES = ("opacity", "rgb", "scale")


def sound(layout: Layout) -> bool:
    """Whether no code stands for an invalid splat (`splats.INVALID`): positions of version 1 are floats."""
    return layout.version > 1


@dataclass(frozen=True, eq=False)
class CodedSpz:
    """An SPZ file whose data have been unpacked and checked; its tree may be broken.

    Attributes:
        layout: of the file.
        codes: (N, bytes) of streams, by name; of a column that was not asked for there are none.
        sh_degree: as it is decoded.
        antialiased, format, notes, header, up: as in `Scene`.
    """

    layout: Layout
    codes: Mapping[str, Bytes]
    sh_degree: int
    antialiased: bool
    format: str
    notes: tuple[str, ...] = ()
    header: Mapping[str, int] = field(default_factory=dict)
    up: str | None = None

    @property
    def count(self) -> int:
        """N splats."""
        return self.layout.count

    @property
    def sound(self) -> bool:
        """As the function."""
        return sound(self.layout)

    def decode(self, part: slice, columns: Collection[str] = COLUMNS) -> tuple[Splats, LodTree | None]:
        """Some splats, and their part of the tree, if there is one; several threads may ask.

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
        """(256,) what each byte stands for in a column of `BYTES`."""
        return self._tables[column]

    @functools.cached_property
    def _tables(self) -> dict[str, FloatArray]:
        every = np.arange(256, dtype=np.uint8)
        return {each.column: each.decode(every) for each in self.layout.streams() if each.column in BYTES}

    @functools.cached_property
    def _zeros(self) -> Splats:
        """Zeros that all blocks share."""
        splats = Splats.zeros(min(self.count, CHUNK_NODES), self.sh_degree)
        for name in COLUMNS:
            getattr(splats, name).flags.writeable = False
        return splats

    @functools.cached_property
    def _factors(self) -> FloatArray:
        """(256,) feature size over mean scale, of each code of an opacity."""
        splats = Splats.zeros(256, 0)
        splats.scale[...], splats.opacity[...] = 1, self.table("opacity")
        return spark_size(splats)

    def fill_sizes(self, part: slice, out: FloatArray) -> None:
        """The feature sizes of some splats, as `gaussian.spark_size` computes them."""
        fill_sizes(self.codes["scales"][part], self.codes["alphas"][part], self.table("scale"), self._factors, out)

    def extremes(self, part: slice) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of some splats of a sound file: (n,) opacities, largest scales, and largest absolute coordinates."""
        positions, scales, alphas = (self.codes[name][part] for name in ("positions", "scales", "alphas"))
        found = np.empty((3, len(scales)), np.float32)
        tables = self.table("opacity"), self.table("scale")
        fill_extremes(alphas, scales, positions, *tables, np.float32(2.0**-self.layout.fractional_bits), found)
        opacity, largest, furthest = found
        return opacity, largest, furthest

    @functools.cached_property
    def tree(self) -> LodTree | None:
        """The children of all nodes, which are views of the codes; None without a tree."""
        if not self.layout.has_tree:
            return None
        links = [stream for stream in self.layout.streams() if stream.name in LINKS]
        return LodTree(**{stream.column: stream.decode(self.codes[stream.name])[:, 0] for stream in links})
