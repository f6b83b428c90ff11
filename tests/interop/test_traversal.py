"""sparklod's traversal draws exactly the nodes that Spark's traversal draws, for any camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.codecs import ext_splats, spark_nodes
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.foveation import Cones
from sparklod_cli.model.lod_tree import CHUNK_NODES, Nodes
from sparklod_cli.viewers.cut import Forest, TreeCut, TreeInstance, views_of
from sparklod_cli.viewers.spark import SparkViewer
from sparklod_cli.viewers.viewer_settings import pixel_limit
from tests.conftest import FIXTURES, real_scene
from tests.interop.spark import NODE, Spark
from tests.lod.forests import rotation, transform
from tests.lod.sights import CutView
from tests.references import budgeted_cuts

pytestmark = pytest.mark.slow

SPARKS_CONES = Cones(90, 120, 0.4, 0.2)
FOVEATIONS = (
    Cones(),
    SPARKS_CONES,
    Cones(0, 120, 0.4, 0.2),  # no inner cone
    Cones(70, 70, 0.4, 0.2),  # nothing between the cones
    Cones(120, 60, 0.5, 0.1),  # the outer cone inside the inner one
    Cones(90, 120, 0.4, 0.0),  # nothing behind the camera
    Cones(60, 180, 0.3, 0.3),
    Cones(90, 200, 0.3, 0.1),
    Cones(0, 0, 0.4, 0.2),
    Cones(90, 120, 1.0, 0.2),
    Cones(33.3, 77.7, 0.123, 0.0456),
)
BUDGETS = (100, 1_000, 10_000, 50_000, 100_000, 250_000, 500_000, 1_500_000)
#: Pixel-scale limits for a field of view of 60 degrees: none, a pixel of several pictures, 20 pixels, and above all.
FOV_Y = math.radians(60)
LIMITS = (0.0, *(pixel_limit(FOV_Y, height) for height in (480, 1080, 2160)), pixel_limit(FOV_Y, 1080, 20.0), 1e9)

LOD_SCALES = (1.0, 1.0, 1.0, 0.3, 2.5)


@dataclass(frozen=True)
class Tree:
    """A tree as sparklod and as Spark hold it."""

    words: np.ndarray
    nodes: Nodes

    @classmethod
    def of(cls, words: np.ndarray) -> Tree:
        return cls(words, spark_nodes.unpack({"lod_tree": words}))


@cache
def baked(path: Path, method: str = "quick") -> Tree:
    """Bakes a scene; sizes of nodes are those of the splats in Spark's coding, as in Spark."""
    splats, tree = import_module(f"sparklod_cli.lod.{method}").build(read_scene(path).splats)
    return Tree.of(spark_nodes.pack(ext_splats.unpack(ext_splats.pack(splats)), tree)["lod_tree"])


def scene(name: str) -> Path:
    return FIXTURES / name if name == "demo.ply" else real_scene(name)


