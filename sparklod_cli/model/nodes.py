"""`Nodes`: a tree as a traversal reads it."""

from __future__ import annotations

from dataclasses import dataclass

from .gaussian import spark_size
from .lod_tree import LodTree
from .splats import FloatArray, Splats

#: Nodes of a chunk, the unit in which Spark streams trees; as a power of 2.
CHUNK_BITS = 16
CHUNK_NODES = 1 << CHUNK_BITS


@dataclass(frozen=True)
class Nodes:
    """Node data that the traversal reads, N nodes.

    Attributes:
        center: (N, 3) float32 world units.
        size: (N,) float32 feature sizes, world units.
        tree: (N,) children; not validated.
    """

    center: FloatArray
    size: FloatArray
    tree: LodTree

    @classmethod
    def of(cls, splats: Splats, tree: LodTree) -> Nodes:
        """Return the nodes of a tree in full precision, with Spark's feature sizes."""
        return cls(splats.center, spark_size(splats), tree)
