"""Measures traversals against Spark's own in one run: `python benchmarks/bench_traverse.py --help`."""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from fidelity_views import cameras_of
from performance.machine import machine
from performance.rows import Column, Label, Row, Table, figure, label, ratio
from scenes import load, tiled

import sparklod_cli as sparklod
from sparklod_cli.cameras.camera import look_at
from sparklod_cli.cameras.framing import framing
from sparklod_cli.codecs import layouts
from sparklod_cli.codecs.spark_nodes import Nodes
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.simulation.frames import Changes, measure
from sparklod_cli.system.threads import on_threads, ordered_map, processors
from sparklod_cli.viewers.continuous import ContinuousCuts
from sparklod_cli.viewers.loaded_scene import Forest, TreeInstance
from sparklod_cli.viewers.spark import SparkViewer

#: Nodes of the trees of tiled scenes in millions, budgets in nodes, and frames of their path.
MILLIONS, BUDGETS, FRAMES = (0.5, 1, 2, 5, 10, 20), (50_000, 200_000, 500_000, 1_500_000), 24

#: Budgets of real scenes.
REAL_BUDGETS = (20_000, 50_000, 200_000)

#: Nodes up to which continuous cuts are measured, for they look at every inner node.
CONTINUOUS_UP_TO = 1_200_000

#: Width and height of the picture that statistics are of.
SIZE = (1280, 720)


def _table(*names: Column) -> Table:
    return Table(
        columns=(
            *names,
            *(label("budget"), label("drawn")),
            figure("path_s", "a frame of a path, ms", 2, per=1e-3, spread=True),
            ratio("path_s", "drawn", "ns a splat", per=1e-9),
            figure("alone_s", "on one thread, ms", 2, per=1e-3),
            figure("first_s", "a first frame, ms", 2, per=1e-3, spread=True),
            figure("measure_s", "its statistics, ms", 2, per=1e-3),
            figure("continuous_s", "a continuous cut, ms", 1, per=1e-3),
            figure("spark_s", "Spark ms", 1, per=1e-3, spread=True),
            ratio("spark_s", "path_s", "Spark / path", unit="x"),
            ratio("spark_s", "first_s", "Spark / first frame", unit="x"),
        ),
        key=("tree", "budget"),
        judged=("path_s", "alone_s", "first_s", "first_alone_s", "measure_s", "continuous_s"),
    )


TILED = _table(label("tree", "million nodes"))
REAL = _table(label("tree"), label("nodes"))


@dataclass(frozen=True)
class CutView:
    """A camera for the traversal.

    Attributes:
        camera_to_world: (4, 4), axes of OpenGL: x to the right, y up, looking along -z.
        fov_x, fov_y: radians.
    """

    camera_to_world: np.ndarray
    fov_x: float
    fov_y: float


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


def flight(center: np.ndarray, radius: float, frames: int) -> list[CutView]:
    """Returns views on half a circle around a scene, at 1.5 times the radius of one tile, looking at its centre."""
    views = []
    for angle in np.linspace(0, np.pi, frames):
        eye = center + 1.5 * radius * np.array([np.sin(angle), -0.4, np.cos(angle)])
        views.append(CutView(look_at(eye, center, (0, -1, 0)), np.radians(90), np.radians(60)))
    return views


