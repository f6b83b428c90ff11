"""Spark's dynamic traversal, which is fast and keeps to the budget roughly: the reference that its cuts are held to."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


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
