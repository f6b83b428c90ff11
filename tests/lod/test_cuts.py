"""Budgeted cuts of trees, whole or with missing chunks, beside one plain queue; and the statistics of cuts."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.codecs import spark_nodes
from sparklod_cli.codecs.spark_nodes import Nodes
from sparklod_cli.model.foveation import Cones, Frustum
from sparklod_cli.model.lod_tree import CHUNK_NODES
from sparklod_cli.simulation.frames import Changes, measure
from sparklod_cli.tables.columns import Row
from sparklod_cli.viewers import spark
from sparklod_cli.viewers.loaded_scene import Forest, TreeCut, TreeInstance, views_of
from sparklod_cli.viewers.spark import VISITS
from sparklod_cli.viewers.viewer_settings import pixel_limit
from tests.lod.trees import (
    Case,
    CutView,
    ancestors_drawn,
    cases,
    check_cut,
    drawn,
    expected_cut,
    links,
    random_tree,
    transform,
    view_from,
    views,
)
from tests.references import cuts as references

#: Pixel scales at which nothing happens, something does, and everything does.
LIMITS = (0.0, 0.02, 0.3)

#: Nodes of a chunk in tests of small trees, as a power of 2; so large that no node's children are in three.
SMALL = 4


def check_cover(case: Case, indices: list[np.ndarray]) -> None:
    """Every leaf is drawn once, or an ancestor of it, within the budget."""
    assert sum(map(len, indices)) <= case.budget
    for instance, nodes in zip(case.instances, indices, strict=True):
        tree = case.tree(instance)
        assert (ancestors_drawn(tree, nodes)[tree.is_leaf] == 1).all()


def large_case(seed: int, *, nodes: int = 150_000, instances: int = 3) -> Case:
    rng = np.random.default_rng(seed)
    trees = [random_tree(rng, nodes, 5), random_tree(rng, nodes // 3, 2)]
    foveations = (Cones(90, 120, 0.4, 0.2), Frustum(0.3, 0.1), Cones())
    placed = [
        TreeInstance(each % 2, transform(rng, scale=rng.uniform(0.5, 2), spread=2.0), 1.0 + each, foveations[each])
        for each in range(instances)
    ]
    return Case(trees, placed, CutView(transform(rng, spread=4.0), math.radians(80), math.radians(60)), 10_000)


# Whole trees


@given(cases())
@settings(max_examples=400)
@pytest.mark.slow
def test_the_cut_is_that_of_one_queue(case: Case) -> None:
    check_cut(case, case.find())


@given(cases(), st.data())
def test_nodes_no_larger_than_the_limit_are_not_refined(case: Case, data: st.DataObject) -> None:
    """The limit is exactly a node's pixel scale."""
    viewer = case.viewer()
    sight = views_of(viewer.forest, case.instances, case.view)
    number = data.draw(st.integers(0, len(sight) - 1))
    node = data.draw(st.integers(0, len(case.tree(case.instances[number])) - 1))
    smallest = float(references.pixel_scale(viewer.forest.nodes[sight[number]["node_base"] + node], sight[number]))
    case = dataclasses.replace(case, smallest=smallest)
    check_cut(case, case.find(viewer))


@given(cases(), st.data())
def test_earlier_cuts_do_not_change_a_cut(case: Case, data: st.DataObject) -> None:
    viewer = case.viewer()
    for _ in range(data.draw(st.integers(2, 5))):
        budget = data.draw(st.integers(len(case.instances), case.most + 3))
        smallest = data.draw(st.sampled_from([*LIMITS, math.inf]))
        case = dataclasses.replace(case, view=data.draw(views(case.trees)), budget=budget, smallest=smallest)
        cut = case.find(viewer)
        check_cut(case, cut)
        check_cover(case, cut.indices())


@given(cases(), st.data())
def test_nan_and_infinity_give_a_cut(case: Case, data: st.DataObject) -> None:
    """NaN counts as more than infinity, as in Spark; the result is a cut."""
    bad = st.sampled_from([math.nan, math.inf, -math.inf, 65504.0, 3e38, 1e-45])
    for tree in case.trees:
        for node in data.draw(st.lists(st.integers(0, len(tree.size) - 1), max_size=4)):
            if data.draw(st.booleans()):
                tree.size[node] = abs(data.draw(bad))
            else:
                tree.center[node, data.draw(st.integers(0, 2))] = data.draw(bad)
    cut = case.find()
    check_cut(case, cut)
    check_cover(case, cut.indices())


