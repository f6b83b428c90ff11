"""Slow, obvious twins of the kernels, to test them against."""

from __future__ import annotations

import heapq
import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from sparklod_cli.gaussian import MAX_OPACITY, MIN_OPACITY, THOMSEN_P
from sparklod_cli.splats import Splats


def ellipsoid_area(scale: np.ndarray) -> np.ndarray:
    """Knud Thomsen's formula over (..., 3) semi-axes, as it is written down."""
    a, b, c = np.moveaxis(np.asarray(scale, np.float64), -1, 0)
    mean = ((a * b) ** THOMSEN_P + (a * c) ** THOMSEN_P + (b * c) ** THOMSEN_P) / 3
    return 4 * math.pi * mean ** (1 / THOMSEN_P)


def rotation_matrix(quat_xyzw: np.ndarray) -> np.ndarray:
    """(..., 3, 3) from (..., 4), by rotating the axes with the quaternion."""
    quat = np.asarray(quat_xyzw, np.float64)
    vector, w = quat[..., None, :3], quat[..., None, 3:]
    axes = np.broadcast_to(np.eye(3), (*quat.shape[:-1], 3, 3))
    turned = axes + 2 * np.cross(vector, np.cross(vector, axes) + w * axes)
    return np.swapaxes(turned, -1, -2)


def covariance(scale: np.ndarray, quat_xyzw: np.ndarray) -> np.ndarray:
    """(..., 3, 3) R S S^T R^T."""
    factor = rotation_matrix(quat_xyzw) * np.asarray(scale, np.float64)[..., None, :]
    return factor @ np.swapaxes(factor, -1, -2)


@dataclass
class Moments:
    """What a merged splat must have."""

    center: np.ndarray
    covariance: np.ndarray
    weight: float
    rgb: np.ndarray
    sh: np.ndarray


def merge(splats: Splats) -> Moments:
    """Moment matching with weights opacity * area."""
    weight = splats.opacity.astype(np.float64) * ellipsoid_area(splats.scale)
    share = weight / weight.sum()
    center = share @ splats.center.astype(np.float64)
    offset = splats.center - center
    spread = covariance(splats.scale, splats.quat_xyzw) + offset[:, :, None] * offset[:, None, :]
    return Moments(
        center,
        np.tensordot(share, spread, 1),
        weight.sum(),
        share @ splats.rgb.astype(np.float64),
        np.tensordot(share, splats.sh.astype(np.float64), 1),
    )


def opacity_of(weight: float, scale: np.ndarray) -> float:
    """Linear opacity of a merged splat of these scales."""
    return float(np.clip(weight / ellipsoid_area(scale), MIN_OPACITY, MAX_OPACITY))


def natural_level(scale: np.ndarray, base: float) -> int:
    """The smallest level whose step, base ** level, is not below 2 * max(scale)."""
    size = 2 * float(np.max(scale))
    level = math.ceil(math.log(size) / math.log(base))
    while base ** float(level - 1) >= size:
        level -= 1
    while base ** float(level) < size:
        level += 1
    return level


Tree = tuple  # a leaf is (splat index,), a merged node the sorted tuple of its children


def quick_tree(centers_of: dict, levels: list[int], base: float, merge_center) -> Tree:
    """The shape of the Quick-LoD tree, node by node with dictionaries.

    Args:
        centers_of: centre of each leaf (index,); merged nodes are added.
        levels: natural level of each splat.
        base: growth of the grid.
        merge_center: tells the centre of a merged node from the list of its children.
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


@dataclass
class Walked:
    """What the links of a tree lead to, however broken they are."""

    parents: list[list[int]]  # the nodes that have each as a child
    depth: list[int]
    limit: list[float]


def links_of(child_count: np.ndarray, child_start: np.ndarray) -> list[range]:
    """The children of each node that there are."""
    starts, counts = child_start.tolist(), child_count.tolist()
    return [range(start, min(len(starts), start + count)) for start, count in zip(starts, counts, strict=True)]


def walk(child_count: np.ndarray, child_start: np.ndarray, size: np.ndarray) -> Walked:
    """Breadth first, with sets."""
    links = links_of(child_count, child_start)
    every = range(len(links))
    parents = [[node for node in every if child in links[node]] for child in every]
    depth, limit = {0: 0}, {0: float(size[0])}
    waiting = deque([0])
    while waiting:
        node = waiting.popleft()
        for child in links[node]:
            if child not in depth:
                depth[child], limit[child] = depth[node] + 1, min(limit[node], float(size[child]))
                waiting.append(child)
    return Walked(parents, [depth.get(node, -1) for node in every], [limit.get(node, 0.0) for node in every])


def on_cycles(parent: list[int], depth: list[int]) -> list[bool]:
    """Whether one who goes up from a node never comes to an end, nor to a node that has a depth."""
    found = []
    for node in range(len(parent)):
        seen: set[int] = set()
        while node >= 0 and depth[node] < 0 and node not in seen:
            seen.add(node)
            node = parent[node]
        found.append(node in seen)
    return found


def coarse_cut(child_count: np.ndarray, child_start: np.ndarray, size: np.ndarray, most: int) -> set[int]:
    """The cut of a tree that is left when the largest node is divided as long as the cut has no more than `most`."""
    links = links_of(child_count, child_start)
    heap = [(-float(size[0]), 0)]
    leaves: set[int] = set()
    while heap:
        _, node = heap[0]
        if links[node] and len(heap) + len(leaves) - 1 + len(links[node]) > most:
            break
        heapq.heappop(heap)
        if not links[node]:
            leaves.add(node)
        for child in links[node]:
            heapq.heappush(heap, (-float(size[child]), child))
    return leaves | {node for _, node in heap}
