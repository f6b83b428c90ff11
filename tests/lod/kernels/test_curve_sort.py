"""Sorting nodes along a Morton curve, against numpy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.lod.kernels import node_rows
from sparklod_cli.lod.kernels.curve_sort import sort_along_curve

LOW, STEP = np.array([-1.0, -2.0, -1.5]), 4 / (1 << node_rows.CURVE_BITS)


def check(rows: np.ndarray, row: np.ndarray, nodes: np.ndarray, threads: int) -> None:
    leaves = len(rows)
    at = np.where(nodes < leaves, nodes, row[np.maximum(nodes.astype(np.int64) - leaves, 0)]).astype(np.uint32)
    order = np.argsort(node_rows.morton_keys(rows, at, LOW, STEP), kind="stable")
    found, rows_of = sort_along_curve(rows, row, leaves, nodes, LOW, STEP, threads)
    assert np.array_equal(found, nodes[order])
    assert np.array_equal(rows_of, at[order])


@given(st.integers(1, 400), st.integers(1, 9), st.floats(1e-4, 3), st.integers(0, 2**32 - 1))
@settings(max_examples=60)
def test_nodes_are_sorted_stably_by_their_places(count: int, threads: int, spread: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = rng.normal(0, spread, (count, 3)).astype(np.float32)
    rows[: count // 3] = rows[0]  # all in one place
    row = rng.permutation(count).astype(np.uint32)
    nodes = rng.permutation(2 * count).astype(np.uint32)[: int(rng.integers(0, 2 * count))]
    check(rows, row, nodes, threads)


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_parts_of_many_nodes(threads: int) -> None:
    rows = np.random.default_rng(1).normal(0, 0.5, (50_000, 16)).astype(np.float32)
    check(rows, np.zeros(1, np.uint32), np.arange(50_000, dtype=np.uint32), threads)
