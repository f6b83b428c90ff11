"""`sparklod convert`: every format becomes every other one, trees keep their nodes, and leaves keep their values."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.bake.simplifying import leaves_of
from sparklod_cli.codecs import layouts, spz
from sparklod_cli.codecs.formats import ENCODINGS, FORMATS, WRITABLE, WriteOptions
from sparklod_cli.codecs.splat import importance_order
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quick
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from tests.commands.cli import NAMED, Cli
from tests.scenes import random_splats

#: A file of each format.
SOURCES = {
    "PLY": "sh1.ply",
    "compressed PLY": "sh3-compressed.ply",
    "SPZ": "sh3-v3.spz",
    "RAD": "sh1-tree.rad",
    "Streamed SOG": "sh1-streamed-sog",
    "3D Tiles": "sh1-tiles",
    "glTF": "sh2.gltf",
    "checkpoint": "sh2-gsplat.pt",
    "SOG": "sh3-v2.sog",
    "GLB": "sh2.glb",
    "KSPLAT": "sh2-level0.ksplat",
    "HIER": "sh1.hier",
    "SPLAT": "sh0.splat",
}
TREE, TREES = "hand-tree-v3.spz", ["hand-tree-v3.spz", "sh1-tree.rad"]

#: Largest difference of a centre, as a share of the scene's extent: of SOG's logarithms, and of SPZ's steps.
CLOSE = 1e-3


def leaves(path: str) -> Splats:
    scene = read_scene(Path(path))
    return (scene if scene.tree is None else leaves_of(scene)).splats


def test_every_format_has_a_file() -> None:
    assert set(SOURCES) == {form.name for form in FORMATS}


@pytest.mark.parametrize("source", SOURCES.values(), ids=SOURCES)
def test_splats_of_every_format_become_every_format(source: str, cli: Cli) -> None:
    scene, expected = read_scene(NAMED[source]), leaves(str(NAMED[source]))
    extent = np.ptp(expected.center, axis=0).max()
    for ending, form in WRITABLE.items():
        target = ending if not ending.startswith(".") else f"a{ending}"
        options = "--leaves" if form.trees and scene.tree is not None else ""
        cli(f"convert {source} {target} -q {options}")
        written = read_scene(Path(target))
        assert (written.format.split()[0], written.tree) == (form.name, None)
        one, other = (np.sort(splats.center, axis=0) for splats in (written.splats, expected))
        np.testing.assert_allclose(one, other, atol=CLOSE * extent)
        if not form.bare:
            assert (written.up, written.antialiased) == (scene.up, scene.antialiased)
        if form.name == "PLY":
            for column in COLUMNS:
                actual, values = getattr(written.splats, column), getattr(expected, column)
                np.testing.assert_allclose(actual, values, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("source", TREES)
def test_a_tree_keeps_its_nodes_in_every_container(source: str, cli: Cli) -> None:
    expected = read_scene(NAMED[source]).tree
    for name, options in (("a.spz", ""), ("a.rad", ""), ("b.rad", "--format rad-chunked")):
        cli(f"convert {source} {name} -q {options}")
        written = read_scene(Path(name)).tree
        assert written is not None and expected is not None
        # RAD puts nodes into the order of its chunks; a tree has as many nodes with as many children in any order.
        np.testing.assert_array_equal(np.sort(written.child_count), np.sort(expected.child_count))


@pytest.mark.parametrize("suffix", ["spz", "rad"])
def test_a_tree_in_the_same_format_keeps_its_bytes(suffix: str, cli: Cli) -> None:
    cli(f"build-lod sh1.ply -o a.{suffix} -q")
    cli(f"convert a.{suffix} b.{suffix} -q")
    assert Path(f"a.{suffix}").read_bytes() == Path(f"b.{suffix}").read_bytes()
    cli(f"convert a.{suffix} c.{suffix} --compression-level 1 -q")
    one, other = (read_scene(Path(f"{name}.{suffix}")).splats for name in "ac")
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(one, column), getattr(other, column))


@pytest.mark.parametrize("layout", ENCODINGS)
def test_arrays_are_those_that_the_codec_packs(layout: str, cli: Cli) -> None:
    record = cli(f"convert {TREE} a.npz --layout {layout} --json").json
    expected = layouts.pack_layout(read_scene(NAMED[TREE]), layout)
    assert (record["output_format"], record["bytes"]) == (layout, Path("a.npz").stat().st_size)
    with np.load("a.npz") as file:
        assert set(file) == set(expected) == set(record["arrays"])
        for name, words in expected.items():
            np.testing.assert_array_equal(file[name], words, name)
            assert record["arrays"][name] == list(words.shape)
    cli(f"convert {TREE} a.bin --layout {layout} -q")
    np.testing.assert_array_equal(
        np.fromfile("a.bin", "<u4"), np.concatenate([each.ravel() for each in expected.values()])
    )


def test_splats_are_selected_turned_and_limited_on_the_way(cli: Cli) -> None:
    before = read_scene(NAMED["sh1.ply"]).splats
    done = cli("convert sh1.ply a.ply --up -y --max-sh 0 --min-opacity 0.5")
    after = read_scene(Path("a.ply"))
    selected = before.opacity >= np.float32(0.5)
    assert 0 < np.count_nonzero(selected) < len(selected)
    np.testing.assert_allclose(after.splats.center, before.center[selected] * [1, -1, -1], atol=1e-5)
    assert (after.up, after.splats.sh_degree) == ("y", 0)
    assert f"left out: {np.count_nonzero(~selected)} below --min-opacity" in done.err


# --- Leaves of a tree with antialiasing, SH and nine fractional bits --------------------------------------------------


@functools.cache
def tree_bytes() -> bytes:
    scene = Scene(*quick.build(random_splats(3000, sh_degree=2)), antialiased=True)
    return b"".join(spz.encode(scene, WriteOptions(spz_version=2, fractional_bits=9)))


@pytest.fixture
def tree_cli(cli: Cli) -> Cli:
    cli.put("tree.spz", tree_bytes())
    return cli


def test_spz_keeps_every_value_of_the_leaves(tree_cli: Cli) -> None:
    record = tree_cli("convert tree.spz a.spz --leaves --json").json
    scene, expected = read_scene(Path("a.spz")), leaves("tree.spz")
    assert (scene.format, scene.antialiased, scene.tree) == ("SPZ 2", True, None)
    assert (record["splats"], record["nodes"]) == (3000, len(read_scene(Path("tree.spz"))))
    assert scene.header["fractional_bits"] == 9
    for column in ("center", "scale", "rgb", "sh"):
        np.testing.assert_array_equal(getattr(scene.splats, column), getattr(expected, column), column)
    # 127 steps of opacity become 255, and a rotation may fall on the other side of a rounding.
    np.testing.assert_allclose(scene.splats.opacity, expected.opacity, atol=1.001 / 510)
    assert np.abs(np.einsum("ij,ij->i", scene.splats.quat_xyzw, expected.quat_xyzw)).min() > 1 - 1e-4
    tree_cli("convert tree.spz b.spz --leaves --spz-version 3 --fractional-bits 8")
    header = read_scene(Path("b.spz")).header
    assert (header["version"], header["fractional_bits"]) == (3, 8)


def test_ply_and_splat_hold_the_leaves(tree_cli: Cli) -> None:
    assert len(tree_cli("convert tree.spz a.ply").err.splitlines()) == 1  # nothing is lost
    scene, expected = read_scene(Path("a.ply")), leaves("tree.spz")
    for column in COLUMNS:
        np.testing.assert_allclose(getattr(scene.splats, column), getattr(expected, column), rtol=1e-5, atol=1e-6)
    tree_cli("convert tree.spz a.splat")
    by_importance = expected.take(importance_order(expected))
    np.testing.assert_array_equal(leaves("a.splat").center, by_importance.center)


def test_what_splat_cannot_hold_is_reported(cli: Cli) -> None:
    splats = random_splats(3000, sh_degree=1)
    splats.rgb[:1000] += 0.5
    cli.put("tree.spz", b"".join(spz.encode(Scene(*quick.build(splats)))))
    err = cli("convert tree.spz a.splat").err
    rgb = leaves("tree.spz").rgb
    beyond = np.count_nonzero((np.clip(rgb, -0.5 / 255, 255.5 / 255) != rgb).any(axis=1))
    assert 0 < beyond < len(rgb)
    assert f"SPLAT holds no reflections (SH), and clamps the colours of {100 * beyond / len(rgb):.3g} % of" in err


def test_leaves_that_cannot_be_drawn_are_written_too(cli: Cli) -> None:
    splats = random_splats(50)
    splats.opacity[:10] = 1e-4  # becomes 0 in the file
    cli.put("tree.spz", b"".join(spz.encode(Scene(*quick.build(splats)))))
    cli("convert tree.spz a.spz --leaves")
    assert len(leaves("a.spz")) == 50
