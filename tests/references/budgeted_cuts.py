"""Finds a budgeted cut with one queue, in the float32 arithmetic of the kernels."""

from __future__ import annotations

import heapq
import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from sparklod_cli.lod.kernels.pixel_scale import CONE, FRUSTUM


def pixel_scale(node: np.void, view: np.void) -> np.float32:
    """Returns size over distance, times the weights of the view; float32 after every operation."""
    with np.errstate(all="ignore"):
        x, y, z = (node[axis] - view[f"origin_{axis}"] for axis in "xyz")
        distance = np.sqrt(x * x + y * y + z * z)
        nearest = np.float32(1e-6)
        distance = distance if distance > nearest else nearest
        scale = node["size"] * (np.float32(1) / distance) * view["lod_scale"]
        if view["kind"] not in (CONE, FRUSTUM):
            return scale

        def along(axis: str) -> np.float32:
            return x * view[f"{axis}_x"] + y * view[f"{axis}_y"] + z * view[f"{axis}_z"]

        ahead, side, behind, inner, outer = along("forward"), *(view[n] for n in ("side", "behind", "inner", "outer"))
        one = np.float32(1)
        cosine = ahead * (one / distance)
        if ahead <= 0:
            weight = behind
        elif view["kind"] == FRUSTUM:
            seen = abs(along("right")) <= inner * ahead and abs(along("up")) <= outer * ahead
            weight = one if seen else side
        elif cosine >= inner:
            weight = one
        elif cosine >= outer:
            weight = side + (one - side) * ((cosine - outer) / (inner - outer))
        else:
            weight = behind + (side - behind) * (cosine / outer)
        return weight * scale


def bits_of(value: float) -> int:
    """Returns the bits of a number >= 0, which have the same order as the numbers; NaN counts as infinity."""
    value = np.float32(math.inf if np.isnan(value) else value)
    return int(value.view(np.uint32)) & 0x7FFFFFFF


def number_of(bits: int) -> float:
    return float(np.uint32(bits).view(np.float32))


@dataclass
class BudgetedCut:
    """The cut that the queue found; nodes are (instance, index)."""

    limit: dict = field(default_factory=dict)  # the least pixel scale from the root to each node drawn
    waiting: set = field(default_factory=set)  # nodes drawn because they were still in the queue
    reason: str = ""
    missing: int = 0
    least: float = math.inf
    stop: tuple | None = None
    demand: dict = field(
        default_factory=lambda: defaultdict(float)
    )  # the largest limit of a node that wants the chunk, by chunk


def budgeted_cut(
    nodes: np.ndarray,
    views: np.ndarray,
    budget: int,
    smallest: float,
    is_resident: Callable[[int], bool],
    bits: int = 16,
) -> BudgetedCut:
    """Refines the node of the largest pixel scale of all instances, as long as the budget allows.

    Args:
        nodes: nodes of all trees, as the kernel takes them.
        views: views of the instances, as the kernel takes them.
        budget: number of nodes at most.
        smallest: nodes of this pixel scale or less are not refined.
        is_resident: whether a chunk, numbered across all trees, is resident.
        bits: a chunk has 2 ** bits nodes.
    """
    cut, heap, drawn = BudgetedCut(), [], {}

    def push(instance: int, index: int, limit: int) -> None:
        own = bits_of(pixel_scale(nodes[views[instance]["node_base"] + index], views[instance]))
        heapq.heappush(heap, (-own, -instance, -index, min(limit, own)))

    for instance, view in enumerate(views):
        if is_resident(int(view["chunk_base"])):
            push(instance, 0, bits_of(math.inf))
        else:
            cut.missing += 1
    small = False
    while heap:
        own, instance, index, limit = heap[0]
        own, instance, index = -own, -instance, -index
        view = views[instance]
        node = nodes[view["node_base"] + index]
        start, count = int(node["child_start"]), int(node["child_count"])
        if own <= bits_of(smallest):
            break
        chunks = {int(view["chunk_base"]) + (child >> bits) for child in range(start, start + count)}
        resident = all(is_resident(chunk) for chunk in chunks)
        if count and len(drawn) + len(heap) - 1 + count > budget:
            cut.stop = number_of(own), instance, index
            break
        heapq.heappop(heap)
        for chunk in chunks:
            cut.demand[chunk] = max(cut.demand[chunk], number_of(limit))
        if count and resident:
            cut.least = min(cut.least, number_of(limit))
            for child in range(start, start + count):
                push(instance, child, limit)
        else:
            drawn[instance, index] = limit
            cut.missing += count > 0
    for own, instance, index, limit in heap:
        node = nodes[views[-instance]["node_base"] - index]
        small |= -own <= bits_of(smallest) and bool(node["child_count"])
        drawn[-instance, -index] = limit
        cut.waiting.add((-instance, -index))
    cut.limit = {node: number_of(limit) for node, limit in drawn.items()}
    cut.reason = "budget" if cut.stop else "pixel" if small else "missing" if cut.missing else "exhausted"
    return cut
