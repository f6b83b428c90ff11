"""sparklod's cuts have the nodes of Spark's, for any camera: of trees in memory, with missing chunks, and of files.

With `--precision`, its nodes have the numbers that Spark has after loading the very file.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs import layouts, spz
from sparklod_cli.codecs.formats import RAD_ENCODINGS, RadOptions, WriteOptions
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.codecs.spark_codings import SplatEncoding
from sparklod_cli.codecs.spark_nodes import Nodes
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quality, quick
from sparklod_cli.model.foveation import Cones
from sparklod_cli.model.gaussian import linear_opacity
from sparklod_cli.model.instances import Instance
from sparklod_cli.model.lod_tree import CHUNK_NODES
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import FloatArray
from sparklod_cli.simulation.frames import Simulation
from sparklod_cli.viewers.loaded_scene import Forest, TreeCut, TreeInstance, nodes_of, views_of
from sparklod_cli.viewers.scenes import read_scenes
from sparklod_cli.viewers.spark import SparkViewer
from sparklod_cli.viewers.viewer_settings import LodSettings, Network, StreamingSettings, pixel_limit
from tests.codecs.cases import encode
from tests.conftest import FIXTURES, real_scene
from tests.fittings import StandIn
from tests.fittings import stand_in as stand_in
from tests.interop.spark import NODE, PageUpdate, Spark
from tests.interop.spark_words import Words
from tests.interop.test_spark_files import chunks_of
from tests.lod.trees import CutView, links, rotation, transform
from tests.references import cuts as references
from tests.references.cuts import dynamic_limit
from tests.scenes import random_splats
from tests.simulation.conftest import around

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
        return cls(words, layouts.unpack_nodes({"lod_tree": words}))


@cache
def baked(name: str, method: str = "quick") -> Tree:
    """Bake a scene; sizes of nodes are those of the splats in Spark's coding, as in Spark."""
    splats, tree = (quick if method == "quick" else quality).build(read_scene(scene(name)).splats)
    return Tree.of(layouts.pack_nodes(layouts.unpack_ext(layouts.pack_ext(splats)), tree)["lod_tree"])


def scene(name: str) -> Path:
    return FIXTURES / name if name == "demo.ply" else real_scene(name)


def varied(number: int) -> TreeInstance:
    """An instance with one of the LoD scales and foveations."""
    return TreeInstance(0, np.eye(4), LOD_SCALES[number % 5], FOVEATIONS[number % len(FOVEATIONS)])


def as_asked(tree: int, instance: TreeInstance, camera: np.ndarray, **more: int) -> dict[str, Any]:
    """Return an instance as Spark's worker takes it."""
    cones = instance.foveation
    assert isinstance(cones, Cones)
    return {
        "lodId": tree,
        "viewToObjectCols": (np.linalg.inv(instance.object_to_world) @ camera).T.ravel().tolist(),
        "lodScale": instance.lod_scale,
        "coneFov0": cones.fov0,
        "coneFov": cones.fov,
        "coneFoveate": cones.foveate,
        "behindFoveate": cones.behind,
        **more,
    }


