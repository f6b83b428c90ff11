"""The budgeted cut against one plain queue, and the laws of cuts."""

from __future__ import annotations

import dataclasses
import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.model.foveation import Cones, Frustum
from sparklod_cli.model.lod_tree import CHUNK_NODES, Nodes
from sparklod_cli.viewers.cut import Forest, TreeInstance, views_of
from sparklod_cli.viewers.spark import VISITS
from sparklod_cli.viewers.viewer_settings import pixel_limit
from tests.lod.forests import Case, ancestors_drawn, cases, check, drawn, links, random_tree, transform, views
from tests.lod.sights import CutView
from tests.references import budgeted_cuts

#: Pixel scales at which nothing happens, something does, and everything does.
LIMITS = (0.0, 0.02, 0.3)


@given(cases())
@settings(max_examples=400)
@pytest.mark.slow
def test_the_cut_is_that_of_one_queue(case: Case) -> None:
    check(case, case.find())


@given(cases(), st.data())
def test_nodes_no_larger_than_the_limit_are_not_refined(case: Case, data: st.DataObject) -> None:
    """The limit is exactly a node's pixel scale."""
    found = case.traversal()
    sight = views_of(found.forest, case.instances, case.view)
    number = data.draw(st.integers(0, len(sight) - 1))
    node = data.draw(st.integers(0, len(case.trees[case.instances[number].tree].size) - 1))
    smallest = float(budgeted_cuts.pixel_scale(found.forest.nodes[sight[number]["node_base"] + node], sight[number]))
    case = dataclasses.replace(case, smallest=smallest)
    check(case, case.find(found))


@given(cases(), st.data())
def test_earlier_cuts_do_not_change_a_cut(case: Case, data: st.DataObject) -> None:
    found = case.traversal()
    for _ in range(data.draw(st.integers(2, 5))):
        budget = data.draw(st.integers(len(case.instances), case.most + 3))
        smallest = data.draw(st.sampled_from([*LIMITS, math.inf]))
        case = dataclasses.replace(case, view=data.draw(views(case.trees)), budget=budget, smallest=smallest)
        check(case, case.find(found))


@given(cases(), st.data())
def test_nan_and_infinity_give_a_cut(case: Case, data: st.DataObject) -> None:
    """NaN counts as more than infinity, as in Spark; what comes of it is a cut."""
    bad = st.sampled_from([math.nan, math.inf, -math.inf, 65504.0, 3e38, 1e-45])
    for tree in case.trees:
        for node in data.draw(st.lists(st.integers(0, len(tree.size) - 1), max_size=4)):
            if data.draw(st.booleans()):
                tree.size[node] = abs(data.draw(bad))
            else:
                tree.center[node, data.draw(st.integers(0, 2))] = data.draw(bad)
    cut = case.find()
    check(case, cut)
    check_laws(case, cut.indices())


def check_laws(case: Case, indices: list[np.ndarray]) -> None:
    """Every leaf is drawn once, by itself or by a node above it; there are no more than may be."""
    assert sum(map(len, indices)) <= case.budget
    for instance, nodes in zip(case.instances, indices, strict=True):
        tree = case.trees[instance.tree].tree
        assert (ancestors_drawn(tree, nodes)[tree.is_leaf] == 1).all()


@given(cases())
def test_every_leaf_is_drawn_once(case: Case) -> None:
    check_laws(case, case.find().indices())


@given(cases(), st.data())
def test_more_budget_is_never_coarser(case: Case, data: st.DataObject) -> None:
    found = case.traversal()
    finer = dataclasses.replace(case, budget=data.draw(st.integers(case.budget, case.most + 3)))
    lower = dataclasses.replace(case, smallest=case.smallest * data.draw(st.floats(0, 1)) if case.smallest else 0.0)
    coarse = case.find(found).indices()
    for other in (finer, dataclasses.replace(lower, budget=case.most)):
        for instance, before, after in zip(case.instances, coarse, other.find(found).indices(), strict=True):
            assert (ancestors_drawn(case.trees[instance.tree].tree, before)[after] == 1).all()


@given(cases())
def test_enough_budget_draws_all_leaves_that_can_be_seen(case: Case) -> None:
    case = dataclasses.replace(case, budget=case.most, smallest=0.0)
    cut = case.find()
    assert cut.reason in ("exhausted", "pixel")
    if cut.reason == "exhausted":
        for instance, nodes in zip(case.instances, cut.indices(), strict=True):
            np.testing.assert_array_equal(nodes, np.flatnonzero(case.trees[instance.tree].tree.is_leaf))


def large_case(seed: int, *, nodes: int = 150_000, instances: int = 3) -> Case:
    rng = np.random.default_rng(seed)
    trees = [random_tree(rng, nodes, 5), random_tree(rng, nodes // 3, 2)]
    foveations = (Cones(90, 120, 0.4, 0.2), Frustum(0.3, 0.1), Cones())
    placed = [
        TreeInstance(
            number % 2, transform(rng, scale=rng.uniform(0.5, 2), spread=2.0), 1.0 + number, foveations[number]
        )
        for number in range(instances)
    ]
    return Case(trees, placed, CutView(transform(rng, spread=4.0), math.radians(80), math.radians(60)), 10_000, 0.0)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.slow
def test_the_cut_of_large_trees_is_that_of_one_queue(seed: int) -> None:
    case = large_case(seed)
    found = case.traversal()
    for budget, smallest in [(3, 0.0), (20_000, 0.0), (1_000, 0.0), (20_000, pixel_limit(math.radians(60), 100))]:
        case = dataclasses.replace(case, budget=budget, smallest=smallest)
        check(case, case.find(found))


def test_threads_can_share_a_traversal() -> None:
    case, rng = large_case(9), np.random.default_rng(9)
    found = case.traversal()
    asked = [
        dataclasses.replace(
            case,
            view=CutView(transform(rng, spread=4.0), 1.4, 1.0),
            budget=int(rng.integers(3, 80_000)),
            smallest=limit,
        )
        for limit in LIMITS * 14
    ]
    alone = [sorted(drawn(each.find())) for each in asked]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda each: each.find(found), asked))
    assert [sorted(drawn(cut)) for cut in together] == alone


