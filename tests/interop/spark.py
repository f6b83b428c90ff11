"""Runs the real Spark in a Node process, and returns its in-memory layouts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sparklod_cli.codecs import layouts
from sparklod_cli.model.lod_tree import CHUNK_NODES
from sparklod_cli.model.splats import Splats
from tests.interop.node import Node

#: A node of the LodTree. child_count is read as a word, so that a count beyond its uint16 is noticed.
NODE = np.dtype([("center", "<f2", 3), ("size", "<f2"), ("child_count", "<u4"), ("child_start", "<u4")])


@dataclass(frozen=True)
class Traversed:
    """A cut that Spark's traversal found.

    Attributes:
        indices: the nodes drawn of each instance, in Spark's order.
        chunks: (tree, chunk) that were visited, in order.
        pixel_limit: the least pixel scale from the root to the node that did not fit into the budget, as Spark says.
    """

    indices: list[NDArray[np.uint32]]
    chunks: list[tuple[int, int]]
    pixel_limit: float


@dataclass(frozen=True)
class PageUpdate:
    """A chunk of a paged tree that is loaded into a page, with four words a node, or removed from it (None)."""

    tree: int
    chunk: int
    page: int
    words: NDArray[np.uint32] | None


class Spark:
    """One Node process with Spark's worker, which loads one file after the other."""

    def __init__(self, package_dir: Path, scratch: Path) -> None:
        self._scratch = scratch
        self._asked = 0
        self._node = Node("spark_load.mjs", package_dir, scratch=scratch)
        self.close = self._node.close

    @contextmanager
    def _files(self, arrays: Mapping[str, NDArray[np.uint32]]) -> Iterator[dict[str, str | list[str]]]:
        """Write arrays to files for a request: a path for each option, or several if its names are "option.0" etc."""
        paths: dict[str, str | list[str]] = {}
        files = []
        for name, words in arrays.items():
            files.append(self._scratch / name)
            words.tofile(files[-1])
            option, _, number = name.partition(".")
            paths[option] = [*paths.get(option, []), str(files[-1])] if number else str(files[-1])
        yield paths
        for file in files:
            file.unlink()

    def load(self, source: bytes | Path, *, lod: bool = False) -> Splats:
        """Load a file, or the bytes of an SPZ file, as ExtSplats; `lod` builds a tree if it has none."""
        words = self.load_words("Ext", source, lod=lod)
        return layouts.unpack_ext({name: values for name, values in words.items() if name != "lodTree"})

    def load_words(
        self,
        layout: str,
        source: bytes | Path,
        *,
        codes: Mapping[str, NDArray[np.uint32]] | None = None,
        **options: Any,
    ) -> dict[str, NDArray[np.uint32]]:
        """Load a file in a layout, "Packed" or "Ext"; returns its arrays as (N, words), one row a splat.

        `codes` is the palette of SH for a chunk of a RAD file: the arrays whose names have "Codes" of its first chunk.
        `options` go to the worker: `lod` builds a tree, `encoding` sets the ranges of PackedSplats.
        """
        self._asked += 1
        out = self._scratch / str(self._asked)
        path = source if isinstance(source, Path) else out.with_suffix(".spz")
        if isinstance(source, bytes):
            path.write_bytes(source)
        request = {"method": f"load{layout}Splats", "path": str(path), "name": path.name, "options": options}
        with self._files(codes or {}) as words:
            answer = self._node.ask(request | {"out": str(out), "words": words})
        width = dict.fromkeys(("sh1", "sh1Codes"), 2 if layout == "Packed" else 4)
        arrays = {}
        for name, file in answer["arrays"].items():
            arrays[name] = np.fromfile(file, "<u4").reshape(-1, width.get(name, 4))[: answer["numSplats"]]
            Path(file).unlink()
        assert answer["lod"] == ("lodTree" in arrays)
        return arrays

    def keep_tree(self, words: NDArray[np.uint32]) -> int:
        """Load a LodTree, four words a node, into Spark's worker; returns its id."""
        path = self._scratch / "tree"
        words.tofile(path)
        tree: int = self._node.ask({"method": "initLodTree", "path": str(path)})["lodId"]
        path.unlink()
        return tree

    def new_pool(self, pages: int) -> int:
        """Make a page pool in Spark's worker, for trees that are loaded chunk by chunk; returns its id."""
        pool: int = self._node.ask({"method": "newLodTree", "options": {"capacity": pages * CHUNK_NODES}})["lodId"]
        return pool

    def new_paged_tree(self, pool: int) -> int:
        """Make a tree in a page pool, none of its chunks resident; returns its id."""
        tree: int = self._node.ask({"method": "newSharedLodTree", "options": {"lodId": pool}})["lodId"]
        return tree

    def update_pages(self, updates: Sequence[PageUpdate]) -> None:
        """Put chunks of trees into pages and removes others, in this order."""
        ranges: list[dict[str, int]] = []
        path, nodes = self._scratch / "tree", 0
        with path.open("wb") as file:
            for each in updates:
                place = {
                    "lodId": each.tree,
                    "pageBase": each.page * CHUNK_NODES,
                    "chunkBase": each.chunk * CHUNK_NODES,
                    "count": CHUNK_NODES,  # Spark removes whole pages, however many nodes were in them
                }
                if each.words is not None:
                    place |= {"count": len(each.words), "start": nodes}
                    file.write(each.words.tobytes())
                    nodes += len(each.words)
                ranges.append(place)
        self._node.ask({"method": "updateLodTrees", "path": str(path), "options": {"ranges": ranges}})
        path.unlink()

    def traverse(
        self, budget: int, smallest: float, instances: Sequence[Mapping[str, Any]], mode: str = "standard"
    ) -> Traversed:
        """Find a cut, as `SparkRenderer` does.

        Args:
            budget: number of splats at most.
            smallest: the pixel-scale limit.
            instances: lodId, viewToObjectCols, lodScale, behindFoveate, coneFov0, coneFov and coneFoveate of each, and
                of paged trees rootPage.
            mode: of the traversal, "standard" or "dynamic".
        """
        options = {
            "maxSplats": budget,
            "pixelScaleLimit": smallest,
            "traverseMode": mode,
            "instances": list(instances),
        }
        out = self._scratch / "cut"
        answer = self._node.ask({"method": "traverseLodTrees", "options": options, "out": str(out)})
        indices = np.fromfile(out, "<u4")
        out.unlink()
        chunks = [(tree, chunk) for tree, chunk in answer["chunks"]]
        return Traversed(np.split(indices, np.cumsum(answer["counts"])[:-1]), chunks, answer["pixelLimit"])
