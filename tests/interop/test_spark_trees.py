"""`inspect --check` reports the right facts and findings of trees from Spark's own builders.

The expected ones are computed by slow, plain Python from the bytes of the file, as docs/formats/ describes them.
"""

from __future__ import annotations

import gzip
import heapq
import json
import math
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs import ext_splats, spark_nodes, spz
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.lod_tree import CHUNK_NODES
from sparklod_cli.model.scene import Scene
from tests.codecs.cases import encode, rotation_degrees
from tests.conftest import FIXTURES, Capture, real_scene
from tests.interop.spark import Spark

pytestmark = pytest.mark.slow

#: Values of Spark's option `lod` for its two builders, the tiny one and Bhattacharyya's, by sparklod's methods.
BUILDERS: dict[str, Any] = {"quick": True, "quality": "quality"}


def spark_tree(spark: Spark, source: Path, builder: str) -> Scene:
    """Return the tree that Spark builds from a file, as it has it in memory."""
    words = spark.load_words("Ext", source, lod=BUILDERS[builder])
    nodes = spark_nodes.unpack({"lod_tree": words.pop("lodTree")})
    return Scene(ext_splats.unpack(words), nodes.tree)


@dataclass
class Tree:
    """The tree in an LoD SPZ file of version 3.

    Attributes:
        child_count, child_start: as stored.
        size: feature size of each node, world units.
        d: LoD opacity D of each node.
        parents: all parents of each node.
        depth: edges from the root by the first path found; has no nodes that cannot be reached.
        need: the least size on the path from the root to a node's parent, below which a viewer needs the node.
    """

    child_count: list[int]
    child_start: list[int]
    size: list[float]
    d: list[float]
    parents: list[list[int]] = field(default_factory=list)
    depth: dict[int, int] = field(default_factory=dict)
    need: dict[int, float] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> Tree:
        data = gzip.decompress(path.read_bytes())
        count = int.from_bytes(data[8:12], "little")
        assert (data[4], data[14]) == (3, 0x80)
        alphas = data[16 + 9 * count : 16 + 10 * count]
        scales = data[16 + 13 * count : 16 + 16 * count]
        links = data[-6 * count :]
        d, size = [], []
        for node in range(count):
            value = 2 * alphas[node] / 255
            d.append(value if value <= 1 else 4 * value - 3)
            mean = sum(math.exp(code / 16 - 10) for code in scales[3 * node : 3 * node + 3]) / 3
            size.append(2 * mean * (1 + 0.7 * max(0, d[-1] - 1)))
        child_count = np.frombuffer(links, "<u2", count).tolist()
        child_start = np.frombuffer(links, "<u4", count, 2 * count).tolist()
        tree = cls(child_count, child_start, size, d)
        tree._follow()
        return tree

    def __len__(self) -> int:
        return len(self.size)

    def children(self, node: int) -> range:
        return range(self.child_start[node], self.child_start[node] + self.child_count[node])

    def _follow(self) -> None:
        self.parents = [[] for _ in self.size]
        for node in range(len(self)):
            for child in self.children(node):
                self.parents[child].append(node)
        self.depth, self.need, frontier = {0: 0}, {0: math.inf}, [0]
        while frontier:
            node = frontier.pop()
            for child in self.children(node):
                if child not in self.depth:
                    self.depth[child] = self.depth[node] + 1
                    self.need[child] = min(self.need[node], self.size[node])
                    frontier.append(child)

    def codes(self) -> set[str]:
        """Return the codes of the expected findings, except about the order of nodes."""
        count, nodes = len(self), range(len(self))
        leaf = [not children for children in self.child_count]
        wrong = {
            "tree.root": self.parents[0],
            "tree.range": [node for node in nodes if not leaf[node] and self.children(node).stop > count],
            "tree.order": [node for node in nodes if not leaf[node] and self.children(node).start <= node],
            "tree.shared": [node for node in nodes if len(self.parents[node]) > 1],
            "tree.orphan": [node for node in nodes[1:] if not self.parents[node]],
            "tree.unreachable": [node for node in nodes if node not in self.depth and self.parents[node]],
            "tree.leaf-start": [node for node in nodes if leaf[node] and self.child_start[node]],
            "tree.leaf-opacity": [node for node in nodes if leaf[node] and self.d[node] > 1],
            "tree.single-child": [node for node in nodes if self.child_count[node] == 1],
            "tree.size": [
                node for node in nodes for child in self.children(node) if self.size[child] > 3 * self.size[node]
            ],
        }
        return {code for code, found in wrong.items() if found}

    def rise(self) -> float:
        """Return the largest ratio of the median `need` of a sixteenth of the file to that of an earlier one."""
        ends = [part * len(self) // 16 for part in range(17)]
        medians = [median(self.need[node] for node in range(*ends[part : part + 2])) for part in range(16)]
        return max(later / before for part, later in enumerate(medians) for before in medians[:part])

    def coarse_cut(self) -> set[int]:
        """Return the cut that refines the largest node first, as long as it has no more nodes than a chunk."""
        cut, heap = set(), [(-self.size[0], 0)]
        while heap:
            _, node = heapq.heappop(heap)
            if self.child_count[node] and len(cut) + len(heap) + self.child_count[node] > CHUNK_NODES:
                return cut | {node} | {other for _, other in heap}
            if not self.child_count[node]:
                cut.add(node)
            for child in self.children(node):
                heapq.heappush(heap, (-self.size[child], child))
        return cut

    def check_facts(self, report: dict[str, Any]) -> None:
        """Assert that a report has the facts of this tree."""
        facts, levels = report["tree"], Counter(self.depth.values())
        leaves = [node for node in range(len(self)) if not self.child_count[node]]
        assert report["splats"] == len(self)
        assert facts["leaves"] == len(leaves)
        assert facts["inner"] == len(self) - len(leaves)
        assert facts["growth"] == pytest.approx(len(self) / len(leaves), abs=1e-4)
        assert facts["depth"] == max(levels)
        assert [level["nodes"] for level in facts["levels"]] == [levels[depth] for depth in range(len(levels))]
        ends = Counter(self.depth[node] for node in leaves)
        assert [level["leaves"] for level in facts["levels"]] == [ends[depth] for depth in range(len(levels))]
        logs: Counter[int] = Counter()
        for node, depth in self.depth.items():
            logs[depth] += math.log(self.size[node])
        means = [math.exp(logs[depth] / levels[depth]) for depth in range(len(levels))]
        assert [level["size"] for level in facts["levels"]] == pytest.approx(means, rel=1e-3)
        children = Counter(count for count in self.child_count if count)
        assert facts["children"] == {str(count): times for count, times in children.items()}
        assert facts["more_than_opaque"] == pytest.approx(sum(d > 1 for d in self.d) / len(self), abs=1e-4)
        assert facts["chunks"] == math.ceil(len(self) / CHUNK_NODES)
        assert facts["chunks_of_coarse_cut"] == len({node // CHUNK_NODES for node in self.coarse_cut()})


def inspected(path: Path, capsys: Capture, *options: str) -> tuple[int, dict[str, Any]]:
    """Run `inspect --check`, and return its exit status and its report."""
    code = run(["inspect", str(path), "--json", "--check", *options])
    return code, json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(
    "name, builder", [("sh2.ply", "quality"), ("demo.ply", "quality"), ("demo.ply", "quick"), ("biker.ply", "quick")]
)
def test_facts_and_findings_of_sparks_trees_are_right(
    spark: Spark, tmp_path: Path, capsys: Capture, name: str, builder: str
) -> None:
    """A fixture with SH, one without, and a real scene with more nodes than a chunk."""
    source = FIXTURES / name if (FIXTURES / name).exists() else real_scene(name)
    path = tmp_path / "tree.spz"
    path.write_bytes(encode(spz, spark_tree(spark, source, builder), threads=2))
    code, report = inspected(path, capsys, "--fail-on", "warning")
    tree = Tree.read(path)
    tree.check_facts(report)
    assert report["tree"]["leaves"] == len(read_scene(source).splats)
    assert tree.codes() == set()  # Spark builds valid trees
    assert code == 0
    # The first 65,536 nodes are coarse before fine. The others follow part by part of the scene, which is a note.
    if len(tree) > CHUNK_NODES:
        assert tree.rise() > 1.5
        assert [found["code"] for found in report["findings"]] == ["tree.coarse-first"]
        assert report["findings"][0]["index"] > CHUNK_NODES
    else:
        assert tree.rise() < 1.5 or len(tree) < 1000
        assert report["findings"] == []


@pytest.mark.parametrize("builder", BUILDERS)
def test_leaves_of_sparks_trees_are_the_splats_but_for_small_rotations(
    spark: Spark, tmp_path: Path, capsys: Capture, builder: str
) -> None:
    """Spark's builders hold the w of a rotation as float16, which rounds it to 1 below 2.5 degrees."""
    source, path = FIXTURES / "demo.ply", tmp_path / "tree.spz"
    scene = spark_tree(spark, source, builder)
    path.write_bytes(encode(spz, scene))
    code, report = inspected(path, capsys, "--leaves-of", str(source))
    original = read_scene(source).splats
    by_center = {tuple(center): quat for center, quat in zip(original.center.tolist(), original.quat_xyzw, strict=True)}
    assert scene.tree is not None
    leaves = scene.splats.take(scene.tree.is_leaf)
    quats = np.array([by_center[tuple(center)] for center in leaves.center.tolist()], np.float64)
    turned = rotation_degrees(leaves.quat_xyzw, quats)
    assert code == 3
    (found,) = (found for found in report["findings"] if found["code"] == "expect.leaves")
    assert 0 < np.count_nonzero(turned > 1) <= np.count_nonzero(turned > 0.5) < 1e-3 * len(leaves)
    # They hold scales as float16, too, so that a few are rounded to other codes, and opacities make up for that.
    assert np.count_nonzero(turned > 1) <= found["count"] < 1e-2 * len(leaves)
    assert turned.max() < 2.6
    # Without such small rotations, the leaves are the splats.
    needle = tmp_path / "needle.spz"
    needle.write_bytes(encode(spz, spark_tree(spark, FIXTURES / "needle.ply", builder)))
    code, report = inspected(needle, capsys, "--leaves-of", str(FIXTURES / "needle.ply"))
    assert (code, report["tree"]["leaves"]) == (0, 60)
