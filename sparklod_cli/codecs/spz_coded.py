"""`CodedSpz`: an SPZ file whose columns stay as codes in memory, a third to a half of what they decode to."""

from __future__ import annotations

import functools
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from ..model.lod_tree import LodTree
from ..model.splats import COLUMNS, Splats
from .quantize import Bytes
from .spz_layout import LINKS, Layout, column_of


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
        antialiased, format, notes, header: as in `Scene`.
    """

    layout: Layout
    codes: Mapping[str, Bytes]
    sh_degree: int
    antialiased: bool
    format: str
    notes: tuple[str, ...] = ()
    header: Mapping[str, int] = field(default_factory=dict)

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
            columns: of `Splats`; the others are 0.
        """
        splats = Splats.zeros(len(range(*part.indices(self.count))), self.sh_degree)
        for stream in self.layout.streams():
            if stream.column in columns:
                out = column_of(splats, None, stream)
                out[...] = stream.decode(self.codes[stream.name][part]).reshape(out.shape)
        tree = self.tree
        return splats, None if tree is None else LodTree(tree.child_count[part], tree.child_start[part])

    @functools.cached_property
    def tree(self) -> LodTree | None:
        """The children of all nodes, which are views of the codes; None without a tree."""
        if not self.layout.has_tree:
            return None
        links = [stream for stream in self.layout.streams() if stream.name in LINKS]
        return LodTree(**{stream.column: stream.decode(self.codes[stream.name])[:, 0] for stream in links})
