"""Builds the tree of the quick method node by node, with dictionaries."""

from __future__ import annotations

import math

import numpy as np


def natural_level(scale: np.ndarray, base: float) -> int:
    """Returns the smallest level whose step, base ** level, is not below 2 * max(scale)."""
    size = 2 * float(np.max(scale))
    level = math.ceil(math.log(size) / math.log(base))
    while base ** float(level - 1) >= size:
        level -= 1
    while base ** float(level) < size:
        level += 1
    return level


Tree = tuple  # a leaf is (splat index,), a merged node the sorted tuple of its children


def quick_tree(centers_of: dict, levels: list[int], base: float, merge_center) -> Tree:
    """Returns the shape of the tree of the quick method.

    Args:
        centers_of: the centre of each leaf (index,); those of merged nodes are added.
        levels: the natural level of each splat.
        base: ratio of the cell sizes of two levels.
        merge_center: returns the centre of a merged node, from the list of its children.
    """
    waiting = sorted(range(len(levels)), key=lambda i: levels[i])
    level, active = min(levels), []
    while True:
        while waiting and levels[waiting[0]] <= level:
            active.append((waiting.pop(0),))
        step = base ** float(level)
        cells: dict = {}
        for node in active:
            cells.setdefault(tuple(np.floor(centers_of[node].astype(np.float64) / step)), []).append(node)
        active = []
        for members in cells.values():
            active.append(_merged(members, centers_of, merge_center) if len(members) > 1 else members[0])
        spots = np.array([np.floor(centers_of[node].astype(np.float64) / step) for node in active])
        if not waiting and np.ptp(spots, axis=0).max() <= 1:
            return _merged(active, centers_of, merge_center) if len(active) > 1 else active[0]
        level += 1


def _merged(members: list, centers_of: dict, merge_center) -> Tree:
    node = tuple(sorted(members, key=str))
    centers_of[node] = merge_center(members)
    return node
