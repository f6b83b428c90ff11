"""How far cuts of our trees and of Spark's are from full detail: `python benchmarks/bench_fidelity.py --help`."""

from __future__ import annotations

import argparse
import io
import json
import math
import os
import statistics
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from bench_build import machine
from numpy.typing import NDArray

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.cameras.formats.source import Parsed
from sparklod_cli.cameras.frame import DEFAULT_UP, Settings
from sparklod_cli.cameras.framing import framing
from sparklod_cli.cameras.generators import orbit
from sparklod_cli.cameras.path import GENERATED, cameras_of
from sparklod_cli.codecs import spz
from sparklod_cli.codecs.gpu import ext_splats, lod_tree
from sparklod_cli.codecs.gpu.lod_tree import Nodes
from sparklod_cli.compare import on_background
from sparklod_cli.images.metrics import psnr
from sparklod_cli.io import read_scene
from sparklod_cli.lod import quality, quick
from sparklod_cli.lod.budget import Budget, parse_budgets
from sparklod_cli.lod.traversal import Forest, Instance, Traversal
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.selection import Selection
from sparklod_cli.model.splats import Splats
from sparklod_cli.render.rasterizer import Image, draw
from sparklod_cli.render.settings import RasterSettings
from sparklod_cli.render.shading import show
from sparklod_cli.simulation.frames import view_of
from sparklod_cli.support import jit
from sparklod_cli.support.defaults import DEFAULT_GROWTH
from sparklod_cli.support.parallel import processors

#: What a folder stands for.
REAL_SCENES = ("biker.ply", "playbot.sog", "playbot-125k.ply", "meadow.sog")

#: What builds trees, by what it is called in tables.
METHODS = {
    "spark-tiny": "Spark tiny",
    "spark-quality": "Spark quality",
    "quick": "our quick",
    "quality": "our quality",
}

#: Ours, and what of Spark's each is held against.
PAIRS = (("quality", "spark-quality"), ("quick", "spark-tiny"))

BUDGETS = "2%,5%,10%,25%,50%"

#: The cameras: pixels, degrees of the vertical field of view, how many go once around, how many degrees above the
#: middle, and how many radii away from it.
SIZE, FOV_Y, AROUND, ELEVATION, DISTANCES = (960, 540), 60.0, 6, 15.0, (1.6, 3.5)

#: Grays that pictures are compared on.
BACKGROUNDS = (0.0, 1.0)


@dataclass(frozen=True)
class Built:
    """A tree as a viewer holds it, and how long building it took.

    Attributes:
        splats: of all nodes, without spherical harmonics.
        nodes: the same as the traversal reads them.
        seconds: of each run.
    """

    splats: Splats
    nodes: Nodes
    seconds: list[float]


@dataclass(frozen=True)
class Measured:
    """What was found of one builder's tree.

    Attributes:
        nodes, leaves: how many.
        seconds: of each run of the builder.
        psnr: (cameras, budgets) dB, means of the backgrounds.
    """

    nodes: int
    leaves: int
    seconds: list[float]
    psnr: NDArray[np.float64]

    @property
    def mean(self) -> list[float]:
        """(budgets,) dB, means of the cameras."""
        mean: list[float] = self.psnr.mean(axis=0).tolist()
        return mean

    @property
    def build(self) -> float:
        """The median of the runs, seconds."""
        return statistics.median(self.seconds)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "nodes": self.nodes,
            "leaves": self.leaves,
            "build_s": self.seconds,
            "build_s_median": self.build,
            "psnr": self.mean,
            "psnr_of_cameras": self.psnr.tolist(),
        }


#: Of one scene, by method.
Found = dict[str, Measured]


class FullDetail:
    """A scene as it was read, drawn from every camera.

    Args:
        splats: of the scene; their spherical harmonics are left out.

    Attributes:
        leaves: how many splats there are.
    """

    def __init__(self, splats: Splats) -> None:
        self.leaves = len(splats)
        self._cameras = cameras_around(splats.center)
        self._pictures = [picture(splats.with_max_sh(0), camera) for camera in self._cameras]

    def psnr(self, built: Built, budgets: Sequence[Budget]) -> NDArray[np.float64]:
        """(cameras, budgets) dB: how far cuts of a tree are from it."""
        forest = Forest([built.nodes])
        # One for each budget: a traversal begins where its last cut ended.
        traversals = [(Traversal(forest, [Instance()]), budget.of(self.leaves)) for budget in budgets]
        found = np.empty((len(self._cameras), len(budgets)))
        for row, camera, full in zip(found, self._cameras, self._pictures, strict=True):
            for at, (traversal, budget) in enumerate(traversals):
                cut = traversal.cut(view_of(camera), budget=budget).indices()[0]
                row[at] = difference(picture(built.splats.take(cut), camera), full)
        return found


