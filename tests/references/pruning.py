"""A slow, obvious twin of the kernel that prunes: it looks at every node in every round."""

from __future__ import annotations

import numpy as np

from sparklod_cli.lod.kernels import prune
from sparklod_cli.model.lod_tree import MAX_CHILDREN


def drop_nodes(
    leaves: int,
    most: int,
    parent: np.ndarray,
    log_size: np.ndarray,
    lost: np.ndarray,
    weight: np.ndarray,
    saved: np.ndarray,
) -> None:
    """As `pair_tree.drop_nodes`."""
    root = len(parent) - 1 - leaves
    left, turn, children = root + 1, prune.ROUNDS, prune.MOST_CHILDREN

    def above(node: int) -> int:
        return int(parent[node + leaves]) - leaves

    def is_candidate(node: int) -> bool:
        return bool(saved[node] > 0 and saved[above(node)] + saved[node] < children)

    def key(node: int) -> int:
        span = log_size[parent[node + leaves]] - log_size[node + leaves]
        span = prune.UNKNOWN_SPAN if span > prune.ABOVE_ALL / 2 else span
        useful = span * (np.float32(saved[node]) - lost[node]) * weight[node]
        return int(prune.usefulness_key(np.float32(useful)))

    while left > most:
        keys = sorted(key(node) for node in range(root) if is_candidate(node))
        if not keys:
            if children == MAX_CHILDREN:
                return
            children = min(2 * children, MAX_CHILDREN)
            continue
        threshold = keys[min(max((left - most) // turn, 1), len(keys)) - 1]
        for node in range(root):
            if left > most and is_candidate(node) and key(node) <= threshold:
                saved[above(node)] += saved[node]
                lost[above(node)] += lost[node]
                saved[node], left = -1, left - 1
        for any_node in range(len(parent) - 2, -1, -1):
            if saved[parent[any_node] - leaves] == -1:
                parent[any_node] = parent[parent[any_node]]
        turn = max(turn - 1, 1)
