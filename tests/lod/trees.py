"""Trees, cameras and detail levels to test with, strategies that draw them, and the laws that every tree keeps."""

from __future__ import annotations

import dataclasses
import itertools
import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from sparklod_cli.codecs.spark_nodes import Nodes
from sparklod_cli.lod.bounds import check
from sparklod_cli.lod.stages import (
    NO_FAMILY,
    STAGE_BITS,
    Pending,
    Region,
    StagedBuilder,
    StageFamilies,
    drawn_splats,
    joined,
)
from sparklod_cli.model.foveation import Cones, Frustum
from sparklod_cli.model.gaussian import MAX_OPACITY, MIN_OPACITY
from sparklod_cli.model.instances import DetailScene
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.progress import silent
from sparklod_cli.system.threads import on_threads
from sparklod_cli.viewers.loaded_scene import Forest, TreeCut, TreeInstance
from sparklod_cli.viewers.spark import SparkViewer
from tests.references import cuts as references
from tests.references import gaussians
from tests.scenes import random_splats

# Laws of trees


def children(tree: LodTree, node: int) -> slice:
    start = int(tree.child_start[node])
    return slice(start, start + int(tree.child_count[node]))


def parents(tree: LodTree) -> np.ndarray:
    """The parent of each node, that of the root itself."""
    parent = np.zeros(len(tree), np.int64)
    for node in np.flatnonzero(~tree.is_leaf):
        parent[children(tree, node)] = node
    return parent


def leaves_under(tree: LodTree) -> list[frozenset[int]]:
    """The leaves under each node."""
    under: list[frozenset[int]] = [frozenset()] * len(tree)
    for node in range(len(tree) - 1, -1, -1):
        own = range(len(tree))[children(tree, node)]
        under[node] = frozenset().union(*(under[child] for child in own)) if own else frozenset([node])
    return under


def sorted_rows(splats: Splats) -> np.ndarray:
    rows = np.concatenate([getattr(splats, name).reshape(len(splats), -1) for name in COLUMNS], axis=1)
    return rows[np.lexsort(rows.T)]


def same(one: tuple[Splats, LodTree], other: tuple[Splats, LodTree]) -> bool:
    """Whether two trees are the same to the last bit."""
    columns = [getattr(one[0], name).tobytes() == getattr(other[0], name).tobytes() for name in COLUMNS]
    links_are = [getattr(one[1], name).tobytes() == getattr(other[1], name).tobytes() for name in vars(one[1])]
    return all(columns + links_are)


def check_tree(splats: Splats, nodes: Splats, tree: LodTree) -> None:
    """The tree is valid, its leaves are the input bit for bit, and its other nodes are merged splats."""
    tree.validate()
    assert len(nodes) == len(tree)
    assert np.array_equal(sorted_rows(nodes.take(tree.is_leaf)), sorted_rows(splats))
    assert (tree.child_count[~tree.is_leaf] > 1).all()
    for name in COLUMNS:
        assert np.isfinite(getattr(nodes, name)).all(), name
    inner = nodes.take(~tree.is_leaf)
    assert ((inner.opacity >= np.float32(MIN_OPACITY)) & (inner.opacity <= MAX_OPACITY)).all()
    assert np.allclose(np.linalg.norm(inner.quat_xyzw, axis=1), 1, atol=1e-6)


def check_threads(build: Callable[[], tuple[Splats, LodTree]]) -> None:
    """The number of threads does not change a bit."""
    results = []
    for threads in (1, 2, 3):
        with on_threads(threads):
            results.append(build())
    assert all(same(result, results[0]) for result in results[1:])


def check_colours(nodes: Splats, tree: LodTree) -> None:
    """The colours of a tree are means of those of its leaves, weighted by opacity times area."""
    parent = parents(tree)
    color = np.concatenate([nodes.rgb, nodes.sh.reshape(len(nodes), -1)], axis=1).astype(np.float64)
    weight = np.where(tree.is_leaf, nodes.opacity.astype(np.float64) * gaussians.ellipsoid_area(nodes.scale), 0)
    total = weight[:, None] * color
    for node in range(len(tree) - 1, 0, -1):
        weight[parent[node]] += weight[node]
        total[parent[node]] += total[node]
    np.testing.assert_allclose(color, total / weight[:, None], atol=2e-5)


