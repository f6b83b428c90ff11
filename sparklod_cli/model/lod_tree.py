"""`LodTree`: the child columns of a Level-of-Detail tree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..system.errors import TreeError

#: The most children of a node: child counts are uint16 in Spark's nodes and in SPZ files.
MAX_CHILDREN = 65535

#: Attribute of frozen trees: whether the tree was validated.
_VALID = "_valid"


@dataclass(frozen=True)
class LodTree:
    """The children of M nodes: node i has the children `child_start[i]` to `child_start[i] + child_count[i] - 1`.

    Attributes:
        child_count: (M,) uint16, 0 for a leaf.
        child_start: (M,) uint32 index of the first child; without meaning for a leaf, where writers put 0.
    """

    child_count: NDArray[np.uint16]
    child_start: NDArray[np.uint32]

    def __post_init__(self) -> None:
        for name, dtype in (("child_count", np.uint16), ("child_start", np.uint32)):
            column = getattr(self, name)
            if not isinstance(column, np.ndarray):
                raise TypeError(f"{name} is a {type(column).__name__}; give an array of {np.dtype(dtype)}")
            if column.dtype != dtype or column.ndim != 1:
                raise ValueError(
                    f"{name} is {column.dtype}{list(column.shape)}, expected {np.dtype(dtype)} of one dimension"
                )

    def __len__(self) -> int:
        return len(self.child_count)

    def frozen(self) -> LodTree:
        """Return this tree with immutable columns, copied unless it is frozen already.

        Kernels follow links without bounds checks: a tree must not change after `validate`.
        """
        if _VALID in self.__dict__:
            return self
        # From bytes, as the owner of a read-only array can make it writable again.
        count, start = self.child_count.tobytes(), self.child_start.tobytes()
        tree = LodTree(np.frombuffer(count, np.uint16), np.frombuffer(start, np.uint32))
        tree.__dict__[_VALID] = False
        return tree

    def __reduce__(self) -> tuple[type[LodTree], tuple[Any, ...]]:
        return LodTree, (self.child_count, self.child_start)  # copies are writable, and validated again

    def rows(self, part: slice) -> LodTree:
        """Return views of consecutive nodes."""
        return LodTree(self.child_count[part], self.child_start[part])

    @property
    def is_leaf(self) -> NDArray[np.bool_]:
        """(M,) bool, true for nodes without children."""
        return self.child_count == 0

    def first_child(self) -> NDArray[np.uint32]:
        """Return the (M,) uint32 index of the first child, 0 for a leaf."""
        return np.where(self.is_leaf, np.uint32(0), self.child_start)

    def depths(self) -> NDArray[np.int32]:
        """Return (M,) int32 numbers of edges from the root to each node; raise `TreeError` if the tree is invalid."""
        self.validate()
        depth = np.zeros(len(self), np.int32)
        frontier = np.zeros(1, np.int64)
        level = 0
        while frontier.size:
            depth[frontier] = level
            count = self.child_count[frontier].astype(np.int64)
            start = self.child_start[frontier].astype(np.int64)
            first = np.cumsum(count) - count
            frontier = np.repeat(start - first, count) + np.arange(count.sum())
            level += 1
        return depth

    def validate(self) -> None:
        """Check that this is a single tree with root 0, in linear time.

        Each node but the root is the child of exactly one node, which comes before it. As in Spark, the
        `child_start` of a leaf is not checked. A frozen tree is validated once.

        Raises:
            TreeError: the tree is invalid; names the first invalid node.
        """
        if self.__dict__.get(_VALID):
            return
        if len(self.child_count) != len(self.child_start):
            raise TreeError(f"{len(self.child_count)} child counts but {len(self.child_start)} child starts")
        if len(self) == 0:
            raise TreeError("the tree has no node")
        node = np.flatnonzero(self.child_count)
        start = self.child_start[node].astype(np.int64)
        end = start + self.child_count[node]
        # Ranges of children, sorted by their start, cover 1..M exactly once if each begins where the last one ended.
        by_start = np.argsort(start, kind="stable")
        expected = np.concatenate([[1], end[by_start]])
        for wrong, what in (
            (node[start <= node], "comes after one of its children"),
            (node[end > len(self)], "has children past the last node"),
            (node[by_start[start[by_start] != expected[:-1]]], "shares children with another node or skips some"),
        ):
            if wrong.size:
                raise TreeError(f"node {wrong[0]} {what}")
        if expected[-1] != len(self):
            raise TreeError(f"node {expected[-1]} has no parent")
        if _VALID in self.__dict__:
            self.__dict__[_VALID] = True


#: Nodes of a chunk, the unit in which Spark streams trees; as a power of 2.
CHUNK_BITS = 16
CHUNK_NODES = 1 << CHUNK_BITS