def tree_of(source: Splats, nodes: int) -> Nodes:
    """Tiles and bakes a scene to a tree of about `nodes` nodes; returns them as Spark stores them."""
    sample = min(nodes // 4, 500_000)  # the ratio of nodes to leaves hardly depends on the number
    growth = len(sparklod.build_lod(Scene(tiled(source, sample)))) / sample
    return _as_stored(sparklod.build_lod(Scene(tiled(source, round(nodes / growth)))))


def _as_stored(tree: Scene) -> Nodes:
    return layouts.unpack_nodes(sparklod.pack(tree, "lodtree"))


@dataclass(frozen=True)
class Flight:
    """A tree and the views of a path.

    Attributes:
        labels: of its rows.
        nodes: of the tree.
        views: of the path.
    """

    labels: dict[str, Label]
    nodes: Nodes
    views: Sequence[CutView]


def rows(flights: Iterable[Flight], budgets: Sequence[int], runs: int, spark: Spark | None) -> Iterator[Row]:
    """A row for each tree and budget, in turns with Spark.

    Budgets near or above the number of leaves are left out: they limit nothing.
    """
    with tempfile.TemporaryDirectory() as folder:
        for flight in flights:
            if spark:
                _give(spark, flight.nodes, Path(folder, "tree.u32"))
            measured = Measured(flight)
            for budget in budgets:
                if budget < len(flight.nodes.size) / 2:
                    yield measured.row(budget, runs, spark, Path(folder, "nodes.u32"))


class Measured:
    """Measures the cuts of one tree.

    Args:
        flight: the tree and its views.
    """

    def __init__(self, flight: Flight) -> None:
        self._labels, self._views = flight.labels, flight.views
        self._forest = Forest([flight.nodes])
        self._traversal = SparkViewer(self._forest, [TreeInstance()])
        self._depths = flight.nodes.tree.depths()
        small = len(flight.nodes.size) <= CONTINUOUS_UP_TO
        self._continuous = ContinuousCuts(self._traversal) if small else None

    def row(self, budget: int, runs: int, spark: Spark | None, indices: Path) -> Row:
        """Everything of one budget; a run of a path is its mean frame."""
        asked = [
            {"viewToObjectCols": view.camera_to_world.T.ravel().tolist(), "maxSplats": budget, "pixelScaleLimit": 0}
            for view in self._views
        ]
        self._path(budget, processors())
        cut = self._traversal.cut(self._views[-1], budget=budget).indices()[0]
        if spark:
            spark.ask(views=asked[-1:], indices=str(indices))
            if not np.array_equal(cut, np.sort(np.fromfile(indices, np.uint32))):
                raise SystemExit(f"the cut of {budget:,} of {self._labels['tree']} is not Spark's")
        jobs: dict[str, Callable[[], float]] = {
            "path_s": lambda: self._path(budget, processors()),
            "alone_s": lambda: self._path(budget, 1),
            "first_s": lambda: self._first(budget),
            "measure_s": lambda: self._statistics(budget),
        }
        if self._continuous:
            jobs["continuous_s"] = lambda: self._blended(budget)
        if spark:
            jobs["spark_s"] = lambda: statistics.mean(spark.ask(views=asked)) / 1e3
        figures: dict[str, list[float]] = {name: [] for name in jobs}
        for _ in range(runs):
            for name, job in jobs.items():
                figures[name].append(job())
        return Row({**self._labels, "nodes": len(self._forest.nodes), "budget": budget, "drawn": len(cut)}, figures)

    def _path(self, budget: int, threads: int) -> float:
        """Seconds per frame of a whole path."""
        start = time.perf_counter()
        for _ in ordered_map(lambda view: len(self._traversal.cut(view, budget=budget)), self._views, threads):
            pass
        return (time.perf_counter() - start) / len(self._views)

    def _first(self, budget: int) -> float:
        """Seconds of a cut that cannot start from the one before it; its buffers are allocated already.

        The mean of the first, the middle and the last view.
        """
        seconds = []
        for view in (self._views[0], self._views[len(self._views) // 2], self._views[-1]):
            find = partial(self._traversal.cut, view, budget=budget)
            find()
            self._traversal._memory.guess = 0.0
            seconds.append(_seconds(find))
        return statistics.mean(seconds)

    def _statistics(self, budget: int) -> float:
        """Seconds per frame of the statistics of cuts, and of what changes from one to the next, on one thread."""
        changes = Changes(self._forest, self._traversal.instances)
        seconds = []
        with on_threads(1):
            for view in self._views:
                cut = self._traversal.cut(view, budget=budget)
                seconds.append(
                    _seconds(lambda cut=cut, view=view: measure(self._forest, cut, view))
                    + _seconds(lambda cut=cut: changes.next(cut))
                )
        return statistics.mean(seconds)

    def _blended(self, budget: int) -> float:
        """Seconds of a continuous cut."""
        assert self._continuous
        return _seconds(lambda: self._continuous.cut(self._views[0], budget=budget))


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def _give(spark: Spark, nodes: Nodes, file: Path) -> None:
    """Has Spark load a tree."""
    rows = np.empty(len(nodes.size), layouts.NODE)
    rows["center"], rows["size"] = nodes.center, nodes.size
    rows["child_count"], rows["child_start"] = nodes.tree.child_count, nodes.tree.child_start
    rows.tofile(file)
    spark.ask(tree=str(file))
    file.unlink()


def tiled_flights(source: Path, millions: Iterable[float], frames: int) -> Iterator[Flight]:
    """Trees of a scene tiled to so many million nodes."""
    splats = load(source).with_max_sh(0)
    _, radius = framing(splats.center)
    for million in millions:
        nodes = tree_of(splats, round(million * 1e6))
        center, _ = framing(nodes.center)
        yield Flight({"tree": f"{len(nodes.size) / 1e6:.1f}"}, nodes, flight(center, radius, frames))


def real_flights(paths: Iterable[Path], method: str = "quality") -> Iterator[Flight]:
    """Trees of scenes, from the twelve cameras around them."""
    for path in paths:
        scene = Scene(load(path).with_max_sh(0))
        views = list(cameras_of("around", scene, SIZE))
        yield Flight({"tree": path.name}, _as_stored(sparklod.build_lod(scene, method=method)), views)


def main() -> None:
    """Prints a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path, help="splat file to tile and bake")
    parser.add_argument("--millions", type=float, nargs="*", default=MILLIONS, help="nodes of the trees")
    parser.add_argument("--budgets", type=int, nargs="*", default=BUDGETS, help="in nodes")
    parser.add_argument("--frames", type=int, default=FRAMES, help="frames of the path")
    parser.add_argument("--real", type=Path, nargs="*", default=[], help="scenes seen from cameras around them")
    parser.add_argument("--runs", type=int, default=5, help="number of runs, in turns; medians are printed")
    arguments = parser.parse_args()
    print(f"Machine: {machine()}. Medians of {arguments.runs} runs of {arguments.frames} frames.\n")
    spark = Spark()
    flights = tiled_flights(arguments.scene, arguments.millions, arguments.frames)
    TILED.show(rows(flights, arguments.budgets, arguments.runs, spark))
    if arguments.real:
        print()
        REAL.show(rows(real_flights(arguments.real), REAL_BUDGETS, arguments.runs, spark))
    spark.close()


if __name__ == "__main__":
    main()
