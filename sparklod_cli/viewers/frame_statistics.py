"""Statistics of cuts: how many nodes are where, how large, and what changes from one cut to the next."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..lod.kernels import cut_statistics as kernels
from ..lod.kernels.cut_arrays import CutNodes
from .cut import Forest, TreeCut, TreeInstance
from .viewer_settings import pixel_limit


@dataclass(frozen=True)
class CutStatistics:
    """Statistics of a cut, or of one instance's nodes in it: columns that `simulation.results.COLUMNS` describes.

    Levels are None if no node is selected, projected sizes if none is inside the frustum.
    """

    selected: int
    leaves: int
    frontier: int
    in_frustum: int
    outside: int
    behind: int
    level_min: int | None
    level_mean: float | None
    level_max: int | None
    projected_px_p50: float | None
    projected_px_p95: float | None
    overdraw_estimate: float


def measure(
    forest: Forest, cut: TreeCut, view: Camera, *, by_instance: bool = False
) -> tuple[CutStatistics, list[CutStatistics]]:
    """Return the statistics of a cut found for `view` as a whole and, optionally, of each instance in it."""
    pixels = view.width * view.height
    counts = np.empty((len(cut.views), kernels.COUNTS), np.int64)
    sizes, owners = np.empty(len(cut.node), np.float32), np.empty(len(cut.node), np.uint16)
    screen = kernels.Screen(
        np.float32(math.tan(view.fov_x / 2)),
        np.float32(math.tan(view.fov_y / 2)),
        np.float32(pixel_limit(view.fov_y, view.height)),
        float(pixels),
    )
    nodes = CutNodes(cut.node, cut.limit.view(np.int32), cut.instance)
    found = kernels.measure_cut(forest.nodes, forest.depth, cut.views, nodes, screen, counts, sizes, owners)
    sizes, owners = sizes[:found], owners[:found]
    total = counts.sum(axis=0)
    total[kernels.DEPTH_MIN] = counts[:, kernels.DEPTH_MIN].min()
    total[kernels.DEPTH_MAX] = counts[:, kernels.DEPTH_MAX].max()
    whole = _measured(total, sizes, pixels)
    if not by_instance:
        return whole, []
    order = np.argsort(owners, kind="stable")
    parts = np.split(sizes[order], np.cumsum(np.bincount(owners, minlength=len(cut.views)))[:-1])
    return whole, [_measured(row, part, pixels) for row, part in zip(counts, parts, strict=True)]


def _measured(row: NDArray[np.int64], sizes: NDArray[np.float32], pixels: int) -> CutStatistics:
    count = [int(value) for value in row]
    selected = count[kernels.SELECTED]
    percentiles: list[float | None] = [None, None]
    if len(sizes):  # interpolated linearly between two sizes each
        places = [share * (len(sizes) - 1) for share in (0.50, 0.95)]
        pairs = [(int(at), min(int(at) + 1, len(sizes) - 1)) for at in places]
        found = np.empty((len(pairs), 2), np.float32)
        kernels.select(sizes, np.array(pairs, np.int64).ravel(), found.ravel())
        percentiles = [
            below + (at - int(at)) * (above - below) if above > below else below  # both may be infinite
            for at, (below, above) in zip(places, found.tolist(), strict=True)
        ]
    return CutStatistics(
        selected=selected,
        leaves=count[kernels.LEAVES],
        frontier=count[kernels.FRONTIER],
        in_frustum=count[kernels.IN_FRUSTUM],
        outside=count[kernels.OUTSIDE],
        behind=count[kernels.BEHIND],
        level_min=count[kernels.DEPTH_MIN] if selected else None,
        level_mean=count[kernels.DEPTH_SUM] / selected if selected else None,
        level_max=count[kernels.DEPTH_MAX] if selected else None,
        projected_px_p50=percentiles[0],
        projected_px_p95=percentiles[1],
        overdraw_estimate=count[kernels.AREA] / kernels.AREA_PARTS / pixels,
    )


class Changes:
    """Compares each cut with the one before it."""

    def __init__(self, forest: Forest, instances: Sequence[TreeInstance]) -> None:
        sizes = np.diff(forest.node_base)
        bits = [int(sizes[instance.tree]) for instance in instances]
        # Each instance begins with a new word.
        ends = np.cumsum([-(-count // 32) * 32 for count in bits])
        self._base = np.concatenate([[0], ends[:-1]]).astype(np.int64)
        self._drawn, self._before = (np.zeros(int(ends[-1]) // 32, np.uint32) for _ in range(2))
        self._last: tuple[NDArray[np.uint32], NDArray[np.uint16]] | None = None
        self._counts = [0] * len(bits)

    def next(self, cut: TreeCut) -> list[tuple[int, int | None, int]]:
        """Return for each instance: nodes in this cut, nodes in both this and the last cut, and nodes in the last cut.

        The second is None for the first cut.
        """
        found = np.empty((len(self._base), 2), np.int64)
        old = self._last or (cut.node[:0], cut.instance[:0])
        kernels.replace_drawn(self._drawn, self._before, self._base, cut.node, cut.instance, *old, found)
        first = self._last is None
        result = [
            (new, None if first else same, before)
            for (new, same), before in zip(found.tolist(), self._counts, strict=True)
        ]
        self._drawn, self._before = self._before, self._drawn
        self._last, self._counts = (cut.node, cut.instance), found[:, 0].tolist()
        return result
