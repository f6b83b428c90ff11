"""Scenes of which viewers draw whole runs of splats, in the memory layout of traversals of trees."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import spark_size
from ..model.splats import Splats
from .kernels import pixel_scale
from .traversal import Forest


class SplatForest(Forest):
    """Splats as the nodes of a `Forest`, so that statistics of cuts are of them, too; chunks are files.

    Args:
        splats: of each scene.
        coarse: of each, (N,) bool, true for splats that finer ones replace; the others count as leaves.
        files: number of files of each.
    """

    def __init__(self, splats: Sequence[Splats], coarse: Sequence[NDArray[np.bool_]], files: Sequence[int]) -> None:
        self._splats, self._coarse = splats, coarse
        self.node_base = np.cumsum([0, *map(len, splats)]).astype(np.int64)
        self.chunk_base = np.cumsum([0, *files]).astype(np.int64)

    @functools.cached_property
    def nodes(self) -> NDArray[np.void]:  # type: ignore[override]  # made when the first statistics are asked for
        """(N,) `pixel_scale.NODE` of all scenes."""
        nodes = np.zeros(int(self.node_base[-1]), pixel_scale.NODE)
        for splats, coarse, start in zip(self._splats, self._coarse, self.node_base.tolist(), strict=False):
            part = nodes[start : start + len(splats)]
            part["x"], part["y"], part["z"] = splats.center.T
            part["size"] = spark_size(splats)
            part["child_count"] = coarse
        return nodes
