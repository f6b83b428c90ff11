"""Finds continuous cuts by plain numpy: inner nodes depth by depth, all of them sorted by their limits."""

from __future__ import annotations

import math

import numpy as np

from sparklod_cli.model.lod_tree import LodTree
from tests.references import budgeted_cuts


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
        blend(tree, order, shares(limit, threshold, width))
        for tree, order, limit in zip(trees, orders, limits, strict=True)
    ]
    return [node for node, _ in blended], [weight for _, weight in blended], threshold


def limits_of(nodes: np.ndarray, tree: LodTree, order: np.ndarray, view: np.void) -> np.ndarray:
    """The least pixel scale on the path from the root to each inner node."""
    path = np.full(len(tree), np.inf)
    for node in order:
        own = budgeted_cuts.number_of(budgeted_cuts.bits_of(budgeted_cuts.pixel_scale(nodes[node], view)))
        path[node] = min(path[node], math.inf if math.isnan(own) else own)
        start = int(tree.child_start[node])
        path[start : start + int(tree.child_count[node])] = path[node]
    return np.minimum(path[order], np.finfo(np.float32).max)


def shares(limit: np.ndarray, threshold: float, width: float) -> np.ndarray:
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
