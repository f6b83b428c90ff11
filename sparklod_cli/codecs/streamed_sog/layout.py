"""Where the splats of each region and detail level lie in the chunks, by a manifest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...model.scene import Bounds, Counts
from .manifest import Manifest

Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Runs:
    """The runs that are not empty, in the order in which they lie in the files; each (n,) int64."""

    file: Index
    offset: Index
    count: Index
    level: Index
    region: Index


@dataclass(frozen=True, eq=False)
class Layout:
    """A manifest as arrays: R regions in the order of the tree, L detail levels.

    Attributes:
        manifest: as parsed.
        runs: that tile the files which they are in.
        counts: (R, L) splats of each region at each level.
    """

    manifest: Manifest
    runs: Runs
    counts: Counts

    def starts(self) -> Counts:
        """(n,) the first splat of each run in a `DetailScene`, where they lie level after level."""
        flat = self.counts.T.ravel()
        before = np.cumsum(flat) - flat
        return before[self.runs.level * len(self.counts) + self.runs.region]

    def bounds(self) -> Bounds:
        """(R, 2, 3) lowest and highest corner of each region; all must have a bound."""
        return np.array([node.bound for _, node in self.manifest.regions()], np.float64)

    def children(self) -> Index:
        """(R - 1, 2) the tree as in `DetailScene`; it must be a binary one."""
        nodes = self.manifest.nodes
        numbers = np.empty(len(nodes), np.int64)
        inner = [number for number, node in enumerate(nodes) if node.children]
        numbers[inner] = np.arange(len(inner))
        numbers[[number for number, _ in self.manifest.regions()]] = -1 - np.arange(len(self.counts))
        return numbers[np.array([nodes[number].children for number in inner], np.int64).reshape(-1, 2)]

    def errors(self) -> NDArray[np.float64] | None:
        """(R, L) the error of each region at each level, which must be numbers; None unless all regions have some."""
        found = [node.errors for _, node in self.manifest.regions()]
        return None if None in found else np.array(found, np.float64)


def layout_of(manifest: Manifest) -> Layout:
    """The layout of a manifest, whose runs must tile the files that they are in."""
    rows = [
        (run.file, run.offset, run.count, level, region)
        for region, (_, node) in enumerate(manifest.regions())
        for level, run in (node.runs or {}).items()
        if run.count
    ]
    table = np.array(rows, np.int64).reshape(-1, 5)
    runs = Runs(*np.ascontiguousarray(table[np.lexsort((table[:, 1], table[:, 0]))].T))
    counts = np.zeros((sum(1 for _ in manifest.regions()), manifest.levels), np.int64)
    counts[runs.region, runs.level] = runs.count
    return Layout(manifest, runs, counts)
