"""Scenes in parts, as detail levels or tiles, and instances: scenes of any kind at their positions in the world."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from . import TOTAL
from .foveation import Foveation
from .scene import Scene, facts_of
from .splats import Splats
from .transforms import LARGEST, SKEW, Transform, scale_of

Bounds = NDArray[np.float64]
Counts = NDArray[np.int64]


@dataclass(frozen=True, eq=False, kw_only=True)
class FileFacts:
    """Metadata of the file of a scene in parts, as in `Scene`."""

    antialiased: bool = False
    format: str = ""
    notes: tuple[str, ...] = ()
    header: Mapping[str, int] = field(default_factory=dict)
    up: str | None = None
    up_by: str = ""


def _check_columns(scene: DetailScene | TileScene, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise `ValueError` for a column of another shape, or `counts` of another number of splats."""
    for name, shape in shapes.items():
        if getattr(scene, name).shape != shape:
            raise ValueError(f"{name} has the shape {getattr(scene, name).shape}; expected {shape}")
    if scene.counts.sum() != len(scene.splats):
        raise ValueError(f"counts are of {scene.counts.sum():,} splats, but there are {len(scene.splats):,}")


@dataclass(frozen=True, eq=False)
class DetailScene(FileFacts):
    """Splats of all detail levels, in regions for which a viewer chooses a level each, as in Streamed SOG.

    Level 0 is full detail; the levels of a region stand for the same splats. The splats of a region at a level are its
    run. Runs are stored level after level, and within a level region after region.

    Attributes:
        splats: N splats, those of all levels.
        counts: (R, L) int64 splats of each region at each level; 0 where a region lacks the level.
        bounds: (R, 2, 3) float64 lowest and highest corner of each region, in world units.
        children: (R - 1, 2) int64 the binary tree over the regions: its inner nodes, root first and before their
            children. A number from 0 on is an inner node, -1 - r is region r.
        errors: (R, L) float64 differences of each level of a region from its level 0, not decreasing from level to
            level; None if they were not measured.
        environment: splats far outside, which are drawn at all levels; None without.
    """

    splats: Splats
    counts: Counts
    bounds: Bounds
    children: NDArray[np.int64]
    errors: NDArray[np.float64] | None = None
    environment: Splats | None = None

    def __post_init__(self) -> None:
        regions, levels = self.counts.shape
        shapes = {"bounds": (regions, 2, 3), "children": (regions - 1, 2)}
        _check_columns(self, shapes | ({} if self.errors is None else {"errors": (regions, levels)}))

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
        """Return the splats of all regions at a level."""
        before = int(self.counts[:, :level].sum())
        return slice(before, before + int(self.counts[:, level].sum()))

    def scene(self) -> Scene:
        """Return full detail as a plain scene: level 0, then the environment."""
        splats = self.splats.take(self.level(0))
        if self.environment is not None:
            splats = Splats.concat([splats, self.environment])
        return Scene(splats, **facts_of(self))


@dataclass(frozen=True, eq=False)
class TileScene(FileFacts):
    """Tiles, root first and each after its parent, and their splats, tile after tile; as in 3D Tiles.

    The children of a tile together replace it with more splats. A tile without children has full detail. A viewer draws
    tiles that together stand for the scene, none of them below another.

    Attributes:
        splats: N splats, those of all tiles.
        parent: (T,) int32 tile that each tile replaces a part of; -1 of the root.
        level: (T,) int32 number of the cut that a tile is a part of, 0 of the root; more than that of its parent.
        counts: (T,) int64 splats of each tile.
        errors: (T,) float64 geometric error of each tile in world units, 0 of tiles without children.
        bounds: (T, 2, 3) float64 lowest and highest corner of each tile and those below it, in the axes of the splats.
        sizes: (T,) int64 bytes of the file of each tile, 0 without splats; None for a scene in memory.
        transform: (4, 4) float64 for column vectors, from the axes of the tileset, z up, to the Earth's (ECEF), metres;
            the identity for a scene without a place on the Earth.
    """

    splats: Splats
    parent: NDArray[np.int32]
    level: NDArray[np.int32]
    counts: Counts
    errors: NDArray[np.float64]
    bounds: Bounds
    sizes: Counts | None = None
    transform: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        tiles = len(self.parent)
        shapes = {"level": (tiles,), "counts": (tiles,), "errors": (tiles,), "bounds": (tiles, 2, 3)}
        _check_columns(self, shapes | {"transform": (4, 4)})
        if not tiles or self.parent[0] != -1 or not (np.arange(tiles)[1:] > self.parent[1:]).all():
            raise ValueError("the first tile is the root, and every other comes after its parent")

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
        """Return the tiles, ascending, that together are the cut of a level: its own, and leaves of coarser levels.

        A tile in which nothing is refined from one level to the next has no children at the next; it belongs to both.
        """
        below = np.full(self.tiles, np.iinfo(np.int32).max, np.int32)
        below[self.parent[1:]] = self.level[1:]  # siblings have one level
        return np.flatnonzero((self.level <= level) & (below > level))

    def scene(self) -> Scene:
        """Return full detail as a plain scene: the splats of the tiles without children."""
        splats = self.splats.take(np.repeat(self.is_leaf, self.counts))
        return Scene(splats, **facts_of(self))


