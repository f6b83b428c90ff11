"""Tiles of a tree for 3D Tiles: cuts that refine one another, divided in space into tiles of bounded size.

The geometric error of a tile is `PIXEL_ERROR` times the median feature size of those of its splats that its children
replace. A viewer such as CesiumJS refines a tile where its error, projected, is larger than 16 pixels by default: where
half of these splats are larger than a pixel. That is the rule by which Spark refines a node (see `traversal`), for a
tile as a whole. See docs/decisions/21-3d-tiles.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import spark_size
from ..model.lod_tree import LodTree
from ..model.splats import FloatArray, Splats
from ..model.traversed import TileScene
from ..system.progress import Progress, silent
from .detail_levels import STEP, Nodes, RefinementOrder, extents, owners_of, united, with_plain_opacity
from .part_settings import TileSettings

#: Geometric error of a splat in its feature sizes: pixels of error that CesiumJS allows by default
#: (`maximumScreenSpaceError`), so that a splat is refined where it is larger than a pixel.
PIXEL_ERROR = 16.0

#: Least geometric error of a tile that has children, as a share of the diagonal of its box: one of 0 is never refined.
#: A millionth of what fills a screen is no pixel of any. Chosen.
LEAST_ERROR = 1e-6


def make(nodes: Splats, tree: LodTree, settings: TileSettings, *, progress: Progress = silent) -> TileScene:
    """Return the tiles of a scene, from its tree.

    Tiles without children have the leaves, bit for bit if their opacity is at most 1. Every level is a cut of the tree
    of about a quarter of the splats of the next finer one, up to the root tile, whose cut is one tile. The children of
    a tile have the nodes of a finer cut that are below those of the tile, or are those: no splat is lost or doubled.
    The result does not depend on the number of threads.
    Tiles are in the order of their levels; within a tile, splats are in the order of the tree.
    """
    order = RefinementOrder(nodes, tree)
    cuts = tile_cuts(order, settings.tile_splats)
    members: list[Nodes] = [cuts[0]]
    parent, level = [-1], [0]
    tile = np.full(len(nodes), -1, np.int64)  # of the nodes of the cut that was last divided
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
    """Return cuts, the coarsest, of at most `tile_splats`, first; each has `STEP` of the splats of the next one."""
    counts = [order.leaves]
    while counts[-1] > tile_splats:
        counts.append(round(counts[-1] * STEP))
    return [order.cut(count) for count in reversed(counts)]


def _groups(some: Nodes, center: FloatArray, count: int) -> list[Nodes]:
    """Divide nodes into `count` ascending groups of about one size, recursively along the longest side."""
    if count < 2:
        return [np.sort(some)]
    where = center[some]
    axis = int(np.argmax(np.ptp(where.astype(np.float64), axis=0)))
    order = np.argsort(where[:, axis], kind="stable")
    first = count // 2
    at = len(some) * first // count
    return _groups(some[order[:at]], center, first) + _groups(some[order[at:]], center, count - first)


def _measured(
    nodes: Splats,
    tree: LodTree,
    members: list[Nodes],
    parent: NDArray[np.int32],
    level: NDArray[np.int32],
    settings: TileSettings,
) -> TileScene:
    """Return tiles with their splats, bounds and errors."""
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