@given(cases(), st.data())
def test_more_budget_is_never_coarser(case: Case, data: st.DataObject) -> None:
    viewer = case.viewer()
    finer = dataclasses.replace(case, budget=data.draw(st.integers(case.budget, case.most + 3)))
    lower = dataclasses.replace(case, smallest=case.smallest * data.draw(st.floats(0, 1)) if case.smallest else 0.0)
    coarse = case.find(viewer).indices()
    for other in (finer, dataclasses.replace(lower, budget=case.most)):
        for instance, before, after in zip(case.instances, coarse, other.find(viewer).indices(), strict=True):
            assert (ancestors_drawn(case.tree(instance), before)[after] == 1).all()


@given(cases())
def test_enough_budget_draws_all_leaves_that_can_be_seen(case: Case) -> None:
    case = dataclasses.replace(case, budget=case.most, smallest=0.0)
    cut = case.find()
    assert cut.reason in ("exhausted", "pixel")
    if cut.reason == "exhausted":
        for instance, nodes in zip(case.instances, cut.indices(), strict=True):
            np.testing.assert_array_equal(nodes, np.flatnonzero(case.tree(instance).is_leaf))


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.slow
def test_the_cut_of_large_trees_is_that_of_one_queue(seed: int) -> None:
    case = large_case(seed)
    viewer = case.viewer()
    for budget, smallest in [(3, 0.0), (20_000, 0.0), (1_000, 0.0), (20_000, pixel_limit(math.radians(60), 100))]:
        case = dataclasses.replace(case, budget=budget, smallest=smallest)
        check_cut(case, case.find(viewer))


def test_threads_can_share_a_viewer() -> None:
    case, rng = large_case(9), np.random.default_rng(9)
    viewer = case.viewer()
    requests = [
        Case(case.trees, case.instances, CutView(transform(rng, spread=4.0), 1.4, 1.0), budget, limit)
        for budget, limit in zip(rng.integers(3, 80_000, 42).tolist(), LIMITS * 14, strict=True)
    ]
    alone = [sorted(drawn(each.find())) for each in requests]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda each: each.find(viewer), requests))
    assert [sorted(drawn(cut)) for cut in together] == alone


@pytest.mark.parametrize("ends", [1, 2, 3])
def test_chains_longer_than_the_buffers_are_traversed(ends: int) -> None:
    """A node of one child adds nothing, so no budget bounds how many are visited."""
    length = 4 * CHUNK_NODES
    assert length > VISITS * ends + CHUNK_NODES
    tree = links([1] * length + ([ends] + [1] * ends * 1000 if ends > 1 else []))
    size = np.random.default_rng(ends).uniform(0.5, 1, len(tree)).astype(np.float32)
    case = Case([Nodes(np.zeros((len(tree), 3), np.float32), size, tree)], [TreeInstance()], view_from(0, 0, 2), ends)
    viewer = case.viewer()
    for budget in (ends, 1, ends):
        cut = dataclasses.replace(case, budget=budget).find(viewer)
        stopped = [length] if ends > 1 and budget == 1 else range(len(tree) - ends, len(tree))
        assert sorted(cut.node.tolist()) == list(stopped)
        assert cut.reason == ("budget" if ends > 1 and budget == 1 else "exhausted")


def test_a_tree_as_long_as_the_buffers_is_cut_as_by_one_queue() -> None:
    """Where the buffers are as long as the tree: by the threshold, then by the queue."""
    size = np.array([1, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5], np.float32)
    tree = Nodes(np.zeros((7, 3), np.float32), size, links([2, 2, 2]))
    case = Case([tree], [TreeInstance()], view_from(0, 0, 5), 3)
    cut = case.find()
    check_cut(case, cut)
    assert sorted(cut.node.tolist()) == [1, 5, 6]


