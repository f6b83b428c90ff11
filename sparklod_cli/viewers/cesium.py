"""CesiumJS: the tiles of 3D Tiles that it draws for a camera, also while tiles load.

A tile is refined if its geometric error covers more than `PIXEL_ERROR` pixels on the screen, and none of its
children is missing; tiles outside the picture are neither drawn nor refined. CesiumJS 1.145 does so by
default (`Cesium3DTile.getScreenSpaceError` and `Cesium3DTilesetBaseTraversal`), except for `dynamicScreenSpaceError`,
which takes coarser tiles far away in views along the horizon of the Earth.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..lod.parts import PIXEL_ERROR
from ..model.instances import TileScene
from .loaded_scene import TILES, Forest, Index, LoadedScene, TreeCut, TreeInstance, bytes_of, cut_of_runs
from .viewer_settings import CESIUM_FETCHERS

#: Corners of a box, as shares of its extent.
CORNERS = np.stack(np.meshgrid(*[(0.0, 1.0)] * 3, indexing="ij"), axis=-1).reshape(8, 3)

Mask = NDArray[np.bool_]


@dataclass(eq=False)
class LoadedTiles(LoadedScene):
    """A scene of tiles; `scene` and `splats` have those of all tiles."""

    fetchers = CESIUM_FETCHERS

    tiles: TileScene = field(kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.kind, self.chunks = TILES, self.tiles.tiles

    @property
    def headers(self) -> tuple[int, ...]:
        """Bytes of the manifest; none for a scene in memory."""
        return () if self.tiles.sizes is None else (self.bytes - int(self.tiles.sizes.sum()),)

    @functools.cached_property
    def depth(self) -> NDArray[np.int32]:
        """(N,) the level of the tile of each splat, 0 of the root."""
        return np.repeat(self.tiles.level, self.tiles.counts)

    @functools.cached_property
    def leaves(self) -> Index:
        """(M,) indices of the splats of tiles without children."""
        return np.flatnonzero(np.repeat(self.tiles.is_leaf, self.tiles.counts))

    def chunk_of(self, index: Index) -> NDArray[np.int64]:
        return self.first_chunk + np.searchsorted(np.cumsum(self.tiles.counts), index, side="right")

    @property
    def requests(self) -> Sequence[tuple[int, ...]]:
        sizes = self.tiles.sizes
        if sizes is None:
            sizes = bytes_of(self.splats) * self.tiles.counts // max(1, self.count)
        return [(size,) for size in sizes.tolist()]


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


class CesiumViewer:
    """Finds cuts of scenes of tiles; several threads may use it."""

    def __init__(self, forest: Forest, instances: Sequence[TreeInstance]) -> None:
        self.forest, self.instances = forest, list(instances)

    def cut(self, camera: Camera, *, budget: int, smallest: float = 0.0, resident: Mask | None = None) -> TreeCut:
        """Return the cut that CesiumJS draws; see `Viewer.cut`.

        Args:
            budget: has no effect: CesiumJS draws as many splats as the error on the screen requires.
            smallest: pixel scale of a pixel, see `viewer_settings.pixel_limit`; 0 for full detail inside the picture.
        """
        start = time.perf_counter()
        forest = self.forest
        there = np.ones(forest.chunks, np.bool_) if resident is None else resident
        demand, nodes, missing, limited = np.zeros(forest.chunks, np.float32), [], 0, False
        for instance in self.instances:
            scene = forest.scenes[instance.tree].tiles
            own = slice(*forest.chunk_base[instance.tree : instance.tree + 2])
            limit = PIXEL_ERROR * smallest / instance.lod_scale
            choice = choose(scene, camera, instance.object_to_world, limit, there[own])
            drawn = choice.drawn & there[own]
            nodes.append(np.flatnonzero(np.repeat(drawn, scene.counts)).astype(np.uint32))
            missing += int(scene.counts[choice.coarse | (choice.drawn & ~there[own])].sum())
            limited |= bool((drawn & ~choice.coarse & ~scene.is_leaf).any())
            # Coarser tiles first, and nearer ones of a level.
            rank = 1 / (1 + choice.distance)
            priority = (scene.level.max() + 1 - scene.level + rank).astype(np.float32)
            demand[own] = np.maximum(demand[own], np.where(choice.wanted & (scene.counts > 0), priority, 0))
        reason = "missing" if missing else "distance" if limited else "exhausted"
        return cut_of_runs(forest, self.instances, camera, nodes, reason, missing, demand, start)


def choose(
    scene: TileScene, view: Camera, object_to_world: NDArray[np.float64], limit: float, resident: Mask
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
    eye = np.linalg.solve(object_to_world, view.camera_to_world[:, 3])[:3]
    nearest = np.clip(eye, scene.bounds[:, 0], scene.bounds[:, 1])
    distance = np.linalg.norm(nearest - eye, axis=1)
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


def in_picture(scene: TileScene, view: Camera, object_to_world: NDArray[np.float64]) -> Mask:
    """Return (T,) bool, false for tiles whose box lies behind the camera or beyond one side of the picture."""
    to_camera = np.linalg.solve(view.camera_to_world, object_to_world)
    low, high = scene.bounds[:, None, 0], scene.bounds[:, None, 1]
    corners = low + (high - low) * CORNERS
    x, y, z = np.moveaxis(corners @ to_camera[:3, :3].T + to_camera[:3, 3], -1, 0)
    across, up = -z * np.tan(view.fov_x / 2), -z * np.tan(view.fov_y / 2)
    outside = [side.all(axis=1) for side in (z > 0, x > across, x < -across, y > up, y < -up)]
    visible: Mask = ~np.logical_or.reduce(outside)
    return visible
