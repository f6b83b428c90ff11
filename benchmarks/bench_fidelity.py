"""How far cuts of our trees and of Spark's are from full detail: `python benchmarks/bench_fidelity.py --help`."""

from __future__ import annotations

import argparse
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

import sparklod_cli as sparklod

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

#: The ball that cameras go around holds this share of the splats; so many splats are looked at to find it.
SHARE, SAMPLE = 0.9, 1 << 18

#: Grays that pictures are compared on.
BACKGROUNDS = (0.0, 1.0)

#: A picture, (height, width, 4).
Image = NDArray[np.float32]


@dataclass(frozen=True)
class Built:
    """A tree as a viewer holds it, and how long building it took.

    Attributes:
        tree: without spherical harmonics.
        seconds: of each run.
    """

    tree: sparklod.Tree
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
        scene: without spherical harmonics.

    Attributes:
        leaves: how many splats there are.
    """

    def __init__(self, scene: sparklod.Scene) -> None:
        self.leaves = len(scene)
        self._cameras = cameras_around(scene)
        self._pictures = [sparklod.render(scene, camera) for camera in self._cameras]

    def psnr(self, tree: sparklod.Tree, budgets: Sequence[str]) -> NDArray[np.float64]:
        """(cameras, budgets) dB: how far cuts of a tree are from it; nodes have the precision that Spark holds."""
        settings = sparklod.LodSettings(foveation=sparklod.Cones(), pixel_scale_limit=0.0)
        found = np.empty((len(self._cameras), len(budgets)))
        for row, camera, full in zip(found, self._cameras, self._pictures, strict=True):
            for at, budget in enumerate(budgets):
                count = count_of(budget, self.leaves)
                cut = sparklod.cut(tree, camera, budget=count, settings=settings, precision="float16")
                row[at] = difference(sparklod.render(cut, camera), full)
        return found


def count_of(budget: str, leaves: int) -> int:
    """Splats of a budget such as "5%" or "5000"."""
    return max(1, int(float(budget[:-1]) * leaves / 100)) if budget.endswith("%") else int(budget)


def cameras_around(scene: sparklod.Scene) -> list[sparklod.Camera]:
    """Cameras around the middle of a scene whose up is -y, near ones and far ones."""
    center = scene.splats.center[:: max(len(scene) // SAMPLE, 1)].astype(np.float64)
    middle = np.median(center, axis=0)
    radius = float(np.quantile(np.linalg.norm(center - middle, axis=1), SHARE))
    how = {"count": AROUND, "center": tuple(middle), "elevation": ELEVATION, "fov_y": FOV_Y, "size": SIZE}
    return [
        camera
        for away in DISTANCES
        for camera in sparklod.orbit(scene, distance=away * radius, **how)  # type: ignore
    ]


def difference(image: Image, full: Image) -> float:
    """PSNR in dB, mean of the backgrounds."""
    return statistics.mean(sparklod.psnr(image, full, background=gray) for gray in BACKGROUNDS)


def spark(path: Path, builder: str, runs: int) -> Built:
    """A tree of one of Spark's builders, as its memory holds it."""
    with tempfile.TemporaryDirectory() as folder:
        program = Path(__file__).with_name("spark_build.mjs")
        command = ["node", str(program), str(path), str(runs), builder, folder]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode:
            raise SystemExit(f"Spark failed on {path}: {result.stderr.strip()}")
        names = ("ext0", "ext1", "lod_tree")
        words = {name: np.fromfile(Path(folder, f"{name}.u32"), np.uint32).reshape(-1, 4) for name in names}
    tree = sparklod.unpack(words)
    assert isinstance(tree, sparklod.Tree)
    return Built(tree, [json.loads(line)["build"] for line in result.stdout.splitlines()])


def ours(scene: sparklod.Scene, method: str, arguments: argparse.Namespace) -> Built:
    """A tree of one of our builders, as its file holds it."""
    seconds = []
    for run in range(arguments.runs + 1):
        start = time.perf_counter()
        tree = sparklod.build_lod(scene, method=method, growth=arguments.growth)
        if run:  # the first may have to compile
            seconds.append(time.perf_counter() - start)
    with tempfile.TemporaryDirectory() as folder:
        written = sparklod.read(sparklod.write(Path(folder, "tree.spz"), tree).path)
    assert isinstance(written, sparklod.Tree)
    return Built(written, seconds)


def measure(path: Path, arguments: argparse.Namespace) -> Found:
    """Measures one scene with every method, and prints a row for each."""
    read = sparklod.read(path)
    kept, _ = sparklod.Selection().apply(read.splats.with_max_sh(0))
    scene = sparklod.Scene(kept, antialiased=read.antialiased)
    full = FullDetail(scene)
    found = {}
    for method in arguments.methods:
        if method.startswith("spark-"):
            built = spark(path, method.removeprefix("spark-"), arguments.runs)
        else:
            built = ours(scene, method, arguments)
        leaves = int(np.count_nonzero(built.tree.tree.is_leaf))
        one = Measured(len(built.tree), leaves, built.seconds, full.psnr(built.tree, arguments.budgets))
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
        "budgets": arguments.budgets,
        "scenes": scenes,
    }
    file.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


def plot(file: Path, found: dict[str, Found], budgets: Sequence[str]) -> None:
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
            shares = [100 * count_of(budget, measured.leaves) / measured.leaves for budget in budgets]
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
    parser.add_argument("--budgets", default=BUDGETS, help="shares of the leaves, or counts, between commas")
    parser.add_argument("--growth", type=float, default=1.4, help="of our quality builder")
    parser.add_argument("--runs", type=int, default=3, help="runs of each builder; medians are printed")
    parser.add_argument("--json", type=Path, help="file for all numbers, with those of each camera")
    parser.add_argument("--plot", type=Path, help="file for the curves, such as fidelity.png; needs matplotlib")
    arguments = parser.parse_args()
    arguments.budgets = arguments.budgets.split(",")
    if "SPARK_DIR" not in os.environ and any(method.startswith("spark-") for method in arguments.methods):
        parser.error("Spark's builders need SPARK_DIR: a folder with Spark in its node_modules")
    return arguments


def main() -> None:
    """Prints Markdown tables."""
    arguments = parsed()
    budgets = [budget.replace("%", " %") for budget in arguments.budgets]
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