def cameras_around(center: NDArray[np.floating]) -> tuple[Camera, ...]:
    """Cameras around the middle of a scene whose up is -y, near ones and far ones."""
    middle, radius = framing(center)
    frames = []
    for away in DISTANCES:
        frames += orbit(AROUND, middle, away * radius, math.radians(ELEVATION), DEFAULT_UP)
    settings = Settings(size=SIZE, fov_y=math.radians(FOV_Y))
    return cameras_of(Parsed(frames), GENERATED["orbit"], settings).cameras


def picture(splats: Splats, camera: Camera) -> Image:
    """What a camera sees."""
    return draw(show([(splats, np.eye(4))], camera), camera, RasterSettings())


def difference(image: Image, full: Image) -> float:
    """PSNR in dB, mean of the backgrounds."""
    return statistics.mean(psnr(on_background(image, gray), on_background(full, gray)) for gray in BACKGROUNDS)


def spark(path: Path, builder: str, runs: int) -> Built:
    """A tree of one of Spark's builders, with the sizes of nodes that Spark gave it."""
    with tempfile.TemporaryDirectory() as folder:
        program = Path(__file__).with_name("spark_build.mjs")
        command = ["node", str(program), str(path), str(runs), builder, folder]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode:
            raise SystemExit(f"Spark failed on {path}: {result.stderr.strip()}")
        names = ("ext0", "ext1", "lod_tree")
        words = {name: np.fromfile(Path(folder, f"{name}.u32"), np.uint32).reshape(-1, 4) for name in names}
    seconds = [json.loads(line)["build"] for line in result.stdout.splitlines()]
    return Built(ext_splats.unpack(words, threads=processors()), lod_tree.unpack(words), seconds)


def ours(splats: Splats, method: str, arguments: argparse.Namespace) -> Built:
    """A tree of one of our builders, as its file holds it."""
    seconds = []
    for run in range(arguments.runs + 1):
        start = time.perf_counter()
        nodes, tree = quick.build(splats) if method == "quick" else quality.build(splats, arguments.growth)
        if run:  # the first may have to compile
            seconds.append(time.perf_counter() - start)
    held, links = as_written(Scene(nodes.with_max_sh(0), tree))
    packed = lod_tree.pack(held, links, threads=processors())
    return Built(held, lod_tree.unpack(packed), seconds)


def as_written(scene: Scene) -> tuple[Splats, LodTree]:
    """A tree after its coding as SPZ, with the options of `build-lod`."""
    data = b"".join(spz.encode(scene, threads=processors()))
    held = spz.decode(io.BytesIO(data), threads=processors())
    assert held.tree is not None
    return held.splats, held.tree


def measure(path: Path, arguments: argparse.Namespace) -> Found:
    """Measures one scene with every method, and prints a row for each."""
    splats, _ = Selection().apply(read_scene(path, threads=processors()).splats)
    full = FullDetail(splats)
    found = {}
    for method in arguments.methods:
        if method.startswith("spark-"):
            built = spark(path, method.removeprefix("spark-"), arguments.runs)
        else:
            built = ours(splats, method, arguments)
        leaves = int(np.count_nonzero(built.nodes.tree.is_leaf))
        one = Measured(len(built.splats), leaves, built.seconds, full.psnr(built, arguments.budgets))
        decibels = [f"{mean:.2f}" for mean in one.mean]
        line([path.name, METHODS[method], f"{one.nodes / one.leaves:.2f}", *decibels, f"{one.build:.3f}"])
        found[method] = one
    return found


def line(cells: Sequence[str]) -> None:
    """Prints a row in Markdown."""
    print("| " + " | ".join(cells) + " |", flush=True)


def head(cells: Sequence[str]) -> None:
    """Prints the head of a table in Markdown."""
    line(cells)
    print("|---" * len(cells) + "|")


