"""Rows of nodes: of leaves, of merged nodes, and their keys."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.lod.kernels import geometry, node_rows, pair_merge
from sparklod_cli.lod.kernels.geometry import SplatColumns
from sparklod_cli.lod.kernels.node_rows import merge_colors
from sparklod_cli.lod.kernels.pair_merge import CENTER, COLOR, COVERED, DENSITY, WEIGHT
from sparklod_cli.model.gaussian import spark_size
from tests.references import gaussians
from tests.references import quality as twin
from tests.scenes import random_splats


def test_rows_of_leaves_are_their_splats_in_units() -> None:
    splats = random_splats(100, seed=9)
    index = np.random.default_rng(1).permutation(100).astype(np.uint32)
    rows = np.zeros((120, pair_merge.WIDTH), np.float32)
    middle, unit = np.array([0.5, -1.0, 2.0]), 2.0**-6
    columns = SplatColumns(splats.center, splats.scale, splats.quat_xyzw, splats.opacity)
    size = np.zeros(120, np.float32)
    node_rows.fill_leaf_rows(100, index, columns, splats.rgb, node_rows.Space(middle, unit), rows, size)
    assert not rows[100:].any() and not size[100:].any()
    np.testing.assert_allclose(size[:100] * unit, spark_size(splats)[index], rtol=1e-5)
    for row, i in zip(rows, index, strict=False):
        np.testing.assert_allclose(row[CENTER : CENTER + 3] * unit + middle, splats.center[i], atol=1e-5)
        covariance = gaussians.covariance(splats.scale[i], splats.quat_xyzw[i]) / unit**2
        np.testing.assert_allclose(twin.matrix(row), covariance, atol=1e-5 * np.trace(covariance))
        area = gaussians.ellipsoid_area(splats.scale[i]) / unit**2
        assert row[COVERED] == row[WEIGHT] == pytest.approx(splats.opacity[i] * area, rel=1e-5)
        assert row[DENSITY] == splats.opacity[i]
        assert np.array_equal(row[COLOR : COLOR + 3], splats.rgb[i])


def test_merged_nodes_are_drawn_with_the_variance_and_coverage_of_their_rows() -> None:
    rows = twin.random_rows(100, seed=10)
    rows[:, DENSITY] = np.geomspace(0.01, 5, 100)
    order = np.random.default_rng(2).permutation(100).astype(np.uint32)
    middle, unit = np.array([0.5, -1.0, 2.0]), 2.0**-6
    out = random_splats(100, seed=11)
    before = out.take(np.arange(100))
    space, columns = node_rows.Space(middle, unit), (out.center, out.scale, out.quat_xyzw, out.opacity)
    row = np.random.default_rng(3).permutation(60).astype(np.uint32)  # of nodes 40 to 99
    node_rows.fill_merged_splats(100, order, 40, row, rows, space, *columns)
    for i, node in enumerate(order):
        if node < 40:  # a leaf
            assert np.array_equal(out.center[i], before.center[i])
            assert out.opacity[i] == before.opacity[i]
            continue
        drawn = rows[row[node - 40]]
        np.testing.assert_allclose(out.center[i], drawn[CENTER : CENTER + 3] * unit + middle, rtol=1e-5)
        opacity, spread = geometry.profile_of(
            float(drawn[DENSITY]), geometry.is_needle(*np.linalg.eigvalsh(twin.matrix(drawn)))
        )
        assert out.opacity[i] == pytest.approx(opacity)
        covariance = twin.matrix(drawn) * unit**2 / spread
        got = gaussians.covariance(out.scale[i], out.quat_xyzw[i])
        np.testing.assert_allclose(got, covariance, atol=1e-5 * np.trace(covariance))


def test_keys_are_places_on_a_morton_curve_and_what_is_outside_is_at_its_edge() -> None:
    rows = twin.random_rows(100, seed=12)
    low, step = np.array([-1.0, -1.5, -2.0]), 1e-3
    nodes = np.arange(100, dtype=np.uint32)[::-1].copy()
    most = (1 << node_rows.CURVE_BITS) - 1
    cells = np.clip((rows[nodes, CENTER : CENTER + 3].astype(np.float64) - low) / step, 0, most).astype(int)
    expected = [
        sum(
            ((int(axis) >> bit) & 1) << (3 * bit + k)
            for k, axis in enumerate(cell)
            for bit in range(node_rows.CURVE_BITS)
        )
        for cell in cells
    ]
    keys = np.empty(100, np.uint64)
    node_rows.fill_morton_keys(100, rows, nodes, low, step, keys)
    assert keys.tolist() == expected


def test_colours_are_weighted_means_of_children() -> None:
    rng = np.random.default_rng(3)
    color, weight = rng.normal(size=(9, 5)).astype(np.float32), rng.uniform(0.1, 2, 9)
    order = rng.permutation(9).astype(np.uint32)
    start, count = np.array([1, 4, 0, 6, 0, 0, 0, 0, 0], np.uint32), np.array([3, 2, 0, 3, 0, 0, 0, 0, 0], np.uint16)
    expected = color.copy()
    for node in (1, 3):
        part = slice(start[node], start[node] + count[node])
        expected[node] = np.average(color[part].astype(np.float64), axis=0, weights=weight[order[part]])
    merge_colors(2, np.array([1, 3], np.uint32), start, count, order, weight, color)
    assert np.allclose(color, expected, atol=1e-6)
