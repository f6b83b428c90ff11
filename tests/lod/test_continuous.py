"""Laws of continuous cuts: weights sum to one on every way to a leaf, do not jump, and become those of the cut."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.lod.kernels.pixel_scale import pixel_scales
from sparklod_cli.model.foveation import Cones
from sparklod_cli.model.gaussian import lod_opacity
from sparklod_cli.viewers.continuous import BlendedCut, ContinuousCuts, faded, find_threshold, shares
from sparklod_cli.viewers.loaded_scene import Forest, TreeInstance
from sparklod_cli.viewers.spark import SparkViewer
from tests.lod.trees import Case, CutView, cases, children, drawn, random_tree, transform, view_from
from tests.references import cuts as references

WIDTHS = (1.05, 1.25, 2.0)
SPARK = Cones(90, 120, 0.4, 0.2)


def weights_of(case: Case, cut: BlendedCut) -> list[np.ndarray]:
    """Of each instance, the weight of every node of its tree."""
    weights = [np.zeros(len(case.tree(instance))) for instance in case.instances]
    for instance, node, weight in zip(cut.instance, cut.node, cut.weight, strict=True):
        assert weights[instance][node] == 0  # no node comes twice
        weights[instance][node] = weight
    return weights


def sums_to_leaves(case: Case, weights: list[np.ndarray]) -> Iterator[float]:
    """Of each leaf of each instance, the sum of the weights on the way to it."""
    for instance, of_nodes in zip(case.instances, weights, strict=True):
        tree = case.tree(instance)
        total = of_nodes.copy()
        for node in np.flatnonzero(tree.child_count):
            total[children(tree, node)] += total[node]
        yield from total[tree.is_leaf]


def some_case(seed: int, count: int = 400, foveation: Cones = SPARK) -> Case:
    """A tree twice."""
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, count, 5)
    instances = [TreeInstance(0, np.eye(4), 1.0, foveation), TreeInstance(0, transform(rng, spread=4), 0.7, foveation)]
    return Case([tree], instances, view_from(0.3, -0.2, 6.0), count // 2)


def blended(case: Case, width: float) -> BlendedCut:
    return ContinuousCuts(case.viewer()).cut(case.view, budget=case.budget, smallest=case.smallest, width=width)


@given(st.one_of(cases(), st.integers(0, 2).map(lambda seed: some_case(seed, 6000))), st.sampled_from(WIDTHS))
def test_the_cut_is_that_of_numpy_to_the_last_bit(case: Case, width: float) -> None:
    cut, viewer = blended(case, width), case.viewer()
    sizes = [len(case.tree(instance)) for instance in case.instances]
    views = viewer.cut(case.view, budget=len(case.instances)).views
    nodes, weights, threshold = references.continuous_cut(
        viewer.forest.nodes, views, sizes, case.budget, case.smallest, width
    )
    assert cut.threshold == threshold
    assert cut.node.tolist() == np.concatenate(nodes).tolist()
    assert cut.weight.tolist() == np.concatenate(weights).tolist()
    assert np.bincount(cut.instance, minlength=len(nodes)).tolist() == [len(each) for each in nodes]


@given(cases(), st.sampled_from(WIDTHS))
def test_weights_are_shares_that_sum_to_one_on_every_way_to_a_leaf_and_keep_the_budget(
    case: Case, width: float
) -> None:
    cut = blended(case, width)
    assert ((cut.weight > 0) & (cut.weight <= 1)).all()
    assert cut.threshold >= case.smallest
    assert cut.weight.sum() <= case.budget * (1 + 1e-9)
    np.testing.assert_allclose(list(sums_to_leaves(case, weights_of(case, cut))), 1)


@given(cases(), st.sampled_from(WIDTHS))
def test_with_a_large_budget_all_leaves_have_weight_one(case: Case, width: float) -> None:
    case = dataclasses.replace(case, budget=case.most, smallest=0.0)
    cut = blended(case, width)
    assert set(drawn(cut)) == set(drawn(case.find()))
    assert (cut.weight == 1).all()


@pytest.mark.parametrize("seed", range(8))
def test_without_a_range_to_fade_in_it_is_the_ordinary_cut(seed: int) -> None:
    case = some_case(seed)
    ordinary, cut = case.find(), blended(case, 1 + 1e-9)
    # Both refine in the same order; the node that does not fit is refined by a share here, and not at all there.
    assert ordinary.stop is not None
    _, instance, node = ordinary.stop
    tree = case.trees[0].tree
    partly = {(instance, node), *((instance, child) for child in np.arange(len(tree))[children(tree, node)].tolist())}
    whole = {each for each, weight in zip(drawn(cut), cut.weight, strict=True) if weight == pytest.approx(1)}
    nodes = set(drawn(ordinary))
    assert whole - partly == nodes - partly
    assert len(nodes) > 100


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("seed", range(3))
def test_weights_move_no_faster_than_pixel_scales(width: float, seed: int) -> None:
    case = some_case(seed)
    cuts = ContinuousCuts(case.viewer())
    before = scales = None
    changed = 0
    for step in range(60):
        view = view_from(0.3, -0.2, 6.0 - 0.004 * step**1.5)
        cut = cuts.cut(view, budget=case.budget, width=width)
        weights, now = np.concatenate(weights_of(case, cut)), log_scales(case, view)
        if before is not None:
            bound = 6 * np.abs(now - scales).max() / math.log(width)
            change = np.abs(weights - before)
            assert change.max() <= bound + 1e-5  # pixel scales are float32
            changed += int((change > 0).sum())
        before, scales = weights, now
    assert changed > 1000  # there was something to see


def log_scales(case: Case, view: CutView) -> np.ndarray:
    """Logarithms of the pixel scales of the nodes with children, of all instances."""
    scales = []
    for instance in case.instances:
        nodes = case.trees[instance.tree]
        place = SparkViewer(Forest(case.trees), [instance])
        inner = np.flatnonzero(nodes.tree.child_count)
        found = np.empty(len(inner), np.float32)
        first = place.forest.node_base[instance.tree]
        pixel_scales(place.forest.nodes[first:], inner, place.cut(view, budget=1).views, 0, found)
        scales.append(found)
    return np.log(np.concatenate(scales).astype(np.float64))


@given(
    st.lists(st.tuples(st.sampled_from([0.0, 0.5, 1.0, 1.01, 1.5, 2.0, 7.0, 1e30]), st.integers(0, 5)), max_size=30),
    st.integers(0, 60),
    st.sampled_from(WIDTHS),
)
def test_the_threshold_uses_the_budget_and_no_more(nodes: list[tuple[float, int]], room: int, width: float) -> None:
    limit = np.array([node[0] for node in nodes], np.float32)
    more = np.array([node[1] for node in nodes], np.int64)
    threshold = find_threshold(limit, more, room, width)
    used = float(more @ shares(limit, threshold, width)) if len(nodes) else 0.0
    assert used <= room + 1e-6
    assert used == pytest.approx(min(room, more[limit > 0].sum()), abs=1e-6)


def test_fading_is_even_in_d_and_ends_at_the_splat_itself() -> None:
    opacity = np.array([0.01, 0.5, 1.0, 1.0001, 3.0, 1000.0], np.float32)
    np.testing.assert_array_equal(faded(opacity, np.ones(6)), opacity)
    np.testing.assert_array_equal(faded(opacity, np.zeros(6)), 0)
    for weight in (1e-3, 0.25, 0.5, 0.999, 1 - 1e-9):
        np.testing.assert_allclose(lod_opacity(faded(opacity, np.full(6, weight))), weight * lod_opacity(opacity), 1e-5)


@given(cases())
def test_at_a_threshold_the_cut_is_that_of_all_larger_nodes(case: Case) -> None:
    """Without a budget, the nodes far above the limit are divided, and none below it."""
    case = dataclasses.replace(case, budget=case.most, smallest=0.5)
    fine, coarse = (set(drawn(dataclasses.replace(case, smallest=limit).find())) for limit in (0.5, 0.5 * 1.25))
    assert fine & coarse <= set(drawn(blended(case, 1.25)))


@given(cases())
def test_pixel_scales_are_those_of_the_traversal(case: Case) -> None:
    traversal = case.viewer()
    views = traversal.cut(case.view, budget=len(case.instances)).views
    nodes = traversal.forest.nodes
    for number, view in enumerate(views):
        some = nodes[view["node_base"] : view["node_base"] + 20]
        found = np.empty(len(some), np.float32)
        pixel_scales(some, np.arange(len(some)), views, number, found)
        expected = [references.number_of(references.bits_of(references.pixel_scale(node, view))) for node in some]
        np.testing.assert_array_equal(found, np.array([math.inf if math.isnan(e) else e for e in expected], np.float32))
