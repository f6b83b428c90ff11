"""Trees, instances and cameras for tests of the traversal, made of a few numbers so that much of it coincides."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st

from sparklod_cli.model.foveation import Cones, Frustum
from sparklod_cli.model.lod_tree import LodTree, Nodes
from sparklod_cli.viewers.cut import Forest, TreeCut, TreeInstance
from sparklod_cli.viewers.spark import SparkViewer
from tests.lod.sights import CutView
from tests.references import budgeted_cuts

FOVEATIONS = (
    Cones(),
    Cones(90, 120, 0.4, 0.2),  # Spark's
    Cones(0, 0, 0.5, 0.25),
    Cones(60, 60, 0.4, 0.2),
    Cones(100, 20, 0.4, 0.0),  # the outer one inside of the inner one
    Cones(0, 120, 0.4, 0.2),
    Cones(170, 180, 0.4, 0.2),
    Cones(90, 120, 1.0, 0.0),
    Frustum(),
    Frustum(0.3, 0.1),
    Frustum(1.0, 0.0),
    Frustum(0.0, 1.0),
)


@dataclass(frozen=True)
class Case:
    """What a cut is asked of."""

    trees: list[Nodes]
    instances: list[TreeInstance]
    view: CutView
    budget: int
    smallest: float

    def traversal(self) -> SparkViewer:
        return SparkViewer(Forest(self.trees), self.instances)

    def find(self, found: SparkViewer | None = None, resident: np.ndarray | None = None) -> TreeCut:
        found = found or self.traversal()
        return found.cut(self.view, budget=self.budget, smallest=self.smallest, resident=resident)

    @property
    def most(self) -> int:
        """Nodes of all instances."""
        return sum(len(self.trees[instance.tree].size) for instance in self.instances)


def expected_cut(
    case: Case, cut: TreeCut, resident: np.ndarray | None = None, bits: int = 16
) -> budgeted_cuts.BudgetedCut:
    """The twin's, for the views of a cut."""
    forest = Forest(case.trees)
    there = np.ones(forest.chunks, bool) if resident is None else resident
    return budgeted_cuts.budgeted_cut(forest.nodes, cut.views, case.budget, case.smallest, there.__getitem__, bits)


def drawn(cut: TreeCut) -> list[tuple[int, int]]:
    """(instance, index) of each node of a cut."""
    return list(zip(cut.instance.tolist(), cut.node.tolist(), strict=True))


def check(case: Case, cut: TreeCut, resident: np.ndarray | None = None, bits: int = 16) -> None:
    """A cut is that of the queue, with all that is told of it."""
    expected = expected_cut(case, cut, resident, bits)
    nodes = drawn(cut)
    assert sorted(nodes) == sorted(expected.limit)
    assert cut.reason == expected.reason
    assert cut.missing == expected.missing
    assert cut.least == expected.least
    np.testing.assert_equal(cut.stop, expected.stop)
    np.testing.assert_array_equal(np.abs(cut.limit), np.array([expected.limit[node] for node in nodes]))
    waits = (cut.limit.view(np.int32) >= 0).tolist()
    assert {node for node, wait in zip(nodes, waits, strict=True) if wait} == expected.waiting
    demand = [expected.demand[chunk] for chunk in range(len(cut.demand))]
    assert cut.demand.tolist() == demand
    assert [demand[chunk] for chunk in cut.wanted()] == sorted(filter(None, demand), reverse=True)
    of_each = [sorted(node for number, node in nodes if number == each) for each in range(len(case.instances))]
    assert [indices.tolist() for indices in cut.indices()] == of_each


def ancestors_drawn(tree: LodTree, nodes: np.ndarray) -> np.ndarray:
    """How many of some nodes lie on the way from the root to each, itself included."""
    above = np.zeros(len(tree), np.int64)
    np.add.at(above, nodes, 1)
    for node in np.flatnonzero(tree.child_count):
        start = int(tree.child_start[node])
        above[start : start + int(tree.child_count[node])] += above[node]
    return above


def links(fan_out: list[int], order: np.random.Generator | None = None) -> LodTree:
    """A tree whose nodes have so many children, those left over none; breadth first, or in another order of runs."""
    count, start, waiting = [0], [0], [0]
    for children in fan_out:
        if not waiting:
            break
        node = waiting.pop(0 if order is None else int(order.integers(len(waiting))))
        if children:
            count[node], start[node] = children, len(count)
            waiting += range(len(count), len(count) + children)
            count += [0] * children
            start += [0] * children
    tree = LodTree(np.array(count, np.uint16), np.array(start, np.uint32))
    tree.validate()
    return tree


