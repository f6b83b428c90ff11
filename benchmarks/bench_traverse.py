"""Measures traversals against Spark's own in one run: `python benchmarks/bench_traverse.py --help`."""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from bench_build import machine
from scenes import load, tiled

import sparklod_cli as sparklod
from sparklod_cli.cameras.framing import framing
from sparklod_cli.cameras.pose import look_at
from sparklod_cli.codecs.gpu import lod_tree
from sparklod_cli.lod.traversal import Forest, Traversal, TreeInstance, View
from sparklod_cli.model.nodes import Nodes
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.support.parallel import ordered_map, processors

HEADINGS = (
    "million nodes",
    "budget",
    "drawn",
    "a frame of a path, ms (min to max)",
    "ns a splat",
    "on one thread, ms",
    "a first frame, ms",
    "Spark ms (min to max)",
    "ratio",
    "ratio on one thread",
)


class Spark:
    """Spark's traversal in a Node process."""

    def __init__(self) -> None:
        program = Path(__file__).with_name("spark_traverse.mjs")
        self._node = subprocess.Popen(["node", str(program)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def ask(self, **request: Any) -> list[float]:
        """Sends a request; returns the milliseconds of each of its views."""
        assert self._node.stdin and self._node.stdout
        self._node.stdin.write(json.dumps(request) + "\n")
        self._node.stdin.flush()
        answer: list[float] = json.loads(self._node.stdout.readline())["ms"]
        return answer

    def close(self) -> None:
        """Ends the process."""
        assert self._node.stdin
        self._node.stdin.close()
        self._node.wait()


def flight(center: np.ndarray, radius: float, frames: int) -> list[View]:
    """Returns views on half a circle around a scene, at 1.5 times the radius of one tile, looking at its centre."""
    views = []
    for angle in np.linspace(0, np.pi, frames):
        eye = center + 1.5 * radius * np.array([np.sin(angle), -0.4, np.cos(angle)])
        views.append(View(look_at(eye, center, (0, -1, 0)), np.radians(90), np.radians(60)))
    return views


def tree_of(source: Splats, nodes: int) -> Nodes:
    """Tiles and bakes a scene to a tree of about `nodes` nodes; returns them as Spark stores them."""
    sample = min(nodes // 4, 500_000)  # the ratio of nodes to leaves hardly depends on the number
    growth = len(sparklod.build_lod(Scene(tiled(source, sample)))) / sample
    tree = sparklod.build_lod(Scene(tiled(source, round(nodes / growth))))
    return lod_tree.unpack(sparklod.pack(tree, "lodtree"))


def seconds_of(traversal: Traversal, views: list[View], budget: int, threads: int) -> float:
    """Seconds per frame of a whole path."""
    start = time.perf_counter()
    for _ in ordered_map(lambda view: len(traversal.cut(view, budget=budget)), views, threads):
        pass
    return (time.perf_counter() - start) / len(views)


def first(forest: Forest, view: View, budget: int) -> float:
    """Seconds of a cut that cannot start from the one before it; its buffers are allocated already."""
    traversal = Traversal(forest, [TreeInstance()])
    traversal.cut(view, budget=budget)
    traversal.forget()
    start = time.perf_counter()
    traversal.cut(view, budget=budget)
    return time.perf_counter() - start


def rows(nodes: Nodes, spark: Spark, budgets: list[int], frames: int, runs: int, radius: float, folder: Path) -> None:
    """Measures one tree with every budget, in turns with Spark, and prints a row for each budget."""
    forest = Forest([nodes])
    center, _ = framing(nodes.center)
    views = flight(center, radius, frames)
    words, indices = folder / "tree.u32", folder / "nodes.u32"
    words_of(nodes).tofile(words)
    spark.ask(tree=str(words))
    words.unlink()
    traversal = Traversal(forest, [TreeInstance()])
    for budget in budgets:
        asked = [
            {"viewToObjectCols": view.camera_to_world.T.ravel().tolist(), "maxSplats": budget, "pixelScaleLimit": 0}
            for view in views
        ]
        seconds_of(traversal, views, budget, processors())
        spark.ask(views=asked[-1:], indices=str(indices))
        cut = traversal.cut(views[-1], budget=budget).indices()[0]
        if not np.array_equal(cut, np.sort(np.fromfile(indices, np.uint32))):
            raise SystemExit(f"the cut of {budget:,} is not Spark's")
        paths, alone, firsts, theirs = [], [], [], []
        for _ in range(runs):
            paths.append(seconds_of(traversal, views, budget, processors()))
            alone.append(seconds_of(traversal, views, budget, 1))
            firsts.append(first(forest, views[0], budget))
            theirs += spark.ask(views=asked)
        ours, spark_ms = 1e3 * statistics.median(paths), statistics.median(theirs)
        cells = [
            f"{len(nodes.size) / 1e6:.1f}",
            f"{budget:,}",
            f"{len(cut):,}",
            f"{ours:.2f} ({1e3 * min(paths):.2f} to {1e3 * max(paths):.2f})",
            f"{1e6 * ours / len(cut):.1f}",
            f"{1e3 * statistics.median(alone):.2f}",
            f"{1e3 * statistics.median(firsts):.2f}",
            f"{spark_ms:.1f} ({min(theirs):.1f} to {max(theirs):.1f})",
            f"{spark_ms / ours:.1f}x",
            f"{spark_ms / 1e3 / statistics.median(alone):.1f}x",
        ]
        print("| " + " | ".join(cells) + " |", flush=True)


def words_of(nodes: Nodes) -> np.ndarray:
    """Returns the words of nodes that were unpacked from words."""
    rows = np.empty(len(nodes.size), lod_tree.NODE)
    rows["center"], rows["size"] = nodes.center, nodes.size
    rows["child_count"], rows["child_start"] = nodes.tree.child_count, nodes.tree.child_start
    return rows


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path, help="splat file to tile and bake")
    parser.add_argument(
        "--millions",
        type=float,
        nargs="*",
        default=[0.5, 1, 2, 5, 10, 20],
        help="nodes of the trees",
    )
    parser.add_argument(
        "--budgets", type=int, nargs="*", default=[50_000, 200_000, 500_000, 1_500_000], help="in nodes"
    )
    parser.add_argument("--frames", type=int, default=24, help="frames of the path")
    parser.add_argument("--runs", type=int, default=5, help="number of runs, in turns; medians are printed")
    arguments = parser.parse_args()
    print(f"Machine: {machine()}. Medians of {arguments.runs} runs of {arguments.frames} frames.\n")
    print("| " + " | ".join(HEADINGS) + " |")
    print("|---" * len(HEADINGS) + "|")
    scene = load(arguments.scene).with_max_sh(0)
    _, radius = framing(scene.center)
    spark = Spark()
    with tempfile.TemporaryDirectory() as folder:
        for millions in arguments.millions:
            nodes = tree_of(scene, round(millions * 1e6))
            # Skip budgets near or above the number of leaves: they limit nothing.
            budgets = [budget for budget in arguments.budgets if budget < len(nodes.size) / 2]
            rows(nodes, spark, budgets, arguments.frames, arguments.runs, radius, Path(folder))
    spark.close()


if __name__ == "__main__":
    main()
