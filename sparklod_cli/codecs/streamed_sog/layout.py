"""Where the splats of each region and detail level lie in the chunks, by a manifest."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...model.detail import Bounds, Counts
from ...support.errors import FormatError
from ...support.untrusted import quoted_value
from .manifest import Manifest
from .names import MANIFEST

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
        """(R, 2, 3) lowest and highest corner of each region; `FormatError` where one has none."""
        found = [node.bound for _, node in self.manifest.regions()]
        if None in found:
            number = next(number for number, node in self.manifest.regions() if node.bound is None)
            raise FormatError(f"{self.manifest.place(number)} of {MANIFEST} has no bound of six finite numbers")
        return np.array(found, np.float64)

    def children(self) -> Index:
        """(R - 1, 2) the tree as in `DetailScene`; `FormatError` where it is not a binary one."""
        nodes = self.manifest.nodes
        numbers = np.empty(len(nodes), np.int64)
        inner = [number for number, node in enumerate(nodes) if node.children]
        numbers[inner] = np.arange(len(inner))
        numbers[[number for number, _ in self.manifest.regions()]] = -1 - np.arange(len(self.counts))
        for number in inner:
            if len(nodes[number].children) != 2:
                place, count = self.manifest.place(number), len(nodes[number].children)
                raise FormatError(f"{place} of {MANIFEST} has {count} children; a node has two or none")
        return numbers[np.array([nodes[number].children for number in inner], np.int64).reshape(-1, 2)]

    def errors(self) -> NDArray[np.float64] | None:
        """(R, L) the error of each region at each level; None unless all regions have errors.

        Raises:
            FormatError: errors are not L finite numbers from 0 on.
        """
        for number, node in self.manifest.regions():
            if node.errors is not None and not _are_errors(node.errors, self.manifest.levels):
                place, value = self.manifest.place(number), quoted_value(node.errors)
                wanted = f"{self.manifest.levels} finite numbers from 0 on"
                raise FormatError(f"{place}.errors of {MANIFEST} is {value}, not {wanted}")
        found = [node.errors for _, node in self.manifest.regions()]
        return None if None in found else np.array(found, np.float64)


def _are_errors(value: object, levels: int) -> bool:
    if not isinstance(value, list) or len(value) != levels:
        return False
    return all(type(each) in (int, float) and math.isfinite(each) and each >= 0 for each in value)


def layout_of(manifest: Manifest) -> Layout:
    """The layout of a manifest.

    Raises:
        FormatError: runs do not tile the files that they are in, or a node has both children and runs.
    """
    rows = list[tuple[int, int, int, int, int]]()
    regions = 0
    for number, node in enumerate(manifest.nodes):
        if node.children:
            if node.runs is not None:
                raise FormatError(f"{manifest.place(number)} of {MANIFEST} has both children and lods")
            continue
        rows += [
            (run.file, run.offset, run.count, level, regions) for level, run in (node.runs or {}).items() if run.count
        ]
        regions += 1
    table = np.array(rows, np.int64).reshape(-1, 5)
    runs = Runs(*np.ascontiguousarray(table[np.lexsort((table[:, 1], table[:, 0]))].T))
    counts = np.zeros((regions, manifest.levels), np.int64)
    counts[runs.region, runs.level] = runs.count
    layout = Layout(manifest, runs, counts)
    _check_tiling(layout)
    return layout


def _check_tiling(layout: Layout) -> None:
    runs = layout.runs
    before = np.cumsum(runs.count) - runs.count
    first = np.searchsorted(runs.file, runs.file)
    expected = before - before[first]
    wrong = np.flatnonzero(runs.offset != expected)
    if not len(wrong):
        return
    run, manifest = int(wrong[0]), layout.manifest
    node = [number for number, _ in manifest.regions()][runs.region[run]]
    raise FormatError(
        f"{manifest.place(node)}.lods.{runs.level[run]} of {MANIFEST} begins at splat {runs.offset[run]:,} of"
        f" {quoted_value(manifest.filenames[runs.file[run]])}, but the runs before it end at {expected[run]:,}"
    )
