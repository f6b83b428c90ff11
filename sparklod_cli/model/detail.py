"""`DetailScene`, a scene whose regions each exist at several detail levels, as Streamed SOG holds it."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .scene import Scene
from .splats import Splats

Bounds = NDArray[np.float64]
Counts = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class DetailScene:
    """Splats of all detail levels, and the regions whose level a viewer chooses one by one.

    Level 0 is full detail; the levels of a region stand for the same splats. The splats of a region at a level are its
    run. Runs lie level after level, and in a level region after region.

    Attributes:
        splats: N splats, those of all levels.
        counts: (R, L) int64 splats of each region at each level; 0 where a region has no such level.
        bounds: (R, 2, 3) float64 lowest and highest corner of each region, in world units.
        children: (R - 1, 2) int64 the binary tree over the regions: its inner nodes, root first and before their
            children. A number from 0 on is an inner node, -1 - r is region r.
        errors: (R, L) float64 how far each level of a region is from its level 0, 0 there and not decreasing from level
            to level; None where nobody measured it.
        environment: splats far outside, which are drawn whatever the levels are; None without.
        antialiased: trained with the opacity compensation of Mip-Splatting.
        format, notes, header, up: as of `Scene`.
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

    def __post_init__(self) -> None:
        regions, levels = self.counts.shape
        shapes = {"bounds": (regions, 2, 3), "children": (regions - 1, 2)}
        shapes |= {} if self.errors is None else {"errors": (regions, levels)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has the shape {getattr(self, name).shape}; expected {shape}")
        if self.counts.sum() != len(self.splats):
            raise ValueError(f"counts are of {self.counts.sum():,} splats, but there are {len(self.splats):,}")

    @property
    def regions(self) -> int:
        """How many regions there are."""
        return len(self.counts)

    @property
    def levels(self) -> int:
        """How many detail levels there are."""
        return self.counts.shape[1]

    @functools.cached_property
    def starts(self) -> Counts:
        """(R, L) the first splat of each run."""
        flat = self.counts.T.ravel()
        return np.ascontiguousarray((np.cumsum(flat) - flat).reshape(self.levels, self.regions).T)

    def run(self, region: int, level: int) -> slice:
        """The splats of a region at a level."""
        start = int(self.starts[region, level])
        return slice(start, start + int(self.counts[region, level]))

    def level(self, level: int) -> slice:
        """The splats of a level, of all regions."""
        before = int(self.counts[:, :level].sum())
        return slice(before, before + int(self.counts[:, level].sum()))

    def scene(self) -> Scene:
        """Full detail as a plain scene: level 0, then the environment."""
        splats = self.splats.take(self.level(0))
        if self.environment is not None:
            splats = Splats.concat([splats, self.environment])
        return Scene(splats, None, self.antialiased, self.format, self.notes, self.header, up=self.up)