@pytest.mark.parametrize("ends", [1, 2, 3])
def test_chains_longer_than_the_buffers_are_traversed(ends: int) -> None:
    """A node of one child adds nothing, so no budget bounds how many are looked at."""
    length = 4 * CHUNK_NODES
    assert length > VISITS * ends + CHUNK_NODES
    tree = links([1] * length + ([ends] + [1] * ends * 1000 if ends > 1 else []))
    rng = np.random.default_rng(ends)
    size = rng.uniform(0.5, 1, len(tree)).astype(np.float32)
    case = Case([Nodes(np.zeros((len(tree), 3), np.float32), size, tree)], [TreeInstance()], seen_from(2.0), ends, 0.0)
    found = case.traversal()
    for budget in (ends, 1, ends):
        cut = dataclasses.replace(case, budget=budget).find(found)
        stopped = [length] if ends > 1 and budget == 1 else range(len(tree) - ends, len(tree))
        assert sorted(cut.node.tolist()) == list(stopped)
        assert cut.reason == ("budget" if ends > 1 and budget == 1 else "exhausted")


def seen_from(distance: float) -> CutView:
    """A camera that looks at the origin."""
    camera = np.eye(4)
    camera[2, 3] = distance
    return CutView(camera, 1.4, 1.0)


def test_a_tree_as_long_as_the_buffers_is_cut_as_by_one_queue() -> None:
    """Where the buffers are as long as the tree: by the threshold, then by the queue."""
    tree = links([2, 2, 2])
    size = np.array([1, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5], np.float32)
    case = Case([Nodes(np.zeros((7, 3), np.float32), size, tree)], [TreeInstance()], seen_from(5.0), 3, 0.0)
    cut = case.find()
    check(case, cut)
    assert sorted(cut.node.tolist()) == [1, 5, 6]


def test_many_children_and_many_instances_are_traversed() -> None:
    tree = links([65535])
    rng = np.random.default_rng(0)
    center = rng.normal(size=(65536, 3)).astype(np.float32)
    instances = [TreeInstance(object_to_world=transform(rng)) for _ in range(300)]
    case = Case([Nodes(center, np.ones(65536, np.float32), tree)], instances, seen_from(20.0), 65534 + 300, 0.0)
    cut = case.find()
    assert len(cut) == 300 + 65534
    assert cut.reason == "budget"
    assert np.count_nonzero(cut.node == 0) == 299
    assert len(dataclasses.replace(case, budget=65533 + 300).find()) == 300


@given(st.integers(0, 2**32 - 1), st.sampled_from([Cones(), Cones(90, 120, 0.4, 0.2), Frustum(0.5, 0.25)]))
def test_pixel_scales_are_those_of_the_world(seed: int, foveation: Cones | Frustum) -> None:
    """An instance is seen in its own space, which comes to the same but for rounding."""
    rng = np.random.default_rng(seed)
    scale = rng.uniform(0.2, 5)
    placed = TreeInstance(0, transform(rng, scale=scale), rng.uniform(0.5, 2), foveation)
    view = CutView(transform(rng, spread=3.0), 1.4, 1.0)
    tree = random_tree(rng, 50, 3)
    forest = Forest([tree])
    (sight,) = views_of(forest, [placed], view)
    camera = np.linalg.inv(view.camera_to_world) @ placed.object_to_world
    x, y, z = camera[:3, :3] @ tree.center.T.astype(np.float64) + camera[:3, 3:]
    distance = np.sqrt(x * x + y * y + z * z)
    if isinstance(foveation, Cones):
        angles = [0, foveation.fov0 / 2, max(foveation.fov0, foveation.fov) / 2, 90]
        cosines = np.cos(np.radians(angles))[::-1]
        if foveation.fov0:
            weights = [foveation.behind, foveation.foveate, 1, 1]
            weight = np.where(z < 0, np.interp(-z / distance, cosines, weights), foveation.behind)
        else:
            weight = np.ones(len(z))
    else:
        seen = (abs(x) <= np.tan(view.fov_x / 2) * -z) & (abs(y) <= np.tan(view.fov_y / 2) * -z)
        weight = np.where(z < 0, np.where(seen, 1, foveation.outside), foveation.behind)
    expected = scale * tree.size / distance * placed.lod_scale * weight
    got = np.array([budgeted_cuts.pixel_scale(node, sight) for node in forest.nodes])
    # One in a thousand lies on an edge, where it falls to the other side.
    assert np.count_nonzero(~np.isclose(got, expected, rtol=1e-4)) <= 1


def test_the_pixel_limit_is_a_pixels_size_at_distance_1() -> None:
    """At distance 1 the picture is 2 * tan(fov_y / 2) high."""
    assert pixel_limit(math.radians(90), 1000) == pytest.approx(2 / 1000)
    assert pixel_limit(math.radians(60), 1080, 2.0) == pytest.approx(2 * pixel_limit(math.radians(60), 1080))
