"""Scenes as viewers traverse them besides trees: regions at several detail levels, and hierarchies of tiles."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .scene import Scene, facts_of
from .splats import Splats

Bounds = NDArray[np.float64]
Counts = NDArray[np.int64]


def _check_shapes(scene: DetailScene | TileScene, shapes: Mapping[str, tuple[int, ...]]) -> None:
    for name, shape in shapes.items():
        if getattr(scene, name).shape != shape:
            raise ValueError(f"{name} has the shape {getattr(scene, name).shape}; expected {shape}")


@dataclass(frozen=True, eq=False)
class DetailScene:
    """Splats of all detail levels, and the regions whose level a viewer chooses one by one, as in Streamed SOG.

    Level 0 is full detail; the levels of a region stand for the same splats. The splats of a region at a level are its
    run. Runs lie level after level, and in a level region after region.

    Attributes:
        splats: N splats, those of all levels.
        counts: (R, L) int64 splats of each region at each level; 0 where a region has no such level.
        bounds: (R, 2, 3) float64 lowest and highest corner of each region, in world units.
        children: (R - 1, 2) int64 the binary tree over the regions: its inner nodes, root first and before their
            children. A number from 0 on is an inner node, -1 - r is region r.
        errors: (R, L) float64 differences of each level of a region from its level 0, not decreasing from level to
            level; None if they were not measured.
        environment: splats far outside, which are drawn at all levels; None without.
        antialiased: trained with the opacity compensation of Mip-Splatting.
        format, notes, header, up, up_by: as of `Scene`.
    """

    splats: Splats
    counts: Counts
    bounds: Bounds
    children: NDArray[np.int64]
    errors: NDArray[np.float64] | None = None
    environment: Splats | None = None
    antialiased: bool = False
    format: str = ""
    notes: tuple[str, ...] = ()
    header: Mapping[str, int] = field(default_factory=dict)
    up: str | None = None
    up_by: str = ""

    def __post_init__(self) -> None:
        regions, levels = self.counts.shape
        shapes = {"bounds": (regions, 2, 3), "children": (regions - 1, 2)}
        shapes |= {} if self.errors is None else {"errors": (regions, levels)}
        _check_shapes(self, shapes)
        if self.counts.sum() != len(self.splats):
            raise ValueError(f"counts are of {self.counts.sum():,} splats, but there are {len(self.splats):,}")

    @property
    def regions(self) -> int:
        """Number of regions."""
        return len(self.counts)

    @property
    def levels(self) -> int:
        """Number of detail levels."""
        return self.counts.shape[1]

    @functools.cached_property
    def starts(self) -> Counts:
        """(R, L) the first splat of each run."""
        flat = self.counts.T.ravel()
        return np.ascontiguousarray((np.cumsum(flat) - flat).reshape(self.levels, self.regions).T)

    def run(self, region: int, level: int) -> slice:
        """Return the splats of a region at a level."""
        start = int(self.starts[region, level])
        return slice(start, start + int(self.counts[region, level]))

    def level(self, level: int) -> slice:
        """Return the splats of a level, of all regions."""
        before = int(self.counts[:, :level].sum())
        return slice(before, before + int(self.counts[:, level].sum()))

    def scene(self) -> Scene:
        """Return full detail as a plain scene: level 0, then the environment."""
        splats = self.splats.take(self.level(0))
        if self.environment is not None:
            splats = Splats.concat([splats, self.environment])
        return Scene(splats, **facts_of(self))


@dataclass(frozen=True, eq=False)
class TileScene:
    """Tiles, root first and each after its parent, and their splats, tile after tile; as in 3D Tiles.

    The children of a tile together stand for what it stands for, in more splats. A tile without children has full
    detail. A viewer draws some tiles, none of them below another, that together stand for the scene.

    Attributes:
        splats: N splats, those of all tiles.
        parent: (T,) int32 tile that each tile replaces a part of; -1 of the root.
        level: (T,) int32 number of the cut that a tile is a part of, 0 of the root; more than that of its parent.
        counts: (T,) int64 splats of each tile.
        errors: (T,) float64 geometric error of each tile in world units, 0 of tiles without children.
        bounds: (T, 2, 3) float64 lowest and highest corner of each tile and those below it, in the axes of the splats.
        sizes: (T,) int64 bytes of the file of each tile, 0 without splats; None for a scene in memory.
        transform: (4, 4) float64 for column vectors, from the axes of the tileset, z up, to the Earth's (ECEF), metres;
            the identity where the scene has no place there.
        antialiased, format, notes, header, up, up_by: as of `Scene`.
    """

    splats: Splats
    parent: NDArray[np.int32]
    level: NDArray[np.int32]
    counts: Counts
    errors: NDArray[np.float64]
    bounds: Bounds
    sizes: Counts | None = None
    transform: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    antialiased: bool = False
    format: str = ""
    notes: tuple[str, ...] = ()
    header: Mapping[str, int] = field(default_factory=dict)
    up: str | None = None
    up_by: str = ""

    def __post_init__(self) -> None:
        tiles = len(self.parent)
        shapes = {"level": (tiles,), "counts": (tiles,), "errors": (tiles,), "bounds": (tiles, 2, 3)}
        _check_shapes(self, shapes | {"transform": (4, 4)})
        if not tiles or self.parent[0] != -1 or not (np.arange(tiles)[1:] > self.parent[1:]).all():
            raise ValueError("the first tile is the root, and every other comes after its parent")
        if self.counts.sum() != len(self.splats):
            raise ValueError(f"counts are of {self.counts.sum():,} splats, but there are {len(self.splats):,}")

    @property
    def tiles(self) -> int:
        """Number of tiles."""
        return len(self.parent)

    @functools.cached_property
    def starts(self) -> Counts:
        """(T,) int64 the first splat of each tile."""
        return np.cumsum(self.counts) - self.counts

    @functools.cached_property
    def is_leaf(self) -> NDArray[np.bool_]:
        """(T,) bool, true for tiles without children."""
        leaf = np.ones(self.tiles, np.bool_)
        leaf[self.parent[1:]] = False
        return leaf

    def run(self, tile: int) -> slice:
        """Return the splats of a tile."""
        return slice(int(self.starts[tile]), int(self.starts[tile] + self.counts[tile]))

    def at_level(self, level: int) -> NDArray[np.int64]:
        """Return the tiles, ascending, that together are the cut of a level: those of it, and leaves of coarser ones.

        A tile in which nothing is refined from one level to the next has no children at the next; it belongs to both.
        """
        below = np.full(self.tiles, np.iinfo(np.int32).max, np.int32)
        below[self.parent[1:]] = self.level[1:]  # siblings have one level
        return np.flatnonzero((self.level <= level) & (below > level))

    def scene(self) -> Scene:
        """Return full detail as a plain scene: the splats of the tiles without children."""
        splats = self.splats.take(np.repeat(self.is_leaf, self.counts))
        return Scene(splats, **facts_of(self))