def compare(found: dict[str, Found], budgets: Sequence[str]) -> None:
    """Prints how much nearer to full detail ours are than Spark's, and how many times as long Spark's took to build."""
    rows = []
    for scene, of_scene in found.items():
        for mine, theirs in PAIRS:
            if mine in of_scene and theirs in of_scene:
                a, b = of_scene[mine], of_scene[theirs]
                gains = [f"{gain:+.2f}" for gain in np.subtract(a.mean, b.mean)]
                rows.append([scene, f"{METHODS[mine]} - {METHODS[theirs]}", *gains, f"{b.build / a.build:.2f}x"])
    if rows:
        print()
        head(["scene", "dB", *budgets, "Spark's build time / ours"])
        for row in rows:
            line(row)


def write_json(file: Path, found: dict[str, Found], arguments: argparse.Namespace) -> None:
    """Writes all numbers; cameras are in order of distance, and then around the scene."""
    scenes = {
        scene: {method: measured.as_dict() for method, measured in of_scene.items()}
        for scene, of_scene in found.items()
    }
    cameras = {"size": SIZE, "fov_y": FOV_Y, "around": AROUND, "elevation": ELEVATION, "distances": DISTANCES}
    record = {
        "machine": machine(),
        "runs": arguments.runs,
        "growth": arguments.growth,
        "cameras": cameras,
        "budgets": [budget.text for budget in arguments.budgets],
        "scenes": scenes,
    }
    file.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


def plot(file: Path, found: dict[str, Found], budgets: Sequence[Budget]) -> None:
    """Draws PSNR over the share of the leaves, a panel for each scene and a line for each builder."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    styles = {"spark-tiny": "C1o--", "spark-quality": "C0o--", "quick": "C1s-", "quality": "C0s-"}
    across = math.ceil(math.sqrt(len(found)))
    down = math.ceil(len(found) / across)
    figure = Figure(figsize=(6 * across, 4 * down), layout="constrained")
    for number, (scene, of_scene) in enumerate(found.items(), 1):
        axes = figure.add_subplot(down, across, number, title=scene, xlabel="share of the leaves", ylabel="PSNR, dB")
        for method, measured in of_scene.items():
            shares = [100 * budget.of(measured.leaves) / measured.leaves for budget in budgets]
            axes.plot(shares, measured.mean, styles[method], markersize=4, label=METHODS[method])
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda share, _: f"{share:g} %"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(alpha=0.3)
        axes.legend()
    figure.savefig(file, dpi=100)


def scenes_of(paths: Sequence[Path]) -> list[Path]:
    """The files; those of a folder are the real scenes."""
    files: list[Path] = []
    for path in paths:
        files += [path / name for name in REAL_SCENES] if path.is_dir() else [path]
    return files


def parsed() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path, help=f"splat files, or a folder with {', '.join(REAL_SCENES)}")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="what builds trees")
    parser.add_argument("--budgets", type=parse_budgets, default=BUDGETS, help="shares of the leaves, or counts")
    parser.add_argument("--growth", type=float, default=DEFAULT_GROWTH, help="of our quality builder")
    parser.add_argument("--runs", type=int, default=3, help="runs of each builder; medians are printed")
    parser.add_argument("--json", type=Path, help="file for all numbers, with those of each camera")
    parser.add_argument("--plot", type=Path, help="file for the curves, such as fidelity.png; needs matplotlib")
    arguments = parser.parse_args()
    if "SPARK_DIR" not in os.environ and any(method.startswith("spark-") for method in arguments.methods):
        parser.error("Spark's builders need SPARK_DIR: a folder with Spark in its node_modules")
    return arguments


def main() -> None:
    """Prints Markdown tables."""
    arguments = parsed()
    jit.use_threads(processors())
    budgets = [budget.text.replace("%", " %") for budget in arguments.budgets]
    print(f"Machine: {machine()}. PSNR in dB; medians of {arguments.runs} builds.\n")
    head(["scene", "builder", "nodes / leaves", *budgets, "build s"])
    found = {path.name: measure(path, arguments) for path in scenes_of(arguments.scenes)}
    compare(found, budgets)
    if arguments.json:
        write_json(arguments.json, found, arguments)
    if arguments.plot:
        plot(arguments.plot, found, arguments.budgets)


if __name__ == "__main__":
    main()