def test_many_children_and_many_instances_are_traversed() -> None:
    rng = np.random.default_rng(0)
    center = rng.normal(size=(65536, 3)).astype(np.float32)
    instances = [TreeInstance(object_to_world=transform(rng)) for _ in range(300)]
    tree = Nodes(center, np.ones(65536, np.float32), links([65535]))
    case = Case([tree], instances, view_from(0, 0, 20), 65534 + 300)
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
    if isinstance(foveation, Frustum):
        seen = (abs(x) <= np.tan(view.fov_x / 2) * -z) & (abs(y) <= np.tan(view.fov_y / 2) * -z)
        weight = np.where(z < 0, np.where(seen, 1, foveation.outside), foveation.behind)
    elif foveation.fov0:
        angles = [0, foveation.fov0 / 2, max(foveation.fov0, foveation.fov) / 2, 90]
        weights = [foveation.behind, foveation.foveate, 1, 1]
        weight = np.interp(-z / distance, np.cos(np.radians(angles))[::-1], weights)
        weight = np.where(z < 0, weight, foveation.behind)
    else:
        weight = np.ones(len(z))
    expected = scale * tree.size / distance * placed.lod_scale * weight
    got = np.array([references.pixel_scale(node, sight) for node in forest.nodes])
    # One in a thousand lies on an edge, where it falls to the other side.
    assert np.count_nonzero(~np.isclose(got, expected, rtol=1e-4)) <= 1


def test_the_pixel_limit_is_a_pixels_size_at_distance_1() -> None:
    """At distance 1 the picture is 2 * tan(fov_y / 2) high."""
    assert pixel_limit(math.radians(90), 1000) == pytest.approx(2 / 1000)
    assert pixel_limit(math.radians(60), 1080, 2.0) == pytest.approx(2 * pixel_limit(math.radians(60), 1080))


# Missing chunks


