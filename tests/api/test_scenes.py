"""Scenes and trees of the public interface: read, written, made of arrays, built; errors and reports."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparklod_cli as sparklod
from tests.api.runs import DEMO, EYE, command
from tests.conftest import Capture
from tests.scenes import random_splats


@pytest.mark.parametrize("suffix", [".ply", ".spz"])
def test_a_written_scene_is_read_back(scene: sparklod.Scene, tmp_path: Path, suffix: str) -> None:
    written = sparklod.write(tmp_path / f"scene{suffix}", scene)
    again = sparklod.read(written.path)
    assert written.bytes == written.path.stat().st_size
    assert len(again) == len(scene)
    steps = {"center": 2e-3, "scale": 0.04, "opacity": 0.1, "rgb": 0.02} if suffix == ".spz" else {}
    for name in ("center", "scale", "opacity", "rgb"):
        ours, theirs = getattr(scene.splats, name), getattr(again.splats, name)
        if name == "scale":
            ours, theirs = np.log(ours), np.log(theirs)
        np.testing.assert_allclose(theirs, ours, atol=steps.get(name, 1e-5), err_msg=name)
    # What has been through the coding once stays as it is.
    once_more = sparklod.write(tmp_path / f"again{suffix}", again)
    third = sparklod.read(once_more.path)
    for name in ("center", "scale", "opacity", "rgb"):
        np.testing.assert_allclose(getattr(third.splats, name), getattr(again.splats, name), rtol=2e-6, atol=1e-7)


def test_a_tree_is_read_as_a_tree(tree: sparklod.Tree, held: sparklod.Scene) -> None:
    assert isinstance(held, sparklod.Tree)
    assert np.array_equal(held.tree.child_start, tree.tree.child_start)
    assert np.array_equal(held.tree.child_count, tree.tree.child_count)
    assert "nodes" in repr(held) and "leaves" in repr(held) and "depth" in repr(held)


def test_leaves_of_a_tree_are_the_scene(scene: sparklod.Scene, tree: sparklod.Tree) -> None:
    leaves = sparklod.extract_leaves(tree)
    assert leaves.tree is None
    order, given = (np.lexsort(each.splats.center.T) for each in (leaves, scene))
    assert np.array_equal(leaves.splats.center[order], scene.splats.center[given])
    with pytest.raises(sparklod.FormatError, match="no Level-of-Detail tree"):
        sparklod.extract_leaves(scene)


@pytest.mark.parametrize("method", ["quick", "quality"])
def test_a_tree_is_what_the_command_bakes(scene: sparklod.Scene, tmp_path: Path, method: str) -> None:
    command("build-lod", DEMO, "--method", method, "-o", tmp_path / "theirs.spz", "-q")
    sparklod.write(tmp_path / "ours.spz", sparklod.build_lod(scene, method=method))
    assert (tmp_path / "ours.spz").read_bytes() == (tmp_path / "theirs.spz").read_bytes()


@pytest.mark.parametrize("encoding", ["packed", "ext", "lodtree", "texture"])
def test_arrays_are_what_the_command_writes(scene: sparklod.Scene, tmp_path: Path, encoding: str) -> None:
    sparklod.write(tmp_path / "tree.spz", sparklod.build_lod(scene))
    command("convert", tmp_path / "tree.spz", tmp_path / "theirs.npz", "--layout", encoding, "-q")
    sparklod.write(tmp_path / "ours.npz", sparklod.read(tmp_path / "tree.spz"), encoding=encoding)
    assert (tmp_path / "ours.npz").read_bytes() == (tmp_path / "theirs.npz").read_bytes()


@pytest.mark.parametrize("encoding", ["packed", "ext"])
def test_arrays_of_viewers_are_unpacked(scene: sparklod.Scene, tree: sparklod.Tree, encoding: str) -> None:
    words = sparklod.pack(tree, encoding) | sparklod.pack(tree, "lodtree")
    again = sparklod.unpack(words)
    assert isinstance(again, sparklod.Tree)
    assert np.array_equal(again.tree.child_start, tree.tree.child_start)
    near = {"packed": 2**-11, "ext": 0.0}[encoding]
    np.testing.assert_allclose(again.splats.center, tree.splats.center, rtol=near, atol=near and 2**-25)
    coarse = {"packed": 0.045, "ext": 0.006}[encoding]
    np.testing.assert_allclose(np.log(again.splats.scale), np.log(tree.splats.scale), atol=coarse)
    assert again.splats.opacity.max() > 1
    assert sparklod.unpack(sparklod.pack(scene, encoding)).tree is None
    with pytest.raises(sparklod.FormatError, match="nodes but"):
        sparklod.unpack(sparklod.pack(scene, encoding) | sparklod.pack(tree, "lodtree"))
    with pytest.raises(ValueError, match="no encoding 'zip'"):
        sparklod.pack(scene, "zip")


def test_a_scene_is_made_of_arrays() -> None:
    splats = random_splats(50, sh_degree=1)
    columns = {each.name: getattr(splats, each.name) for each in dataclasses.fields(splats)}
    made = sparklod.Scene.from_arrays(**columns)
    for name, column in columns.items():
        assert np.shares_memory(getattr(made.splats, name), column), "float32 is not copied"
    wide = sparklod.Scene.from_arrays(**{name: column.astype(np.float64) for name, column in columns.items()})
    assert np.array_equal(wide.splats.sh, splats.sh)
    assert sparklod.Scene.from_arrays(**{**columns, "sh": None}).splats.sh_degree == 0
    assert repr(made) == "Scene(50 splats, SH degree 1)"


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"center": np.zeros((50, 2))}, r"center has the shape \(50, 2\); give \(50, 3\)"),
        ({"opacity": np.zeros((50, 1))}, r"opacity has the shape \(50, 1\); give \(50,\)"),
        ({"rgb": np.zeros((49, 3))}, "rgb has the shape"),
        ({"scale": np.zeros((50, 3), complex)}, "scale holds complex128"),
        ({"quat_xyzw": np.full((50, 4), "x")}, "quat_xyzw holds"),
        ({"sh": np.zeros((50, 4, 3))}, "K = 0, 3, 8 or 15"),
        ({"sh": np.zeros((50, 9))}, "K = 0, 3, 8 or 15"),
    ],
)
def test_arrays_of_other_shapes_are_refused(wrong: dict[str, Any], message: str) -> None:
    splats = random_splats(50)
    columns = {each.name: getattr(splats, each.name) for each in dataclasses.fields(splats)}
    with pytest.raises(ValueError, match=message):
        sparklod.Scene.from_arrays(**{**columns, **wrong})


def test_invalid_splats_are_refused() -> None:
    splats = random_splats(50)
    columns = {each.name: getattr(splats, each.name) for each in dataclasses.fields(splats)}
    with pytest.raises(sparklod.InvalidSplatsError, match="not finite"):
        sparklod.Scene.from_arrays(**{**columns, "opacity": np.full(50, np.nan)})


def test_errors_are_those_that_are_documented(scene: sparklod.Scene, tree: sparklod.Tree, tmp_path: Path) -> None:
    with pytest.raises(sparklod.FormatError):
        sparklod.read(tmp_path / "missing.ply")
    with pytest.raises(sparklod.FormatError, match=r"written as \.spz"):
        sparklod.write(tmp_path / "tree.ply", tree)
    with pytest.raises(sparklod.FormatError, match="a scene is written as"):
        sparklod.write(tmp_path / "scene.txt", scene)
    sparklod.write(tmp_path / "once.ply", scene)
    with pytest.raises(sparklod.OutputError, match="exists"):
        sparklod.write(tmp_path / "once.ply", scene)
    with pytest.raises(sparklod.FormatError, match="tree already"):
        sparklod.build_lod(tree)
    with pytest.raises(ValueError, match="no method 'fast'"):
        sparklod.build_lod(scene, method="fast")
    with pytest.raises(sparklod.CameraPathError, match="the camera looks at its own position"):
        sparklod.Camera.look_at(EYE, EYE)
    with pytest.raises(ValueError, match="threads is 0"):
        sparklod.read(DEMO, threads=0)
    with pytest.raises(ValueError, match="no column colour"):
        sparklod.read(DEMO, columns=["colour"])


def test_a_report_is_what_inspect_prints(file: Path, capsys: Capture) -> None:
    command("inspect", file, "--json", "--check", "--stats")
    theirs = json.loads(capsys.readouterr().out)
    ours = sparklod.inspect(file, all_quantities=True, check=True).as_dict()
    assert json.loads(json.dumps(ours)) == (theirs["files"][0] if "files" in theirs else theirs)
