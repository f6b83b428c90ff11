"""No way of writing a file takes what no splat can be, or a broken tree: from the API, and from files with such."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

import sparklod_cli as sparklod
from sparklod_cli.api.files import Tree
from sparklod_cli.bake.converting import convert
from sparklod_cli.bake.flow import bake
from sparklod_cli.bake.settings import BakeSettings
from sparklod_cli.codecs.formats import ENCODINGS, MANIFEST, WRITABLE
from sparklod_cli.codecs.options import RadOptions, WriteOptions
from sparklod_cli.codecs.spark_codings import SplatEncoding
from sparklod_cli.lod.tree_settings import DetailSettings
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.system.errors import InvalidSplatsError, TreeError
from sparklod_cli.system.output import write_file
from tests.scenes import random_splats

#: Encodings of RAD that hold any float.
FLOATS = RadOptions("f32", "f32", "f32", "f32", "f32", "f32", ranges=SplatEncoding(lod_opacity=True))

#: What is wrong with a splat, by column, and the value that makes it so.
WRONG: Mapping[str, tuple[str, float]] = {
    "NaN centre": ("center", np.nan),
    "infinite scale": ("scale", np.inf),
    "negative scale": ("scale", -1.0),
    "no rotation": ("quat_xyzw", 0.0),
    "negative opacity": ("opacity", -0.5),
    "NaN colour": ("rgb", np.nan),
    "infinite SH": ("sh", -np.inf),
}

Write = Callable[[Path, Scene], object]

#: Every way in which the API writes a scene without a tree.
PLAIN: dict[str, Write] = dict.fromkeys((".ply", ".splat", ".sog", ".glb", ".spz", ".rad"), sparklod.write)
#: And a tree.
TREES: dict[str, Write] = {
    ".spz": sparklod.write,
    ".rad": sparklod.write,
    **{
        f"{encoding}.npz": lambda path, scene, e=encoding: sparklod.write(path, scene, encoding=e)
        for encoding in ENCODINGS
    },
    MANIFEST: sparklod.write,
}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(random_splats(60, sh_degree=1))


@pytest.fixture(scope="module")
def tree(scene: Scene) -> Tree:
    return sparklod.build_lod(scene)


def spoiled(scene: Scene, wrong: str) -> Scene:
    """A scene whose last splat is invalid, which is a leaf of a tree."""
    column, value = WRONG[wrong]
    values = getattr(scene.splats, column).copy()
    values[-1] = value
    return dataclasses.replace(scene, splats=dataclasses.replace(scene.splats, **{column: values}))


@pytest.mark.parametrize("wrong", WRONG)
def test_invalid_splats_are_never_written(wrong: str, scene: Scene, tree: Tree, tmp_path: Path) -> None:
    for ways, whole in ((PLAIN, scene), (TREES, tree)):
        for ending, write in ways.items():
            count, path = len(whole), tmp_path / (ending if ending == MANIFEST else f"out{ending}")
            with pytest.raises(InvalidSplatsError, match=f"{path.name}: 1 of {count} splats is .*splat {count - 1}"):
                write(path, spoiled(whole, wrong))
    environment = spoiled(scene, wrong)
    with pytest.raises(InvalidSplatsError, match="1 of 60 splats is"):
        sparklod.write(tmp_path / MANIFEST, tree, environment=environment)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("wrong", WRONG)
def test_invalid_splats_reach_neither_a_builder_nor_the_fitting(wrong: str, scene: Scene, tree: Tree) -> None:
    whole, nodes = spoiled(scene, wrong), spoiled(tree, wrong)
    for work in (
        lambda: sparklod.build_lod(whole),
        lambda: sparklod.simplify(whole, to=20),
        lambda: sparklod.simplify(nodes, to=20),
        lambda: sparklod.refine(nodes, steps=1),
    ):
        with pytest.raises(InvalidSplatsError, match=r"1 of .* splats is"):
            work()


def test_broken_trees_are_never_written(tree: Tree, tmp_path: Path) -> None:
    start = tree.tree.child_start.copy()
    start[0] = 2**32 - 1
    for links in (
        LodTree(tree.tree.child_count, start),
        LodTree(tree.tree.child_count[:-1], tree.tree.child_start[:-1]),
    ):
        broken = dataclasses.replace(tree, tree=links)
        for ending, write in TREES.items():
            with pytest.raises(TreeError, match="node"):
                write(tmp_path / (ending if ending == MANIFEST else f"out{ending}"), broken)
    with pytest.raises(ValueError, match="child_start is int64"):
        LodTree(tree.tree.child_count, start.astype(np.int64))
    assert not list(tmp_path.iterdir())


@pytest.fixture(params=["NaN centre", "infinite scale", "negative scale", "infinite SH"], scope="module")
def spoiled_file(request: pytest.FixtureRequest, tree: Tree, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tree as another program may write it: with all of its floats, whatever they are."""
    path = tmp_path_factory.mktemp("spoiled") / "tree.rad"
    pieces = WRITABLE[".rad"].codec().encode(spoiled(tree, request.param), WriteOptions(rad=FLOATS))
    write_file(path, pieces, overwrite=False)
    return path


@pytest.mark.filterwarnings("error")
def test_what_a_file_has_is_examined_before_it_is_written(spoiled_file: Path, tmp_path: Path) -> None:
    ways = [
        BakeSettings(converts=True),
        BakeSettings(converts=True, suffix=".rad", options=WriteOptions(rad=RadOptions(chunked=True))),
        BakeSettings(converts=True, detail=DetailSettings()),
    ]
    for settings in ways:
        with pytest.raises(InvalidSplatsError, match="1 of"):
            bake(spoiled_file, tmp_path / "out", settings)
    for ending in WRITABLE:
        with pytest.raises(InvalidSplatsError, match="1 of 60 splats is"):
            convert(spoiled_file, tmp_path / f"out{ending}", BakeSettings(suffix=ending), leaves=True)
    assert not list(tmp_path.iterdir())
