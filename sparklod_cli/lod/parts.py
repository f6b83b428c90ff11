"""Detail levels of a tree, for Streamed SOG, and its tiles, for 3D Tiles.

Detail levels are cuts of a tree for all cameras, divided into regions. Tiles are cuts of a tree, each a refinement of
the one before, divided in space. Both have plain splats.

These formats hold opacities of at most 1: splats with more become larger ones of opacity 1. A splat of linear opacity
A > 1 has the alpha p(z) = 1 - (1 - exp(-z^2 / 2)) ** A, flat on top. A plain Gaussian of opacity 1 and k times the
scale has g(z) = exp(-z^2 / (2 k^2)). Both are isotropic on the screen, in standard deviations of the splat, so k
depends on A alone. They cover the same area if k = sqrt(H(A)): the integral of p over the plane is 2 pi H(A), with the
harmonic number H (see `model/falloff.py`), that of g is 2 pi k^2.

The geometric error of a tile is `PIXEL_ERROR` times the median feature size of the splats that its children replace. A
viewer such as CesiumJS refines a tile if its projected error is larger than 16 pixels by default, so if half of these
splats are larger than a pixel: Spark's rule for a node, applied to a whole tile. See docs/decisions/21-3d-tiles.md.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..model.falloff import harmonic
from ..model.gaussian import covariance, rotation_matrices, spark_size
from ..model.instances import DetailScene, TileScene
from ..model.lod_tree import LodTree
from ..model.splats import FloatArray, Splats
from ..system.errors import InvalidSplatsError
from ..system.progress import Progress, silent
from .kernels.tree_links import find_parents
from .tree_settings import DetailSettings, TileSettings

#: Half the side of a splat's bound, in standard deviations. Other tools bound a splat by the rotated box of one
#: standard deviation along its own axes; sqrt(3) is the least multiple of the ellipsoid's box that encloses that box at
#: any rotation. At its border, 22 % of the splat's opacity are left. With more, viewers, which measure distances from
#: bounds, would be inside the bounds of wide splats.
EXTENT = 3**0.5

#: Share of each default level in the splats of the level before. A viewer draws a level coarser for each factor in
#: distance, by default 3 in PlayCanvas's engine: a surface then covers a ninth of the pixels, so that levels of a
#: quarter still have twice as many splats a pixel as the level before. All coarser levels together are a third of full
#: detail. Chosen.
STEP = 0.25

#: Maximum number of splats of the coarsest default level, which a viewer loads first and draws at least. Chosen.
COARSE_ENOUGH = 1 << 16

#: Rows and columns, among xx xy xz yy yz zz, of the covariance on the planes xy, xz and yz, and the axes of these.
PLANES = ((0, 3, 1, 0, 1), (0, 5, 2, 0, 2), (3, 5, 4, 1, 2))

#: Maximum distance of two siblings in the list of children for their overlap to count: all siblings in trees of the
#: quality builder with up to 1.4 nodes a leaf. Nodes of other trees may have thousands. Chosen.
SIBLINGS = 15

#: Weight of opacity, where red, green and blue have 1: pictures may have any background. Chosen.
ALPHA_WEIGHT = 1.0

#: Least standard deviation of ln(size) of the leaves for their number to count in full; trained scenes have 0.6 and
#: more. Chosen.
SIZES_DIFFER = 0.3

#: Splats or pairs per block, so that their columns stay in the cache. Chosen.
BLOCK = 1 << 14

Nodes = NDArray[np.int64]
Column = NDArray[np.float64]

#: Corners, (n, 2, 3) float64, lowest and highest.
Boxes = NDArray[np.float64]


def make_levels(nodes: Splats, tree: LodTree, settings: DetailSettings, *, progress: Progress = silent) -> DetailScene:
    """Return the detail levels of a scene, from its tree.

    Level 0 has the leaves, bit for bit if their opacity is at most 1. Each further level is a cut of the tree that the
    finer levels refine. A region has some nodes of the coarsest level and all nodes below them: at every level it
    represents the same leaves, and no leaf is in two regions. The result does not depend on the number of threads.
    The scene has no errors yet; within a run, splats are in the order of the tree.
    """
    leaves = int(np.count_nonzero(tree.is_leaf))
    shares = shares_of(settings.levels, leaves)
    levels = len(shares) + 1
    progress("dividing", 0, levels, "level")
    cuts, parent = detail_cuts(nodes, tree, shares)
    order, coarsest = np.concatenate(cuts), cuts[-1]
    owner, under = owners_of(parent, coarsest)[order], len(coarsest)
    center = nodes.center[order]
    box = united(np.stack([center, center], axis=1), owner, under)
    under_each = np.bincount(owner, minlength=under)
    number, children = divide(nodes.center[coarsest], box, under_each, settings)
    region, count = number[owner], int(number.max()) + 1
    level = np.repeat(np.arange(levels), [len(some) for some in cuts])
    key = level * count + region
    splats = with_plain_opacity(nodes.take(order[np.argsort(key, kind="stable")]))
    counts = np.bincount(key, minlength=levels * count).reshape(levels, count).T
    bounds = united(extents(splats), np.sort(key) % count, count)
    progress("dividing", levels, levels, "level")
    return DetailScene(splats, np.ascontiguousarray(counts), bounds, children)


def owners_of(parent: NDArray[np.int32], cut: Nodes) -> NDArray[np.int64]:
    """Return (M,) the place in a cut of each node or its ancestor in the cut, by (M,) parents; -1 above the cut."""
    above = np.maximum(parent, 0).astype(np.int64)
    above[cut] = cut
    while not np.array_equal(higher := above[above], above):  # each round doubles the number of edges climbed
        above = higher
    place = np.full(len(parent), -1, np.int64)
    place[cut] = np.arange(len(cut))
    owner: NDArray[np.int64] = place[above]
    return owner


def shares_of(levels: Sequence[float] | None, leaves: int) -> list[float]:
    """Return the shares of the levels after full detail; those of None suit the number of leaves."""
    if levels is not None:
        return list(levels)
    shares = [STEP]
    while shares[-1] * leaves > COARSE_ENOUGH:
        shares.append(shares[-1] * STEP)
    return shares


class RefinementOrder:
    """The order in which nodes are refined, by descending `losses`.

    It is one for all cuts, so that each refines the coarser cuts. A node comes before its children, whose losses are no
    larger.

    Attributes:
        parent: (M,) int32 parent of each node, -1 of the root.
        leaves: number of leaves.
    """

    def __init__(self, nodes: Splats, tree: LodTree) -> None:
        self.parent, _ = find_parents(tree.child_count, tree.child_start)
        loss = losses(nodes, tree, self.parent)
        inner = np.flatnonzero(~tree.is_leaf)
        order = inner[np.argsort(-loss[inner], kind="stable")]  # parents come first among equals, too
        self._turn = np.full(len(tree), len(order), np.int64)  # refined nodes before it; leaves come last
        self._turn[order] = np.arange(len(order))
        self._turn_of_parent = np.where(self.parent >= 0, self._turn[np.maximum(self.parent, 0)], -1)
        self._splats = 1 + np.cumsum(tree.child_count[order].astype(np.int64) - 1)
        self.leaves = len(tree) - len(inner)

    def cut(self, count: int) -> Nodes:
        """Return the nodes, ascending, of the finest cut of at most `count` splats, but at least the root.

        The cut is short of `count` by less than the children of a node.
        """
        refined = int(np.searchsorted(self._splats, count, side="right"))
        return np.flatnonzero((self._turn_of_parent < refined) & (self._turn >= refined))


def detail_cuts(nodes: Splats, tree: LodTree, shares: Sequence[float]) -> tuple[list[Nodes], NDArray[np.int32]]:
    """Return the leaves and cuts with shares of their number, each as `RefinementOrder.cut`.

    Returns:
        (n,) ascending nodes of each level, the leaves first; and (M,) int32 parent of each node, -1 of the root.
    """
    order = RefinementOrder(nodes, tree)
    cuts = [order.cut(round(share * order.leaves)) for share in shares]
    return [np.flatnonzero(tree.is_leaf), *cuts], order.parent


@np.errstate(over="ignore", invalid="ignore")  # of splats as large as float32 allows
def losses(nodes: Splats, tree: LodTree, parent: NDArray[np.int32]) -> Column:
    """Return the (M,) float64 loss from drawing each node instead of its subtree; at least the losses in the subtree.

    The loss of a node is the root of its picture error, times its feature size, times its leaves (to a power of at most
    1). The picture error is the squared difference between the picture of the node and that of its children, over red,
    green, blue and opacity, on the planes of the three axes; like the size squared, an area. The number of leaves
    measures detail: training puts small splats close together where pictures need them. If all leaves have one size, as
    in a point cloud, it measures only the density of samples: the power is 0.
    """
    size = spark_size(nodes).astype(np.float64)
    loss = np.sqrt(picture_errors(with_plain_opacity(nodes), parent)) * size
    logs = np.log(np.maximum(size[tree.is_leaf], np.finfo(np.float64).tiny))
    power = min(1.0, float(logs.std()) / SIZES_DIFFER)
    leaves, largest = tree.is_leaf.astype(np.float64), np.zeros(len(tree))  # largest: of the losses of children
    depth = tree.depths()
    for level in np.split(np.argsort(depth, kind="stable"), np.cumsum(np.bincount(depth))[:-1])[::-1]:
        inner = level[~tree.is_leaf[level]]
        own = np.nan_to_num(loss[inner], nan=0.0) * leaves[inner] ** power
        loss[inner] = np.maximum(own, largest[inner])
        np.add.at(leaves, parent[level], leaves[level])
        np.maximum.at(largest, parent[level], loss[level])
    return loss


def picture_errors(splats: Splats, parent: NDArray[np.int32]) -> Column:
    """Return the (M,) squared difference between the picture of each splat and the sum of its children's, 0 for leaves.

    For Gaussians G of opacity times colour: the integral of (G - sum of G_c)^2 over a plane, the mean of three planes,
    divided by pi. Overlaps of children more than SIBLINGS apart are left out. Opacities must be at most 1.
    """
    count = len(splats)
    shape = np.empty((count, 6))
    for begin in range(0, count, BLOCK):
        some = slice(begin, begin + BLOCK)
        shape[some] = covariance(splats.scale[some], splats.quat_xyzw[some])
    node = np.arange(1, count)
    above = parent[1:].astype(np.int64)
    alone = _shared(splats, shape, np.arange(count), np.arange(count))
    error = np.bincount(above, alone[1:] - 2 * _shared(splats, shape, node, above), count)
    for step in range(1, SIBLINGS + 1):
        first = node[:-step][above[:-step] == above[step:]]
        if not first.size:
            break
        error += np.bincount(parent[first], 2 * _shared(splats, shape, first, first + step), count)
    inner = np.zeros(count, np.bool_)
    inner[above] = True
    return np.where(inner, np.maximum(error + alone, 0), 0.0)


@np.errstate(divide="ignore", over="ignore", invalid="ignore")  # of splats without extent, or too far apart
def _shared(splats: Splats, shape: Column, first: NDArray[np.int64], second: NDArray[np.int64]) -> Column:
    """Return (n,) integrals of the product of two splats' pictures, over all channels; mean of the planes, over pi."""
    found = np.empty(len(first))
    for begin in range(0, len(first), BLOCK):
        a, b = first[begin : begin + BLOCK], second[begin : begin + BLOCK]
        color = np.einsum("ni,ni->n", splats.rgb[a], splats.rgb[b], dtype=np.float64) + ALPHA_WEIGHT
        high = splats.opacity[a].astype(np.float64) * splats.opacity[b] * color
        offset = splats.center[b].astype(np.float64) - splats.center[a]
        p, q = shape[a].T, shape[b].T
        total = np.zeros(len(a))
        for row, column, mixed, across, along in PLANES:
            xx, yy, xy = p[row] + q[row], p[column] + q[column], p[mixed] + q[mixed]
            own = np.maximum(p[row] * p[column] - p[mixed] ** 2, 0) * np.maximum(q[row] * q[column] - q[mixed] ** 2, 0)
            det = xx * yy - xy * xy
            x, y = offset[:, across], offset[:, along]
            power = (yy * x * x - 2 * xy * x * y + xx * y * y) / det
            total += np.where(det > 0, np.sqrt(own / det) * np.exp(-power / 2), 0.0)
        found[begin : begin + BLOCK] = high * total * (2 / 3)
    return found


