"""RAD out of `sparklod build-lod`: one file or chunks, trees that keep their nodes, options, refusals, reports."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.codecs import spz
from sparklod_cli.codecs.options import RAD_ENCODINGS, RadOptions, WriteOptions
from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.codecs.rad.rad_header import read_chunk_header, read_header
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quick
from sparklod_cli.model.scene import Scene
from tests.commands.build_lod.runs import ONE, SMALL, build, convert
from tests.conftest import FIXTURES, Capture
from tests.scenes import random_splats

TREE = FIXTURES / "golden" / "tree-v3.spz"


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An LoD SPZ of more nodes than a chunk has."""
    path = tmp_path_factory.mktemp("large") / "scene-lod.spz"
    splats = random_splats(60_000, extent=50)
    path.write_bytes(b"".join(spz.encode(Scene(*quick.build(splats)), WriteOptions(compression_level=1))))
    return path


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def rows(scene: Scene) -> np.ndarray:
    """(N, 9) what is the same in both formats up to rounding, in an order that does not depend on that of the nodes."""
    assert scene.tree is not None
    count, start = scene.tree.child_count.astype(np.int64), scene.tree.child_start.astype(np.int64)
    first = np.where(count[:, None] > 0, scene.splats.center[np.minimum(start, len(count) - 1)], 0)
    found = np.column_stack([scene.splats.center, first, count, scene.splats.opacity > 1])
    return np.array(sorted(map(tuple, np.round(found, 1).tolist())))


