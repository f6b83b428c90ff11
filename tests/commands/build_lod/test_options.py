"""Options of `sparklod build-lod`: they reach the file and the tree, and wrong ones are refused."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs import ply
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod.tree_settings import METHODS
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.model.transforms import Transform
from tests.commands.build_lod.runs import build
from tests.conftest import FIXTURES, Capture
from tests.scenes import random_splats


def test_options_of_spz_reach_the_file(scene: Path, tmp_path: Path, capsys: Capture) -> None:
    assert build(scene, "-o", tmp_path / "a.spz", "--json", "--spz-version", 2, "--fractional-bits", 9) == 0
    record = json.loads(capsys.readouterr().out)
    assert (record["version"], record["fractional_bits"]) == (2, 9)
    assert read_scene(tmp_path / "a.spz").format == "SPZ 2 LoD"
    sizes = {}
    for base in (1.1, 2.0):
        assert build(scene, "-o", tmp_path / f"{base}.spz", "--base", base) == 0
        sizes[base] = len(read_scene(tmp_path / f"{base}.spz").splats)
    assert sizes[1.1] > sizes[2.0]


def test_quality_builds_a_tree_of_all_splats(scene: Path, tmp_path: Path, capsys: Capture) -> None:
    total = len(read_scene(scene).splats)
    sizes = {}
    for growth in (1.05, 1.2, 2.0):
        output = tmp_path / f"{growth}.spz"
        assert build(scene, "-o", output, "--method", "quality", "--growth", growth, "--json", "-v") == 0
        out, err = capsys.readouterr()
        record, baked = json.loads(out), read_scene(output)
        assert baked.tree is not None
        baked.tree.validate()
        assert baked.tree.is_leaf.sum() == total
        assert (record["method"], record["nodes"]) == ("quality", len(baked.splats))
        assert len(baked.splats) <= growth * total
        assert "PLY -> quality tree -> SPZ 3 LoD" in err
        sizes[growth] = len(baked.splats)
    assert sizes[1.05] < sizes[1.2] < sizes[2.0]


def test_the_default_method_is_quick(scene: Path, tmp_path: Path, capsys: Capture) -> None:
    for name, arguments in {"a": [], "b": ["--method", "quick"], "c": ["--method", "quality"]}.items():
        assert build(scene, "-o", tmp_path / f"{name}.spz", "--json", *arguments) == 0
    records = map(json.loads, capsys.readouterr().out.splitlines())
    assert [record["method"] for record in records] == ["quick", "quick", "quality"]
    a, b, c = ((tmp_path / f"{name}.spz").read_bytes() for name in "abc")
    assert a == b != c


@pytest.mark.parametrize("method", METHODS)
def test_threads_do_not_change_the_file(method: str, tmp_path: Path) -> None:
    for threads in (1, 2):
        output = tmp_path / f"{threads}.spz"
        assert build(FIXTURES / "demo.ply", "-o", output, "--method", method, "--threads", threads) == 0
    assert (tmp_path / "1.spz").read_bytes() == (tmp_path / "2.spz").read_bytes()


def test_options_reach_the_tree(scene: Path, tmp_path: Path, capsys: Capture) -> None:
    splats = read_scene(scene).splats
    x, y, z = splats.center[0].tolist()
    distance = np.sqrt(((splats.center - splats.center[0]) ** 2).sum(axis=1, dtype=np.float64))
    radius = float(np.median(distance))
    opacity = float(np.median(splats.opacity))
    left = {
        ("--within", f"{x},{y},{z},{radius}"): int((distance <= radius).sum()),
        ("--min-opacity", str(opacity)): int((splats.opacity >= opacity).sum()),
        ("--min-box", f"{x},{y},{z}"): int((splats.center >= splats.center[0]).all(axis=1).sum()),
        ("--max-sh", "0"): len(splats),
    }
    for arguments, count in left.items():
        assert build(scene, "-o", tmp_path / "out.spz", "--overwrite", "--json", "-q", *arguments) == 0
        assert json.loads(capsys.readouterr().out)["splats"] == count
    assert read_scene(tmp_path / "out.spz").splats.sh_degree == 0
    sizes = []
    for level in (1, 9):
        assert build(FIXTURES / "demo.ply", "-o", tmp_path / f"{level}.spz", "--compression-level", level) == 0
        sizes.append((tmp_path / f"{level}.spz").stat().st_size)
    assert sizes[1] < sizes[0]


def test_more_processors_than_the_most_threads_are_no_error(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sparklod_cli.system.threads.processors", lambda: 5000)
    assert build(scene) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "Missing argument"),
        (["a.ply", "--method", "quality", "--base", "1.5"], "--base is an option of --method quick, not of quality"),
        (["a.ply", "--method", "quick", "--growth", "1.4"], "--growth is an option of --method quality, not of quick"),
        (["a.ply", "--growth", "1.4"], "--growth is an option of --method quality, not of quick"),
        (["a.ply", "--fractional-bits", "many"], "--fractional-bits"),
        (["a.ply", "--min-box", "1,2"], "x,y,z"),
        (["a.ply", "--max-box", "1,2,nan"], "x,y,z"),
        (["a.ply", "--within", "1,2,3"], "x,y,z,radius"),
        (["a.ply", "--within", "1,2,3,-1"], "radius"),
        (["a.ply", "b.ply", "-o", "c.spz"], "--output takes one input, not 2"),
        (["a.ply", "-o", "c.spz", "--output-dir", "d"], "--output cannot be used with --output-dir"),
        (["x/a.ply", "y/a.ply", "--output-dir", "d"], "two outputs would be written to d/a-lod.spz"),
        (["a.ply", "-o", "-", "--json"], "standard output"),
        (
            ["a.ply", "-o", "out.obj"],
            "written as SPZ, RAD, Streamed SOG or 3D Tiles, not as .obj; name the output .spz, .rad, lod-meta.json or",
        ),
        (["a.ply", "-o", "out.RADC"], "trees are written as SPZ, RAD, Streamed SOG or 3D Tiles, not as .radc"),
        (["a.ply", "-o", "out.spz.gz"], "trees are written as SPZ, RAD, Streamed SOG or 3D Tiles, not as .gz"),
        (
            ["a.ply", "-o", "out.ply"],
            ".ply cannot hold a tree; name the output .spz, .rad, lod-meta.json or tileset.json, or write",
        ),
        (["a.ply", "-o", "out.bin"], ".bin holds arrays; bake a tree, and write it with sparklod convert --layout"),
        (["a-lod.spz", "--unlod"], "there is no option --unlod any more; write sparklod convert IN OUT --leaves"),
        (["a.ply", "--encoding", "ext"], "--encoding any more; write sparklod convert IN OUT.npz --layout NAME"),
        (["a.ply", "--quality"], "there is no option --quality; did you mean --method quality?"),
        (["a.ply", "--overwritten"], "--overwrite"),
    ],
)
def test_wrong_usage_of_build_lod_is_exit_code_2(arguments: list[str], message: str, capsys: Capture) -> None:
    assert build(*arguments) == 2
    assert message in capsys.readouterr().err


def test_a_bake_of_a_ply_loads_no_other_reader(tmp_path: Path) -> None:
    """Nor what only bakes out of core, of other outputs, or of several files need."""
    scene = Path(__file__).parents[3] / "fixtures" / "sh3.ply"
    code = f"""
import sys
from sparklod_cli import cli
assert cli.run(["build-lod", {str(scene)!r}, "-o", {str(tmp_path / "tree.spz")!r}, "-q"]) == 0
print(*sorted(sys.modules))
"""
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "sparklod_cli.codecs.ply" in loaded
    others = ("cameras.camera", "codecs.sog", "codecs.streamed_manifest", "codecs.rad.rad_writer")
    others += (
        "codecs.array_files",
        "bake.out_of_core.cluster",
        "bake.out_of_core.in_blocks",
        "bake.skipping",
        "viewers.instances_file",
    )
    assert {f"sparklod_cli.{name}" for name in others}.intersection(loaded) == set()
    assert "PIL" not in loaded


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
        (["--translate", "1e9,0,0"], 1, "scale the scene"),
    ],
)
def test_transforms_that_cannot_be_done_are_refused(
    arguments: list[str], status: int, message: str, tmp_path: Path, capsys: Capture
) -> None:
    assert build(SCENE, "-o", tmp_path / "out.spz", *arguments) == status
    assert message in capsys.readouterr().err
