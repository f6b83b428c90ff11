"""The order in which detail levels refine nodes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sparklod_cli.lod import quality, quick
from sparklod_cli.lod.detail_order import SIBLINGS, losses, picture_errors
from sparklod_cli.lod.kernels.tree_links import find_parents
from sparklod_cli.lod.plain_opacity import with_plain_opacity
from sparklod_cli.model.gaussian import covariance, spark_size
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.splats import Splats
from tests.lod.trees import children, hard_cases
from tests.scenes import random_splats

STEPS = np.linspace(-6, 6, 241)


def picture(splats: Splats, axes: tuple[int, int], middle: np.ndarray, unit: float) -> np.ndarray:
    """The sum of splats on a plane, (y, x, red green blue and opacity), from the densities of 2D Gaussians."""
    x, y = (middle[axis] + unit * STEPS for axis in axes)
    full = np.zeros((3, 3, len(splats)))
    full[np.triu_indices(3)] = covariance(splats.scale, splats.quat_xyzw).T
    total = np.zeros((len(STEPS), len(STEPS), 4))
    for at in range(len(splats)):
        shape = (full[:, :, at] + np.triu(full[:, :, at], 1).T)[np.ix_(axes, axes)]
        away = np.stack(np.meshgrid(x - splats.center[at, axes[0]], y - splats.center[at, axes[1]]), axis=-1)
        high = np.exp(-0.5 * np.einsum("yxi,ij,yxj->yx", away, np.linalg.inv(shape), away)) * splats.opacity[at]
        total += high[:, :, None] * np.append(splats.rgb[at], 1)
    return total


@pytest.mark.parametrize("count", [2, 3, 7])
def test_picture_errors_are_those_of_pictures(count: int) -> None:
    near = random_splats(count, seed=count)
    rng = np.random.default_rng(count)
    near = dataclasses.replace(
        near,
        center=rng.normal(0, 0.02, (count, 3)).astype(np.float32),
        scale=rng.uniform(0.01, 0.03, (count, 3)).astype(np.float32),
    )
    nodes, tree = quick.build(near, 2.0)
    plain = with_plain_opacity(nodes)
    parent, _ = find_parents(tree.child_count, tree.child_start)
    found = picture_errors(plain, parent)
    for node in range(len(tree)):
        expected = 0.0
        if tree.child_count[node]:
            own = plain.take(slice(node, node + 1))
            unit = 2 * float(max(own.scale.max(), 0.03))
            for axes in ((0, 1), (0, 2), (1, 2)):
                pictures = [
                    picture(some, axes, own.center[0], unit) for some in (own, plain.take(children(tree, node)))
                ]
                step = unit * (STEPS[1] - STEPS[0])
                expected += float(((pictures[0] - pictures[1]) ** 2).sum()) * step * step / (3 * np.pi)
        np.testing.assert_allclose(found[node], expected, rtol=2e-3)


@pytest.mark.parametrize("growth", [1.1, 2.0])
@pytest.mark.parametrize(("sigma", "power"), [(None, 1.0), (0.0, 0.0), (0.15, 0.5)])
def test_losses_grow_towards_the_root_with_error_size_and_leaves(
    growth: float, sigma: float | None, power: float
) -> None:
    """Leaves count by as much as their sizes differ, which those of random splats do."""
    splats = random_splats(300, seed=1)
    if sigma is not None:
        logs = np.random.default_rng(1).normal(size=(300, 1))
        splats.scale[:] = 0.05 * np.exp(sigma * (logs - logs.mean()) / logs.std())
    nodes, tree = quality.build(splats, growth)
    parent, _ = find_parents(tree.child_count, tree.child_start)
    found = losses(nodes, tree, parent)
    error = np.sqrt(picture_errors(with_plain_opacity(nodes), parent))
    leaves, expected = np.zeros(len(tree)), np.zeros(len(tree))
    for node in range(len(tree) - 1, -1, -1):
        if not tree.child_count[node]:
            leaves[node] = 1
            continue
        below = children(tree, node)
        leaves[node] = leaves[below].sum()
        own = error[node] * float(spark_size(nodes)[node]) * leaves[node] ** power
        expected[node] = max(own, expected[below].max())
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert leaves[0] == 300


def test_children_far_apart_in_the_list_count_as_apart() -> None:
    count = SIBLINGS + 2
    same = random_splats(1, seed=2).take(np.zeros(count, np.int64))
    wide = dataclasses.replace(same, scale=same.scale * 0)
    nodes = Splats.concat([wide.take(slice(0, 1)), same])
    tree = LodTree(np.array([count] + [0] * count, np.uint16), np.array([1] + [0] * count, np.uint32))
    parent, _ = find_parents(tree.child_count, tree.child_start)
    one = picture_errors(Splats.concat([nodes.take(slice(0, 2))]), parent[:2])[0]
    pairs = count * count - 2  # all but those of the first and the last child
    np.testing.assert_allclose(picture_errors(nodes, parent)[0], pairs * one, rtol=1e-5)


@pytest.mark.parametrize("name", hard_cases())
def test_losses_are_numbers(name: str) -> None:
    nodes, tree = quality.build(hard_cases()[name], 2.0)
    parent, _ = find_parents(tree.child_count, tree.child_start)
    found = losses(nodes, tree, parent)
    assert not np.isnan(found).any()
    assert (found[1:] <= found[parent[1:]]).all()