def rotation(rng: np.random.Generator) -> np.ndarray:
    turned, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return turned * np.sign(np.linalg.det(turned))


def transform(rng: np.random.Generator, *, scale: float = 1.0, spread: float = 1.0) -> np.ndarray:
    """A random rotation and translation, and a uniform scale."""
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation(rng)
    matrix[:3, 3] = spread * rng.normal(size=3)
    return matrix


def node_values(rng: np.random.Generator, kind: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Centres and sizes, as float16 has them."""
    if kind == "few":  # most of them tie, and some are nothing
        center, size = rng.integers(-1, 2, (count, 3)), rng.choice([0, 0.25, 0.5, 1, 1, 2], count)
    elif kind == "one":
        center, size = np.ones((count, 3)), np.ones(count)
    elif kind == "near":  # all within a bucket of pixel scales, so that the queue does all the work
        center, size = 1e-4 * rng.normal(size=(count, 3)), 1 + 2e-3 * rng.integers(0, 3, count)
    else:
        center, size = rng.normal(size=(count, 3)), np.exp(rng.normal(size=count))
    rounded = [np.asarray(values, np.float16).astype(np.float32) for values in (center, size)]
    return rounded[0], rounded[1]


@st.composite
def some_trees(draw: st.DrawFn, max_nodes: int = 40) -> Nodes:
    fan_out = draw(st.lists(st.sampled_from([0, 1, 1, 2, 2, 3, 4, 9]), max_size=max_nodes))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    tree = links(fan_out, rng if draw(st.booleans()) else None)
    kind = draw(st.sampled_from(["few", "one", "near", "any"]))
    return Nodes(*node_values(rng, kind, len(tree)), tree)


@st.composite
def views(draw: st.DrawFn, trees: list[Nodes]) -> CutView:
    """A camera somewhere, or at a node's centre."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    camera = transform(rng, spread=draw(st.sampled_from([0.0, 0.5, 3.0, 100.0])))
    if draw(st.booleans()):
        camera[:3, :3] = np.eye(3)
    if draw(st.booleans()):
        camera[:3, 3] = rng.choice(trees[0].center)
    return CutView(camera, math.radians(80), math.radians(60))


@st.composite
def cases(draw: st.DrawFn, max_nodes: int = 40) -> Case:
    trees = draw(st.lists(some_trees(max_nodes), min_size=1, max_size=3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))

    @st.composite
    def some_instances(draw: st.DrawFn) -> TreeInstance:
        scale = draw(st.sampled_from([1.0, 1.0, 0.5, 1.7]))
        return TreeInstance(
            tree=draw(st.integers(0, len(trees) - 1)),
            object_to_world=np.eye(4) if draw(st.booleans()) else transform(rng, scale=scale),
            lod_scale=draw(st.sampled_from([1.0, 1.0, 1.0, 0.25, 3.0, 0.0])),
            foveation=draw(st.sampled_from(FOVEATIONS)),
        )

    instances = draw(st.lists(some_instances(), min_size=1, max_size=4))
    case = Case(trees, instances, draw(views(trees)), 0, 0)
    budget = draw(st.integers(len(instances), case.most + 3))
    smallest = draw(st.sampled_from([0.0, 0.0, 1e-3, 0.1, 0.25, 0.5, 1.0, 2.0, 1e30, math.inf]))
    return Case(trees, instances, case.view, budget, smallest)


def random_tree(rng: np.random.Generator, count: int, most_children: int) -> Nodes:
    """A tree of about `count` nodes, whose children are mostly smaller and scatter around their parents."""
    fan_out = rng.integers(2, most_children + 1, count).tolist()
    fan_out = fan_out[: 1 + int(np.searchsorted(np.cumsum(fan_out), count))]
    tree = links(fan_out)
    center, size = np.zeros((len(tree), 3)), np.ones(len(tree))
    for node in np.flatnonzero(tree.child_count):
        part = slice(int(tree.child_start[node]), int(tree.child_start[node]) + int(tree.child_count[node]))
        center[part] = center[node] + rng.normal(0, size[node], (part.stop - part.start, 3))
        size[part] = size[node] * rng.uniform(0.4, 1.05, part.stop - part.start)
    return Nodes(*(np.asarray(values, np.float16).astype(np.float32) for values in (center, size)), tree)
