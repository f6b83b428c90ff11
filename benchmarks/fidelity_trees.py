"""Trees that `bench_fidelity.py` measures: Spark's and ours."""

from __future__ import annotations

import dataclasses
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

import sparklod_cli as sparklod
from sparklod_cli.bake.flow import bake
from sparklod_cli.bake.settings import BakeSettings, Resources

#: Builders, by their names in tables.
METHODS = {
    "spark-tiny": "Spark tiny",
    "spark-quality": "Spark quality",
    "quick": "our quick",
    "quality": "our quality",
    "blocks": "our quality, in blocks",
    "refined": "our quality, refined",
}

#: A block of `blocks` has this share of the splats at most, far fewer than blocks in use have.
BLOCK_SHARE = 1 / 8

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
        growth: of our quality builder.
        steps: of refining; None for as many as suit the tree.
        trees: folder that keeps our trees, and has those that need not be built; None for none.
    """

    path: Path
    scene: sparklod.Scene
    sh: bool
    growth: float
    steps: int | None
    trees: Path | None = None

    @property
    def drawn(self) -> sparklod.Scene:
        """The scene as it is drawn: with or without spherical harmonics."""
        return self.scene if self.sh else without_sh(self.scene)


def build(source: Source, method: str) -> sparklod.Tree:
    """Return the tree of a method, one of `METHODS`, as a viewer holds it."""
    if method.startswith("spark-"):
        return _sparks(source, method.removeprefix("spark-"))
    return _ours(source, method)


def without_sh(scene: sparklod.Scene) -> sparklod.Scene:
    """Return a scene without spherical harmonics."""
    return sparklod.Scene(scene.splats.with_max_sh(0), antialiased=scene.antialiased)


def _sparks(source: Source, builder: str) -> sparklod.Tree:
    """Return a tree of one of Spark's builders, as its memory holds it."""
    with tempfile.TemporaryDirectory() as folder:
        command = spark_command(source.path, builder, Path(folder))
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode:
            raise SystemExit(f"Spark failed on {source.path}: {result.stderr.strip()}")
        return spark_tree(Path(folder), sh=source.sh)


def spark_command(file: Path, builder: str, folder: Path) -> list[str]:
    """Return the command that builds a tree with one of Spark's builders, tiny or quality, into a folder."""
    return ["node", str(Path(__file__).with_name("spark_build.mjs")), str(file), "1", builder, str(folder)]


def spark_tree(folder: Path, *, sh: bool = False) -> sparklod.Tree:
    """Return the tree that `spark_command` left in a folder, with spherical harmonics if they are drawn."""
    names = ["ext0", "ext1", "lod_tree"]
    if sh:
        names += [name for name in SH_ARRAYS if (folder / f"{name}.u32").is_file()]
    tree = sparklod.unpack({name: np.fromfile(folder / f"{name}.u32", np.uint32).reshape(-1, 4) for name in names})
    assert isinstance(tree, sparklod.Tree)
    return tree


def _ours(source: Source, method: str) -> sparklod.Tree:
    """Return a tree of one of our builders as its file holds it, its spherical harmonics as Spark holds those."""
    with tempfile.TemporaryDirectory() as scratch:
        file = (source.trees or Path(scratch)) / f"{source.path.stem}-{method}{'-sh' * source.sh}.spz"
        if not file.is_file():
            if method == "blocks":
                _bake_in_blocks(source, file)
            else:
                sparklod.write(file, _built(source, method))
        tree = sparklod.read(file)
    assert isinstance(tree, sparklod.Tree)
    return _as_spark_holds_sh(tree) if source.sh else tree


def _built(source: Source, method: str) -> sparklod.Tree:
    if method == "refined":
        return _refined(source)
    return sparklod.build_lod(source.drawn, method=method, growth=source.growth)


def _bake_in_blocks(source: Source, file: Path) -> None:
    settings = BakeSettings(method="quality", growth=source.growth, max_sh=3 if source.sh else 0)
    blocks = Resources(memory=1 << 60, block_splats=int(len(source.scene) * BLOCK_SHARE))
    bake(source.path, file, settings, resources=blocks)


def _refined(source: Source) -> sparklod.Tree:
    """Return a tree of our quality builder whose merged splats are fitted to pictures of the scene."""
    from sparklod_cli.fitting.fit import fit
    from sparklod_cli.fitting.fit_settings import FitSettings
    from sparklod_cli.system.threads import processors

    tree = sparklod.build_lod(source.drawn, method="quality", growth=source.growth)
    settings = FitSettings(source.steps)
    splats, _ = fit(tree.splats, tree.tree, settings, antialiased=source.drawn.antialiased, threads=processors())
    return dataclasses.replace(tree, splats=splats)


def _as_spark_holds_sh(scene: AnyScene) -> AnyScene:
    """Return a scene or a tree with those spherical harmonics that Spark holds of it in `ExtSplats`."""
    rounded = sparklod.unpack(sparklod.pack(scene, "ext")).splats
    return dataclasses.replace(scene, splats=dataclasses.replace(scene.splats, sh=rounded.sh))
