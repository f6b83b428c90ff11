"""Trees that `bench_fidelity.py` measures: Spark's, ours, and what splat-transform decimates."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

import sparklod_cli as sparklod

#: What builds trees, by what it is called in tables.
METHODS = {
    "spark-tiny": "Spark tiny",
    "spark-quality": "Spark quality",
    "quick": "our quick",
    "quality": "our quality",
    "refined": "our quality, refined",
}

#: Percent of the splats that splat-transform left, and its ways to get there.
SHARES = (50, 25, 10, 5)
WAYS = ("decimate", "decimate-adaptive")

#: Arrays of Spark's SH, four words a splat, those of its degree and below.
SH_ARRAYS = ("sh1", "sh2", "sh3a", "sh3b")


AnyScene = TypeVar("AnyScene", sparklod.Scene, sparklod.Tree)


@dataclass(frozen=True)
class Source:
    """A scene, and how trees of it are built.

    Attributes:
        path: its file, for Spark.
        scene: with all of its spherical harmonics.
        sh: pictures are drawn with them.
        runs: of each builder that is timed; 0 if how long it takes does not matter.
        growth: of our quality builder.
        steps: of refining; None for as many as suit the tree.
        trees: folder that keeps our trees, and has those that need not be built; None for none.
    """

    path: Path
    scene: sparklod.Scene
    sh: bool
    runs: int
    growth: float
    steps: int | None
    trees: Path | None = None

    @property
    def drawn(self) -> sparklod.Scene:
        """The scene as it is drawn: with or without spherical harmonics."""
        return self.scene if self.sh else without_sh(self.scene)


@dataclass(frozen=True)
class Built:
    """A tree as a viewer holds it, and how long building it took.

    Attributes:
        tree: with spherical harmonics only if they are drawn.
        seconds: of each run; none for a tree that was kept.
    """

    tree: sparklod.Tree
    seconds: list[float]


def build(source: Source, method: str) -> Built:
    """The tree of a method, one of `METHODS`."""
    if method.startswith("spark-"):
        return _sparks(source, method.removeprefix("spark-"))
    return _ours(source, method)


def without_sh(scene: sparklod.Scene) -> sparklod.Scene:
    """A scene without spherical harmonics."""
    return sparklod.Scene(scene.splats.with_max_sh(0), antialiased=scene.antialiased)


def _sparks(source: Source, builder: str) -> Built:
    """A tree of one of Spark's builders, as its memory holds it."""
    with tempfile.TemporaryDirectory() as folder:
        command = spark_command(source.path, builder, Path(folder), max(source.runs, 1))
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode:
            raise SystemExit(f"Spark failed on {source.path}: {result.stderr.strip()}")
        tree = spark_tree(Path(folder), sh=source.sh)
    return Built(tree, [json.loads(line)["build"] for line in result.stdout.splitlines()])


def spark_command(file: Path, builder: str, folder: Path, runs: int = 1) -> list[str]:
    """The command that builds a tree with one of Spark's builders, tiny or quality, into a folder."""
    return ["node", str(Path(__file__).with_name("spark_build.mjs")), str(file), str(runs), builder, str(folder)]


def spark_tree(folder: Path, *, sh: bool = False) -> sparklod.Tree:
    """The tree that `spark_command` left in a folder, with spherical harmonics if it has some and they are drawn."""
    names = ["ext0", "ext1", "lod_tree"]
    if sh:
        names += [name for name in SH_ARRAYS if (folder / f"{name}.u32").is_file()]
    tree = sparklod.unpack({name: np.fromfile(folder / f"{name}.u32", np.uint32).reshape(-1, 4) for name in names})
    assert isinstance(tree, sparklod.Tree)
    return tree


def _ours(source: Source, method: str) -> Built:
    """A tree of one of our builders, as its file holds it; spherical harmonics as Spark holds those of the file."""
    with tempfile.TemporaryDirectory() as made:
        file = (source.trees or Path(made)) / f"{source.path.stem}-{method}{'-sh' * source.sh}.spz"
        seconds = [] if file.is_file() else _bake(source, method, file)
        tree = sparklod.read(file)
    assert isinstance(tree, sparklod.Tree)
    return Built(_held(tree) if source.sh else tree, seconds)


def _bake(source: Source, method: str, file: Path) -> list[float]:
    """Writes a tree of one of our builders, and returns the seconds of each run of it."""

    def timed(scene: sparklod.Scene) -> tuple[sparklod.Tree, float]:
        start = time.perf_counter()
        if method == "refined":
            return _refined(scene, source), time.perf_counter() - start
        tree = sparklod.build_lod(scene, method=method, growth=source.growth)
        return tree, time.perf_counter() - start

    runs = 0 if method == "refined" or not source.runs else source.runs + 1
    seconds = [timed(source.scene)[1] for _ in range(runs)][1:]  # the first may have to compile
    tree, took = timed(source.drawn)
    sparklod.write(file, tree)
    return seconds or [took]


def _refined(scene: sparklod.Scene, source: Source) -> sparklod.Tree:
    """A tree of our quality builder whose merged splats are fitted to pictures of the scene."""
    from sparklod_cli.fitting.fit import fit
    from sparklod_cli.fitting.settings import FitSettings
    from sparklod_cli.support.parallel import processors

    tree = sparklod.build_lod(scene, method="quality", growth=source.growth)
    settings = FitSettings(source.steps)
    splats, _ = fit(tree.splats, tree.tree, settings, antialiased=scene.antialiased, threads=processors())
    return dataclasses.replace(tree, splats=splats)


def _held(scene: AnyScene) -> AnyScene:
    """A scene or a tree with those spherical harmonics that Spark holds of it in `ExtSplats`."""
    held = sparklod.unpack(sparklod.pack(scene, "ext")).splats
    return dataclasses.replace(scene, splats=dataclasses.replace(scene.splats, sh=held.sh))


def decimated(folder: Path, name: str, *, sh: bool = False) -> Iterator[tuple[str, list[sparklod.Scene]]]:
    """Each way of splat-transform whose files are all there, and its scenes, in the order of `SHARES`.

    Spherical harmonics are left out, or as Spark holds them.
    """
    for way in WAYS:
        files = [folder / f"{name}-{way}-{share}.ply" for share in SHARES]
        if all(file.is_file() for file in files):
            scenes = [sparklod.read(file) for file in files]
            yield way, [_held(scene) if sh else without_sh(scene) for scene in scenes]


def seconds_of_decimations(folder: Path) -> dict[tuple[str, str, int], float]:
    """Seconds that splat-transform took, by scene, way and percent: the lines of times.txt."""
    file = folder / "times.txt"
    rows = [row.split() for row in file.read_text(encoding="utf-8").splitlines()] if file.is_file() else []
    return {(scene, way, int(share)): float(seconds) for scene, way, share, seconds in rows}
