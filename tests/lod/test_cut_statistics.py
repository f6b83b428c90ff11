"""What is told of a cut against plain numpy, and changes between cuts against sets."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.model.lod_tree import Nodes
from sparklod_cli.simulation.frames import Changes, CutStatistics, measure
from sparklod_cli.viewers.cut import TreeCut, TreeInstance
from sparklod_cli.viewers.spark import SparkViewer
from sparklod_cli.viewers.viewer_settings import pixel_limit
from tests.lod.forests import Case, cases, drawn, expected_cut, links, views
from tests.lod.sights import CutView

SIZE = (640, 480)


def levels(case: Case) -> np.ndarray:
    return np.concatenate([tree.tree.depths() for tree in case.trees])


def told(case: Case, cut: TreeCut) -> tuple[CutStatistics, list[CutStatistics]]:
    found = case.traversal()
    return measure(found.forest, cut, case.view, by_instance=True)


def expected(case: Case, cut: TreeCut, instances: list[int], waiting: set[tuple[int, int]]) -> dict:
    """The same figures of the nodes of some instances, in numpy, an instance at a time."""
    level, pixels, places, sizes = [], [], [], []
    tan_x, tan_y = (np.float32(math.tan(fov / 2)) for fov in (case.view.fov_x, case.view.fov_y))
    pixel = np.float32(pixel_limit(case.view.fov_y, SIZE[1]))
    leaves = 0
    for number in instances:
        tree = case.trees[case.instances[number].tree]
        nodes = cut.node[cut.instance == number]
        level += tree.tree.depths()[nodes].tolist()
        leaves += int(tree.tree.is_leaf[nodes].sum())
        axes = {name: np.array([cut.views[number][f"{name}_{axis}"] for axis in "xyz"]) for name in NAMES}
        offset = tree.center[nodes] - axes["origin"]
        along = {
            name: (offset * axis)[:, 0] + (offset * axis)[:, 1] + (offset * axis)[:, 2] for name, axis in axes.items()
        }
        ahead = along["forward"]
        seen = (abs(along["right"]) <= tan_x * ahead) & (abs(along["up"]) <= tan_y * ahead)
        places += np.where(~(ahead > 0), "behind", np.where(seen, "in_frustum", "outside")).tolist()
        square = offset * offset
        distance = np.maximum(np.sqrt(square[:, 0] + square[:, 1] + square[:, 2]), np.float32(1e-6))
        sizes += (tree.size[nodes] / distance / pixel).tolist()
    pixels = [size for size, place in zip(sizes, places, strict=True) if place == "in_frustum"]
    areas = [min(math.pi / 4 * 8 * size * size, SIZE[0] * SIZE[1]) for size in pixels]
    figures = {name: places.count(name) for name in ("in_frustum", "outside", "behind")}
    return figures | {
        "selected": len(level),
        "leaves": leaves,
        "frontier": sum(number in instances for number, _ in waiting),
        "level_min": min(level, default=None),
        "level_mean": pytest.approx(sum(level) / len(level)) if level else None,
        "level_max": max(level, default=None),
        "projected_px_p50": pytest.approx(np.percentile(pixels, 50), rel=1e-6) if pixels else None,
        "projected_px_p95": pytest.approx(np.percentile(pixels, 95), rel=1e-6) if pixels else None,
        "overdraw_estimate": pytest.approx(
            sum(areas) / (SIZE[0] * SIZE[1]), rel=1e-5, abs=(1 + len(areas)) / 1024 / SIZE[0] / SIZE[1]
        ),
    }


NAMES = ("origin", "right", "up", "forward")


@given(cases())
def test_the_figures_of_a_cut_are_those_of_numpy(case: Case) -> None:
    cut = case.find()
    waiting = expected_cut(case, cut).waiting
    whole, parts = told(case, cut)
    everything = list(range(len(case.instances)))
    assert dataclasses.asdict(whole) == expected(case, cut, everything, waiting)
    assert [dataclasses.asdict(part) for part in parts] == [expected(case, cut, [i], waiting) for i in everything]
    for name in ("selected", "leaves", "frontier", "in_frustum", "outside", "behind"):
        assert getattr(whole, name) == sum(getattr(part, name) for part in parts), name
    assert whole.in_frustum + whole.outside + whole.behind == whole.selected == len(cut)


@given(cases(), st.randoms(use_true_random=False))
def test_the_order_of_the_nodes_does_not_matter(case: Case, random: object) -> None:
    cut = case.find()
    order = list(range(len(cut)))
    random.shuffle(order)
    mixed = dataclasses.replace(cut, node=cut.node[order], instance=cut.instance[order], limit=cut.limit[order])
    assert told(case, mixed) == told(case, cut)
    for of_each, of_mixed in zip(cut.indices(), mixed.indices(), strict=True):
        np.testing.assert_array_equal(of_each, of_mixed)
    found = case.traversal()
    changes, again = (Changes(found.forest, case.instances) for _ in range(2))
    for a, b in ((cut, mixed), (mixed, cut)):
        assert changes.next(a) == again.next(b)


@given(cases(), st.data())
def test_added_and_removed_nodes_are_those_of_sets(case: Case, data: st.DataObject) -> None:
    found = case.traversal()
    changes = Changes(found.forest, case.instances)
    before: list[set[int]] | None = None
    for _ in range(data.draw(st.integers(1, 5))):
        budget = data.draw(st.integers(len(case.instances), case.most))
        case = dataclasses.replace(case, view=data.draw(views(case.trees)), budget=budget)
        cut = case.find(found)
        now = [{node for number, node in drawn(cut) if number == each} for each in range(len(case.instances))]
        old = before or [set() for _ in now]
        kept = [None if before is None else len(new & last) for new, last in zip(now, old, strict=True)]
        assert changes.next(cut) == [(len(a), b, len(c)) for a, b, c in zip(now, kept, old, strict=True)]
        before = now


def at_distance(center: list[float], size: float) -> CutStatistics:
    """Of one splat, seen from the origin."""
    tree = Nodes(np.array([center], np.float32), np.array([size], np.float32), links([]))
    case = Case([tree], [TreeInstance()], CutView(np.eye(4), math.radians(90), math.radians(90), 100, 100), 1, 0.0)
    found = SparkViewer(case.traversal().forest, case.instances)
    whole, parts = told(case, case.find(found))
    assert parts == [whole]
    return whole


def test_one_splat_in_a_cut_has_the_size_and_overdraw_of_its_place() -> None:
    """At distance 1 the picture is 2 wide, 100 pixels."""
    ahead = at_distance([0, 0, -1], 0.1)
    assert (ahead.in_frustum, ahead.outside, ahead.behind) == (1, 0, 0)
    assert ahead.projected_px_p50 == ahead.projected_px_p95 == pytest.approx(5)
    # 0.1 is two standard deviations, so the radius is sqrt(8) / 2 * 5 pixels.
    assert ahead.overdraw_estimate == pytest.approx(math.pi * (math.sqrt(8) / 2 * 5) ** 2 / 100**2, rel=1e-3)
    assert at_distance([0, 0, -1], 1e6).overdraw_estimate == pytest.approx(1)  # it fills the picture, not more
    open_companion, behind = at_distance([1.1, 0, -1], 0.1), at_distance([0, 0, 1], 0.1)
    assert (open_companion.outside, open_companion.projected_px_p50, open_companion.overdraw_estimate) == (1, None, 0)
    assert (behind.behind, behind.projected_px_p95, behind.overdraw_estimate) == (1, None, 0)
    assert at_distance([0, 0, 0], 0.1).behind == 1  # where the camera is, nothing is seen
    assert at_distance([0, 1, -1], 0.1).in_frustum == 1  # on the edge


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_size_that_is_not_finite_fills_the_picture(bad: float) -> None:
    assert at_distance([0, 0, -1], bad).overdraw_estimate == pytest.approx(1)


def test_an_empty_cut_has_no_figures() -> None:
    tree = Nodes(np.zeros((1, 3), np.float32), np.ones(1, np.float32), links([]))
    case = Case([tree], [TreeInstance()], CutView(np.eye(4), 1.0, 1.0), 1, 0.0)
    cut = case.find(resident=np.zeros(1, np.bool_))
    whole, parts = told(case, cut)
    nothing = CutStatistics(0, 0, 0, 0, 0, 0, None, None, None, None, None, 0.0)
    assert (whole, parts) == (nothing, [nothing])
    assert Changes(case.traversal().forest, case.instances).next(cut) == [(0, None, 0)]
