"""`PagedForest`: trees of which some are read chunk by chunk, as cuts need them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..lod.traversal import Forest
from ..model.nodes import Nodes
from .pages import Pages

#: Share of the chunks that a cut lacks that is read before the cut is found again, the most important ones first. With
#: fewer, it is found more often; with more, chunks are read that it turns out not to need. Chosen.
READ_SHARE = 0.5


class PagedForest(Forest):
    """Trees in the memory layout of the traversal; those with pages are read as cuts need them.

    Args:
        trees: whole, each with the depths of its nodes, or pages.

    Attributes:
        depth: (nodes,) int32 edges from the root to each, of the nodes that were read and of their children.
    """

    def __init__(self, trees: Sequence[tuple[Nodes, NDArray[np.int32]] | Pages]) -> None:
        # Zeros take no memory before something is written to them.
        self._make_room([tree.count if isinstance(tree, Pages) else len(tree[1]) for tree in trees], np.zeros)
        self.depth = np.zeros(len(self.nodes), np.int32)
        self._pages = {number: tree for number, tree in enumerate(trees) if isinstance(tree, Pages)}
        for number, tree in enumerate(trees):
            start, stop = self.node_base[number : number + 2]
            if isinstance(tree, Pages):
                tree.place(self.nodes[start:stop], self.depth[start:stop])
            else:
                self._put(tree[0], int(start))
                self.depth[start:stop] = tree[1]

    def present(self) -> NDArray[np.bool_]:
        """(chunks,) bool, those whose nodes are in memory; not changed later."""
        present = np.ones(self.chunks, np.bool_)
        for number, pages in self._pages.items():
            present[self.chunk_base[number] : self.chunk_base[number + 1]] = pages.present
        return present

    def read(self, chunks: NDArray[np.bool_]) -> None:
        """Reads those of these chunks, (chunks,) bool, that are not in memory.

        Raises:
            FormatError, TreeError: see `Pages.read`.
        """
        for number, pages in self._pages.items():
            own = chunks[self.chunk_base[number] : self.chunk_base[number + 1]]
            pages.read(np.flatnonzero(own & ~pages.present).tolist())

    def read_some(self, wanted: NDArray[np.float32], present: NDArray[np.bool_]) -> bool:
        """Reads the more important half of the chunks that a cut lacked; False if it lacked none.

        The most important one is needed for certain, as a cut takes nodes by their importance; others may turn out not
        to be, once the nodes in that one take their share of the budget.
        """
        missing = np.flatnonzero((wanted > 0) & ~present)
        missing = missing[np.argsort(-wanted[missing], kind="stable")]
        now = np.zeros(self.chunks, np.bool_)
        now[missing[: int(np.ceil(READ_SHARE * len(missing)))]] = True
        self.read(now)
        return len(missing) > 0
