"""Follows the child columns of a tree, with sets and queues."""

from __future__ import annotations

import heapq
from collections import deque
from dataclasses import dataclass

import numpy as np


@dataclass
class Followed:
    """What the links of a tree lead to, however broken they are."""

    parents: list[list[int]]  # all nodes that have the node as a child
    depth: list[int]
    limit: list[float]


def links_of(child_count: np.ndarray, child_start: np.ndarray) -> list[range]:
    """Returns the existing children of each node."""
    starts, counts = child_start.tolist(), child_count.tolist()
    return [range(start, min(len(starts), start + count)) for start, count in zip(starts, counts, strict=True)]


def follow(child_count: np.ndarray, child_start: np.ndarray, size: np.ndarray) -> Followed:
    """Follows the children of the root breadth first."""
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
    return Followed(parents, [depth.get(node, -1) for node in every], [limit.get(node, 0.0) for node in every])


def on_cycles(parent: list[int], depth: list[int]) -> list[bool]:
    """Whether following parents from a node never ends, nor reaches a node that has a depth."""
    found = []
    for node in range(len(parent)):
        seen: set[int] = set()
        while node >= 0 and depth[node] < 0 and node not in seen:
            seen.add(node)
            node = parent[node]
        found.append(node in seen)
    return found


def coarse_cut(child_count: np.ndarray, child_start: np.ndarray, size: np.ndarray, most: int) -> set[int]:
    """Returns the cut that refines the largest node first, as long as it has no more than `most` nodes."""
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