def with_plain_opacity(splats: Splats) -> Splats:
    """Limit opacities to 1, and enlarge the splats with more so that they cover as much of the screen as before."""
    above = np.flatnonzero(splats.opacity > 1)
    if not above.size:
        return splats
    scale, opacity = splats.scale.copy(), splats.opacity.copy()
    factor = np.sqrt(harmonic(opacity[above].astype(np.float64))[0])
    with np.errstate(over="ignore"):
        scale[above] = np.minimum(scale[above] * factor[:, None], np.finfo(np.float32).max)
    opacity[above] = 1
    return dataclasses.replace(splats, scale=scale, opacity=opacity)


def divide(
    center: FloatArray, box: Boxes, splats: NDArray[np.int64], settings: DetailSettings
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Divide nodes of the coarsest level into regions, recursively at the median splat along the longest side.

    Args:
        center: (n, 3) of the nodes, world units.
        box: (n, 2, 3) corners of all centres under each node, at any level.
        splats: (n,) int64 splats under each node, of all levels.
        settings: sizes of regions; a single node is not divided, whatever its size.

    Returns:
        (n,) int64 region of each node, and (R - 1, 2) int64 `DetailScene.children`.
    """
    number = np.zeros(len(splats), np.int64)
    children: list[list[int]] = []
    regions = 0
    waiting: list[tuple[NDArray[np.int64], int]] = [(np.arange(len(number)), -1)]
    while waiting:
        some, parent = waiting.pop()
        count = splats[some]
        side = float((box[some, 1].max(axis=0) - box[some, 0].min(axis=0)).max())
        total, limit = int(count.sum()), settings.chunk_splats if side <= settings.extent else settings.min_splats
        if len(some) < 2 or total <= min(limit, settings.chunk_splats):
            number[some] = regions
            own, regions = -1 - regions, regions + 1
        else:
            ordered = some[_along_longest_side(center[some])]
            until = np.cumsum(splats[ordered])
            cut = 1 + int(np.argmin(np.abs(2 * until[:-1] - until[-1])))
            own = len(children)
            children.append([])
            waiting += [(ordered[cut:], own), (ordered[:cut], own)]  # the first half comes next
        if parent >= 0:
            children[parent].append(own)
    return number, np.array(children, np.int64).reshape(-1, 2)


def _along_longest_side(center: FloatArray) -> NDArray[np.int64]:
    """Return the order of centres along the longest side of their box."""
    axis = int(np.argmax(np.ptp(center.astype(np.float64), axis=0)))
    return np.argsort(center[:, axis], kind="stable")


def extents(splats: Splats) -> Boxes:
    """Return (N, 2, 3) corners of the boxes of splats, EXTENT standard deviations on either side."""
    boxes = np.empty((len(splats), 2, 3))
    for begin in range(0, len(splats), BLOCK):
        some = slice(begin, begin + BLOCK)
        axes = rotation_matrices(splats.quat_xyzw[some])
        axes *= splats.scale[some].T.astype(np.float64)
        half = EXTENT * np.sqrt(np.einsum("wln,wln->nw", axes, axes))
        boxes[some, 0], boxes[some, 1] = splats.center[some] - half, splats.center[some] + half
    return boxes


def united(boxes: FloatArray, number: NDArray[np.int64], count: int) -> Boxes:
    """Return (count, 2, 3) boxes, each around all boxes of its number; each number must occur."""
    order = np.argsort(number, kind="stable")
    starts = np.searchsorted(number[order], np.arange(count))
    low = np.minimum.reduceat(boxes[order, 0], starts)
    return np.stack([low, np.maximum.reduceat(boxes[order, 1], starts)], axis=1).astype(np.float64)


def beyond(splats: Splats, radius: float) -> NDArray[np.bool_]:
    """Return a (N,) mask of the splats whose centres are farther than a radius from the middle of the scene.

    The middle is the median of the centres along each axis, which few splats far outside hardly move.

    Raises:
        InvalidSplatsError: all splats are farther.
    """
    middle = np.median(splats.center.astype(np.float64), axis=0)
    offset = splats.center - middle
    far: NDArray[np.bool_] = np.einsum("ij,ij->i", offset, offset) > float(radius) ** 2
    if far.all():
        x, y, z = middle
        raise InvalidSplatsError(
            f"no splat is within {radius:g} of the middle of the scene ({x:.4g}, {y:.4g}, {z:.4g}); "
            "give --environment-beyond a larger radius"
        )
    return far


#: Geometric error of a splat, in its feature sizes: as many as CesiumJS allows pixels of error by default
#: (`maximumScreenSpaceError`), so that splats larger than a pixel are refined.
PIXEL_ERROR = 16.0

#: Least geometric error of a tile that has children, as a share of the diagonal of its box: a tile of error 0 is never
#: refined. A millionth is less than a pixel if the tile fills the screen. Chosen.
LEAST_ERROR = 1e-6


def make_tiles(nodes: Splats, tree: LodTree, settings: TileSettings, *, progress: Progress = silent) -> TileScene:
    """Return the tiles of a scene, from its tree.

    Tiles without children have the leaves, bit for bit if their opacity is at most 1. Every level is a cut of the tree
    with about a quarter of the splats of the next finer one, up to the root tile, whose cut is one tile. The children
    of a tile have the nodes of the next cut at or below the nodes of the tile: no splat is lost or doubled.
    The result does not depend on the number of threads.
    Tiles are in the order of their levels; within a tile, splats are in the order of the tree.
    """
    order = RefinementOrder(nodes, tree)
    cuts = tile_cuts(order, settings.tile_splats)
    members: list[Nodes] = [cuts[0]]
    parent, level = [-1], [0]
    tile = np.full(len(nodes), -1, np.int64)  # of the nodes of the cut divided last
    tile[cuts[0]] = 0
    for number in range(1, len(cuts)):
        progress("dividing", number, len(cuts), "level")
        cut, above = cuts[number], cuts[number - 1]
        owner = above[owners_of(order.parent, above)[cut]]
        held = tile[owner]
        refined = np.unique(held[owner != cut])
        held_in_order = np.argsort(held, kind="stable")
        starts = np.searchsorted(held[held_in_order], np.stack([refined, refined + 1]))
        tile[cut] = held
        for each, start, stop in zip(refined.tolist(), *starts.tolist(), strict=True):
            below = cut[held_in_order[start:stop]]
            for group in _groups(below, nodes.center, -(-len(below) // settings.tile_splats)):
                tile[group] = len(members)
                members.append(group)
                parent.append(each)
                level.append(number)
    progress("dividing", len(cuts), len(cuts), "level")
    return _measured(nodes, tree, members, np.array(parent, np.int32), np.array(level, np.int32), settings)


def tile_cuts(order: RefinementOrder, tile_splats: int) -> list[Nodes]:
    """Return cuts from coarse to fine, the first of at most `tile_splats`, each `STEP` times the next one."""
    counts = [order.leaves]
    while counts[-1] > tile_splats:
        counts.append(round(counts[-1] * STEP))
    return [order.cut(count) for count in reversed(counts)]


def _groups(some: Nodes, center: FloatArray, count: int) -> list[Nodes]:
    """Divide nodes into `count` sorted groups of about the same size, recursively along the longest side."""
    if count < 2:
        return [np.sort(some)]
    ordered, first = some[_along_longest_side(center[some])], count // 2
    at = len(some) * first // count
    return _groups(ordered[:at], center, first) + _groups(ordered[at:], center, count - first)


def _measured(
    nodes: Splats,
    tree: LodTree,
    members: list[Nodes],
    parent: NDArray[np.int32],
    level: NDArray[np.int32],
    settings: TileSettings,
) -> TileScene:
    """Return the scene of tiles with these nodes, with bounds and errors."""
    counts = np.array([len(each) for each in members], np.int64)
    index, number = np.concatenate(members), np.repeat(np.arange(len(members)), counts)
    splats = with_plain_opacity(nodes.take(index))
    bounds = united(extents(splats), number, len(members))
    size, merged = spark_size(splats).astype(np.float64), ~tree.is_leaf[index]
    errors, stop = np.zeros(len(members)), np.cumsum(counts)
    for tile in reversed(range(len(members))):  # children come after their parents
        part = slice(stop[tile] - counts[tile], stop[tile])
        if merged[part].any():
            diagonal = float(np.linalg.norm(bounds[tile, 1] - bounds[tile, 0]))
            own = PIXEL_ERROR * float(np.median(size[part][merged[part]]))
            errors[tile] = max(errors[tile], own, LEAST_ERROR * diagonal, float(np.finfo(np.float32).tiny))
        if tile:
            above = parent[tile]
            errors[above] = max(errors[above], errors[tile])
            bounds[above, 0] = np.minimum(bounds[above, 0], bounds[tile, 0])
            bounds[above, 1] = np.maximum(bounds[above, 1], bounds[tile, 1])
    transform = np.array(settings.matrix).reshape(4, 4).T
    return TileScene(splats, parent, level, counts, errors, bounds, transform=transform)
