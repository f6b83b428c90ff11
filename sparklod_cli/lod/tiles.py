"""Tiles of a tree for 3D Tiles: cuts that refine one another, divided in space into tiles of bounded size.

The geometric error of a tile is `PIXEL_ERROR` times the median feature size of those of its splats that its children
replace. A viewer such as CesiumJS refines a tile where its error, projected, is larger than 16 pixels by default: where
half of these splats are larger than a pixel. That is the rule by which Spark refines a node (see `traversal`), for a
tile as a whole. See docs/decisions/21-3d-tiles.md.

The tiles that CesiumJS draws for a camera, also while tiles load: a tile is refined where its geometric error, as many
pixels on the screen, is more than `PIXEL_ERROR`, and none of its children is missing; tiles outside the picture are
neither drawn nor refined. That is what CesiumJS 1.145 does by default (`Cesium3DTile.getScreenSpaceError` and
`Cesium3DTilesetBaseTraversal`), but for `dynamicScreenSpaceError`, which takes coarser tiles far away in views along
the horizon of the Earth.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import spark_size
from ..model.lod_tree import LodTree
from ..model.splats import FloatArray, Splats
from ..model.traversed import TileScene
from ..system.progress import Progress, silent
from .detail_levels import STEP, Nodes, RefinementOrder, extents, owners_of, united, with_plain_opacity
from .part_settings import TileSettings
from .traversal import CutView, SplatForest, TreeCut, TreeInstance

#: Geometric error of a splat in its feature sizes: pixels of error that CesiumJS allows by default
#: (`maximumScreenSpaceError`), so that a splat is refined where it is larger than a pixel.
PIXEL_ERROR = 16.0

#: Least geometric error of a tile that has children, as a share of the diagonal of its box: one of 0 is never refined.
#: A millionth of what fills a screen is no pixel of any. Chosen.
LEAST_ERROR = 1e-6

#: Corners of a box, as shares of its extent.
CORNERS = np.stack(np.meshgrid(*[(0.0, 1.0)] * 3, indexing="ij"), axis=-1).reshape(8, 3)

Mask = NDArray[np.bool_]


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


class TileForest(SplatForest):
    """One or more scenes of tiles, and their splats as drawn, in the memory layout of traversals; see `SplatForest`."""

    def __init__(self, scenes: Sequence[TileScene], splats: Sequence[Splats]) -> None:
        self.scenes = scenes
        coarse = [np.repeat(~scene.is_leaf, scene.counts) for scene in scenes]
        super().__init__(splats, coarse, [scene.tiles for scene in scenes])


@dataclass(frozen=True, eq=False)
class TileChoice:
    """Tiles of an instance that a viewer draws and loads.

    Attributes:
        drawn: (T,) bool.
        coarse: (T,) bool, drawn tiles that would be refined if no child were missing.
        wanted: (T,) bool, tiles that are drawn or refined, and children of tiles that are or should be refined.
        distance: (T,) from the camera to the boxes of all tiles, in units of the scene; 0 inside.
    """

    drawn: Mask
    coarse: Mask
    wanted: Mask
    distance: NDArray[np.float64]


class TileTraversal:
    """Finds cuts of scenes of tiles; several threads may ask it."""

    def __init__(self, forest: TileForest, instances: Sequence[TreeInstance]) -> None:
        self.forest, self.instances = forest, list(instances)

    def cut(self, view: CutView, *, budget: int, smallest: float = 0.0, resident: Mask | None = None) -> TreeCut:
        """Return the cut that a viewer draws.

        Args:
            budget: has no effect: CesiumJS draws as many splats as the error on the screen requires.
            smallest: pixel scale of a pixel, see `settings.pixel_limit`; 0 for full detail inside the picture.
            resident: (chunks,) bool, of the files of tiles; all are resident unless given.
        """
        start = time.perf_counter()
        forest = self.forest
        there = np.ones(forest.chunks, np.bool_) if resident is None else resident
        demand, nodes, missing, limited = np.zeros(forest.chunks, np.float32), [], 0, False
        for instance in self.instances:
            scene, own = forest.scenes[instance.tree], slice(*forest.chunk_base[instance.tree : instance.tree + 2])
            limit = PIXEL_ERROR * smallest / instance.lod_scale
            choice = choose(scene, view, instance.object_to_world, limit, there[own])
            drawn = choice.drawn & there[own]
            nodes.append(np.flatnonzero(np.repeat(drawn, scene.counts)).astype(np.uint32))
            missing += int(scene.counts[choice.coarse | (choice.drawn & ~there[own])].sum())
            limited |= bool((drawn & ~choice.coarse & ~scene.is_leaf).any())
            # Coarser tiles first, and nearer ones of a level.
            rank = 1 / (1 + choice.distance)
            priority = (scene.level.max() + 1 - scene.level + rank).astype(np.float32)
            demand[own] = np.maximum(demand[own], np.where(choice.wanted & (scene.counts > 0), priority, 0))
        reason = "missing" if missing else "distance" if limited else "exhausted"
        return forest.cut_of(self.instances, view, nodes, reason, missing, demand, start)


def choose(
    scene: TileScene, view: CutView, object_to_world: NDArray[np.float64], limit: float, resident: Mask
) -> TileChoice:
    """Return the tiles of an instance that a viewer draws and loads.

    Args:
        limit: largest geometric error over distance of a tile that is not refined.
        resident: (T,) bool; a tile without splats needs no file.
    """
    visible = in_picture(scene, view, object_to_world)
    present = resident | (scene.counts == 0)
    refinable = np.ones(scene.tiles, np.bool_)  # all children are there
    np.logical_and.at(refinable, scene.parent[1:], present[1:])
    distance = distances(scene, view, object_to_world)
    exceeds = (scene.errors > limit * distance) | (scene.counts == 0)
    desired = visible & exceeds & ~scene.is_leaf
    visited, wanted = np.zeros(scene.tiles, np.bool_), np.zeros(scene.tiles, np.bool_)
    visited[0] = wanted[0] = visible[0]
    for level in np.unique(scene.level[1:]).tolist():
        tiles = np.flatnonzero(scene.level == level)
        above = scene.parent[tiles]
        wanted[tiles] = visited[above] & desired[above]
        visited[tiles] = wanted[tiles] & refinable[above]
    drawn = visited & visible & ~(desired & refinable)
    return TileChoice(drawn, drawn & desired, wanted, distance)


def distances(scene: TileScene, view: CutView, object_to_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (T,) distances from the camera to the boxes of tiles, in units of the scene; 0 inside."""
    eye = np.linalg.solve(object_to_world, view.camera_to_world[:, 3])[:3]
    nearest = np.clip(eye, scene.bounds[:, 0], scene.bounds[:, 1])
    found: NDArray[np.float64] = np.linalg.norm(nearest - eye, axis=1)
    return found


def in_picture(scene: TileScene, view: CutView, object_to_world: NDArray[np.float64]) -> Mask:
    """Return (T,) bool, false for tiles whose box lies behind the camera or beyond one side of the picture."""
    to_camera = np.linalg.solve(view.camera_to_world, object_to_world)
    low, high = scene.bounds[:, None, 0], scene.bounds[:, None, 1]
    corners = low + (high - low) * CORNERS
    x, y, z = np.moveaxis(corners @ to_camera[:3, :3].T + to_camera[:3, 3], -1, 0)
    across, up = -z * np.tan(view.fov_x / 2), -z * np.tan(view.fov_y / 2)
    outside = [side.all(axis=1) for side in (z > 0, x > across, x < -across, y > up, y < -up)]
    visible: Mask = ~np.logical_or.reduce(outside)
    return visible
