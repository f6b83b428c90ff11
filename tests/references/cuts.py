"""Cuts by plain means: budgeted ones by one queue, in the float32 arithmetic of kernels; continuous ones by numpy."""

from __future__ import annotations

import heapq
import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from sparklod_cli.lod.kernels.pixel_scale import CONE, FRUSTUM
from sparklod_cli.model.lod_tree import LodTree


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


def continuous_cut(
    nodes: np.ndarray, views: np.ndarray, sizes: list[int], budget: int, smallest: float, width: float
) -> tuple[list[np.ndarray], list[np.ndarray], float]:
    """Of each instance the nodes with a weight, and the weights; and the threshold.

    Args:
        nodes: of all trees, as the kernels take them.
        views: of the instances, as the kernels take them.
        sizes: number of nodes of each instance.
        budget: sum of the weights at most.
        smallest: nodes of this pixel scale or less are not refined.
        width: nodes of this many times the threshold are refined completely.
    """
    parts = [nodes[view["node_base"] : view["node_base"] + size] for view, size in zip(views, sizes, strict=True)]
    trees = [LodTree(part["child_count"].astype(np.uint16), part["child_start"]) for part in parts]
    orders = [np.flatnonzero(tree.child_count) for tree in trees]
    orders = [order[np.argsort(tree.depths()[order], kind="stable")] for tree, order in zip(trees, orders, strict=True)]
    limits = [limits_of(*each) for each in zip(parts, trees, orders, views, strict=True)]
    more = [tree.child_count[order].astype(np.int64) - 1 for tree, order in zip(trees, orders, strict=True)]
    threshold = find_threshold(np.concatenate(limits), np.concatenate(more), budget - len(views), width)
    threshold = max(threshold, smallest)
    blended = [
        blend(tree, order, shares_of(limit, threshold, width))
        for tree, order, limit in zip(trees, orders, limits, strict=True)
    ]
    return [node for node, _ in blended], [weight for _, weight in blended], threshold


def limits_of(nodes: np.ndarray, tree: LodTree, order: np.ndarray, view: np.void) -> np.ndarray:
    """The least pixel scale on the path from the root to each inner node."""
    path = np.full(len(tree), np.inf)
    for node in order:
        own = number_of(bits_of(pixel_scale(nodes[node], view)))
        path[node] = min(path[node], math.inf if math.isnan(own) else own)
        start = int(tree.child_start[node])
        path[start : start + int(tree.child_count[node])] = path[node]
    return np.minimum(path[order], np.finfo(np.float32).max)


def shares_of(limit: np.ndarray, threshold: float, width: float) -> np.ndarray:
    """The shares by which nodes are refined."""
    with np.errstate(divide="ignore"):
        if not threshold:
            return (limit > 0).astype(np.float64)
        return smoothstep(np.log(limit / threshold) / math.log(width))


def smoothstep(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)


def find_threshold(limit: np.ndarray, more: np.ndarray, room: int, width: float) -> float:
    """The threshold at which the shares add `room` to the sum of weights, by 40 bisections."""
    order = np.argsort(-limit, kind="stable")
    total = np.cumsum(more[order])
    over = int(np.searchsorted(total, room, side="right"))
    if over == len(order) or not limit[order[over]]:
        return 0.0
    most = float(limit[order[over]])
    undecided = (limit * width > most) & (limit < most * width)
    room -= int(more[limit >= most * width].sum())
    places, adds = np.log(limit[undecided] / most) / math.log(width), more[undecided]
    low, high = -1.0, 0.0
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if adds @ smoothstep(places - middle) > room else (low, middle)
    return most * float(width**high)


def blend(tree: LodTree, order: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nodes with a weight above 0, ascending, and their weights."""
    weight = np.zeros(len(tree))
    weight[0] = 1
    own = np.zeros(len(tree))
    own[order] = share
    for node in order[share > 0]:
        start = int(tree.child_start[node])
        weight[start : start + int(tree.child_count[node])] = own[node]
    weight -= own
    drawn = np.flatnonzero(weight > 0)
    return drawn, weight[drawn]


def dynamic_limit(nodes_at: Callable[[float], int], budget: int, smallest: float) -> float:
    """The pixel scale above which Spark's dynamic traversal refines all nodes, whether or not they fit the budget.

    It goes down from 100 times the pixel-scale limit, in steps that shrink as the cut nears the budget, and ends with
    the first cut that reaches it.

    Args:
        nodes_at: number of nodes of the cut of all nodes above a pixel scale.
        budget: of the viewer.
        smallest: the pixel-scale limit.
    """
    least, scale = np.float32(smallest), np.float32(smallest) * np.float32(100)
    while True:
        count = nodes_at(float(scale))
        step = np.float32(0.99) * scale * np.sqrt(np.float32(count) / np.float32(budget))
        following = max(max(step, np.float32(0.5) * scale), least)
        if following == scale or count >= budget:
            return float(scale)
        scale = following
