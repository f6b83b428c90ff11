"""Other orders of chunks: Spark's, and the largest node first."""

from __future__ import annotations

import heapq
from collections import deque

import numpy as np

from sparklod_cli.model.gaussian import rotation_matrices, spark_size
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.splats import Splats

#: Of Spark's `chunk_tree.rs`: nodes of a batch, the least that one is filled by, standard deviations of a splat's box,
#: the least scale in it, and how much longer than its shortest side a box is halved rather than cut into octants.
BATCH, LEAST_BATCH, DEVIATIONS, LEAST_SCALE, LONG = 1 << 16, 1 << 13, 1.5, 1e-3, 3.0

#: Octants are bits of x, y, z; neighbours in this order share a face.
OCTANTS = (0, 1, 3, 2, 6, 7, 5, 4)


def spark_order(splats: Splats, tree: LodTree, size: np.ndarray | None = None) -> np.ndarray:
    """Spark's order of a tree, by its `chunk_tree_size`: the node at each place.

    Each batch of nodes is refined, the largest first (of equal ones the last), until its families fill the chunk that
    has room for at least `LEAST_BATCH` more nodes. Those that are left are divided in the middle of their box: along
    its longest side, the larger half first, if it is long; else into octants. The parts are later batches.

    Args:
        splats, tree: the nodes, in the order that breaks ties.
        size: feature sizes; Spark's of the splats unless given.
    """
    sizes = (spark_size(splats) if size is None else size).tolist()
    starts, counts = tree.child_start.tolist(), tree.child_count.tolist()
    half = half_extents(splats)
    order, batches = [0], deque([[0]])
    while batches:
        heap = [(-sizes[node], -node) for node in batches.popleft()]
        heapq.heapify(heap)
        end = -(-(len(order) + LEAST_BATCH) // BATCH) * BATCH
        while heap and len(order) + counts[-heap[0][1]] <= end:
            node = -heapq.heappop(heap)[1]
            for child in range(starts[node], starts[node] + counts[node]):
                order.append(child)
                heapq.heappush(heap, (-sizes[child], -child))
        if heap:
            batches += divided(np.array([-node for _, node in heap]), splats.center, half)
    return np.array(order, np.uint32)


def divided(nodes: np.ndarray, center: np.ndarray, half: np.ndarray) -> list[list[int]]:
    """The later batches of the nodes that a batch has left, in Spark's order."""
    low, high = (center[nodes] - half[nodes]).min(axis=0), (center[nodes] + half[nodes]).max(axis=0)
    extent = high - low
    above = center[nodes] >= (low + high) * np.float32(0.5)
    if extent.max() < np.float32(LONG) * extent.min():
        octant = above @ [1, 2, 4]
        return [nodes[octant == number].tolist() for number in OCTANTS]
    upper = above[:, int(np.argmax(extent))]
    return sorted((nodes[~upper].tolist(), nodes[upper].tolist()), key=len, reverse=True)


def half_extents(splats: Splats) -> np.ndarray:
    """(N, 3) half the sides of the boxes that Spark puts around splats."""
    turned = np.abs(rotation_matrices(splats.quat_xyzw)).transpose(2, 0, 1)
    reach = np.maximum(splats.scale, np.float32(LEAST_SCALE)) * np.float32(DEVIATIONS)
    return np.einsum("nij,nj->ni", turned, reach).astype(np.float32)


def size_order(splats: Splats, tree: LodTree) -> np.ndarray:
    """The largest node first throughout: the node at each place."""
    sizes, starts, counts = spark_size(splats).tolist(), tree.child_start.tolist(), tree.child_count.tolist()
    order, heap = [0], [(-sizes[0], 0)]
    while heap:
        node = -heapq.heappop(heap)[1]
        for child in range(starts[node], starts[node] + counts[node]):
            order.append(child)
            heapq.heappush(heap, (-sizes[child], -child))
    return np.array(order, np.uint32)


def reordered(splats: Splats, tree: LodTree, order: np.ndarray) -> tuple[Splats, LodTree]:
    """The tree with the node `order[i]` at place i."""
    place = np.empty(len(order), np.uint32)
    place[order] = np.arange(len(order))
    count, start = tree.child_count[order], tree.child_start[order]
    return splats.take(order), LodTree(count, np.where(count > 0, place[start * (count > 0)], 0).astype(np.uint32))
