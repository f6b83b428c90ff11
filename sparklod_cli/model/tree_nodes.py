"""`Nodes`, what a traversal reads of the nodes of a tree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from .lod_tree import CHUNK_NODES, LodTree
from .splats import FloatArray


@dataclass(frozen=True)
class Nodes:
    """N nodes of a tree, which is not validated, with (N, 3) float32 centres and (N,) feature sizes, world units."""

    center: FloatArray
    size: FloatArray
    tree: LodTree

    #: Whether nodes are read as cuts need them.
    paged: ClassVar[bool] = False

    @property
    def count(self) -> int:
        return len(self.size)

    @property
    def chunks(self) -> int:
        return -(-self.count // CHUNK_NODES)

    @property
    def depth(self) -> NDArray[np.int32]:
        return self.tree.depths()

    def fill(self, rows: NDArray[np.void]) -> None:
        """Fill (N,) `pixel_scale.NODE`."""
        rows["x"], rows["y"], rows["z"] = self.center.T
        rows["size"] = self.size
        rows["child_start"], rows["child_count"] = self.tree.first_child(), self.tree.child_count