@pytest.fixture(scope="class")
def small_chunks() -> Iterator[None]:
    """Small chunks, so that small trees have many."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(spark, "CHUNK_BITS", SMALL)
        for module in (spark, spark_nodes):
            patch.setattr(module, "CHUNK_NODES", 1 << SMALL)
        yield


def some_chunks(data: st.DataObject, forest: Forest) -> np.ndarray:
    """Which chunks are resident: all but a few."""
    there = np.ones(forest.chunks, np.bool_)
    gone = data.draw(st.sets(st.integers(0, forest.chunks - 1), max_size=max(1, forest.chunks // 2)))
    there[list(gone)] = False
    return there


@pytest.mark.usefixtures("small_chunks")
class TestSmallChunks:
    @given(cases(60), st.data())
    @settings(max_examples=300)
    def test_the_cut_with_missing_chunks_is_that_of_one_queue(self, case: Case, data: st.DataObject) -> None:
        """Also where other chunks were resident before."""
        viewer = case.viewer()
        for _ in range(data.draw(st.integers(1, 3))):
            there = some_chunks(data, viewer.forest)
            cut = case.find(viewer, there)
            check_cut(case, cut, there, SMALL)
            assert len(cut) <= case.budget
            for instance, nodes in zip(case.instances, cut.indices(), strict=True):
                tree, base = case.tree(instance), viewer.forest.chunk_base[instance.tree]
                assert (ancestors_drawn(tree, nodes)[tree.is_leaf] == there[base]).all()
                assert there[base + (nodes >> SMALL)].all()

    @given(cases(60))
    def test_loading_the_wanted_chunks_in_turn_gives_the_whole_cut(self, case: Case) -> None:
        """As a viewer fetches them: the roots, then always the most wanted chunk that is missing."""
        viewer = case.viewer()
        whole = case.find(viewer)
        there = np.zeros(viewer.forest.chunks, np.bool_)
        there[viewer.forest.chunk_base[[instance.tree for instance in case.instances]]] = True
        for _ in range(len(there) + 1):
            cut = case.find(viewer, there)
            assert set(cut.wanted()) >= set(np.flatnonzero(cut.demand > 0))
            lacking = [chunk for chunk in cut.wanted() if not there[chunk]]
            assert (cut.missing > 0) == bool(lacking)
            if not lacking:
                break
            there[lacking[0]] = True
        assert [nodes.tolist() for nodes in cut.indices()] == [nodes.tolist() for nodes in whole.indices()]
        assert cut.demand.tolist() == whole.demand.tolist()


@pytest.mark.parametrize("seed", range(2))
def test_the_cut_of_large_trees_with_missing_chunks_is_that_of_one_queue(seed: int) -> None:
    rng = np.random.default_rng(seed)
    trees = [random_tree(rng, 200_000, 6), random_tree(rng, 100_000, 3)]
    instances = [TreeInstance(tree, transform(rng, spread=2.0), 1.0 + tree) for tree in (0, 1, 0)]
    view = CutView(transform(rng, spread=4.0), math.radians(80), math.radians(60))
    case = Case(trees, instances, view, 30_000)
    viewer = case.viewer()
    there = rng.random(viewer.forest.chunks) < 0.6
    there[viewer.forest.chunk_base[:-1]] = True, seed % 2
    for budget, smallest in [(30_000, 0.0), (3_000, 0.0), (30_000, 0.05)]:
        request = dataclasses.replace(case, budget=budget, smallest=smallest)
        cut = request.find(viewer, there)
        check_cut(request, cut, there)
        assert cut.missing >= 1 - seed % 2
    nothing = case.find(viewer, np.zeros_like(there))
    assert (len(nothing), nothing.missing, nothing.reason, nothing.wanted()) == (0, 3, "missing", [])


# Statistics


def statistics_of(case: Case, cut: TreeCut) -> tuple[Row, list[Row]]:
    return measure(case.viewer().forest, cut, case.view, by_instance=True)


def expected_statistics(case: Case, cut: TreeCut, instances: list[int], waiting: set[tuple[int, int]]) -> dict:
    """The figures of the nodes of some instances, in numpy, an instance at a time."""
    level, pixels, places, sizes = [], [], [], []
    tan_x, tan_y = (np.float32(math.tan(fov / 2)) for fov in (case.view.fov_x, case.view.fov_y))
    area = case.view.width * case.view.height
    pixel = np.float32(pixel_limit(case.view.fov_y, case.view.height))
    leaves = 0
    for number in instances:
        tree = case.trees[case.instances[number].tree]
        nodes = cut.node[cut.instance == number]
        level += tree.tree.depths()[nodes].tolist()
        leaves += int(tree.tree.is_leaf[nodes].sum())

        def axis(name: str, number: int = number) -> np.ndarray:
            return np.array([cut.views[number][f"{name}_{each}"] for each in "xyz"])

        offset = tree.center[nodes] - axis("origin")
        products = {name: offset * axis(name) for name in ("forward", "right", "up")}
        along = {name: product[:, 0] + product[:, 1] + product[:, 2] for name, product in products.items()}
        ahead = along["forward"]
        seen = (abs(along["right"]) <= tan_x * ahead) & (abs(along["up"]) <= tan_y * ahead)
        places += np.where(~(ahead > 0), "behind", np.where(seen, "in_frustum", "outside")).tolist()
        square = offset * offset
        distance = np.maximum(np.sqrt(square[:, 0] + square[:, 1] + square[:, 2]), np.float32(1e-6))
        sizes += (tree.size[nodes] / distance / pixel).tolist()
    pixels = [size for size, place in zip(sizes, places, strict=True) if place == "in_frustum"]
    areas = [min(math.pi / 4 * 8 * size * size, area) for size in pixels]
    return {name: places.count(name) for name in ("in_frustum", "outside", "behind")} | {
        "selected": len(level),
        "leaves": leaves,
        "interior": len(level) - leaves,
        "frontier": sum(number in instances for number, _ in waiting),
        "level_min": min(level, default=None),
        "level_mean": pytest.approx(sum(level) / len(level)) if level else None,
        "level_max": max(level, default=None),
        "projected_px_p50": pytest.approx(np.percentile(pixels, 50), rel=1e-6) if pixels else None,
        "projected_px_p95": pytest.approx(np.percentile(pixels, 95), rel=1e-6) if pixels else None,
        "overdraw_estimate": pytest.approx(sum(areas) / area, rel=1e-5, abs=(1 + len(areas)) / 1024 / area),
    }


@given(cases())
def test_the_statistics_of_a_cut_are_those_of_numpy(case: Case) -> None:
    cut = case.find()
    waiting = expected_cut(case, cut).waiting
    whole, parts = statistics_of(case, cut)
    every = list(range(len(case.instances)))
    assert whole == expected_statistics(case, cut, every, waiting)
    assert parts == [expected_statistics(case, cut, [number], waiting) for number in every]
    for name in ("selected", "leaves", "frontier", "in_frustum", "outside", "behind"):
        assert whole[name] == sum(part[name] for part in parts), name
    assert whole["in_frustum"] + whole["outside"] + whole["behind"] == whole["selected"] == len(cut)


@given(cases(), st.randoms(use_true_random=False))
def test_the_order_of_the_nodes_does_not_matter(case: Case, random: object) -> None:
    cut = case.find()
    order = list(range(len(cut)))
    random.shuffle(order)
    mixed = dataclasses.replace(cut, node=cut.node[order], instance=cut.instance[order], limit=cut.limit[order])
    assert statistics_of(case, mixed) == statistics_of(case, cut)
    for of_each, of_mixed in zip(cut.indices(), mixed.indices(), strict=True):
        np.testing.assert_array_equal(of_each, of_mixed)
    changes, again = (Changes(case.viewer().forest, case.instances) for _ in range(2))
    for a, b in ((cut, mixed), (mixed, cut)):
        assert changes.next(a) == again.next(b)


@given(cases(), st.data())
def test_added_and_removed_nodes_are_those_of_sets(case: Case, data: st.DataObject) -> None:
    viewer = case.viewer()
    changes = Changes(viewer.forest, case.instances)
    before: list[set[int]] | None = None
    for _ in range(data.draw(st.integers(1, 5))):
        budget = data.draw(st.integers(len(case.instances), case.most))
        case = dataclasses.replace(case, view=data.draw(views(case.trees)), budget=budget)
        cut = case.find(viewer)
        now = [{node for number, node in drawn(cut) if number == each} for each in range(len(case.instances))]
        old = before or [set() for _ in now]
        kept = [None if before is None else len(new & last) for new, last in zip(now, old, strict=True)]
        assert changes.next(cut) == [(len(a), b, len(c)) for a, b, c in zip(now, kept, old, strict=True)]
        before = now


def statistics_of_one(center: list[float], size: float) -> SimpleNamespace:
    """Of one splat, seen from the origin; at distance 1 the picture is 2 wide, 100 pixels."""
    tree = Nodes(np.array([center], np.float32), np.array([size], np.float32), links([]))
    case = Case([tree], [TreeInstance()], CutView(np.eye(4), math.radians(90), math.radians(90), 100, 100), 1)
    whole, parts = statistics_of(case, case.find())
    assert parts == [whole]
    return SimpleNamespace(**whole)


def test_one_splat_in_a_cut_has_the_size_and_overdraw_of_its_place() -> None:
    ahead = statistics_of_one([0, 0, -1], 0.1)
    assert (ahead.in_frustum, ahead.outside, ahead.behind) == (1, 0, 0)
    assert ahead.projected_px_p50 == ahead.projected_px_p95 == pytest.approx(5)
    # 0.1 is two standard deviations, so the radius is sqrt(8) / 2 * 5 pixels.
    assert ahead.overdraw_estimate == pytest.approx(math.pi * (math.sqrt(8) / 2 * 5) ** 2 / 100**2, rel=1e-3)
    for large in (1e6, math.nan, math.inf):  # it fills the picture, not more
        assert statistics_of_one([0, 0, -1], large).overdraw_estimate == pytest.approx(1)
    beside, behind = statistics_of_one([1.1, 0, -1], 0.1), statistics_of_one([0, 0, 1], 0.1)
    assert (beside.outside, beside.projected_px_p50, beside.overdraw_estimate) == (1, None, 0)
    assert (behind.behind, behind.projected_px_p95, behind.overdraw_estimate) == (1, None, 0)
    assert statistics_of_one([0, 0, 0], 0.1).behind == 1  # where the camera is, nothing is seen
    assert statistics_of_one([0, 1, -1], 0.1).in_frustum == 1  # on the edge


def test_an_empty_cut_has_no_statistics() -> None:
    tree = Nodes(np.zeros((1, 3), np.float32), np.ones(1, np.float32), links([]))
    case = Case([tree], [TreeInstance()], CutView(np.eye(4), 1.0, 1.0), 1)
    cut = case.find(resident=np.zeros(1, np.bool_))
    whole, parts = statistics_of(case, cut)
    assert parts == [whole]
    empty = ("level_min", "level_mean", "level_max", "projected_px_p50", "projected_px_p95")
    assert whole == dict.fromkeys(whole, 0) | dict.fromkeys(empty)
    assert Changes(case.viewer().forest, case.instances).next(cut) == [(0, None, 0)]