class Both:
    """Trees that are loaded in Spark's worker as well, to compare cuts of both."""

    def __init__(self, spark: Spark, trees: Sequence[Tree]) -> None:
        self._spark, self._trees = spark, trees
        self._ids = [spark.keep_tree(tree.words) for tree in trees]
        self._forest = Forest([tree.nodes for tree in trees])

    def check(self, instances: Sequence[TreeInstance], camera: np.ndarray, budget: int, smallest: float) -> TreeCut:
        """Asserts that both find the same nodes, least pixel scale, and wanted chunks in the same order.

        Chunks of the roots are left out of the order, since Spark always visits them.
        """
        view = CutView(camera, FOV_Y, FOV_Y)
        found = SparkViewer(self._forest, instances)
        cut = found.cut(view, budget=budget, smallest=smallest)
        theirs = self._spark.traverse(budget, smallest, [self._instance(each, camera) for each in instances])
        for ours, indices in zip(cut.indices(), theirs.indices, strict=True):
            np.testing.assert_array_equal(ours, np.sort(indices))
        base = self._forest.chunk_base
        roots = {int(base[each.tree]) for each in instances}
        touched = [int(base[self._ids.index(tree)]) + chunk for tree, chunk in theirs.chunks]
        assert set(touched) == roots | set(cut.wanted())
        beyond = [chunk for chunk in touched if chunk not in roots]
        if len(set(cut.demand[beyond])) == len(beyond):
            assert beyond == [chunk for chunk in cut.wanted() if chunk not in roots]
        if cut.stop:  # Spark returns the least pixel scale from the root to the node that did not fit
            _, instance, node = cut.stop
            assert [theirs.pixel_limit] == cut.limit[(cut.instance == instance) & (cut.node == node)].tolist()
        again = found.cut(view, budget=budget, smallest=smallest)  # starts from the first cut
        assert [nodes.tolist() for nodes in again.indices()] == [nodes.tolist() for nodes in cut.indices()]
        return cut

    def pixel_scale(self, instance: TreeInstance, camera: np.ndarray) -> np.float32:
        """Returns the pixel scale of the root."""
        (view,) = views_of(self._forest, [instance], CutView(camera, FOV_Y, FOV_Y))
        return budgeted_cuts.pixel_scale(self._forest.nodes[view["node_base"]], view)

    def _instance(self, instance: TreeInstance, camera: np.ndarray) -> dict[str, Any]:
        view_to_object = np.linalg.inv(instance.object_to_world) @ camera
        cones = instance.foveation
        assert isinstance(cones, Cones)
        return {
            "lodId": self._ids[instance.tree],
            "viewToObjectCols": view_to_object.T.ravel().tolist(),
            "lodScale": instance.lod_scale,
            "coneFov0": cones.fov0,
            "coneFov": cones.fov,
            "coneFoveate": cones.foveate,
            "behindFoveate": cones.behind,
        }


def cameras(nodes: Nodes, count: int, seed: int) -> list[np.ndarray]:
    """Returns (4, 4) matrices of cameras far, near, inside and at a node, looking at the scene, away or anywhere."""
    rng = np.random.default_rng(seed)
    middle = np.median(nodes.center, axis=0).astype(np.float64)
    radius = float(np.percentile(np.linalg.norm(nodes.center - middle, axis=1), 90))
    found = []
    for number in range(count):
        camera = np.eye(4)
        camera[:3, :3] = rotation(rng)
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        camera[:3, 3] = middle + (50, 3, 1.5, 0.7, 0.1)[number % 5] * radius * direction
        if number % 4 == 3:
            camera[:3, 3] = nodes.center[rng.integers(len(nodes.size))]
        if number % 3:  # to the scene or away from it
            backward = camera[:3, 3] - middle - 0.3 * radius * rng.normal(size=3)
            camera[:3, :3] = facing(backward if number % 3 == 1 else -backward)
        found.append(camera)
    return found


