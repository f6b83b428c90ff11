"""With chunks missing, sparklod draws the nodes that Spark's paged traversal draws, and wants the same chunks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import pytest

from sparklod_cli.codecs import spark_nodes
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quick
from sparklod_cli.model.foveation import Cones
from sparklod_cli.model.instances import Instance
from sparklod_cli.model.lod_tree import CHUNK_NODES, Nodes
from sparklod_cli.model.scene import Scene
from sparklod_cli.simulation.frames import Simulation
from sparklod_cli.viewers.cut import Forest, TreeCut, TreeInstance
from sparklod_cli.viewers.scenes import read_scenes
from sparklod_cli.viewers.spark import SparkViewer
from sparklod_cli.viewers.viewer_settings import LodSettings, Network, StreamingSettings
from tests.conftest import real_scene
from tests.interop.spark import NODE, PageUpdate, Spark
from tests.interop.test_traversal import FOV_Y, FOVEATIONS, LOD_SCALES, SPARKS_CONES, Tree, cameras, scene
from tests.lod.forests import links, transform
from tests.lod.sights import CutView
from tests.simulation.conftest import around

pytestmark = pytest.mark.slow


def scattered(rng: np.random.Generator, count: int, chunks: int, most_children: int) -> Tree:
    """A tree of about `count` nodes, the children of each anywhere in some chunks, now and then across a border.

    The nodes in between belong to nobody.
    """
    fan_out = rng.integers(1, most_children + 1, count).tolist()
    tree = links(fan_out[: 1 + int(np.searchsorted(np.cumsum(fan_out), count))])
    runs = np.flatnonzero(tree.child_count)
    lengths = tree.child_count[runs].astype(np.int64)
    # Gaps of any size between the runs, in any order; some runs are moved onto the border of two chunks.
    room = chunks * CHUNK_NODES - 1 - int(lengths.sum())
    gaps = np.diff(np.sort(rng.integers(0, room, len(runs))), prepend=0)
    shuffled = rng.permutation(len(runs))
    start = np.empty(len(runs), np.int64)
    start[shuffled] = 1 + np.cumsum(gaps) + np.cumsum(lengths[shuffled]) - lengths[shuffled]
    words = np.zeros((chunks * CHUNK_NODES, 4), np.uint32)
    nodes = words.view(NODE)[:, 0]
    place = np.zeros(len(tree), np.int64)  # of each node of the tree
    center, size = np.zeros((len(tree), 3)), np.ones(len(tree))
    for run, node in enumerate(runs):
        part = slice(int(tree.child_start[node]), int(tree.child_start[node]) + int(lengths[run]))
        children = part.stop - part.start
        place[part] = start[run] + np.arange(children)
        center[part] = center[node] + rng.normal(0, size[node], (children, 3))
        size[part] = size[node] * rng.choice([0.5, 0.7, 0.8, 1.0, 1.1], children)
    nodes["center"][place], nodes["size"][place] = center, size
    nodes["child_count"][place[runs]], nodes["child_start"][place[runs]] = lengths, start
    return Tree.of(words)


@dataclass
class Paged:
    """Trees in a page pool of Spark's worker, and the same trees of sparklod.

    Attributes:
        trees: the trees.
        resident: (chunks,) of all trees, numbered as in `Forest`.
    """

    spark: Spark
    trees: Sequence[Tree]
    pages: int
    resident: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        pool = self.spark.new_pool(self.pages)
        self.ids = [self.spark.new_paged_tree(pool) for _ in self.trees]
        self.forest = Forest([tree.nodes for tree in self.trees])
        self.resident = np.zeros(self.forest.chunks, np.bool_)
        self.page_of = np.full(self.forest.chunks, -1)
        self._free = list(range(self.pages))

    def keep(self, demand: np.ndarray, rng: np.random.Generator) -> None:
        """Makes exactly these chunks resident, in pages at random."""
        updates = []
        for chunk in np.flatnonzero(self.resident & ~demand).tolist():
            page = int(self.page_of[chunk])
            updates.append(PageUpdate(*self._tree_and_number(chunk), page, None))
            self._free.append(page)
            self.page_of[chunk] = -1
        for chunk in rng.permutation(np.flatnonzero(demand & ~self.resident)).tolist():
            page = self._free.pop(int(rng.integers(len(self._free))))
            updates.append(PageUpdate(*self._tree_and_number(chunk), page, self._words(chunk)))
            self.page_of[chunk] = page
        self.spark.update_pages(updates)
        self.resident = demand.copy()

    def _place(self, chunk: int) -> tuple[int, int]:
        """The tree of a chunk, and the number of the chunk in that tree."""
        tree = int(np.searchsorted(self.forest.chunk_base, chunk, side="right")) - 1
        return tree, chunk - int(self.forest.chunk_base[tree])

    def _tree_and_number(self, chunk: int) -> tuple[int, int]:
        tree, number = self._place(chunk)
        return self.ids[tree], number

    def _words(self, chunk: int) -> np.ndarray:
        tree, number = self._place(chunk)
        return self.trees[tree].words[number * CHUNK_NODES : (number + 1) * CHUNK_NODES]

    def check(self, instances: Sequence[TreeInstance], camera: np.ndarray, budget: int, smallest: float) -> TreeCut:
        """Asserts that both draw the same nodes and want the same chunks, in the same order."""
        cut = SparkViewer(self.forest, instances).cut(
            CutView(camera, FOV_Y, FOV_Y), budget=budget, smallest=smallest, resident=self.resident
        )
        base = self.forest.chunk_base
        drawn = [number for number, each in enumerate(instances) if self.resident[base[each.tree]]]
        theirs = self.spark.traverse(budget, smallest, [self._instance(instances[number], camera) for number in drawn])
        ours = cut.indices()
        for number, indices in zip(drawn, theirs.indices, strict=True):
            np.testing.assert_array_equal(ours[number], np.sort(self._nodes(instances[number].tree, indices)))
        assert sum(map(len, ours)) == sum(map(len, theirs.indices))  # nothing of trees without a root
        roots = {int(base[instances[number].tree]) for number in drawn}
        touched = [int(base[self.ids.index(tree)]) + chunk for tree, chunk in theirs.chunks]
        assert set(touched) == roots | set(cut.wanted())
        # Of chunks with the same limit, ours come by number, Spark's as its queue finds them.
        beyond = [chunk for chunk in touched if chunk not in roots]
        limits = cut.demand[beyond]
        assert (limits[1:] <= limits[:-1]).all()
        return cut

    def _nodes(self, tree: int, indices: np.ndarray) -> np.ndarray:
        """The nodes of a tree at some indices of the page pool."""
        chunk_of = np.full(self.pages, -1)
        first, last = self.forest.chunk_base[tree : tree + 2]
        loaded = np.flatnonzero(self.resident[first:last])
        chunk_of[self.page_of[first + loaded]] = loaded
        chunks = chunk_of[indices // CHUNK_NODES]
        assert (chunks >= 0).all()
        return chunks * CHUNK_NODES + indices % CHUNK_NODES

    def _instance(self, instance: TreeInstance, camera: np.ndarray) -> dict[str, Any]:
        view_to_object = np.linalg.inv(instance.object_to_world) @ camera
        cones = instance.foveation
        assert isinstance(cones, Cones)
        return {
            "lodId": self.ids[instance.tree],
            "rootPage": int(self.page_of[self.forest.chunk_base[instance.tree]]),
            "viewToObjectCols": view_to_object.T.ravel().tolist(),
            "lodScale": instance.lod_scale,
            "coneFov0": cones.fov0,
            "coneFov": cones.fov,
            "coneFoveate": cones.foveate,
            "behindFoveate": cones.behind,
        }


def live(tree: Tree) -> Nodes:
    """The nodes of a tree, without those that belong to nobody."""
    there = tree.nodes.size > 0
    return Nodes(tree.nodes.center[there], tree.nodes.size[there], tree.nodes.tree)


def some_chunks(rng: np.random.Generator, forest: Forest) -> np.ndarray:
    """Random chunks of a forest, few of them or most."""
    return rng.random(forest.chunks) < rng.choice([0.2, 0.5, 0.8, 0.95])


@pytest.mark.parametrize("seed", range(2))
def test_the_cut_of_random_trees_with_missing_chunks_is_that_of_spark(spark: Spark, seed: int) -> None:
    """Budgets and limits end some of the cuts before chunks are missing, others not at all."""
    rng = np.random.default_rng(seed)
    tree = scattered(rng, 3_000, chunks=8, most_children=5)
    paged = Paged(spark, [tree], pages=11)
    reasons = set()
    for number, camera in enumerate(cameras(live(tree), 20, seed)):
        demand = some_chunks(rng, paged.forest)
        demand[0] = True
        paged.keep(demand, rng)
        instance = TreeInstance(0, np.eye(4), LOD_SCALES[number % 5], FOVEATIONS[number % len(FOVEATIONS)])
        for budget in (50, 200, 500, 1_000, 3_000):
            for smallest in (0.0, 0.01):
                reasons.add(paged.check([instance], camera, budget, smallest).reason)
    assert reasons >= {"budget", "pixel", "missing"}


def test_a_budget_ends_the_cut_at_a_node_whose_children_are_missing(spark: Spark) -> None:
    """Spark asks what the children would cost before it asks whether they are there."""
    rng = np.random.default_rng(9)
    tree = scattered(rng, 400, chunks=6, most_children=9)
    paged = Paged(spark, [tree], pages=6)
    ended = 0
    for camera in cameras(live(tree), 6, seed=9):
        demand = np.arange(6) != 1 + rng.integers(5)
        paged.keep(demand, rng)
        for budget in range(2, 90):
            cut = paged.check([TreeInstance()], camera, budget, 0.0)
            if cut.stop is not None:
                start = int(tree.nodes.tree.child_start[cut.stop[2]])
                last = start + int(tree.nodes.tree.child_count[cut.stop[2]]) - 1
                ended += not (demand[start // CHUNK_NODES] and demand[last // CHUNK_NODES])
    assert ended > 20


def test_the_cut_of_several_trees_in_one_page_pool_is_that_of_spark(spark: Spark) -> None:
    """Trees whose root is missing draw nothing, in Spark as in sparklod."""
    rng = np.random.default_rng(5)
    trees = [scattered(rng, count, chunks, 4) for count, chunks in ((2_000, 5), (800, 3), (50, 1))]
    paged = Paged(spark, trees, pages=12)
    for camera in cameras(live(trees[0]), 24, seed=5):
        paged.keep(some_chunks(rng, paged.forest), rng)
        instances = [
            TreeInstance(
                int(rng.integers(3)), transform(rng, spread=1.5), 1.0, FOVEATIONS[rng.integers(len(FOVEATIONS))]
            )
            for _ in range(rng.integers(1, 6))
        ]
        if any(paged.resident[paged.forest.chunk_base[each.tree]] for each in instances):
            for budget in (50, 500, 3_000):
                paged.check(instances, camera, budget, 0.0)


def test_the_cut_of_a_file_of_spark_with_missing_chunks_is_that_of_spark(spark: Spark) -> None:
    """Three chunks, so that all that can be missing are tried."""
    scene = read_scene(real_scene("rad/biker-spark.rad"))
    assert scene.tree is not None
    tree = Tree.of(spark_nodes.pack(scene.splats, scene.tree)["lod_tree"])
    paged = Paged(spark, [tree], pages=4)
    rng = np.random.default_rng(2)
    for number in range(4):
        paged.keep(np.array([True, bool(number & 1), bool(number & 2)]), rng)
        for camera in cameras(tree.nodes, 3, seed=number):
            for budget in (1_000, 20_000, 150_000):
                paged.check([TreeInstance(0, foveation=SPARKS_CONES)], camera, budget, 0.0)


@cache
def robot() -> Scene:
    """A tree of eleven chunks."""
    return Scene(*quick.build(read_scene(scene("playbot.sog")).splats))


@pytest.mark.parametrize("capacity", [None, 6])
def test_a_simulated_flight_is_that_of_spark(spark: Spark, capacity: int | None) -> None:
    """Frame by frame, with the chunks that are resident in the simulation in Spark's pages."""
    whole = robot()
    assert whole.tree is not None
    scenes = read_scenes([Instance(whole, "playbot")], precision="float16")
    paged = Paged(spark, [Tree.of(spark_nodes.pack(whole.splats, whole.tree)["lod_tree"])], pages=12)
    settings = LodSettings(60_000, SPARKS_CONES)
    rng = np.random.default_rng(3)
    counts = set()
    chunks = [sum(each) for each in scenes.with_cuts[0].requests]
    network = Network(bandwidth=3.0 * float(chunks[0]), latency=0.05)  # three chunks a second
    for frame in Simulation(scenes, settings, StreamingSettings(network, capacity)).run(around(24, 2.0, seconds=4.0)):
        paged.keep(frame.resident, rng)
        counts.add(int(frame.resident.sum()))
        if not frame.resident[0]:
            assert len(frame.cut) == 0
            continue
        at, limit = frame.camera, settings.limit(frame.camera.fov_y, frame.camera.height)
        cut = paged.check([TreeInstance(0, foveation=SPARKS_CONES)], at.camera_to_world, 60_000, limit)
        assert [nodes.tolist() for nodes in cut.indices()] == [nodes.tolist() for nodes in frame.cut.indices()]
        assert cut.wanted() == frame.cut.wanted()
    assert len(counts) > 3
