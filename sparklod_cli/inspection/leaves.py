"""Checks that the leaves of a tree are the splats of the file that it was baked from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..codecs.spz_layout import LOD, Layout
from ..model.scene import Scene
from ..model.selection import Selection
from ..model.splats import Splats
from ..support.errors import InvalidSplatsError
from ..support.units import count_of
from .findings import Finding

#: Largest differences of the codes of one splat: writers round, truncate or go through float16. Codes of SH keep upper
#: bits only, so that a step of theirs is a bucket of 16.
STEPS, SH_STEPS = 1, 16

#: Largest angle in degrees between two codes of one rotation, by the bytes of the code.
DEGREES = {3: 14.0, 4: 0.8}

#: Most leaves, without an equal splat or one at the same place of the order, that are searched for nearby: searching
#: takes time that grows with their number.
MAX_SEARCHED = 20_000

#: Columns whose codes may differ by a step, in the order in which `_Coded.numbers` has them.
COLUMNS = ("center", "opacity", "rgb", "scale", "sh")


@dataclass(frozen=True)
class _Coded:
    """N splats as codes.

    Attributes:
        rows: (N,) all bytes of a splat as one value, to compare whole splats.
        numbers: (N, n) int32 codes of `COLUMNS`; the first three are those of the centre.
        quat_xyzw: (N, 4) rotations.
    """

    rows: NDArray[np.void]
    numbers: NDArray[np.int32]
    quat_xyzw: NDArray[np.float32]


def check(scene: Scene, original: Scene) -> list[Finding]:
    """A finding if the leaves of `scene`, an SPZ tree, are not exactly the splats of `original` that can be drawn.

    Both are compared as codes of the tree's file: most are equal, and each of the others must pair with one whose codes
    all lie within a step.
    """
    if scene.tree is None:
        return [Finding("expect.leaves", "the file has no tree whose leaves could be compared")]
    leaves = scene.splats.take(scene.tree.is_leaf)
    source = original.splats if original.tree is None else original.splats.take(original.tree.is_leaf)
    try:
        splats, _ = Selection(drop_invalid=True).apply(source.with_max_sh(leaves.sh_degree))
    except InvalidSplatsError as error:
        return [Finding("expect.leaves", f"the original: {error}")]
    if len(leaves) != len(splats):
        found, expected = count_of(len(leaves), "leaf", "leaves"), count_of(len(splats), "splat")
        return [Finding("expect.leaves", f"{found}, but {expected} of the original can be drawn")]
    if leaves.sh_degree != splats.sh_degree:
        return [Finding("expect.leaves", f"SH degree {leaves.sh_degree}, but the original has {splats.sh_degree}")]
    bits, version = int(scene.header["fractional_bits"]), max(2, int(scene.header["version"]))
    layout = Layout(version, len(leaves), leaves.sh_degree, bits, LOD)
    missing = _unpaired(_coded(layout, leaves), _coded(layout, splats), DEGREES[3 if version == 2 else 4])
    if not len(missing):
        return []
    index = int(np.flatnonzero(scene.tree.is_leaf)[missing[0]])
    what = f"{len(missing):,} leaves are not splats of the original; the first is node {index:,}"
    return [Finding("expect.leaves", what, index, len(missing))]


def _coded(layout: Layout, splats: Splats) -> _Coded:
    parts, numbers = [], {}
    for stream in layout.streams():
        if not hasattr(splats, stream.column):
            continue  # the columns of the tree
        values = np.ascontiguousarray(stream.encode(getattr(splats, stream.column)))
        codes = values.view(np.uint8).reshape(len(splats), stream.size)
        parts.append(codes)
        numbers[stream.column] = codes.astype(np.int32)
    center = numbers["center"].reshape(-1, 3, 3) @ np.array([1, 1 << 8, 1 << 16], np.int32)
    numbers["center"] = np.where(center >= 1 << 23, center - (1 << 24), center)
    together = np.ascontiguousarray(np.concatenate(parts, axis=1))
    rows = together.view(np.dtype((np.void, together.shape[1])))[:, 0]
    columns = [numbers[name] for name in COLUMNS if name in numbers]
    return _Coded(rows, np.concatenate(columns, axis=1), splats.quat_xyzw)


def _unpaired(ours: _Coded, theirs: _Coded, degrees: float) -> NDArray[np.intp]:
    """Ascending indices of ours without a counterpart among theirs; each of theirs pairs with one of ours only."""
    left, right = _not_equal(ours.rows, theirs.rows)
    # Splats of a writer that rounds differently mostly still have the same order when sorted.
    left = left[np.lexsort(ours.numbers[left].T[::-1])]
    right = right[np.lexsort(theirs.numbers[right].T[::-1])]
    apart = ~_alike(ours, left, theirs, right, degrees)
    left, right = np.sort(left[apart]), right[apart]
    if len(left) > MAX_SEARCHED:
        return left
    # The others are searched for along the axis with the most distinct coordinates.
    axis = int(np.argmax([len(np.unique(theirs.numbers[right, axis])) for axis in range(3)]))
    free = right[np.argsort(theirs.numbers[right, axis], kind="stable")]
    along = theirs.numbers[free, axis]
    taken = np.zeros(len(free), np.bool_)
    missing = []
    for leaf in left:
        first, last = np.searchsorted(along, ours.numbers[leaf, axis] + [-STEPS, STEPS + 1])
        near = np.arange(first, last)[~taken[first:last]]
        fits = near[_alike(ours, np.full(len(near), leaf), theirs, free[near], degrees)]
        if len(fits):
            off = np.abs(theirs.numbers[free[fits]] - ours.numbers[leaf]).sum(axis=1)
            taken[fits[np.argmin(off)]] = True
        else:
            missing.append(leaf)
    return np.array(missing, np.intp)


def _alike(
    ours: _Coded, left: NDArray[np.intp], theirs: _Coded, right: NDArray[np.intp], degrees: float
) -> NDArray[np.bool_]:
    """Whether pairs of splats of ours and theirs lie within a step of each other in every code."""
    most = np.full(ours.numbers.shape[1], STEPS)
    most[10:] = SH_STEPS  # after 3 of centre, 1 of opacity, 3 of colour and 3 of scale
    near = (np.abs(theirs.numbers[right] - ours.numbers[left]) <= most).all(axis=1)
    cosine = np.abs(np.einsum("ij,ij->i", theirs.quat_xyzw[right], ours.quat_xyzw[left], dtype=np.float64))
    return near & (np.degrees(2 * np.arccos(np.minimum(cosine, 1))) <= degrees)


def _not_equal(ours: NDArray[np.void], theirs: NDArray[np.void]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Ascending indices of ours and of theirs that remain when pairs of equal rows are removed."""
    count = len(ours)
    rows = np.concatenate([ours, theirs])
    order = np.argsort(rows, kind="stable")  # of equal rows ours come first
    ordered, is_ours = rows[order], order < count
    begins = np.concatenate([[True], ordered[1:] != ordered[:-1]])
    group = np.cumsum(begins) - 1
    of_ours = np.bincount(group[is_ours], minlength=group[-1] + 1)
    of_theirs = np.bincount(group[~is_ours], minlength=group[-1] + 1)
    rank = np.arange(len(rows)) - np.flatnonzero(begins)[group] - np.where(is_ours, 0, of_ours[group])
    left = order[rank >= np.minimum(of_ours, of_theirs)[group]]
    return np.sort(left[left < count]), np.sort(left[left >= count]) - count
