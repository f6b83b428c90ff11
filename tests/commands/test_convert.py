"""Every format becomes every other one that can be written; trees stay trees where the format holds them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.bake.simplifying import leaves_of
from sparklod_cli.cli import run
from sparklod_cli.codecs import array_files
from sparklod_cli.codecs.formats import ENCODINGS, FORMATS, WRITABLE
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS
from tests.conftest import FIXTURES, Capture

GOLDEN = FIXTURES / "golden"

#: A file of each format.
SOURCES = {
    "PLY": FIXTURES / "sh1.ply",
    "compressed PLY": GOLDEN / "sh3-compressed.ply",
    "SPZ": GOLDEN / "sh3-v3.spz",
    "RAD": GOLDEN / "sh1-tree.rad",
    "Streamed SOG": GOLDEN / "sh1-streamed-sog",
    "3D Tiles": GOLDEN / "sh1-tiles",
    "glTF": GOLDEN / "sh2.gltf",
    "checkpoint": GOLDEN / "sh2-gsplat.pt",
    "SOG": GOLDEN / "sh3-v2.sog",
    "GLB": GOLDEN / "sh2.glb",
    "KSPLAT": GOLDEN / "sh2-level0.ksplat",
    "HIER": GOLDEN / "sh1.hier",
    "SPLAT": GOLDEN / "sh0.splat",
}
TREES = {"SPZ": GOLDEN / "hand-tree-v3.spz", "RAD": SOURCES["RAD"]}

#: Largest difference of a centre, as a share of the scene's extent: of SOG's logarithms, and of SPZ's steps.
CLOSE = 1e-3


def convert(*arguments: object) -> int:
    return run(["convert", *map(str, arguments)])


def splats_of(path: Path) -> Scene:
    scene = read_scene(path)
    return scene if scene.tree is None else leaves_of(scene)


def test_every_format_has_a_file() -> None:
    assert set(SOURCES) == {form.name for form in FORMATS}


@pytest.mark.parametrize("source", SOURCES)
def test_splats_of_every_format_become_every_format(source: str, tmp_path: Path) -> None:
    expected = splats_of(SOURCES[source])
    extent = np.ptp(expected.splats.center, axis=0).max()
    for ending, form in WRITABLE.items():
        target = tmp_path / (ending if not ending.startswith(".") else f"a{ending}")
        leaves = ["--leaves"] if form.trees and read_scene(SOURCES[source]).tree is not None else []
        assert convert(SOURCES[source], target, "-q", *leaves) == 0
        written = read_scene(target)
        assert (written.format.split()[0], written.tree) == (form.name, None)
        one, other = (np.sort(each.splats.center, axis=0) for each in (written, expected))
        np.testing.assert_allclose(one, other, atol=CLOSE * extent)
        if not form.bare:
            assert (written.up, written.antialiased) == (expected.up, expected.antialiased)
        if form.name == "PLY":
            for column in COLUMNS:
                actual, values = getattr(written.splats, column), getattr(expected.splats, column)
                np.testing.assert_allclose(actual, values, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("source", TREES)
def test_a_tree_keeps_its_nodes_and_links_in_every_container(source: str, tmp_path: Path) -> None:
    expected = read_scene(TREES[source])
    for name, options in (("a.spz", ()), ("a.rad", ()), ("b.rad", ("--format", "rad-chunked"))):
        assert convert(TREES[source], tmp_path / name, "-q", *options) == 0
        written = read_scene(tmp_path / name)
        assert written.tree is not None
        assert expected.tree is not None
        # RAD puts nodes into the order of its chunks; a tree has as many nodes with as many children in any order.
        one, other = (np.sort(tree.child_count) for tree in (written.tree, expected.tree))
        np.testing.assert_array_equal(one, other)
        assert len(written) == len(expected)


@pytest.mark.parametrize("source", TREES)
def test_the_way_there_and_back_in_the_same_format_keeps_the_bytes(source: str, tmp_path: Path) -> None:
    first, second = (tmp_path / f"{name}.{source.lower()}" for name in "ab")
    assert convert(FIXTURES / "sh1.ply", tmp_path / "plain.ply", "-q") == 0
    assert run(["build-lod", str(tmp_path / "plain.ply"), "-o", str(first), "-q"]) == 0
    assert convert(first, second, "-q") == 0
    assert second.read_bytes() == first.read_bytes()
    assert convert(first, tmp_path / f"{source}-other.{source.lower()}", "--compression-level", 1, "-q") == 0
    other = read_scene(tmp_path / f"{source}-other.{source.lower()}")
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(other.splats, column), getattr(read_scene(first).splats, column))


@pytest.mark.parametrize("layout", ENCODINGS)
def test_arrays_are_those_that_the_codec_packs(layout: str, tmp_path: Path, capsys: Capture) -> None:
    path, raw, scene = tmp_path / "a.npz", tmp_path / "a.bin", read_scene(TREES["SPZ"])
    assert convert(TREES["SPZ"], path, "--layout", layout, "--json") == 0
    record, expected = json.loads(capsys.readouterr().out), array_files.pack_layout(scene, layout)
    assert (record["output_format"], record["bytes"]) == (layout, path.stat().st_size)
    with np.load(path) as file:
        assert set(file) == set(expected) == set(record["arrays"])
        for name, words in expected.items():
            np.testing.assert_array_equal(file[name], words, name)
            assert record["arrays"][name] == list(words.shape)
    assert convert(TREES["SPZ"], raw, "--layout", layout, "-q") == 0
    np.testing.assert_array_equal(np.fromfile(raw, "<u4"), np.concatenate([each.ravel() for each in expected.values()]))


def test_splats_are_selected_turned_and_limited_on_the_way(tmp_path: Path, capsys: Capture) -> None:
    source, target = FIXTURES / "sh1.ply", tmp_path / "a.ply"
    before = read_scene(source).splats
    assert convert(source, target, "--up", "-y", "--max-sh", 0, "--min-opacity", 0.5) == 0
    after = read_scene(target)
    kept = before.opacity >= np.float32(0.5)
    assert 0 < np.count_nonzero(kept) < len(kept)
    np.testing.assert_allclose(after.splats.center, before.center[kept] * [1, -1, -1], atol=1e-5)
    assert (after.up, after.splats.sh_degree) == ("y", 0)
    assert f"left out: {np.count_nonzero(~kept)} below --min-opacity" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "status", "message"),
    [
        ("TREE a.spz --up -y", 1, "it has a tree, which is written as it is; leave out --up, or"),
        ("PLY a.spz --leaves", 1, "it has no Level-of-Detail tree whose leaves could be written"),
        ("PLY a.npz --layout lodtree", 1, "it has no tree, which the layout lodtree consists of; build-lod makes one"),
        ("PLY a.npz", 2, ".npz holds arrays; choose their --layout: packed, ext, lodtree, texture"),
        ("PLY a.ply --layout ext", 2, "--layout writes .npz, .bin, .raw, not .ply"),
        ("PLY web/lod-meta.json", 2, "lod-meta.json consists of cuts of a tree; build-lod -o web/lod-meta.json makes"),
        ("PLY tileset.json", 2, "build-lod -o tileset.json makes them"),
        ("PLY a", 2, "OUT a has no suffix, which chooses the format"),
        (
            "PLY a.ksplat",
            2,
            "OUT ends in .ply, .spz, .rad, .sog, meta.json, .glb, .splat, .npz, .bin, .raw, not",
        ),
        ("PLY a.ply --format sog", 2, "--format sog writes .sog, not .ply"),
        ("PLY a.ply --spz-version 2", 2, "--spz-version is an option of SPZ, not of PLY"),
        ("PLY a.npz --layout ext --fractional-bits 9", 2, "--fractional-bits is an option of SPZ, not of --layout"),
        ("PLY -", 2, "standard output has no name, which chooses the format; add --format"),
        ("PLY - --format rad-chunked", 2, "--format rad-chunked writes several files"),
        ("PLY PLY -f", 2, "is an input; name another output"),
        ("PLY ./", 2, "OUT is a folder; name the file in it, or add --format"),
        ("- ./ --format sog", 2, "standard input has no name"),
        ("PLY", 2, "Missing argument 'OUT'"),
    ],
)
def test_errors(
    line: str, status: int, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.chdir(tmp_path)
    words = {"PLY": str(FIXTURES / "sh1.ply"), "TREE": str(TREES["SPZ"])}
    assert convert(*(words.get(word, word) for word in line.split())) == status
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_an_output_that_exists_is_kept(tmp_path: Path, capsys: Capture) -> None:
    target = tmp_path / "a.sog"
    target.write_bytes(b"precious")
    assert convert(FIXTURES / "sh1.ply", target) == 1
    assert "exists, add --overwrite to replace it" in capsys.readouterr().err
    assert target.read_bytes() == b"precious"
    assert convert(FIXTURES / "sh1.ply", target, "-fq") == 0
    assert convert(FIXTURES / "sh1.ply", tmp_path, "--format", "sog", "-q") == 0
    assert (tmp_path / "sh1.sog").read_bytes() == target.read_bytes()
    assert convert(GOLDEN / "sh1-sog" / "meta.json", tmp_path, "--format", "ply", "-q") == 0
    assert (tmp_path / "sh1-sog.ply").exists()  # named after its folder, as all outputs of an unpacked SOG
