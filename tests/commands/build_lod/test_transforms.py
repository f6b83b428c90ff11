"""`build-lod --up --rotate --scale --translate`: the tree stands elsewhere, and looks as before from there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs import ply
from sparklod_cli.io import read_scene
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.model.transforms import Transform
from tests.commands.build_lod.runs import build
from tests.conftest import FIXTURES, Capture
from tests.scenes import random_splats

SCENE = FIXTURES / "sh3.ply"

CASES = {
    "up": (["--up", "-y"], {"up": "-y"}),
    "rotate": (["--rotate", "25,-70,130"], {"rotate": (25, -70, 130)}),
    "translate": (["--translate", "-3,0.5,2"], {"translate": (-3, 0.5, 2)}),
    "all": (
        ["--up", "z", "--rotate", "0,90,0", "--scale", "2.5", "--translate", "1,2,3"],
        {"up": "z", "rotate": (0, 90, 0), "scale": 2.5, "translate": (1, 2, 3)},
    ),
}


def leaves(path: Path) -> Splats:
    scene = read_scene(path)
    assert scene.tree is not None
    return scene.splats.take(scene.tree.is_leaf)


def in_order(splats: Splats) -> Splats:
    """The same splats in an order of their colours, which no transform changes."""
    return splats.take(np.lexsort(splats.rgb.T))


@pytest.mark.parametrize("case", CASES)
def test_the_leaves_are_the_splats_transformed(case: str, tmp_path: Path) -> None:
    options, parts = CASES[case]
    assert build(SCENE, "-o", tmp_path / "before.spz", "--fractional-bits", 12) == 0
    assert build(SCENE, "-o", tmp_path / "after.spz", "--fractional-bits", 12, *options) == 0
    found = in_order(leaves(tmp_path / "after.spz"))
    expected = in_order(Transform.from_parts(**parts).apply(leaves(tmp_path / "before.spz")))  # type: ignore[arg-type]
    # Both were rounded to SPZ's codes, before the transform or after it; opacities make up for the rounding of scales.
    for column, most in (("center", 0.001), ("opacity", 0.1), ("rgb", 0), ("sh", 0.2)):
        np.testing.assert_allclose(getattr(found, column), getattr(expected, column), atol=most, err_msg=column)
    np.testing.assert_allclose(found.scale, expected.scale, rtol=0.07)
    assert np.abs(np.einsum("ij,ij->i", found.quat_xyzw, expected.quat_xyzw)).min() > 0.999


@pytest.mark.parametrize("case", ["up", "rotate", "translate"])
def test_a_camera_that_moves_along_sees_the_same_picture(case: str, tmp_path: Path) -> None:
    options, parts = CASES[case]
    matrix = Transform.from_parts(**parts).matrix  # type: ignore[arg-type]
    look = ["--look-at", "0.4,-1.5,4:0,0,0", "--size", "80x60", "--full"]
    moved = ["--world-transform", ",".join(str(number) for number in matrix.ravel())]
    source = tmp_path / "scene.ply"
    splats = random_splats(300, sh_degree=3, seed=4)
    splats.scale[:] *= 4
    source.write_bytes(b"".join(ply.encode(Scene(splats))))
    for name, place, camera in (("before", [], []), ("after", options, moved), ("unmoved", options, [])):
        assert build(source, "-o", tmp_path / f"{name}.spz", *place) == 0
        output = tmp_path / f"{name}.npy"
        assert run(["render", str(tmp_path / f"{name}.spz"), "-o", str(output), *look, *camera]) == 0
    before, after, unmoved = (np.load(tmp_path / f"{name}.npy") for name in ("before", "after", "unmoved"))
    assert before[..., 3].mean() > 0.1
    assert np.abs(before - after).mean() < 0.1 * np.abs(before - unmoved).mean()


@pytest.mark.parametrize("name", COLUMNS)
def test_without_transform_options_the_file_is_the_same(name: str, tmp_path: Path) -> None:
    assert build(SCENE, "-o", tmp_path / "a.spz") == 0
    assert build(SCENE, "-o", tmp_path / "b.spz", "--up", "y", "--rotate", "0,0,0", "--scale", 1) == 0
    one, other = (getattr(read_scene(tmp_path / f"{each}.spz").splats, name) for each in "ab")
    np.testing.assert_array_equal(one, other)


def test_selection_goes_by_the_coordinates_of_the_input(tmp_path: Path) -> None:
    box = ["--min-box", "0,-9,-9"]
    assert build(SCENE, "-o", tmp_path / "a.spz", *box) == 0
    assert build(SCENE, "-o", tmp_path / "b.spz", *box, "--translate", "-100,0,0") == 0
    assert len(leaves(tmp_path / "a.spz")) == len(leaves(tmp_path / "b.spz")) < len(read_scene(SCENE).splats)


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["--up", "x"], 2, "'x' is not one of"),
        (["--rotate", "90"], 2, "x,y,z"),
        (["--scale", "0"], 2, "--scale"),
        (["--scale", "1e13"], 2, "the scale 1e+13 is out of range"),
        (["--translate", "1e13,0,0"], 2, "the translation 1e+13,0,0 is out of range"),
        (["--unlod", "--up", "-y"], 2, "--up cannot be used with --unlod"),
        (["--unlod", "--rotate", "1,2,3"], 2, "--rotate cannot be used with --unlod"),
        (["--translate", "1e9,0,0"], 1, "scale the scene"),
    ],
)
def test_transforms_that_cannot_be_done_are_refused(
    arguments: list[str], status: int, message: str, tmp_path: Path, capsys: Capture
) -> None:
    assert build(SCENE, "-o", tmp_path / "out.spz", *arguments) == status
    assert message in capsys.readouterr().err
