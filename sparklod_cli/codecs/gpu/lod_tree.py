"""LodTree, Spark's layout of 16 bytes per node: what its traversal reads of a Level-of-Detail tree."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...model.gaussian import spark_size
from ...model.lod_tree import MAX_CHILDREN, LodTree
from ...model.scene import Scene
from ...model.splats import Splats
from ...model.traversed import Nodes
from ...system.errors import FormatError
from ...system.threads import for_blocks
from ..spark_codings import Words, checked_words

NODE = np.dtype(
    [
        ("center", "<f2", 3),  # 0: world units; x | y << 16 in word 0, z in word 1
        ("size", "<f2"),  # 6: world units, see `spark_size`; the upper half of word 1
        ("child_count", "<u4"),  # 8: 0 for a leaf; a uint16, the upper half of word 2 is 0
        ("child_start", "<u4"),  # 12: index of the first child, 0 for a leaf
    ]
)
assert NODE.itemsize == 16


def pack(splats: Splats, tree: LodTree, *, threads: int = 1) -> dict[str, Words]:
    """Pack splats and their tree in the layout of Spark's traversal: "lod_tree" (N, 4) uint32.

    Spark measures splats after their coding: for the same words as Spark's, pass splats that were packed and unpacked
    by `ext_splats` or `packed_splats`. A coordinate or a size of 65520 or more becomes infinite, as in Spark.

    Raises:
        FormatError: the numbers of nodes and splats differ.
    """
    if len(tree) != len(splats):
        raise FormatError(f"{len(tree):,} nodes, but {len(splats):,} splats")
    words = np.empty((len(splats), 4), np.uint32)

    @np.errstate(over="ignore")
    def encode(part: slice) -> None:
        rows = words[part].view(NODE)[:, 0]
        rows["center"] = splats.center[part]
        rows["size"] = spark_size(splats.take(part))
        rows["child_count"] = tree.child_count[part]
        rows["child_start"] = tree.child_start[part]

    for_blocks(encode, len(splats), threads)
    return {"lod_tree": words}


def dump(scene: Scene, *, threads: int = 1) -> dict[str, Words]:
    """Return the words of a scene that is a tree; raises `ValueError` if it is none."""
    if scene.tree is None:
        raise ValueError("the scene has no tree")
    return pack(scene.splats, scene.tree, threads=threads)


def unpack(arrays: Mapping[str, NDArray[Any]]) -> Nodes:
    """Return the nodes of the array of `pack`.

    Largest errors: 2 ** -11 of each coordinate and of the size, or 2 ** -25 if that is more; children are exact.

    Raises:
        FormatError: the array is missing or has another shape or type, or a node has more children than a uint16 holds.
    """
    rows = checked_words(arrays, {"lod_tree": 4})["lod_tree"].view(NODE)[:, 0]
    child_count = rows["child_count"]
    if child_count.max(initial=0) > MAX_CHILDREN:
        node = int(np.argmax(child_count > MAX_CHILDREN))
        raise FormatError(f"node {node} has {child_count[node]:,} children, a uint16 holds at most {MAX_CHILDREN:,}")
    tree = LodTree(child_count.astype(np.uint16), rows["child_start"].copy())
    return Nodes(rows["center"].astype(np.float32), rows["size"].astype(np.float32), tree)
