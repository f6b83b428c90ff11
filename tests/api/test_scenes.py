"""Scenes in Python: arrays, columns that are read-only, extreme and invalid ones."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

import sparklod_cli as sparklod
from fuzz.laws import check_passes
from sparklod_cli.codecs.file_names import MANIFEST
from sparklod_cli.codecs.options import RadOptions, SogOptions
from sparklod_cli.codecs.rad.rad_layout import OPTIONS, choices
from sparklod_cli.lod.builders import METHODS
from sparklod_cli.lod.detail_rule import DetailSettings
from sparklod_cli.model.gaussian import normalized_quat
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene, Tree
from sparklod_cli.model.sh import COEFFICIENTS
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.support.errors import SparklodError
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
    command("build-lod", DEMO, "--encoding", encoding, "-o", tmp_path / "theirs.npz", "-q")
    sparklod.write(tmp_path / "ours.npz", sparklod.build_lod(scene), encoding=encoding)
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


LARGEST = float(np.finfo(np.float32).max)
TINIEST = float(np.finfo(np.float32).smallest_subnormal)

#: Magnitudes of coordinates, scales, colours and SH.
SIZES = st.sampled_from([0.0, TINIEST, 1e-30, 1e-6, 1e-3, 1.0, 1.0, 100.0, 70_000.0, 1e9, 1e20, 1e30, 1e38, LARGEST])


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """Splats of a few magnitudes, some of them alike."""
    count, rng = draw(st.sampled_from([1, 2, 3, 17, 150, 300])), np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    degree, different = draw(st.integers(0, 3)), draw(st.sampled_from([1, 2, count]))

    def spread(*shape: int) -> np.ndarray:
        """Values up to a magnitude, or up to two of them."""
        sizes = np.array([draw(SIZES), draw(SIZES)])[rng.integers(0, 1 + draw(st.booleans()), (count, *shape[1:]))]
        return np.clip(sizes * rng.uniform(-1, 1, shape), -LARGEST, LARGEST)

    columns = {
        "center": spread(count, 3),
        "scale": np.abs(spread(count, 3)),
        "quat_xyzw": normalized_quat(rng.normal(size=(count, 4)).astype(np.float32)),
        "opacity": np.clip(
            rng.normal(draw(st.sampled_from([0.0, 0.5, 1.0])), draw(st.sampled_from([0, 0.3])), count), 0, 1
        ),
        "rgb": spread(count, 3),
        "sh": spread(count, COEFFICIENTS[degree], 3),
    }
    return Scene.from_arrays(**{name: values[np.arange(count) % different] for name, values in columns.items()})


def passes(path: Path, scene: Scene, **options: object) -> None:
    """Writes a scene and checks the files; a refusal leaves none."""
    try:
        sparklod.write(path, scene, **options)
    except SparklodError:
        assert not list(path.parent.iterdir())
        return
    check_passes(path)
    shutil.rmtree(path.parent)
    path.parent.mkdir()


@pytest.mark.filterwarnings("error")
@given(scenes(), st.data())
@settings(max_examples=25, phases=[Phase.explicit, Phase.generate])  # shrinking takes minutes, and any scene will do
def test_what_is_written_passes_the_check(scene: Scene, data: st.DataObject) -> None:
    rad = RadOptions(**{name: data.draw(st.sampled_from(["auto", *choices(name)])) for name in OPTIONS})
    shares = data.draw(st.sampled_from([(0.5,), (0.9, 0.5, 0.01), (0.3, 0.1)]))
    detail = DetailSettings(
        shares, data.draw(st.sampled_from([20, 40, 9999])), data.draw(st.sampled_from([1e-3, 16])), 1
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for ending in (".ply", ".splat", ".sog", ".spz"):
            passes(folder / f"plain{ending}", scene)
        passes(folder / "plain.rad", scene, rad=rad)
        with contextlib.suppress(SparklodError):
            tree = sparklod.build_lod(scene, method=data.draw(st.sampled_from(METHODS)))
            passes(folder / "tree.spz", tree)
            passes(folder / "tree.rad", tree, rad=rad)
            passes(folder / MANIFEST, tree, detail=detail, sog=SogOptions(sh_codes=16))
            passes(folder / "leaves.rad", sparklod.extract_leaves(tree), rad=rad)