@pytest.mark.parametrize("arguments", [["--format", "rad"], ["-o", "scene-lod.rad"], ["-o", "scene-lod.RAD"]])
def test_rad_is_written_where_it_is_asked_for(
    arguments: list[str], scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.chdir(scene.parent)
    assert build(scene, *arguments) == 0
    (made,) = (path for path in scene.parent.iterdir() if path.suffix.lower() == ".rad")
    baked = read_scene(made)
    assert baked.tree is not None
    assert (baked.format, baked.header["chunked"]) == ("RAD LoD", 0)
    assert baked.tree.is_leaf.sum() == len(read_scene(scene).splats)
    assert f"{len(baked):,} nodes, depth {baked.tree.depths().max()}, 1 chunk, " in capsys.readouterr().err


def test_chunks_are_files_beside_their_header(large: Path, tmp_path: Path, capsys: Capture) -> None:
    assert build(large, "--format", "rad-chunked", "--output-dir", tmp_path / "web", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert names(tmp_path / "web") == ["scene-lod-0.radc", "scene-lod-1.radc", "scene-lod.rad"]
    assert (record["output_format"], record["chunks"]) == ("rad-chunked", 2)
    assert record["bytes"] == sum(path.stat().st_size for path in (tmp_path / "web").iterdir())
    assert build(large, "-o", tmp_path / "one.rad") == 0
    one, many = read_scene(tmp_path / "one.rad"), read_scene(tmp_path / "web" / "scene-lod.rad")
    assert (one.chunk_bytes, one.tree) != (None, None)
    assert one.chunk_bytes == many.chunk_bytes
    np.testing.assert_array_equal(one.splats.center, many.splats.center)
    assert build(large, "--format", "rad-chunked", "--output-dir", tmp_path / "web") == 1
    assert "scene-lod.rad exists, add --overwrite" in capsys.readouterr().err
    (tmp_path / "web" / "scene-lod.rad").unlink()
    assert build(large, "--format", "rad-chunked", "--output-dir", tmp_path / "web") == 1
    assert "scene-lod-0.radc exists, add --overwrite" in capsys.readouterr().err


def test_a_shorter_output_removes_the_chunks_of_a_longer_one(large: Path, tmp_path: Path) -> None:
    assert build(large, "--format", "rad-chunked", "-o", tmp_path / "x.rad") == 0
    assert build(ONE, "--format", "rad-chunked", "-o", tmp_path / "x.rad", "--overwrite") == 0
    assert names(tmp_path) == ["x-0.radc", "x.rad"]
    assert len(read_scene(tmp_path / "x.rad")) == 1


@pytest.mark.slow
def test_a_tree_is_the_same_in_the_other_format(large: Path, tmp_path: Path, capsys: Capture) -> None:
    before = read_scene(large)
    assert build(large, "-o", tmp_path / "there.rad", "-v", "--json") == 0
    out, err = capsys.readouterr()
    record = json.loads(out)
    assert before.tree is not None
    leaves = int(before.tree.is_leaf.sum())
    assert (record["read"], record["nodes"], record["splats"]) == (len(before), len(before), leaves)
    assert (record["method"], record["dropped"]) == (None, {})
    assert "build" not in record["seconds"]
    assert "SPZ 3 LoD -> the same tree -> RAD LoD, center f32_lebytes" in err
    assert build(tmp_path / "there.rad", "-o", tmp_path / "back.spz") == 0
    there, back = read_scene(tmp_path / "there.rad"), read_scene(tmp_path / "back.spz")
    assert there.tree is not None and back.tree is not None
    np.testing.assert_array_equal(rows(there), rows(before))
    # From RAD to SPZ, nodes keep the order that they have.
    np.testing.assert_array_equal(back.tree.child_start, there.tree.child_start)
    np.testing.assert_allclose(back.splats.center, there.splats.center, atol=1e-3)
    assert build(tmp_path / "there.rad", "--format", "rad-chunked", "-o", tmp_path / "many.rad") == 0
    np.testing.assert_array_equal(rows(read_scene(tmp_path / "many.rad")), rows(there))


@pytest.mark.parametrize("foreign", [False, True])
def test_only_another_container_keeps_every_byte_of_the_chunks(large: Path, tmp_path: Path, foreign: bool) -> None:
    whole, many, back = (tmp_path / name / "x.rad" for name in ("whole", "many", "back"))
    if foreign:  # other encodings and ranges than ours, and a palette
        shutil.copytree(FIXTURES / "golden" / "sh3-rad", many.parent)
        many = many.with_name("sh3.rad")
        assert build(many, "--format", "rad", "-o", whole) == 0
    else:
        assert build(large, "--cluster-sh", 100, "--rad-scales", "f32", "-o", whole) == 0
        assert build(whole, "--format", "rad-chunked", "-o", many) == 0
    chunks = [path.read_bytes() for path in sorted(many.parent.glob("*.radc"))]
    assert whole.read_bytes().endswith(b"".join(chunks))
    assert build(many, "--format", "rad", "-o", back) == 0
    assert back.read_bytes() == whole.read_bytes()
    assert np.array_equal(rows(read_scene(many)), rows(read_scene(whole)))


def test_other_encodings_can_be_chosen_with_another_container(large: Path, tmp_path: Path) -> None:
    assert build(large, "-o", tmp_path / "x.rad") == 0
    assert build(tmp_path / "x.rad", "--format", "rad-chunked", "--rad-scales", "f32", "-o", tmp_path / "y.rad") == 0
    one, other = (read_scene(tmp_path / name) for name in ("x.rad", "y.rad"))
    assert one.coding is not None and other.coding is not None
    assert (one.coding.scales[0][0], other.coding.scales[0][0]) == ("ln_0r8", "")


def test_a_converted_tree_keeps_its_opacities(large: Path, tmp_path: Path) -> None:
    """Scales are rounded to other codes; those of opacities are the same in both formats."""
    assert build(large, "-o", tmp_path / "there.rad") == 0
    assert build(tmp_path / "there.rad", "-o", tmp_path / "back.spz") == 0
    assert convert(tmp_path / "there.rad", tmp_path / "leaves.spz", "--leaves") == 0
    before, there, back = (read_scene(path) for path in (large, tmp_path / "there.rad", tmp_path / "back.spz"))
    assert not np.array_equal(np.sort(before.splats.scale[:, 0]), np.sort(there.splats.scale[:, 0]))
    np.testing.assert_allclose(np.sort(there.splats.opacity), np.sort(before.splats.opacity), rtol=1e-5)
    np.testing.assert_allclose(back.splats.opacity, there.splats.opacity, rtol=1e-5)
    assert there.tree is not None
    leaves = there.splats.opacity[there.tree.is_leaf]
    np.testing.assert_allclose(read_scene(tmp_path / "leaves.spz").splats.opacity, leaves, atol=1 / 510 + 1e-6)


def test_a_converted_tree_has_the_name_of_the_other_one(tmp_path: Path, capsys: Capture) -> None:
    source = tmp_path / "scene-lod.spz"
    shutil.copy(TREE, source)
    assert build(source, "--format", "rad") == 0
    assert names(tmp_path) == ["scene-lod.rad", "scene-lod.spz"]
    for form, path in (
        ("spz", source),
        ("rad", source.with_suffix(".rad")),
        ("rad-chunked", source.with_suffix(".rad")),
    ):
        before = path.read_bytes()
        assert build(path, "--format", form, "--overwrite") == 2
        assert f"{path} is an input; name another output" in capsys.readouterr().err
        assert path.read_bytes() == before


def test_a_tree_is_refused_where_nothing_is_to_be_converted(tmp_path: Path, capsys: Capture) -> None:
    for name, options in {"tree.rad": [], "many.rad": ["--format", "rad-chunked"]}.items():
        assert build(TREE, "-o", tmp_path / name, *options) == 0
    whole, many = tmp_path / "tree.rad", tmp_path / "many.rad"
    refused = [
        (TREE, []),
        (TREE, ["--format", "spz"]),
        (whole, []),
        (whole, ["--format", "rad"]),
        (many, ["--format", "rad-chunked"]),
    ]
    capsys.readouterr()
    for source, options in refused:
        assert build(source, "--output-dir", tmp_path / "out", *options) == 1
        said = "it is a Level-of-Detail file already; sparklod convert writes its tree or its leaves in another format"
        assert said in capsys.readouterr().err
    for options in (
        ["--base", "1.5"],
        ["--max-sh", "3"],
        ["--up", "-y"],
        ["--within", "0,0,0,1"],
        ["--method", "quick"],
    ):
        assert build(TREE, "-o", tmp_path / "out", "--format", "rad", *options) == 1
        assert f"it has a tree, which is written as it is; leave out {options[0]}, " in capsys.readouterr().err
    assert names(tmp_path) == ["many-0.radc", "many.rad", "tree.rad"]


@pytest.mark.parametrize("name", RAD_ENCODINGS)
def test_every_encoding_reaches_the_file_and_the_report(name: str, tmp_path: Path, capsys: Capture) -> None:
    for encoding in RAD_ENCODINGS[name]:
        output = tmp_path / f"{encoding}.rad"
        assert build(SMALL, "-o", output, f"--rad-{name}", encoding, "--json") == 0
        assert json.loads(capsys.readouterr().out)["encodings"][name] == encoding
        with output.open("rb") as file:
            read_header(file)
            written = {each.name: each.encoding for each in read_chunk_header(file).properties}
        assert written["sh1" if name == "sh" else name] == encoding


def test_options_of_both_formats_reach_rad(scene: Path, tmp_path: Path) -> None:
    sizes = []
    for level in (1, 9):
        assert build(FIXTURES / "demo.ply", "-o", tmp_path / f"{level}.rad", "--compression-level", level) == 0
        sizes.append((tmp_path / f"{level}.rad").stat().st_size)
    assert sizes[1] < sizes[0]


def test_the_splats_of_a_rad_are_written_back_out(scene: Path, tmp_path: Path, capsys: Capture) -> None:
    assert build(scene, "-o", tmp_path / "scene-lod.rad") == 0
    baked = read_scene(tmp_path / "scene-lod.rad")
    assert baked.tree is not None
    leaves = baked.splats.take(baked.tree.is_leaf)
    for name in ("scene.rad", "scene.spz"):
        assert convert(tmp_path / "scene-lod.rad", tmp_path / name, "--leaves") == 0
        back = read_scene(tmp_path / name)
        assert back.tree is None
        np.testing.assert_allclose(back.splats.center, leaves.center, atol=1e-3)
    assert convert(tmp_path / "scene-lod.rad", tmp_path / "many.rad", "--leaves", "--format", "rad-chunked") == 0
    assert read_scene(tmp_path / "many.rad").header["chunked"] == 1
    assert convert(tmp_path / "scene-lod.rad", tmp_path / "back.ply") == 0
    np.testing.assert_array_equal(read_scene(tmp_path / "back.ply").splats.center, leaves.center)
    capsys.readouterr()


def test_centres_that_float16_does_not_reach_are_refused(tmp_path: Path, capsys: Capture) -> None:
    splats = random_splats(40)
    splats.center[3] = 1e6
    source = tmp_path / "far.rad"
    source.write_bytes(b"".join(rad.encode(Scene(splats), WriteOptions())))
    assert build(source, "-o", tmp_path / "out.rad", "--rad-center", "f16") == 1
    assert "coordinates reach 1e+06, and f16 holds less than 65504" in capsys.readouterr().err


@pytest.mark.parametrize(("value", "encoding"), [(5e4, "f16"), (1e6, "f32")])
@pytest.mark.parametrize("column", ["rgb", "sh"])
def test_the_encoding_that_is_advised_holds_the_values(
    tmp_path: Path, capsys: Capture, column: str, value: float, encoding: str
) -> None:
    splats = random_splats(400, sh_degree=1)
    getattr(splats, column)[3] = value
    source = tmp_path / "bright.rad"
    source.write_bytes(b"".join(rad.encode(Scene(splats), WriteOptions(rad=RadOptions(rgb="f32", sh="f32")))))
    assert build(source, "-o", tmp_path / "out.rad", "--rad-rgb", "r8", "--rad-sh", "s8", "-v") == 0
    assert f"--rad-{column} {encoding} keeps them" in capsys.readouterr().err
    advised = ("--rad-rgb", encoding, "--rad-sh", encoding)
    assert build(source, "-o", tmp_path / "out.rad", "-f", "-v", *advised) == 0
    assert "keeps them" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--format", "spz", "-o", "x.rad"], "--format spz writes .spz, not .rad"),
        (["--format", "rad", "-o", "x.spz"], "--format rad writes .rad, not .spz"),
        (["--format", "rad-chunked", "-o", "x.ply"], "--format rad-chunked writes .rad, not .ply"),
        (["--format", "rad-chunked", "-o", "-"], "rad-chunked writes several files; name the output"),
        (["--format", "radc"], "--format"),
        (["--format", "rad", "--spz-version", "2"], "--spz-version is an option of SPZ, not of RAD"),
        (["-o", "x.rad", "--fractional-bits", "9"], "--fractional-bits is an option of SPZ, not of RAD"),
        (["--rad-sh", "f16"], "--rad-sh is an option of RAD, not of SPZ; name the output .rad, or add --format rad"),
        (["-o", "x.spz", "--cluster-sh"], "--cluster-sh is an option of RAD and SOG, not of SPZ"),
        (["--format", "rad", "--rad-center", "r8"], "--rad-center"),
        (["--format", "rad", "--cluster-sh", "1"], "2<=x<=65536"),
        (["--format", "rad", "--cluster-sh", "65537"], "2<=x<=65536"),
        (
            ["--format", "rad", "--cluster-sh", "scene.ply"],
            "put --cluster-sh after the inputs, or write --cluster-sh=65536",
        ),
    ],
)
def test_options_that_do_not_suit_the_format_are_refused(arguments: list[str], message: str, capsys: Capture) -> None:
    assert build("a.ply", *arguments) == 2
    assert message in capsys.readouterr().err


def test_a_palette_without_spherical_harmonics_is_no_error(tmp_path: Path, capsys: Capture) -> None:
    assert build(ONE, "-o", tmp_path / "x.rad", "--max-sh", "0", "--cluster-sh", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert record["sh_codes"] is None
    assert "sh" not in record["encodings"]


def test_chunks_of_an_input_are_not_replaced(tmp_path: Path, capsys: Capture) -> None:
    assert build(ONE, "--format", "rad-chunked", "-o", tmp_path / "a.rad") == 0
    moved = (tmp_path / "a.rad").rename(tmp_path / "b.rad")  # it still names a-0.radc
    before = (tmp_path / "a-0.radc").read_bytes()
    assert convert(moved, tmp_path / "a.rad", "--leaves", "--format", "rad-chunked", "--overwrite") == 2
    assert "a-0.radc is an input; name another output" in capsys.readouterr().err
    assert (tmp_path / "a-0.radc").read_bytes() == before