# Scenes that are hard to build a tree of


def coincident(count: int) -> Splats:
    """So many splats of one size at one point, and 20 elsewhere."""
    splats = random_splats(count + 20, seed=5)
    splats.center[:count] = splats.center[0]
    splats.scale[:count] = 0.01
    return splats


def hard_cases() -> dict[str, Splats]:
    plain = random_splats(500, seed=6)
    spread = np.float32(10.0) ** np.random.default_rng(7).uniform(-12, 12, (500, 1)).astype(np.float32)

    def changed(**columns: Any) -> Splats:
        """The plain scene with other columns, or with some filled with a number."""
        arrays = {
            name: np.full_like(getattr(plain, name), value) if np.isscalar(value) else np.float32(value)
            for name, value in columns.items()
        }
        return dataclasses.replace(plain, **arrays)

    return {
        "flat": changed(scale=plain.scale * [1, 1, 0]),
        "needle": changed(scale=plain.scale * [1, 0, 0]),
        "almost flat": changed(scale=plain.scale * [1, 1, 1e-12]),
        "tiny": changed(scale=1e-30),
        "huge": changed(scale=1e18),
        "every scale": changed(scale=plain.scale * spread),
        "far": changed(center=plain.center + np.float32(1e7)),
        "far and tiny": changed(center=plain.center * np.float32(1e7), scale=1e-9),
        "widest": changed(center=plain.center * np.float32(1e37)),
        "one point": changed(center=0.0),
        "on cell edges": changed(center=np.rint(plain.center * 4)),
        "faint": changed(opacity=1e-30),
        "opaque": changed(opacity=1.0),
    }


# Builds in stages, all of them in memory


EVERYWHERE = Region((-np.inf,) * 3, (np.inf,) * 3)


@dataclass(frozen=True)
class Division:
    """A region, and the parts that fill it; a block if there are none.

    Attributes:
        region: of the scene.
        parts: each is a stage; the stage of this division joins the nodes that they hand on.
    """

    region: Region = EVERYWHERE
    parts: tuple[Division, ...] = ()

    def cut(self, axis: int, *faces: float) -> tuple[Division, ...]:
        """Parts of this region between ascending coordinates on an axis; the region itself without any."""
        pieces = []
        for ends in itertools.pairwise([self.region.low[axis], *faces, self.region.high[axis]]):
            low, high = list(self.region.low), list(self.region.high)
            low[axis], high[axis] = ends
            pieces.append(Division(Region(tuple(low), tuple(high))))  # type: ignore[arg-type]
        return tuple(pieces)

    def contains(self, centers: np.ndarray) -> np.ndarray:
        return ((centers >= self.region.low) & (centers < self.region.high)).all(axis=1)


WHOLE = Division()


