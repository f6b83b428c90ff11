"""The final order of nodes, and colours that follow it."""

from __future__ import annotations

import numpy as np

from sparklod_cli.lod.kernels.final_order import merge_colors


def test_colours_are_weighted_means_of_children() -> None:
    rng = np.random.default_rng(3)
    color, weight = rng.normal(size=(9, 5)).astype(np.float32), rng.uniform(0.1, 2, 9)
    order = rng.permutation(9).astype(np.uint32)
    start, count = np.array([1, 4, 0, 6, 0, 0, 0, 0, 0], np.uint32), np.array([3, 2, 0, 3, 0, 0, 0, 0, 0], np.uint16)
    expected = color.copy()
    for node in (1, 3):
        part = slice(start[node], start[node] + count[node])
        expected[node] = np.average(color[part].astype(np.float64), axis=0, weights=weight[order[part]])
    merge_colors(np.array([1, 3], np.uint32), start, count, order, weight, color, 2)
    assert np.allclose(color, expected, atol=1e-6)
