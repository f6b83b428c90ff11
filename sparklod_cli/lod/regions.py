"""Regions of a scene at several detail levels: a binary kd partition of the nodes of the coarsest level.

What is far outside, such as a sky, is the environment, which is drawn whatever the levels are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import rotation_matrices
from ..model.splats import FloatArray, Splats
from ..system.errors import InvalidSplatsError
from .part_settings import DetailSettings

#: Half a bound's side for one splat, in standard deviations. Tools bound a splat by the box of one standard deviation
#: along its own axes, rotated; no multiple of the ellipsoid's box below sqrt(3) encloses that box however it is turned.
#: There 22 % of the splat's opacity are left. More would move viewers, which take their distance from the bound, into
#: the bounds of wide splats.
EXTENT = 3**0.5

#: Splats whose extents are computed at a time, so that their columns stay in the cache. Chosen.
BLOCK = 1 << 14

#: Corners, (n, 2, 3) float64, lowest and highest.
Boxes = NDArray[np.float64]


def divide(
    center: FloatArray, box: Boxes, splats: NDArray[np.int64], settings: DetailSettings
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Divide nodes of the coarsest level at the median of their splats along the longest side, until they are few.

    Args:
        center: (n, 3) of the nodes, world units.
        box: (n, 2, 3) corners of all centres under each node, at any level.
        splats: (n,) int64 splats under each, of all levels.
        settings: sizes of regions; a region that is a single node is not divided.

    Returns:
        (n,) int64 region of each node, and (R - 1, 2) int64 children as of `DetailScene`.
    """
    number = np.zeros(len(splats), np.int64)
    children: list[list[int]] = []
    regions = 0
    waiting: list[tuple[NDArray[np.int64], int]] = [(np.arange(len(number)), -1)]
    while waiting:
        some, parent = waiting.pop()
        count = splats[some]
        side = float((box[some, 1].max(axis=0) - box[some, 0].min(axis=0)).max())
        if len(some) < 2 or _is_small(int(count.sum()), side, settings):
            number[some] = regions
            own, regions = -1 - regions, regions + 1
        else:
            first, second = _halves(some, center[some], count)
            own = len(children)
            children.append([])
            waiting += [(second, own), (first, own)]  # the first is taken next
        if parent >= 0:
            children[parent].append(own)
    return number, np.array(children, np.int64).reshape(-1, 2)


def _is_small(count: int, side: float, settings: DetailSettings) -> bool:
    return count <= settings.chunk_splats and (side <= settings.extent or count <= settings.min_splats)


def _halves(
    some: NDArray[np.int64], center: FloatArray, splats: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the parts of two or more nodes, with as many splats each as the nodes allow."""
    axis = int(np.argmax(np.ptp(center.astype(np.float64), axis=0)))
    order = np.argsort(center[:, axis], kind="stable")
    until = np.cumsum(splats[order])
    cut = 1 + int(np.argmin(np.abs(2 * until[:-1] - until[-1])))
    return some[order[:cut]], some[order[cut:]]


def extents(splats: Splats) -> Boxes:
    """Return (N, 2, 3) corners of splats' boxes, EXTENT standard deviations of the ellipsoids on either side."""
    boxes = np.empty((len(splats), 2, 3))
    for begin in range(0, len(splats), BLOCK):
        some = slice(begin, begin + BLOCK)
        axes = rotation_matrices(splats.quat_xyzw[some])
        axes *= splats.scale[some].T.astype(np.float64)
        half = EXTENT * np.sqrt(np.einsum("wln,wln->nw", axes, axes))
        boxes[some, 0], boxes[some, 1] = splats.center[some] - half, splats.center[some] + half
    return boxes


def united(boxes: FloatArray, number: NDArray[np.int64], count: int) -> Boxes:
    """Return (count, 2, 3) boxes around all boxes of each number, each of which occurs."""
    order = np.argsort(number, kind="stable")
    starts = np.searchsorted(number[order], np.arange(count))
    low = np.minimum.reduceat(boxes[order, 0], starts)
    return np.stack([low, np.maximum.reduceat(boxes[order, 1], starts)], axis=1).astype(np.float64)


def middle_of(splats: Splats) -> NDArray[np.float64]:
    """Return the (3,) median of one or more centres along each axis, which few splats far outside do not move."""
    return np.asarray(np.median(splats.center.astype(np.float64), axis=0))


def beyond(splats: Splats, radius: float) -> NDArray[np.bool_]:
    """Return a (N,) mask of the splats whose centres are farther than a radius from the middle of the scene.

    Args:
        splats: of the whole scene, finite.
        radius: world units.

    Raises:
        InvalidSplatsError: all are.
    """
    middle = middle_of(splats)
    offset = splats.center - middle
    far: NDArray[np.bool_] = np.einsum("ij,ij->i", offset, offset) > float(radius) ** 2
    if far.all():
        x, y, z = middle
        raise InvalidSplatsError(
            f"no splat is within {radius:g} of the middle of the scene ({x:.4g}, {y:.4g}, {z:.4g}); "
            "give --environment-beyond a larger radius"
        )
    return far
