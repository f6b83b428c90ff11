"""Checks that the leaves of a tree are the splats of the file that it was baked from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..model.scene import Scene
from ..model.selection import Selection
from ..support.errors import InvalidSplatsError
from ..support.units import count_of
from .findings import Finding
from .leaf_codes import Coded, Coding, codings_of
from .rad import RadFacts

#: Most leaves, without an equal splat or one at the same place of the order, that are searched for nearby: searching
#: takes time that grows with their number.
MAX_SEARCHED = 20_000


def check(scene: Scene, original: Scene, facts: RadFacts | None = None) -> list[Finding]:
    """A finding if the leaves of `scene`, a tree, are not exactly the splats of `original` that can be drawn.

    Both are compared as codes of the tree's file, as sparklod makes them or as others do: most are equal, and each of
    the others must pair with one whose codes all lie within a step.

    Args:
        scene: of an SPZ or RAD file.
        original: of any file.
        facts: of the RAD file that the tree is from; None for SPZ.
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
    missing = None
    for coding in codings_of(scene, leaves, splats, facts):
        if isinstance(coding, str):
            return [Finding("expect.leaves", coding)]
        unpaired = _unpaired(coding.encode(leaves), coding.encode(splats), coding)
        if not len(unpaired):
            return []
        missing = unpaired if missing is None or len(unpaired) < len(missing) else missing
    assert missing is not None
    index = int(np.flatnonzero(scene.tree.is_leaf)[missing[0]])
    what = f"{len(missing):,} leaves are not splats of the original; the first is node {index:,}"
    return [Finding("expect.leaves", what, index, len(missing))]


def _unpaired(ours: Coded, theirs: Coded, coding: Coding) -> NDArray[np.intp]:
    """Ascending indices of ours without a counterpart among theirs; each of theirs pairs with one of ours only."""
    left, right = _not_equal(ours.rows, theirs.rows)
    # Splats of a writer that rounds differently mostly still have the same order when sorted.
    left = left[np.lexsort(ours.numbers[left].T[::-1])]
    right = right[np.lexsort(theirs.numbers[right].T[::-1])]
    apart = ~_alike(ours, left, theirs, right, coding)
    left, right = np.sort(left[apart]), right[apart]
    if len(left) > MAX_SEARCHED:
        return left
    # The others are searched for along the axis with the most distinct coordinates.
    axis = int(np.argmax([len(np.unique(theirs.numbers[right, axis])) for axis in range(3)]))
    free = right[np.argsort(theirs.numbers[right, axis], kind="stable")]
    along, step = theirs.numbers[free, axis], coding.steps[axis]
    taken = np.zeros(len(free), np.bool_)
    missing = []
    for leaf in left:
        first, last = np.searchsorted(along, int(ours.numbers[leaf, axis]) + np.array([-step, step + 1]))
        near = np.arange(first, last)[~taken[first:last]]
        fits = near[_alike(ours, np.full(len(near), leaf), theirs, free[near], coding)]
        if len(fits):
            off = _apart(theirs.numbers[free[fits]], ours.numbers[leaf]).sum(axis=1)
            taken[fits[np.argmin(off)]] = True
        else:
            missing.append(leaf)
    return np.array(missing, np.intp)


def _alike(
    ours: Coded, left: NDArray[np.intp], theirs: Coded, right: NDArray[np.intp], coding: Coding
) -> NDArray[np.bool_]:
    """Whether pairs of splats of ours and theirs lie within a step of each other in every code."""
    near = (_apart(theirs.numbers[right], ours.numbers[left]) <= coding.steps).all(axis=1)
    cosine = np.abs(np.einsum("ij,ij->i", theirs.quat_xyzw[right], ours.quat_xyzw[left], dtype=np.float64))
    return near & (np.degrees(2 * np.arccos(np.minimum(cosine, 1))) <= coding.degrees)


def _apart(one: NDArray[np.int32], other: NDArray[np.int32]) -> NDArray[np.int64]:
    return np.abs(one.astype(np.int64) - other)  # codes of floats may lie 32 bits apart


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
