"""Regions of a scene at several detail levels: a binary kd partition of the nodes of the coarsest level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import rotation_matrices
from ..model.splats import FloatArray, Splats
from .detail_settings import DetailSettings

#: Half a bound's side for one splat, in standard deviations. Tools bound a splat by the box of one standard deviation
#: along its own axes, rotated; no multiple of the ellipsoid's box below sqrt(3) encloses that box however it is turned.
#: There 22 % of the splat's opacity are left. More would move viewers, which take their distance from the bound, into
#: the bounds of wide splats.
EXTENT = 3**0.5

#: Splats whose extents are computed at a time, so that their columns stay in the cache. Chosen.
BLOCK = 1 << 14

#: Corners, (n, 2, 3) float64, lowest and highest.
Boxes = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Regions:
    """A partition of places into R regions.

    Attributes:
        number: (n,) int64 region of each place.
        children: (R - 1, 2) int64, as of `DetailScene`.
    """

    number: NDArray[np.int64]
    children: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Places:
    """What is divided: n nodes of the coarsest level, which are not divided themselves.

    Attributes:
        center: (n, 3) world units.
        box: (n, 2, 3) corners of all centres under the node, at any level.
        splats: (n,) int64 splats under it, of all levels.
    """

    center: FloatArray
    box: Boxes
    splats: NDArray[np.int64]


def divide(places: Places, settings: DetailSettings) -> Regions:
    """Divides places at the median of their splats along the longest side, until regions are small enough."""
    number = np.zeros(len(places.splats), np.int64)
    children: list[list[int]] = []
    regions = 0
    waiting: list[tuple[NDArray[np.int64], int]] = [(np.arange(len(number)), -1)]
    while waiting:
        some, parent = waiting.pop()
        parts = _parts(places, some, settings)
        if parts is None:
            number[some] = regions
            own, regions = -1 - regions, regions + 1
        else:
            own = len(children)
            children.append([])
            waiting += [(parts[1], own), (parts[0], own)]  # the first is taken next
        if parent >= 0:
            children[parent].append(own)
    return Regions(number, np.array(children, np.int64).reshape(-1, 2))


def _parts(
    places: Places, some: NDArray[np.int64], settings: DetailSettings
) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
    """The two parts of some places; None where they are small enough, or one."""
    if len(some) < 2:
        return None
    splats = places.splats[some]
    count = int(splats.sum())
    side = float((places.box[some, 1].max(axis=0) - places.box[some, 0].min(axis=0)).max())
    if count <= settings.chunk_splats and (side <= settings.extent or count <= settings.min_splats):
        return None
    center = places.center[some]
    axis = int(np.argmax(np.ptp(center.astype(np.float64), axis=0)))
    order = np.argsort(center[:, axis], kind="stable")
    until = np.cumsum(splats[order])
    # At least one on either side, and as many splats on both as the places allow.
    cut = 1 + int(np.argmin(np.abs(2 * until[:-1] - count)))
    return some[order[:cut]], some[order[cut:]]


def extents(splats: Splats) -> Boxes:
    """(N, 2, 3) corners of each splat's box, EXTENT standard deviations of its rotated ellipsoid on either side."""
    found = np.empty((len(splats), 2, 3))
    for begin in range(0, len(splats), BLOCK):
        some = slice(begin, begin + BLOCK)
        axes = rotation_matrices(splats.quat_xyzw[some])
        axes *= splats.scale[some].T.astype(np.float64)
        half = EXTENT * np.sqrt(np.einsum("wln,wln->nw", axes, axes))
        found[some, 0], found[some, 1] = splats.center[some] - half, splats.center[some] + half
    return found


def united(boxes: FloatArray, number: NDArray[np.int64], count: int) -> Boxes:
    """(count, 2, 3) boxes around all boxes of each number, each of which occurs."""
    order = np.argsort(number, kind="stable")
    starts = np.searchsorted(number[order], np.arange(count))
    low = np.minimum.reduceat(boxes[order, 0], starts)
    return np.stack([low, np.maximum.reduceat(boxes[order, 1], starts)], axis=1).astype(np.float64)
