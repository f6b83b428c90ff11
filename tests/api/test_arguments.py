"""Arguments of the public interface that make no sense are refused, with their value, and never silently ignored."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparklod_cli as sparklod
from tests.conftest import FIXTURES

ONE, SH3, DEMO = FIXTURES / "one.ply", FIXTURES / "sh3.ply", FIXTURES / "demo.ply"
CAMERA = sparklod.Camera.look_at((0, -1, 4), (0, 0, 0), size=(40, 30))


@pytest.fixture(scope="module")
def scene() -> sparklod.Scene:
    return sparklod.read(SH3)


@pytest.fixture(scope="module")
def tree(scene: sparklod.Scene) -> sparklod.Tree:
    return sparklod.build_lod(scene)


def test_names_of_the_package_are_the_public_ones() -> None:
    code = "import sparklod_cli as s; print(*(set(dir(s)) - set(s.__all__)))"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert all(name.startswith("__") for name in said.split())


@pytest.mark.parametrize(
    "function",
    [
        lambda wrong: sparklod.build_lod(wrong),
        lambda wrong: sparklod.write("never.ply", wrong),
        lambda wrong: sparklod.extract_leaves(wrong),
        lambda wrong: sparklod.pack(wrong, "packed"),
        lambda wrong: sparklod.cut(wrong, CAMERA),
        lambda wrong: sparklod.render(wrong, CAMERA),
        lambda wrong: sparklod.orbit(wrong, count=2),
    ],
)
@pytest.mark.parametrize("kind", ["path", "splats", "nothing"])
def test_what_is_no_scene_is_named(scene: sparklod.Scene, function: Callable[[Any], object], kind: str) -> None:
    wrong, name = {"path": (str(SH3), "sh3"), "splats": (scene.splats, "Splats"), "nothing": (None, "None")}[kind]
    with pytest.raises(TypeError, match=rf"not .*{name}.*from_arrays"):
        function(wrong)


@pytest.mark.parametrize("wrong", [None, "path.json", (0, 0, 4)])
def test_what_is_no_camera_is_named(tree: sparklod.Tree, wrong: Any) -> None:
    for function in (sparklod.cut, sparklod.render):
        with pytest.raises(TypeError, match="is a Camera, not"):
            function(tree, wrong)
    paths: list[Any] = [wrong if isinstance(wrong, str) else [wrong], [CAMERA, wrong]]
    for cameras in paths:
        with pytest.raises(TypeError, match="is a Camera, not"):
            sparklod.traverse(tree, cameras)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"eye": (1, 2)}, "eye is"),
        ({"eye": "abc"}, "eye is 'abc'"),
        ({"up": (1, 2)}, "up is"),
        ({"size": (100.5, 5)}, "whole numbers"),
        ({"fov_y": float("nan")}, "nan degrees"),
    ],
)
def test_cameras_of_no_sense_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(sparklod.CameraPathError, match=message):
        sparklod.Camera.look_at(**{"eye": (0, -1, 4), "target": (0, 0, 0), **wrong})


@pytest.mark.parametrize("method", ["quick", "quality"])
@pytest.mark.parametrize(
    "options", [{"base": 5}, {"growth": 9}, {"growth": float("nan")}, {"max_sh": -1}, {"max_sh": 4}]
)
def test_options_out_of_range_are_refused_by_either_method(
    scene: sparklod.Scene, method: str, options: dict[str, Any]
) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(options))} is"):
        sparklod.build_lod(scene, method=method, **options)


@pytest.mark.parametrize("budget", [True, [5], object()])
def test_budgets_of_no_number_are_refused(tree: sparklod.Tree, budget: Any) -> None:
    with pytest.raises(TypeError, match="the budget is"):
        sparklod.cut(tree, CAMERA, budget=budget)


def test_a_share_may_be_a_float_of_numpy(tree: sparklod.Tree) -> None:
    expected = sparklod.cut(tree, CAMERA, budget=0.5)
    assert len(expected) > 1
    for share in (np.float32(0.5), np.float64(0.5)):
        assert np.array_equal(sparklod.cut(tree, CAMERA, budget=share).nodes[0], expected.nodes[0])
    with pytest.raises(ValueError, match="2\\^53"):
        sparklod.cut(tree, CAMERA, budget=10**20)


@pytest.mark.parametrize("continuous", [0.5, 1.0, -2, float("nan")])
def test_a_blend_is_above_1(tree: sparklod.Tree, continuous: float) -> None:
    with pytest.raises(ValueError, match="continuous is"):
        sparklod.cut(tree, CAMERA, continuous=continuous)


def test_an_unknown_backend_is_refused(tree: sparklod.Tree) -> None:
    with pytest.raises(ValueError, match="no backend 'gl'; give one of numba"):
        sparklod.render(tree, CAMERA, backend="gl")


@pytest.mark.parametrize("budgets", ["5%", 0.05, []])
def test_budgets_of_a_comparison_are_a_list(tree: sparklod.Tree, budgets: Any) -> None:
    with pytest.raises((TypeError, ValueError), match=r"budgets is|no budgets"):
        sparklod.compare(tree, None, [CAMERA], budgets=budgets)


@pytest.mark.parametrize("function", [sparklod.psnr, sparklod.ssim])
def test_figures_of_no_pictures_are_refused(function: Callable[..., float]) -> None:
    gray = np.full((12, 12, 3), 0.5, np.float32)
    for wrong, message in (
        (gray * np.nan, "NaN"),
        ((255 * gray).astype(np.uint8), "uint8"),
        (gray[:0], "no pixels"),
    ):
        with pytest.raises(ValueError, match=message):
            function(wrong, wrong)
    assert function(gray, gray) in (100.0, 1.0)


def test_a_picture_is_a_png(tmp_path: Path) -> None:
    picture = sparklod.show(np.zeros((4, 4, 4), np.float32))
    assert repr(picture).startswith("Picture(")
    with pytest.raises(ValueError, match=r"saved as \.png"):
        picture.save(tmp_path / "a.jpg")
    assert not list(tmp_path.iterdir())
    for shape in ((5,), (4, 4, 3)):
        with pytest.raises(ValueError, match="the image has the shape"):
            sparklod.show(np.zeros(shape, np.float32))


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.spz", {"compression_level": 99}),
        ("a.spz", {"fractional_bits": 99}),
        ("a.ply", {"spz_version": 2}),
        ("a.npz", {"fractional_bits": 9, "encoding": "packed"}),
    ],
)
def test_options_of_spz_are_held_to_it(
    scene: sparklod.Scene, tmp_path: Path, name: str, options: dict[str, Any]
) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        sparklod.write(tmp_path / name, scene, **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", [".spz", ".ply", ".splat"])
def test_no_splats_are_not_written(tmp_path: Path, suffix: str) -> None:
    empty = sparklod.Scene.from_arrays(*(np.zeros(shape) for shape in ((0, 3), (0, 3), (0, 4), 0, (0, 3))))
    with pytest.raises(sparklod.InvalidSplatsError, match="no splats to write"):
        sparklod.write(tmp_path / f"empty{suffix}", empty)


def test_errors_of_reading_name_the_file(tmp_path: Path) -> None:
    (tmp_path / "broken.ply").write_bytes(DEMO.read_bytes()[:5000])
    for name in ("broken.ply", "missing.ply"):
        with pytest.raises(sparklod.FormatError, match=f"{name}: "):
            sparklod.read(tmp_path / name)


def test_cameras_and_instances_of_no_sense_are_refused(scene: sparklod.Scene, tmp_path: Path) -> None:
    for count in (0, -1, 1 << 30):
        with pytest.raises(sparklod.CameraPathError, match="count is"):
            sparklod.orbit(scene, count=count)
    with pytest.raises(sparklod.CameraPathError, match="no format 'nothing'; give auto or one of"):
        sparklod.read_cameras(DEMO, format="nothing")
    path = tmp_path / "instances.json"
    path.write_text(json.dumps({"instances": [{"file": str(ONE)}]}))
    assert [each.file for each in sparklod.read_instances(str(path))] == [ONE]


@pytest.mark.parametrize("name", ["", "new.spz/", "out.spz"])
def test_a_folder_is_no_file_to_write(name: str, scene: sparklod.Scene, tmp_path: Path) -> None:
    (tmp_path / "out.spz").mkdir()
    for write in (lambda path: sparklod.write(path, scene), sparklod.show(np.zeros((8, 8, 4), np.float32)).save):
        with pytest.raises(sparklod.OutputError, match="is a folder; name a file in it"):
            write(f"{tmp_path}/{name}")
    assert not any((tmp_path / "out.spz").iterdir())


@pytest.mark.parametrize("encoding", [None, "ext"])
def test_a_name_without_suffix_is_refused(encoding: str | None, scene: sparklod.Scene, tmp_path: Path) -> None:
    with pytest.raises(sparklod.FormatError, match=r"written as \.\w+, .*which the name does not end in"):
        sparklod.write(tmp_path / "out", scene, encoding=encoding)
    assert not any(tmp_path.iterdir())
