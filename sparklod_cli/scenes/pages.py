"""`Pages`: a tree whose file is read chunk by chunk, as far as cuts of it need."""

from __future__ import annotations

import itertools
import threading
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ..io import RadFile
from ..lod.kernels.pixel_scale import NODE
from ..model.lod_tree import LodTree
from ..model.nodes import CHUNK_BITS, CHUNK_NODES, Nodes
from ..model.scene import FileCoding
from ..model.splats import COLUMNS, Splats
from ..support.errors import SparklodError, TreeError
from ..support.machine import available_memory
from ..support.parallel import ordered_map

#: Makes nodes of the splats, the tree and the coding of a chunk.
NodesOf = Callable[[Splats, LodTree, FileCoding], Nodes]

#: Columns that nodes are made of.
TRAVERSED = ("center", "scale", "opacity")

#: Decoded chunks that are kept for the splats of the next cut: they take at most this share of the free memory, but
#: there are at least so many. Chosen.
KEPT_SHARE, LEAST_KEPT = 0.25, 8


class Pages:
    """The nodes and splats of a RAD file, as far as they were needed.

    Nodes of chunks that were read stay in memory, 28 bytes each; of decoded splats, only those of some chunks.
    Several threads may ask.

    Args:
        file: of a tree in chunks of `CHUNK_NODES`.
        name: of the file, for errors.
        nodes_of: makes the nodes of a chunk.
        threads: to decode splats with.

    Attributes:
        present: (chunks,) bool, those whose nodes are in memory.
        depth: (N,) int32 edges from the root, of the nodes that the present chunks lead to; 0 of others.
    """

    def __init__(self, file: RadFile, name: str, nodes_of: NodesOf, threads: int) -> None:
        self.file, self._name, self._nodes_of, self._threads = file, name, nodes_of, threads
        self.count = file.header.count
        self.present = np.zeros(len(file.header.chunks), np.bool_)
        self.nodes, self.depth = np.zeros(0, NODE), np.zeros(0, np.int32)
        self._lock = threading.Lock()
        self._cache: OrderedDict[int, Splats] = OrderedDict()
        self._kept = LEAST_KEPT
        free, bytes_of_chunk = available_memory(), Splats.empty(1, file.header.max_sh)
        if free is not None:
            size = CHUNK_NODES * sum(getattr(bytes_of_chunk, name).nbytes for name in COLUMNS)
            self._kept = max(LEAST_KEPT, int(KEPT_SHARE * free / size))

    def place(self, nodes: NDArray[np.void], depth: NDArray[np.int32]) -> None:
        """Takes arrays of zeros, (N,) `NODE` and (N,) int32, for the nodes that will be read, and reads the root's."""
        self.nodes, self.depth = nodes, depth
        self.read([0])

    def read(self, numbers: Sequence[int]) -> None:
        """Reads the nodes of chunks that are not present.

        Raises:
            FormatError, TreeError: a chunk is damaged, or its children are not those of a tree; names the file.
        """
        for number in numbers:
            with self._lock:
                if not self.present[number]:
                    self._read(number)

    def _read(self, number: int) -> None:
        splats, tree, coding = self._decoded(number, TRAVERSED)
        assert tree is not None
        start = number << CHUNK_BITS
        self._check(tree, start)
        found, part = self._nodes_of(splats, tree, coding), self.nodes[start : start + len(tree)]
        part["x"], part["y"], part["z"] = found.center.T
        part["size"] = found.size
        part["child_start"], part["child_count"] = tree.first_child(), tree.child_count
        self.present[number] = True
        known = start + np.flatnonzero(self.depth[start : start + len(tree)])
        self._descend(known if number else np.concatenate([np.zeros(1, np.int64), known]))

    def _check(self, tree: LodTree, start: int) -> None:
        """Raises a `TreeError` for children that no tree has; `LodTree.validate` has the same texts."""
        first, node = tree.child_start.astype(np.int64), start + np.arange(len(tree))
        for mask, what in (
            (~tree.is_leaf & (first <= node), "comes after one of its children"),
            (~tree.is_leaf & (first + tree.child_count > self.count), "has children past the last node"),
        ):
            if mask.any():
                raise TreeError(f"{self._name}: its tree is broken: node {node[np.argmax(mask)]} {what}")

    def _descend(self, frontier: NDArray[np.int64]) -> None:
        """Gives their depths to the nodes below some whose depth is known, as far as chunks are present."""
        while len(frontier):
            count = self.nodes["child_count"][frontier].astype(np.int64)
            inner, count = frontier[count > 0], count[count > 0]
            first = self.nodes["child_start"][inner].astype(np.int64)
            children = np.repeat(first - (np.cumsum(count) - count), count) + np.arange(count.sum())
            twice = self.depth[children] > 0
            if twice.any() or len(np.unique(children)) < len(children):
                node = np.repeat(inner, count)[np.argmax(twice)]
                raise TreeError(f"{self._name}: its tree is broken: node {node} shares children with another node")
            self.depth[children] = np.repeat(self.depth[inner] + 1, count)
            frontier = children[self.present[children >> CHUNK_BITS]]

    def splats(self, index: NDArray[np.integer]) -> Splats:
        """Some splats, whose chunks are decoded, and kept for the next ones as far as there is room.

        Args:
            index: (M,) ascending.

        Raises:
            FormatError: a chunk is damaged; names the file.
        """
        rows = Splats.empty(len(index), self.file.header.max_sh)
        numbers, begins = np.unique(index >> CHUNK_BITS, return_index=True)
        ends = itertools.pairwise([*begins.tolist(), len(index)])
        parts = {int(number): slice(*each) for number, each in zip(numbers, ends, strict=True)}

        def put(number: int, splats: Splats) -> None:
            part = parts[number]
            for name in COLUMNS:
                getattr(rows, name)[part] = getattr(splats, name)[index[part] - (number << CHUNK_BITS)]

        def decoded(number: int) -> tuple[int, Splats]:
            return number, self._decoded(number, COLUMNS)[0]

        with self._lock:
            kept = [number for number in parts if number in self._cache]
            for number in kept:
                put(number, self._cache[number])
                self._cache.move_to_end(number)
            missing = [number for number in parts if number not in self._cache]
            for number, splats in ordered_map(decoded, missing, self._threads):
                put(number, splats)
                self._cache[number] = splats
                if len(self._cache) > self._kept:
                    self._cache.popitem(last=False)
        return rows

    def blocks(self, columns: Collection[str]) -> Iterator[tuple[Splats, LodTree]]:
        """All chunks in order, with these columns; none of them is kept.

        Raises:
            FormatError: a chunk is damaged; names the file.
        """
        try:
            for _, splats, tree in self.file.chunks(columns, thorough=False, threads=self._threads):
                assert tree is not None
                yield splats, tree
        except SparklodError as error:
            raise type(error)(f"{self._name}: {error}") from None

    def leaf_count(self) -> int:
        """How many nodes are leaves, for which the children of all are read."""
        return sum(int(np.count_nonzero(tree.is_leaf)) for _, tree in self.blocks(()))

    def leaves(self) -> NDArray[np.int64]:
        """(M,) indices of all leaves."""
        found = [np.flatnonzero(tree.is_leaf) for _, tree in self.blocks(())]
        return np.concatenate([number * CHUNK_NODES + leaves for number, leaves in enumerate(found)])

    def _decoded(self, number: int, columns: Collection[str]) -> tuple[Splats, LodTree | None, FileCoding]:
        try:
            return self.file.chunk(number, columns)
        except SparklodError as error:
            raise type(error)(f"{self._name}: {error}") from None
