"""Orders of chunks: Spark's, the largest node first, and that of `lod.chunk_order` and its kernels by plain lists."""

from __future__ import annotations

import heapq
import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from sparklod_cli.lod.kernels.chunk_sets import BINS, FEW_CHUNKS, NEARLY_FULL
from sparklod_cli.model.gaussian import rotation_matrices, spark_size
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.splats import Splats
from tests.references.cuts import bits_of, pixel_scale

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


#: Bits of a float32 that pixel scales are told apart by.
COARSE = 18


def demand(nodes: np.ndarray, parent: list[int], view: np.void, least: float, most: float) -> list[int]:
    """The demand for each family from one viewpoint, 0 to 255; `nodes` are the parents of the families."""
    coarse: list[int] = []
    for node, above in zip(nodes, parent, strict=True):
        own = bits_of(pixel_scale(node, view))
        coarse.append(own >> COARSE if above < 0 else min(own >> COARSE, coarse[above]))
    needed = [
        sum(int(node["child_count"]) for node, other in zip(nodes, coarse, strict=True) if other >= mine)
        for mine in coarse
    ]
    chance = [1 - math.log(count / least) / math.log(most / least) for count in needed]
    return [int(255 * min(1, max(0, share))) for share in chance]


@dataclass
class Splitter:
    """Families, the largest first: parents (-1 for none), nodes, ranks of centres, demands by viewpoint."""

    parent: list[int]
    count: list[int]
    rank: list[list[int]]
    demand: list[list[int]]
    size: int

    def roots(self, members: list[int]) -> dict[int, int]:
        """The root above each member."""
        found: dict[int, int] = {}
        for family in members:
            found[family] = found.get(self.parent[family], family)
        return found

    def viewers(self, families: list[int]) -> int:
        """Viewers that need any of these families."""
        return sum(max(lane) for lane in zip(*(self.demand[family] for family in families), strict=True))

    def choices(self, members: list[int], chunks: int) -> list[tuple[float, int, int]]:
        """The cost, axis and share of all divisions, those by size first."""
        root = self.roots(members)
        below = {top: sum(self.count[f] for f in members if root[f] == top) for top in root.values()}
        total, found = sum(below.values()), []
        fewest = 1 if chunks <= FEW_CHUNKS else chunks // 4
        for axis in (3, 0, 1, 2):
            units, nodes = (members, dict(enumerate(self.count))) if axis == 3 else (list(below), below)
            if axis == 3:
                bin_of = {family: at * BINS // len(members) for at, family in enumerate(members)}
            else:
                ranks = {top: self.rank[top][axis] for top in units}
                low, high = min(ranks.values()), max(ranks.values())
                bin_of = {top: (rank - low) * BINS // (high - low + 1) for top, rank in ranks.items()}
            for share in range(fewest, chunks - fewest + 1):
                passed = [sum(nodes[u] for u in units if bin_of[u] <= at) for at in range(BINS)]
                at = next((at for at in range(BINS) if passed[at] >= share * self.size), None)
                if at is None:
                    continue
                # Where several divisions end in one bin, all are costed by the last of them.
                last = min(passed[at] // self.size, chunks - fewest)
                first = [u for u in units if bin_of[u] <= at]
                rest = [u for u in units if bin_of[u] > at or (bin_of[u] == at and passed[at] > last * self.size)]
                nodes_first = share * self.size
                cost = float(nodes_first) * self.viewers(first)
                cost += float(total - nodes_first) * (self.viewers(rest) if rest else 0)
                found.append((cost, axis, share))
        return found

    def first_part(self, members: list[int], axis: int, room: int) -> set[int]:
        """The members that go into the first part."""
        root, taken = self.roots(members), set()
        inside = set(members)
        if axis == 3:
            units = [(family, self.count[family]) for family in members]
        else:
            tops = sorted(set(root.values()), key=lambda top: self.rank[top][axis])
            units = [(top, sum(self.count[f] for f in members if root[f] == top)) for top in tops]
        for unit, nodes in units:
            if axis == 3 and self.parent[unit] in inside and self.parent[unit] not in taken:
                continue
            if nodes <= room and (room > NEARLY_FULL or room - nodes != 1):
                taken.add(unit)
                room -= nodes
        return taken if axis == 3 else {family for family in members if root[family] in taken}

    def chunks(self) -> list[list[int]]:
        """The families of each chunk, in order; the root's node is beside the first."""
        return self._split(list(range(len(self.parent))), self.size - 1)

    def _split(self, members: list[int], room: int = 0) -> list[list[int]]:
        nodes = sum(self.count[family] for family in members)
        axis = 3
        if room == 0:
            if nodes <= self.size:
                return [members]
            found = self.choices(members, -(-nodes // self.size))
            cost = min(cost for cost, _, _ in found)
            _, axis, share = next(choice for choice in found if choice[0] == cost)
            room = share * self.size
        first = self.first_part(members, axis, room) or self.first_part(members, 3, room)
        rest = [family for family in members if family not in first]
        parts = self._split([family for family in members if family in first])
        return parts + (self._split(rest) if rest else [])


def code_of(rank: list[int], bits: int) -> int:
    """The upper 57 bits of the Morton code of three ranks of so many bits, at 21 bits each."""
    code = 0
    for bit in range(21):
        for axis in range(3):
            value = rank[axis] << (21 - bits) if bits <= 21 else rank[axis] >> (bits - 21)
            code |= (value >> bit & 1) << (3 * bit + axis)
    return code >> 6


def inside(chunk: list[int], parent: list[int], rank: list[list[int]], bits: int) -> list[tuple[int, int]]:
    """The (depth, code) of each family of a chunk, by which they are sorted; the place, for deep ones, as a code."""
    depth: dict[int, int] = {}
    keys = []
    for place, family in enumerate(chunk):
        depth[family] = depth.get(parent[family], -1) + 1
        keys.append((min(depth[family], 63), code_of(rank[family], bits) if depth[family] < 63 else place))
    return keys
