"""Nodes in a box."""

from __future__ import annotations

import numpy as np

from sparklod_cli.lod.kernels.group import split_box
from sparklod_cli.lod.kernels.pair_cost import CENTER, WIDTH


def test_nodes_are_split_by_a_box_without_its_faces() -> None:
    axis = np.float32([-1, 0, 1, 2])
    geometry = np.zeros((64, WIDTH), np.float32)
    geometry[:, CENTER : CENTER + 3] = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    nodes = np.random.default_rng(0).permutation(64).astype(np.uint32)
    below, above = np.float32([-1, -np.inf, 0]), np.float32([2, 1, np.inf])
    inside, outside = split_box(nodes, geometry, below, above)
    center = geometry[nodes, CENTER : CENTER + 3]
    expected = ((center > below) & (center < above)).all(axis=1)
    assert inside.tolist() == nodes[expected].tolist()
    assert outside.tolist() == nodes[~expected].tolist()
    assert 0 < len(inside) < 64