def facing(backward: np.ndarray) -> np.ndarray:
    """Returns the (3, 3) rotation of a camera whose z axis is along a vector."""
    z = backward / np.linalg.norm(backward)
    x = np.cross([0.1, 1.0, 0.2], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


@pytest.mark.parametrize(
    "name, method, views",
    [("demo.ply", "quick", 44), ("biker.spz", "quick", 22), ("demo.ply", "quality", 22)],
)
def test_the_cut_of_one_tree_is_that_of_spark(spark: Spark, name: str, method: str, views: int) -> None:
    tree = baked(scene(name), method)
    both = Both(spark, [tree])
    reasons = set()
    for number, camera in enumerate(cameras(tree.nodes, views, seed=len(tree.words))):
        instance = TreeInstance(0, np.eye(4), LOD_SCALES[number % 5], FOVEATIONS[number % len(FOVEATIONS)])
        # In three of four cases the limit ends the cut before the budget does.
        smallest = LIMITS[number // 2 % len(LIMITS)] if number % 4 else 0.0
        budget = BUDGETS[number % len(BUDGETS)]
        reasons.add(both.check([instance], camera, budget, smallest).reason)
    assert reasons >= {"budget", "pixel"}


def test_the_cut_of_every_cone_is_that_of_spark(spark: Spark) -> None:
    tree = baked(scene("demo.ply"))
    both = Both(spark, [tree])
    for camera in cameras(tree.nodes, 5, seed=3):
        for foveation in FOVEATIONS:
            cut = both.check([TreeInstance(0, foveation=foveation)], camera, len(tree.words) // 7, 0.0)
            assert (
                cut.reason == "budget" or foveation.behind == 0
            )  # everything may be behind the camera and have no weight


def test_the_cut_of_every_budget_is_that_of_spark(spark: Spark) -> None:
    """Budgets from a single node to all leaves."""
    tree = baked(scene("demo.ply"))
    both = Both(spark, [tree])
    camera = cameras(tree.nodes, 2, seed=4)[1]
    leaves = int(np.count_nonzero(tree.nodes.tree.is_leaf))
    for budget in (*range(1, 150), leaves - 1, leaves, leaves + 1):
        cut = both.check([TreeInstance(0, foveation=SPARKS_CONES)], camera, budget, 0.0)
        assert (cut.reason == "exhausted") == (budget >= leaves)


@pytest.mark.parametrize("names, views", [(["demo.ply"], 20), (["demo.ply", "biker.spz"], 12)])
def test_the_cut_of_several_instances_is_that_of_spark(spark: Spark, names: list[str], views: int) -> None:
    """Instances of one tree and of several are rotated, scaled and moved; some coincide."""
    trees = [baked(scene(name)) for name in names]
    both = Both(spark, trees)
    rng = np.random.default_rng(len(names))
    for number, camera in enumerate(cameras(trees[0].nodes, views, seed=5)):
        instances = []
        for _ in range(rng.integers(2, 7)):
            moved = transform(rng, scale=math.exp(rng.normal(0, 0.7)), spread=1.5)
            if instances and rng.random() < 0.3:
                moved = instances[-1].object_to_world
            chosen = (int(rng.integers(len(trees))), rng.choice(LOD_SCALES), FOVEATIONS[rng.integers(len(FOVEATIONS))])
            instances.append(TreeInstance(chosen[0], moved, float(chosen[1]), chosen[2]))
        if number % 4 == 0:
            instances = [instances[0]] * len(instances)  # ties at every node
        both.check(instances, camera, BUDGETS[number % 5], LIMITS[number % 3])


def test_the_cut_of_a_tree_that_spark_built_is_that_of_spark(spark: Spark) -> None:
    """Spark's builder takes sizes from another coding than ours; the tree is its four words a node."""
    words = spark.load_words("Packed", scene("demo.ply"), lod=True)["lodTree"]
    tree = Tree.of(words)
    assert (tree.nodes.tree.child_count == words.view(NODE)["child_count"][:, 0]).all()
    both = Both(spark, [tree])
    for number, camera in enumerate(cameras(tree.nodes, 40, seed=6)):
        instance = TreeInstance(0, np.eye(4), LOD_SCALES[number % 5], FOVEATIONS[number % len(FOVEATIONS)])
        both.check([instance], camera, BUDGETS[number % 6], LIMITS[number % 3])


def test_pixel_scales_are_those_of_spark_bit_for_bit(spark: Spark) -> None:
    """A root is refined if the limit is the float before its pixel scale, and not if it is that scale."""
    words = np.zeros((3, 4), np.uint32)
    nodes = words.view(NODE)[:, 0]
    nodes["center"], nodes["size"] = [0.3, -0.7, 0.2], 0.9
    nodes["child_count"][0], nodes["child_start"][0] = 2, 1
    both = Both(spark, [Tree.of(words)])
    rng = np.random.default_rng(8)
    for number in range(150):
        camera = transform(rng, spread=(0.2, 3.0, 100.0)[number % 3])
        moved = transform(rng, scale=math.exp(rng.normal())) if number % 2 else np.eye(4)
        instance = TreeInstance(0, moved, rng.uniform(0.1, 3), FOVEATIONS[rng.integers(len(FOVEATIONS))])
        scale = both.pixel_scale(instance, camera)
        if scale > 0:
            assert len(both.check([instance], camera, 9, float(np.nextafter(scale, np.float32(0))))) == 2
        assert len(both.check([instance], camera, 9, float(scale))) == 1


def test_the_chunks_that_are_wanted_are_those_of_spark(spark: Spark) -> None:
    """Chunks with the largest nodes come first."""
    tree = baked(scene("biker.spz"))
    both = Both(spark, [tree])
    chunks = -(-len(tree.words) // CHUNK_NODES)
    assert chunks > 2
    touched = {
        len(both.check([TreeInstance()], camera, budget, 0.0).wanted())
        for camera in cameras(tree.nodes, 15, seed=7)
        for budget in (1_000, 30_000, 200_000)
    }
    assert touched >= {1, chunks - 1, chunks}