def grid(centers: np.ndarray, *splits: tuple[int, int, int], whole: Division = WHOLE) -> Division:
    """Parts with about as many splats each, along x, then y, then z; each of them divided by the next split."""
    if not splits:
        return whole
    pieces: tuple[Division, ...] = (whole,)
    for axis, count in enumerate(splits[0]):
        cut: tuple[Division, ...] = ()
        for piece in pieces:
            place = np.sort(centers[piece.contains(centers), axis])
            inner = [float(place[len(place) * k // count]) if len(place) else 0.0 for k in range(1, count)]
            cut += piece.cut(axis, *np.clip(inner, piece.region.low[axis], piece.region.high[axis]).tolist())
        pieces = cut
    return dataclasses.replace(whole, parts=tuple(grid(centers, *splits[1:], whole=piece) for piece in pieces))


def random_division(
    rng: random.Random, centers: np.ndarray, base: float, depth: int = 3, whole: Division = WHOLE
) -> Division:
    """Faces through splats, on borders of cells, or elsewhere; joins of 2 to 8; at most `depth` levels of joins."""
    if depth == 0 or rng.random() < 0.2:
        return whole
    parts: tuple[Division, ...] = (whole,)
    for _ in range(rng.randint(1, 3)):
        axis = rng.randrange(3)
        through = float(centers[rng.randrange(len(centers)), axis])
        border = rng.randint(-3, 4) * base ** rng.randint(-12, 6)
        at = rng.choice([through, through, border, float(centers[:, axis].mean())])
        parts = tuple(
            half
            for part in parts
            for half in (part.cut(axis, at) if part.region.low[axis] < at < part.region.high[axis] else (part,))
        )
    if len(parts) == 1:
        return whole
    return dataclasses.replace(
        whole, parts=tuple(random_division(rng, centers, base, depth - 1, part) for part in parts)
    )


@dataclass
class Stages:
    """The stages of one build as they run; children before the stage that joins them.

    Attributes:
        families: of each stage, by its number.
        pending: number of nodes that each stage handed on.
    """

    builder: StagedBuilder
    plan: Any
    splats: Splats
    families: list[StageFamilies] = field(default_factory=list)
    pending: list[int] = field(default_factory=list)

    def run(self, division: Division, region: Region | None) -> Pending:
        if division.parts:
            pending = joined([self.run(part, part.region) for part in division.parts])
        else:
            index = np.flatnonzero(division.contains(self.splats.center))
            pending = self.builder.leaves(self.splats.take(index), index, self.plan)
        families, rest = self.builder.advance(pending, region, len(self.families), self.plan, progress=silent)
        self.families.append(families)
        self.pending.append(len(rest["center"]))
        return rest


def build_in_stages(
    builder: StagedBuilder, splats: Splats, setting: float, division: Division
) -> tuple[Splats, LodTree, Stages]:
    """Build a tree of valid, visible splats, with a block for each of the smallest regions."""
    stages = Stages(builder, builder.plan(check(splats), splats, setting), splats)
    left = stages.run(division, None)
    assert len(left["center"]) == 1
    for stage, families in enumerate(stages.families):
        check_families(families, stage)
    return *assemble(stages.families, drawn_splats(left), int(left["family"][0])), stages


def assemble(families: Sequence[StageFamilies], root: Splats, family: int) -> tuple[Splats, LodTree]:
    """The root, then all families by batch and then by key; where both are equal, by stage and then by place.

    Args:
        families: of each stage, by its number.
        root: the root, one splat.
        family: the number of its family.
    """
    stage = np.repeat(np.arange(len(families)), [len(one) for one in families])
    batch = np.concatenate([one.batch for one in families])
    words = max(one.key.shape[1] for one in families)
    key = np.concatenate([np.pad(one.key, ((0, 0), (words - one.key.shape[1], 0))) for one in families])
    order = np.lexsort((*key.T[::-1], batch))
    count = np.concatenate([one.count for one in families]).astype(np.int64)
    start = np.empty(len(count), np.int64)  # place of a family's first child in the tree
    start[order] = 1 + np.cumsum(count[order]) - count[order]
    first = np.cumsum(count) - count  # and among the nodes of all stages
    gather = np.repeat(first[order], count[order]) + np.arange(count.sum()) - np.repeat(start[order] - 1, count[order])
    nodes = Splats.concat([root, Splats.concat([one.nodes for one in families]).take(gather)])
    of_node = np.concatenate([[family], np.concatenate([one.family for one in families])[gather]])
    begin = np.searchsorted(stage, np.arange(len(families)))
    tree = LodTree(np.zeros(len(nodes), np.uint16), np.zeros(len(nodes), np.uint32))
    inner = np.flatnonzero(of_node != NO_FAMILY)
    at = begin[of_node[inner] >> STAGE_BITS] + (of_node[inner] & ((1 << STAGE_BITS) - 1))
    tree.child_count[inner], tree.child_start[inner] = count[at], start[at]
    return nodes, tree


def check_families(families: StageFamilies, stage: int) -> None:
    """The laws of the families of every stage."""
    assert (np.diff(families.batch) >= 0).all()
    assert (families.count >= 1).all()
    assert families.count.sum(dtype=np.int64) == len(families.nodes) == len(families.family)
    own = families.family[families.family >> STAGE_BITS == stage] & ((1 << STAGE_BITS) - 1)
    assert (own < len(families)).all()
    tied = np.diff(families.batch) == 0
    keys = [tuple(row) for row in families.key.tolist()]
    assert all(a <= b for (a, b), is_tied in zip(itertools.pairwise(keys), tied, strict=True) if is_tied)
    assert families.nodes.is_valid().all()


# Cameras and cuts of trees


@dataclass(frozen=True)
class CutView:
    """A camera for cuts, of any fields of view.

    Attributes:
        camera_to_world: (4, 4), axes of OpenGL: x to the right, y up, looking along -z.
        fov_x, fov_y: radians.
        width, height: of the picture, pixels.
    """

    camera_to_world: NDArray[np.float64]
    fov_x: float
    fov_y: float
    width: int = 640
    height: int = 480


def view_from(*position: float) -> CutView:
    """A camera at a position, looking along -z."""
    camera = np.eye(4)
    camera[:3, 3] = position
    return CutView(camera, math.radians(80), math.radians(60))


def rotation(rng: np.random.Generator) -> np.ndarray:
    turned, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return turned * np.sign(np.linalg.det(turned))


def transform(rng: np.random.Generator, *, scale: float = 1.0, spread: float = 1.0) -> np.ndarray:
    """A random rotation and translation, and a uniform scale."""
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation(rng)
    matrix[:3, 3] = spread * rng.normal(size=3)
    return matrix


#: The second is Spark's; in the fifth the outer cone lies inside of the inner one.
FOVEATIONS = (
    *(Cones(), Cones(90, 120, 0.4, 0.2), Cones(0, 0, 0.5, 0.25), Cones(60, 60, 0.4, 0.2), Cones(100, 20, 0.4, 0.0)),
    *(Cones(0, 120, 0.4, 0.2), Cones(170, 180, 0.4, 0.2), Cones(90, 120, 1.0, 0.0)),
    *(Frustum(), Frustum(0.3, 0.1), Frustum(1.0, 0.0), Frustum(0.0, 1.0)),
)


@dataclass(frozen=True)
class Case:
    """The arguments of a cut."""

    trees: list[Nodes]
    instances: list[TreeInstance]
    view: CutView
    budget: int
    smallest: float = 0.0

    def viewer(self) -> SparkViewer:
        return SparkViewer(Forest(self.trees), self.instances)

    def find(self, viewer: SparkViewer | None = None, resident: np.ndarray | None = None) -> TreeCut:
        viewer = viewer or self.viewer()
        return viewer.cut(self.view, budget=self.budget, smallest=self.smallest, resident=resident)

    def tree(self, instance: TreeInstance) -> LodTree:
        return self.trees[instance.tree].tree

    @property
    def most(self) -> int:
        """Nodes of all instances."""
        return sum(len(self.tree(instance)) for instance in self.instances)


def drawn(cut: Any) -> list[tuple[int, int]]:
    """(instance, index) of each node of a cut."""
    return list(zip(cut.instance.tolist(), cut.node.tolist(), strict=True))


def expected_cut(
    case: Case, cut: TreeCut, resident: np.ndarray | None = None, bits: int = 16
) -> references.BudgetedCut:
    """The cut of one queue, for the views of a cut."""
    forest = Forest(case.trees)
    there = np.ones(forest.chunks, bool) if resident is None else resident
    return references.budgeted_cut(forest.nodes, cut.views, case.budget, case.smallest, there.__getitem__, bits)


def check_cut(case: Case, cut: TreeCut, resident: np.ndarray | None = None, bits: int = 16) -> None:
    """A cut and all that it reports are those of one queue."""
    expected = expected_cut(case, cut, resident, bits)
    nodes = drawn(cut)
    assert sorted(nodes) == sorted(expected.limit)
    assert (cut.reason, cut.missing, cut.least) == (expected.reason, expected.missing, expected.least)
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
        above[children(tree, node)] += above[node]
    return above


def links(fan_out: list[int], order: np.random.Generator | None = None) -> LodTree:
    """A tree whose nodes have so many children, the remaining ones none; breadth first, or in another order of runs."""
    count, start, waiting = [0], [0], [0]
    for many in fan_out:
        if not waiting:
            break
        node = waiting.pop(0 if order is None else int(order.integers(len(waiting))))
        if many:
            count[node], start[node] = many, len(count)
            waiting += range(len(count), len(count) + many)
            count += [0] * many
            start += [0] * many
    tree = LodTree(np.array(count, np.uint16), np.array(start, np.uint32))
    tree.validate()
    return tree


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
    """Cuts made of a few numbers, so that many of them coincide."""
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
    case = Case(trees, instances, draw(views(trees)), 0)
    budget = draw(st.integers(len(instances), case.most + 3))
    smallest = draw(st.sampled_from([0.0, 0.0, 1e-3, 0.1, 0.25, 0.5, 1.0, 2.0, 1e30, math.inf]))
    return dataclasses.replace(case, budget=budget, smallest=smallest)


def random_tree(rng: np.random.Generator, count: int, most_children: int) -> Nodes:
    """A tree of about `count` nodes, whose children are mostly smaller and scatter around their parents."""
    fan_out = rng.integers(2, most_children + 1, count).tolist()
    fan_out = fan_out[: 1 + int(np.searchsorted(np.cumsum(fan_out), count))]
    tree = links(fan_out)
    center, size = np.zeros((len(tree), 3)), np.ones(len(tree))
    for node in np.flatnonzero(tree.child_count):
        part, count = children(tree, node), int(tree.child_count[node])
        center[part] = center[node] + rng.normal(0, size[node], (count, 3))
        size[part] = size[node] * rng.uniform(0.4, 1.05, count)
    return Nodes(*(np.asarray(values, np.float16).astype(np.float32) for values in (center, size)), tree)


# Scenes at several detail levels


@dataclass(frozen=True)
class Regions:
    """(R, 2, 3) float64 bounds of R regions, and (R, L) int64 counts of their splats at L levels."""

    bounds: NDArray[np.float64]
    counts: NDArray[np.int64]


def random_regions(random: np.random.Generator, regions: int, levels: int, *, gaps: float = 0.0) -> Regions:
    """Regions of random places, sizes and counts, which fall from level to level; `gaps` is the share of empty runs."""
    low = random.uniform(-50, 50, (regions, 3))
    size = random.lognormal(0, 1.5, (regions, 3))
    finest = random.integers(1, 5000, regions)
    shares = np.cumprod(random.uniform(0.2, 0.9, (regions, levels)), axis=1)
    counts = np.maximum(1, (finest[:, None] * shares).astype(np.int64))
    counts[random.random(counts.shape) < gaps] = 0
    return Regions(np.stack([low, low + size], axis=1), counts)


def random_view(random: np.random.Generator, spread: float = 60.0) -> CutView:
    """A camera somewhere, which looks somewhere."""
    camera = np.eye(4)
    camera[:3, :3], camera[:3, 3] = rotation(random), random.uniform(-spread, spread, 3)
    fov_y, aspect = float(random.uniform(0.2, 2.0)), float(random.uniform(0.4, 2.5))
    return CutView(camera, 2 * float(np.arctan(np.tan(fov_y / 2) * aspect)), fov_y)


def row_of_regions(regions: int = 6, levels: int = 3, splats: int = 64, *, environment: int = 0) -> DetailScene:
    """Regions side by side along z, two units long each, whose levels have half as many splats each.

    Args:
        splats: of each region at level 0.
        environment: splats around them, far away.
    """
    counts = np.repeat(splats >> np.arange(levels)[None, :], regions, axis=0).astype(np.int64)
    scene = random_splats(int(counts.sum()), sh_degree=1, seed=7)
    center = np.random.default_rng(3).uniform(-1, 1, scene.center.shape).astype(np.float32)
    center[:, 2] += np.repeat(np.tile(2 * np.arange(regions), levels), counts.T.ravel()).astype(np.float32)
    low = np.stack([np.full(regions, -1.0), np.full(regions, -1.0), 2.0 * np.arange(regions) - 1], axis=1)
    below = np.array([[-1 - at, at + 1 if at + 2 < regions else -2 - at] for at in range(regions - 1)], np.int64)
    around = None
    if environment:
        around = random_splats(environment, sh_degree=1, seed=8)
        direction = around.center / np.linalg.norm(around.center, axis=1, keepdims=True)
        around = dataclasses.replace(around, center=(100 * direction).astype(np.float32))
    placed, bounds = dataclasses.replace(scene, center=center), np.stack([low, low + 2], axis=1)
    return DetailScene(placed, counts, bounds, below.reshape(-1, 2), environment=around)
