"""The order of chunks by plain lists: what `lod.chunk_order` and its kernels do to the families of a tree."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sparklod_cli.lod.kernels.chunk_sets import BINS, FEW_CHUNKS, NEARLY_FULL
from tests.references.budgeted_cuts import bits_of, pixel_scale

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
