"""`TileScene`: splats of a hierarchy of tiles, each of which its children replace by more splats, as in 3D Tiles."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .scene import Bounds, Counts, Scene, facts_of
from .splats import Splats


@dataclass(frozen=True, eq=False)
class TileScene:
    """Tiles, root first and each after its parent, and their splats, tile after tile.

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
        for name, shape in (shapes | {"transform": (4, 4)}).items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has the shape {getattr(self, name).shape}; expected {shape}")
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