def cameras(nodes: Nodes, count: int, seed: int) -> list[np.ndarray]:
    """Return (4, 4) matrices of cameras far, near, inside and at a node, looking at the scene, away or anywhere."""
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
            z = (backward if number % 3 == 1 else -backward) / np.linalg.norm(backward)
            x = np.cross([0.1, 1.0, 0.2], z)
            x /= np.linalg.norm(x)
            camera[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
        found.append(camera)
    return found


# --- Whole trees ------------------------------------------------------------------------------------------------------


class Whole:
    """Whole trees in Spark's worker and the same trees of sparklod, whose cuts are compared."""

    def __init__(self, spark: Spark, trees: Sequence[Tree], forest: Forest | None = None) -> None:
        self._spark = spark
        self._ids = [spark.keep_tree(tree.words) for tree in trees]
        self.forest = forest or Forest([tree.nodes for tree in trees])

    def check(self, instances: Sequence[TreeInstance], camera: np.ndarray, budget: int, smallest: float) -> TreeCut:
        """Assert that both find the same nodes, least pixel scale, and wanted chunks in the same order.

        Chunks of the roots are left out of the order, since Spark always visits them.
        """
        view = CutView(camera, FOV_Y, FOV_Y)
        viewer = SparkViewer(self.forest, instances)
        cut = viewer.cut(view, budget=budget, smallest=smallest)
        asked = [as_asked(self._ids[each.tree], each, camera) for each in instances]
        theirs = self._spark.traverse(budget, smallest, asked)
        for ours, indices in zip(cut.indices(), theirs.indices, strict=True):
            np.testing.assert_array_equal(ours, np.sort(indices))
        base = self.forest.chunk_base
        roots = {int(base[each.tree]) for each in instances}
        touched = [int(base[self._ids.index(tree)]) + chunk for tree, chunk in theirs.chunks]
        assert set(touched) == roots | set(cut.wanted())
        beyond = [chunk for chunk in touched if chunk not in roots]
        if len(set(cut.demand[beyond])) == len(beyond):
            assert beyond == [chunk for chunk in cut.wanted() if chunk not in roots]
        if cut.stop:  # Spark returns the least pixel scale from the root to the node that did not fit
            _, instance, node = cut.stop
            assert [theirs.pixel_limit] == cut.limit[(cut.instance == instance) & (cut.node == node)].tolist()
        again = viewer.cut(view, budget=budget, smallest=smallest)  # starts from the first cut
        assert [nodes.tolist() for nodes in again.indices()] == [nodes.tolist() for nodes in cut.indices()]
        return cut

    def check_views(self, nodes: Nodes, views: int, seed: int) -> set[str]:
        """Check one tree from many views, and return the reasons why cuts end.

        In three of four cases the limit ends the cut before the budget does.
        """
        reasons = set()
        for number, camera in enumerate(cameras(nodes, views, seed)):
            smallest = LIMITS[number // 2 % len(LIMITS)] if number % 4 else 0.0
            reasons.add(self.check([varied(number)], camera, BUDGETS[number % len(BUDGETS)], smallest).reason)
        return reasons


@pytest.mark.parametrize(
    ("name", "method", "views"), [("demo.ply", "quick", 44), ("biker.spz", "quick", 22), ("demo.ply", "quality", 22)]
)
def test_the_cut_of_one_tree_is_that_of_spark(spark: Spark, name: str, method: str, views: int) -> None:
    tree = baked(name, method)
    assert Whole(spark, [tree]).check_views(tree.nodes, views, len(tree.words)) >= {"budget", "pixel"}


def test_the_cut_of_every_cone_and_of_every_budget_is_that_of_spark(spark: Spark) -> None:
    """Budgets from a single node to all leaves."""
    tree = baked("demo.ply")
    whole = Whole(spark, [tree])
    for camera in cameras(tree.nodes, 5, seed=3):
        for foveation in FOVEATIONS:
            cut = whole.check([TreeInstance(0, foveation=foveation)], camera, len(tree.words) // 7, 0.0)
            assert cut.reason == "budget" or foveation.behind == 0  # everything may be behind the camera
    camera = cameras(tree.nodes, 2, seed=4)[1]
    leaves = int(np.count_nonzero(tree.nodes.tree.is_leaf))
    for budget in (*range(1, 150), leaves - 1, leaves, leaves + 1):
        cut = whole.check([TreeInstance(0, foveation=SPARKS_CONES)], camera, budget, 0.0)
        assert (cut.reason == "exhausted") == (budget >= leaves)


@pytest.mark.parametrize(("names", "views"), [(["demo.ply"], 20), (["demo.ply", "biker.spz"], 12)])
def test_the_cut_of_several_instances_is_that_of_spark(spark: Spark, names: list[str], views: int) -> None:
    """Instances of one tree and of several are rotated, scaled and moved; some coincide."""
    trees = [baked(name) for name in names]
    whole = Whole(spark, trees)
    rng = np.random.default_rng(len(names))
    for number, camera in enumerate(cameras(trees[0].nodes, views, seed=5)):
        instances = []
        for _ in range(rng.integers(2, 7)):
            moved = transform(rng, scale=math.exp(rng.normal(0, 0.7)), spread=1.5)
            if instances and rng.random() < 0.3:
                moved = instances[-1].object_to_world
            tree, lod_scale, cones = rng.integers(len(trees)), rng.choice(LOD_SCALES), rng.integers(len(FOVEATIONS))
            instances.append(TreeInstance(int(tree), moved, float(lod_scale), FOVEATIONS[cones]))
        if number % 4 == 0:
            instances = [instances[0]] * len(instances)  # ties at every node
        whole.check(instances, camera, BUDGETS[number % 5], LIMITS[number % 3])


def test_the_cut_of_a_tree_that_spark_built_is_that_of_spark(spark: Spark) -> None:
    """Spark's builder takes sizes from another coding than ours; the tree is its four words a node."""
    tree = Tree.of(spark.load_words("Packed", scene("demo.ply"), lod=True)["lodTree"])
    assert (tree.nodes.tree.child_count == tree.words.view(NODE)["child_count"][:, 0]).all()
    Whole(spark, [tree]).check_views(tree.nodes, 40, seed=6)


def test_pixel_scales_are_those_of_spark_bit_for_bit(spark: Spark) -> None:
    """A root is refined if the limit is the float before its pixel scale, and not if it is that scale."""
    words = np.zeros((3, 4), np.uint32)
    nodes = words.view(NODE)[:, 0]
    nodes["center"], nodes["size"] = [0.3, -0.7, 0.2], 0.9
    nodes["child_count"][0], nodes["child_start"][0] = 2, 1
    whole = Whole(spark, [Tree.of(words)])
    rng = np.random.default_rng(8)
    for number in range(150):
        camera = transform(rng, spread=(0.2, 3.0, 100.0)[number % 3])
        moved = transform(rng, scale=math.exp(rng.normal())) if number % 2 else np.eye(4)
        instance = TreeInstance(0, moved, rng.uniform(0.1, 3), FOVEATIONS[rng.integers(len(FOVEATIONS))])
        (view,) = views_of(whole.forest, [instance], CutView(camera, FOV_Y, FOV_Y))
        scale = references.pixel_scale(whole.forest.nodes[view["node_base"]], view)
        if scale > 0:
            assert len(whole.check([instance], camera, 9, float(np.nextafter(scale, np.float32(0))))) == 2
        assert len(whole.check([instance], camera, 9, float(scale))) == 1


def test_the_wanted_chunks_are_those_of_spark(spark: Spark) -> None:
    """Chunks with the largest nodes come first."""
    tree = baked("biker.spz")
    whole, chunks = Whole(spark, [tree]), -(-len(tree.words) // CHUNK_NODES)
    assert chunks > 2
    touched = {
        len(whole.check([TreeInstance()], camera, budget, 0.0).wanted())
        for camera in cameras(tree.nodes, 15, seed=7)
        for budget in (1_000, 30_000, 200_000)
    }
    assert touched >= {1, chunks - 1, chunks}


# --- Missing chunks ---------------------------------------------------------------------------------------------------


def scattered(rng: np.random.Generator, count: int, chunks: int, most_children: int) -> Tree:
    """A tree of about `count` nodes, the children of each anywhere in some chunks, now and then across a border.

    The nodes in between have no parent.
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
    for node, first, children in zip(runs, start, lengths, strict=True):
        part = slice(int(tree.child_start[node]), int(tree.child_start[node]) + int(children))
        place[part] = first + np.arange(children)
        center[part] = center[node] + rng.normal(0, size[node], (children, 3))
        size[part] = size[node] * rng.choice([0.5, 0.7, 0.8, 1.0, 1.1], children)
    nodes["center"][place], nodes["size"][place] = center, size
    nodes["child_count"][place[runs]], nodes["child_start"][place[runs]] = lengths, start
    return Tree.of(words)


@dataclass
class Paged:
    """Trees in a page pool of Spark's worker and the same trees of sparklod, whose cuts are compared.

    Attributes:
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
        """Make exactly these chunks resident, in pages at random."""
        updates = []
        for chunk in np.flatnonzero(self.resident & ~demand).tolist():
            page = int(self.page_of[chunk])
            updates.append(self._update(chunk, page, load=False))
            self._free.append(page)
            self.page_of[chunk] = -1
        for chunk in rng.permutation(np.flatnonzero(demand & ~self.resident)).tolist():
            page = self._free.pop(int(rng.integers(len(self._free))))
            updates.append(self._update(chunk, page, load=True))
            self.page_of[chunk] = page
        self.spark.update_pages(updates)
        self.resident = demand.copy()

    def _update(self, chunk: int, page: int, *, load: bool) -> PageUpdate:
        tree = int(np.searchsorted(self.forest.chunk_base, chunk, side="right")) - 1
        number = chunk - int(self.forest.chunk_base[tree])
        words = self.trees[tree].words[number * CHUNK_NODES : (number + 1) * CHUNK_NODES]
        return PageUpdate(self.ids[tree], number, page, words if load else None)

    def check(self, instances: Sequence[TreeInstance], camera: np.ndarray, budget: int, smallest: float) -> TreeCut:
        """Assert that both draw the same nodes and want the same chunks, in the same order."""
        viewer, base = SparkViewer(self.forest, instances), self.forest.chunk_base
        view = CutView(camera, FOV_Y, FOV_Y)
        cut = viewer.cut(view, budget=budget, smallest=smallest, resident=self.resident)
        drawn = [number for number, each in enumerate(instances) if self.resident[base[each.tree]]]
        asked = [
            as_asked(self.ids[each.tree], each, camera, rootPage=int(self.page_of[base[each.tree]]))
            for each in (instances[number] for number in drawn)
        ]
        theirs = self.spark.traverse(budget, smallest, asked)
        ours = cut.indices()
        for number, indices in zip(drawn, theirs.indices, strict=True):
            np.testing.assert_array_equal(ours[number], np.sort(self._nodes(instances[number].tree, indices)))
        assert sum(map(len, ours)) == sum(map(len, theirs.indices))  # nothing of trees without a root
        roots = {int(base[instances[number].tree]) for number in drawn}
        touched = [int(base[self.ids.index(tree)]) + chunk for tree, chunk in theirs.chunks]
        assert set(touched) == roots | set(cut.wanted())
        # Of chunks with the same limit, ours come by number, Spark's in the order of its queue.
        limits = cut.demand[[chunk for chunk in touched if chunk not in roots]]
        assert (limits[1:] <= limits[:-1]).all()
        return cut

    def _nodes(self, tree: int, indices: np.ndarray) -> np.ndarray:
        """Return the nodes of a tree at some indices of the page pool."""
        chunk_of = np.full(self.pages, -1)
        first, last = self.forest.chunk_base[tree : tree + 2]
        loaded = np.flatnonzero(self.resident[first:last])
        chunk_of[self.page_of[first + loaded]] = loaded
        chunks = chunk_of[indices // CHUNK_NODES]
        assert (chunks >= 0).all()
        return chunks * CHUNK_NODES + indices % CHUNK_NODES


def live(tree: Tree) -> Nodes:
    """The nodes of a tree that have a size; the others have no parent."""
    sized = tree.nodes.size > 0
    return Nodes(tree.nodes.center[sized], tree.nodes.size[sized], tree.nodes.tree)


def random_chunks(rng: np.random.Generator, forest: Forest, *, root: bool = False) -> np.ndarray:
    """Random chunks of a forest, few or most of them."""
    chunks = rng.random(forest.chunks) < rng.choice([0.2, 0.5, 0.8, 0.95])
    chunks[0] |= root
    return chunks


@pytest.mark.parametrize("seed", range(2))
def test_the_cut_of_random_trees_with_missing_chunks_is_that_of_spark(spark: Spark, seed: int) -> None:
    """Budgets and limits end some of the cuts before chunks are missing, others not at all."""
    rng = np.random.default_rng(seed)
    tree = scattered(rng, 3_000, chunks=8, most_children=5)
    paged = Paged(spark, [tree], pages=11)
    reasons = set()
    for number, camera in enumerate(cameras(live(tree), 20, seed)):
        paged.keep(random_chunks(rng, paged.forest, root=True), rng)
        for budget in (50, 200, 500, 1_000, 3_000):
            for smallest in (0.0, 0.01):
                reasons.add(paged.check([varied(number)], camera, budget, smallest).reason)
    assert reasons >= {"budget", "pixel", "missing"}


def test_a_budget_ends_the_cut_at_a_node_whose_children_are_missing(spark: Spark) -> None:
    """Spark checks the budget for the children before it checks whether they are resident."""
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
        paged.keep(random_chunks(rng, paged.forest), rng)
        instances = [
            TreeInstance(
                int(rng.integers(3)), transform(rng, spread=1.5), 1.0, FOVEATIONS[rng.integers(len(FOVEATIONS))]
            )
            for _ in range(rng.integers(1, 6))
        ]
        if any(paged.resident[paged.forest.chunk_base[each.tree]] for each in instances):
            for budget in (50, 500, 3_000):
                paged.check(instances, camera, budget, 0.0)


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
    paged = Paged(spark, [Tree.of(layouts.pack_nodes(whole.splats, whole.tree)["lod_tree"])], pages=12)
    settings = LodSettings(60_000, SPARKS_CONES)
    rng = np.random.default_rng(3)
    counts = set()
    first = float(sum(scenes.with_cuts[0].requests[0]))
    network = Network(bandwidth=3.0 * first, latency=0.05)  # three chunks a second
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


# --- Nodes and cuts of files ------------------------------------------------------------------------------------------

#: Layouts of Spark's worker by precision, of a whole file, and of chunks of a RAD file that are loaded alone, as pages.
LAYOUTS = {"ext": "Ext", "packed": "Packed"}
PAGES = {"ext": "Ext", "packed-pages": "Packed"}


def held(scene: Scene, precision: str) -> Words:
    """Return the words of nodes whose numbers are half floats."""
    assert scene.tree is not None
    nodes = nodes_of(scene.splats, scene.tree, scene.coding, precision=precision, threads=2)
    words = np.zeros((len(nodes.size), 4), np.uint32)
    rows = words.view(NODE)[:, 0]
    rows["center"], rows["size"] = nodes.center, nodes.size
    rows["child_count"], rows["child_start"] = nodes.tree.child_count, nodes.tree.child_start
    return words


def loaded_chunks(spark: Spark, path: Path, layout: str, chunk: Path) -> list[Words]:
    """Load each chunk of a RAD file alone, written to `chunk`, and return its nodes."""
    loaded = []
    for data, _, _ in chunks_of(path):
        chunk.write_bytes(data)
        loaded.append(spark.load_words(layout, chunk)["lodTree"])
    return loaded


def check_nodes(spark: Spark, path: Path, tmp_path: Path, *, whole: bool = True) -> int:
    """Assert that nodes have the words of Spark after loading a file, and of RAD each chunk; count the chunks."""
    scene = read_scene(path)
    if whole:
        for precision, layout in LAYOUTS.items():
            np.testing.assert_array_equal(held(scene, precision), spark.load_words(layout, path)["lodTree"], precision)
    if path.suffix != ".rad":
        return 0
    for precision, layout in PAGES.items():
        loaded = loaded_chunks(spark, path, layout, tmp_path / "chunk.radc")
        np.testing.assert_array_equal(held(scene, precision), np.concatenate(loaded), precision)
    return len(loaded)


def check_cuts(spark: Spark, path: Path, views: int) -> None:
    """Assert that cuts of a file are those of Spark, which loads it itself."""
    for precision, layout in LAYOUTS.items():
        scenes = read_scenes([Instance(path, "tree")], precision=precision, threads=2)
        tree = Tree.of(spark.load_words(layout, path)["lodTree"])
        Whole(spark, [tree], scenes.forest).check_views(tree.nodes, views, seed=len(tree.words))


def check_paged_cuts(spark: Spark, path: Path, tmp_path: Path, precision: str, frames: int) -> None:
    """Assert that cuts of a file with missing chunks are those of Spark, which loads the chunks itself."""
    loaded = loaded_chunks(spark, path, PAGES[precision], tmp_path / "chunk.radc")
    tree = Tree.of(np.concatenate(loaded))
    paged = Paged(spark, [tree], pages=len(loaded) + 1)
    paged.forest = read_scenes([Instance(path, "tree")], precision=precision, threads=2).forest
    rng = np.random.default_rng(frames)
    reasons = set()
    for number, camera in enumerate(cameras(tree.nodes, frames, seed=len(loaded))):
        resident = rng.random(len(loaded)) < rng.choice([0.4, 0.7])
        resident[0] = True
        paged.keep(resident, rng)
        for budget in (1_000, 20_000, 150_000):
            reasons.add(paged.check([varied(number)], camera, budget, LIMITS[number % len(LIMITS)]).reason)
    assert "missing" in reasons


@cache
def built(folder: Path, name: str, method: str, suffix: str) -> Path:
    made = folder / f"{Path(name).stem}-{method}{suffix}"
    assert run(["build-lod", str(scene(name)), "--method", method, "--quiet", "-o", str(made)]) == 0
    return made


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("trees")


BUILT = [
    *(("demo.ply", "quality", suffix) for suffix in (".spz", ".rad")),
    *(("biker.ply", "quick", ".spz"), ("meadow.sog", "quick", ".rad")),
]


@pytest.mark.parametrize(("name", "method", "suffix"), BUILT)
def test_nodes_and_cuts_of_built_files_are_those_of_spark(
    spark: Spark, folder: Path, tmp_path: Path, name: str, method: str, suffix: str
) -> None:
    path = built(folder, name, method, suffix)
    chunks = -(-len(read_scene(path)) // CHUNK_NODES)
    assert check_nodes(spark, path, tmp_path) == (chunks if suffix == ".rad" else 0)
    check_cuts(spark, path, views=8)


@pytest.mark.parametrize("precision", PAGES)
@pytest.mark.parametrize("name", ["meadow.sog", "rad/biker-spark.rad"])
def test_cuts_of_files_with_missing_chunks_are_those_of_spark(
    spark: Spark, folder: Path, tmp_path: Path, name: str, precision: str
) -> None:
    """Of a file of sparklod, and of one of Spark's native program."""
    path = scene(name) if "spark" in name else built(folder, name, "quick", ".rad")
    check_paged_cuts(spark, path, tmp_path, precision, frames=10)


@pytest.mark.parametrize("suffix", [".spz", ".rad"])
def test_nodes_and_cuts_of_refined_trees_are_those_of_spark(
    spark: Spark, tmp_path: Path, stand_in: StandIn, suffix: str
) -> None:
    """Refined as read from their file, so that scales come from no code before they are written again."""
    made, refined = built(tmp_path, "demo.ply", "quality", suffix), tmp_path / f"refined{suffix}"
    assert run(["build-lod", str(made), "--refine", "--quiet", "-o", str(refined)]) == 0
    assert len(stand_in.calls) == 1
    assert refined.read_bytes() != made.read_bytes()
    check_nodes(spark, refined, tmp_path)
    check_cuts(spark, refined, views=8)


@pytest.mark.parametrize("precision", LAYOUTS)
@pytest.mark.parametrize("suffix", [".spz", ".rad"])
def test_dynamic_cuts_are_those_of_spark(spark: Spark, folder: Path, suffix: str, precision: str) -> None:
    """A dynamic cut of Spark is the cut of all nodes above the pixel scale at which it ends."""
    path = built(folder, "demo.ply", "quality", suffix)
    scenes = read_scenes([Instance(path, "tree")], precision=precision, threads=2)
    tree = Tree.of(spark.load_words(LAYOUTS[precision], path)["lodTree"])
    lod_id, count, limit = spark.keep_tree(tree.words), len(tree.words), LIMITS[2]
    instance = TreeInstance(0, foveation=SPARKS_CONES)
    viewer = SparkViewer(scenes.forest, [instance])
    for number, camera in enumerate(cameras(tree.nodes, 12, seed=count)):
        budget, view = BUDGETS[1 + number % 4], CutView(camera, FOV_Y, FOV_Y)

        def nodes_at(scale: float, view: CutView = view) -> int:
            return len(viewer.cut(view, budget=count, smallest=scale))

        ours = viewer.cut(view, budget=count, smallest=dynamic_limit(nodes_at, budget, limit))
        theirs = spark.traverse(budget, limit, [as_asked(lod_id, instance, camera)], mode="dynamic")
        np.testing.assert_array_equal(ours.indices()[0], np.sort(theirs.indices[0]))


def test_nodes_of_files_of_other_writers_are_those_of_spark(spark: Spark, tmp_path: Path) -> None:
    """Of Spark's native program; and chunks of few splats, each with encodings and ranges of its own."""
    by_hand = FIXTURES / "golden" / "sh1-tree.rad"
    coding = read_scene(by_hand).coding
    assert coding is not None and len(coding.scales) == 3
    precision, layout = next(iter(LAYOUTS.items()))
    words = spark.load_words(layout, by_hand)["lodTree"]
    np.testing.assert_array_equal(held(read_scene(by_hand), precision), words)
    path = real_scene("rad/biker-spark.rad")
    assert check_nodes(spark, path, tmp_path) == 3
    check_cuts(spark, path, views=8)
    assert check_nodes(spark, real_scene("rad/playbot-125k-spark/p-lod.rad"), tmp_path, whole=False) == 3


# --- Extreme trees ----------------------------------------------------------------------------------------------------


def extreme(count: int = 30_000, reach: float = np.inf) -> Scene:
    """A tree whose nodes have any size, shape and opacity: needles, huge and tiny splats, the ends of half floats.

    Many numbers are ties of one of the codings, or next to one.
    """
    rng = np.random.default_rng(5)
    splats, tree = quick.build(random_splats(count))
    count = len(splats)
    logs = rng.uniform(-14, 10, (count, 3)).astype(np.float32)
    kind = rng.integers(8, size=count)
    logs[kind == 1] = rng.uniform(-60, 60, (np.sum(kind == 1), 3))
    logs[kind == 2, 0] -= 12  # needles
    logs[kind == 3] = half_ways(rng, np.float32(21 / 254), -12, np.sum(kind == 3))
    logs[kind == 4] = half_ways(rng, np.float32(2**-7), -10, np.sum(kind == 4))
    scale = np.exp(logs.astype(np.float64)).astype(np.float32)
    scale[kind == 5, 1] = 0
    alpha = rng.choice([0, 0.3, 1, 1.2, 1.9, 2], count).astype(np.float32)
    alpha[kind == 6] = rng.uniform(1, 2, np.sum(kind == 6))
    alpha[kind == 7] = 1 + (rng.integers(1024, size=np.sum(kind == 7)) + 0.5) / 1024  # ties of half floats
    d = np.where(alpha > 1, 4 * alpha - 3, alpha)
    center = splats.center * np.exp(rng.uniform(-18, 12, (count, 1))).astype(np.float32)
    center = center.clip(-reach, reach).astype(np.float32)
    return Scene(replace(splats, center=center, scale=scale, opacity=linear_opacity(d)), tree)


def half_ways(rng: np.random.Generator, step: np.float32, low: int, count: int) -> FloatArray:
    """(count, 3) numbers half-way between two codes of logarithms, and next to those."""
    middles = (low + (rng.integers(240, size=(count, 3)) + 0.5) * step).astype(np.float32)
    return np.nextafter(middles, rng.choice([-np.inf, np.inf], middles.shape).astype(np.float32))


#: Ranges other than Spark's, so that splats in pages have other codes than those of the whole file.
NARROW = SplatEncoding(ln_scale_min=-8.3, ln_scale_max=1.7, rgb_min=-0.5, rgb_max=2)
WAYS = [
    RadOptions(scales=scales, alpha=alpha, center=center, ranges=ranges)
    for scales, alpha, center, ranges in (
        ("ln_0r8", "f16", "f32", None),
        ("ln_0r8", "r8", "f16", NARROW),
        ("ln_f16", "f32", "f32_lebytes", NARROW),
        ("f32", "f32", "f16_lebytes", None),
        ("f32", "r8", "f32", NARROW),
    )
]


@pytest.mark.parametrize("way", WAYS, ids=lambda way: f"{way.scales}-{way.alpha}")
def test_nodes_of_extreme_trees_in_rad_are_those_of_spark(spark: Spark, tmp_path: Path, way: RadOptions) -> None:
    for name in ("scales", "alpha", "center"):
        assert {getattr(each, name) for each in WAYS} == set(RAD_ENCODINGS[name])
    path = tmp_path / "tree.rad"
    path.write_bytes(encode(rad, extreme(reach=65_000 if "f16" in way.center else np.inf), WriteOptions(rad=way)))
    assert check_nodes(spark, path, tmp_path) == 1


@pytest.mark.parametrize("version", [2, 3])
def test_nodes_and_cuts_of_extreme_trees_in_spz_are_those_of_spark(spark: Spark, tmp_path: Path, version: int) -> None:
    path = tmp_path / "tree.spz"
    path.write_bytes(encode(spz, extreme(reach=2000), WriteOptions(spz_version=version)))
    check_nodes(spark, path, tmp_path)
    check_cuts(spark, path, views=16)