Source = Path | Scene | DetailScene | TileScene
Matrix = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Instance:
    """A scene and its position in the world.

    Attributes:
        source: a splat file (a path, which may be a string), or a scene in memory.
        name: for messages and tables; unique among the instances of a run.
        object_to_world: (4, 4) rotation, uniform scale and translation.
        lod_scale: factor of the pixel scales of its nodes, or of the distances at which its detail levels begin; above
            1, it gets a larger share of the budget.
        foveation: None for that of the viewer.

    Raises:
        TypeError: the source is neither.
        ValueError: the matrix has another shape, a number that is not finite, or a determinant of 0 or less.
    """

    source: Source
    name: str = ""
    object_to_world: Matrix = field(default_factory=lambda: np.eye(4))
    lod_scale: float = 1.0
    foveation: Foveation | None = None

    def __post_init__(self) -> None:
        if isinstance(self.source, str):
            object.__setattr__(self, "source", Path(self.source))
        if not isinstance(self.source, (Path, Scene, DetailScene, TileScene)):
            raise TypeError(f"an instance is of a file or a scene, not of {type(self.source).__name__}")
        matrix = np.asarray(self.object_to_world, np.float64)
        if matrix.shape != (4, 4):
            raise ValueError(f"object_to_world has the shape {matrix.shape}; give (4, 4)")
        if scale_of(matrix, math.inf) is None:
            raise ValueError("object_to_world is no rotation, uniform scale and translation of finite numbers")
        object.__setattr__(self, "object_to_world", matrix)

    @property
    def file(self) -> Path | None:
        """The splat file; None for a scene in memory."""
        return self.source if isinstance(self.source, Path) else None

    @property
    def transform(self) -> Transform:
        """Similarity in `object_to_world`, with the nearest rotation if the axes are slightly skewed."""
        axes = self.object_to_world[:3, :3]
        scale = min(max(float(np.cbrt(np.linalg.det(axes))), 1 / LARGEST), LARGEST)
        rotation = axes / scale
        if np.abs(rotation.T @ rotation - np.eye(3)).max() > SKEW:
            left, _, right = np.linalg.svd(rotation)
            rotation = left @ right
        return Transform(rotation, scale, self.object_to_world[:3, 3])


def names_of(files: Sequence[Path], taken: Collection[str] = ()) -> list[str]:
    """Return a name for each file, numbered where several have the same; none is `TOTAL` or in `taken`."""
    seen = {TOTAL, *taken}
    counts: dict[str, int] = {}
    names = []
    for file in files:
        stem = file.name if file.stem == TOTAL else file.stem
        for count in itertools.count(counts.get(stem, 0) + 1):
            name = stem if count == 1 else f"{stem} {count}"
            if name not in seen:
                break
        counts[stem] = count
        seen.add(name)
        names.append(name)
    return names


def instances_of(files: Sequence[Path]) -> list[Instance]:
    """Return an instance of each file at its own coordinates."""
    return [Instance(file, name) for file, name in zip(files, names_of(files), strict=True)]
