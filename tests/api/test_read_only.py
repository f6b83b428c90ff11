"""Scenes do not change: their columns are read-only, and those of callers may be, too."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import sparklod_cli as sparklod
from sparklod_cli.api.files import Tree
from sparklod_cli.codecs.formats import MANIFEST
from sparklod_cli.lod.tree_settings import METHODS
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from tests.scenes import random_splats


@pytest.fixture(scope="module")
def tree() -> Tree:
    return sparklod.build_lod(Scene(random_splats(300, sh_degree=1)))


def test_columns_of_scenes_cannot_be_written_to(tree: Tree, tmp_path: Path) -> None:
    sparklod.write(tmp_path / "tree.rad", tree)
    arrays = {name: getattr(tree.splats, name) for name in COLUMNS}
    leaves = sparklod.extract_leaves(tree)
    for scene in (tree, leaves, sparklod.read(tmp_path / "tree.rad"), Scene.from_arrays(**arrays)):
        for name in COLUMNS:
            with pytest.raises(ValueError, match="read-only"):
                getattr(scene.splats, name)[:] = 0
    with pytest.raises(ValueError, match="read-only"):
        tree.tree.child_start[0] = 7


def test_arrays_of_callers_keep_their_flags() -> None:
    splats = random_splats(9)
    scene = Scene(splats)
    splats.center[0] = 5
    assert np.shares_memory(scene.splats.center, splats.center)
    assert dataclasses.replace(scene, antialiased=True).splats is scene.splats


@pytest.mark.parametrize("method", METHODS)
def test_read_only_columns_are_as_good_as_others(method: str, tree: Tree, tmp_path: Path) -> None:
    splats = random_splats(300, sh_degree=1)
    columns = {}
    for name in COLUMNS:
        np.save(tmp_path / f"{name}.npy", getattr(splats, name))
        columns[name] = np.load(tmp_path / f"{name}.npy", mmap_mode="r")
    mapped = sparklod.build_lod(Scene(Splats(**columns)), method=method)
    expected = sparklod.build_lod(Scene(splats), method=method)
    for name in COLUMNS:
        assert getattr(mapped.splats, name).tobytes() == getattr(expected.splats, name).tobytes()
    # Twice, which is what a tree of read-only arrays of callers is.
    again = Tree(mapped.splats, LodTree(mapped.tree.child_count, mapped.tree.child_start))
    for ending in (".spz", ".rad", MANIFEST):
        path = tmp_path / (ending if ending == MANIFEST else f"tree{ending}")
        sparklod.write(path, again, overwrite=True)
    path = sparklod.orbit(again, count=2, size=(32, 24))
    assert np.array_equal(sparklod.render(again, path.cameras[0]), sparklod.render(expected, path.cameras[0]))
    assert len(sparklod.traverse(again, path).rows) == 2
    assert len(sparklod.extract_leaves(again)) == 300
    sparklod.arrange_chunks(again)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("camera_to_world", np.full((4, 4), np.nan)),
        ("focal", (np.inf, 5.0)),
        ("principal", (1.0, np.nan)),
        ("time", np.nan),
    ],
)
def test_cameras_that_are_not_finite_are_refused(field: str, value: object, tree: Tree) -> None:
    path = sparklod.orbit(tree, count=2, size=(32, 24))
    camera = dataclasses.replace(path.cameras[0], **{field: value})
    for call in (
        lambda: sparklod.render(tree, camera),
        lambda: sparklod.cut(tree, camera),
        lambda: sparklod.traverse(tree, [camera]),
        lambda: sparklod.traverse(tree, dataclasses.replace(path, cameras=(camera,))),
    ):
        with pytest.raises(ValueError, match=f"{field} of a camera is"):
            call()
