"""The way back from a tree: its leaves, all of them, with the values of its file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs import spz
from sparklod_cli.codecs.options import WriteOptions
from sparklod_cli.codecs.splat import importance_order
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quick
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from tests.scenes import random_splats


@pytest.fixture
def tree_file(tmp_path: Path) -> Path:
    path = tmp_path / "scene-lod.spz"
    scene = Scene(*quick.build(random_splats(3000, sh_degree=2)), antialiased=True)
    path.write_bytes(b"".join(spz.encode(scene, WriteOptions(spz_version=2, fractional_bits=9))))
    return path


def convert(*arguments: object) -> int:
    return run(["convert", *map(str, arguments)])


def leaves(path: Path) -> Splats:
    scene = read_scene(path)
    assert scene.tree is not None
    return scene.splats.take(scene.tree.is_leaf)


def test_spz_keeps_every_value_of_the_tree(tree_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert convert(tree_file, tree_file.with_name("back.spz"), "--leaves", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    back = read_scene(tree_file.with_name("back.spz"))
    expected = leaves(tree_file)
    assert (back.format, back.antialiased, back.tree) == ("SPZ 2", True, None)
    assert (record["splats"], record["nodes"]) == (3000, len(read_scene(tree_file).splats))
    assert back.header["fractional_bits"] == 9
    for column in ("center", "scale", "rgb", "sh"):
        np.testing.assert_array_equal(getattr(back.splats, column), getattr(expected, column), column)
    # 127 steps of opacity become 255, and a rotation may fall on the other side of a rounding.
    np.testing.assert_allclose(back.splats.opacity, expected.opacity, atol=1.001 / 510)
    assert np.abs(np.einsum("ij,ij->i", back.splats.quat_xyzw, expected.quat_xyzw)).min() > 1 - 1e-4


def test_ply_keeps_them_as_floats(tree_file: Path, tmp_path: Path) -> None:
    assert convert(tree_file, tmp_path / "back.ply") == 0
    back, expected = read_scene(tmp_path / "back.ply"), leaves(tree_file)
    assert back.format == "PLY"
    for column in COLUMNS:
        np.testing.assert_allclose(getattr(back.splats, column), getattr(expected, column), rtol=1e-5, atol=1e-6)


def test_splat_is_sorted_by_importance(tree_file: Path, tmp_path: Path) -> None:
    assert convert(tree_file, tmp_path / "back.splat") == 0
    expected = leaves(tree_file)
    expected = expected.take(importance_order(expected))
    np.testing.assert_array_equal(read_scene(tmp_path / "back.splat").splats.center, expected.center)


def test_what_splat_cannot_hold_is_said(tree_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    splats = random_splats(3000, sh_degree=1)
    splats.rgb[:1000] += 0.5
    tree_file.write_bytes(b"".join(spz.encode(Scene(*quick.build(splats)))))
    assert convert(tree_file, tmp_path / "back.splat") == 0
    said = capsys.readouterr().err
    expected = leaves(tree_file)
    beyond = (np.clip(expected.rgb, -0.5 / 255, 255.5 / 255) != expected.rgb).any(axis=1)
    share = f"{100 * np.count_nonzero(beyond) / len(expected):.3g} %"
    assert 0 < np.count_nonzero(beyond) < len(expected)
    assert f"SPLAT holds no reflections (SH), and clamps the colours of {share} of the splats" in said


def test_nothing_is_said_where_nothing_is_lost(
    tree_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert convert(tree_file, tmp_path / "back.ply") == 0
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize("name", ["back.sog", "web/meta.json"])
def test_sog_holds_all_leaves(tree_file: Path, tmp_path: Path, name: str) -> None:
    assert convert(tree_file, tmp_path / name, "--cluster-sh", 3000) == 0
    back, expected = read_scene(tmp_path / name), leaves(tree_file)
    assert (back.format, back.antialiased, back.header["palette"]) == ("SOG 2", True, 3000)
    for column in ("rgb", "opacity", "sh"):
        one, two = (np.sort(getattr(each, column), axis=0) for each in (back.splats, expected))
        np.testing.assert_allclose(one, two, atol=0.01)
    np.testing.assert_allclose(back.splats.center.mean(axis=0), expected.center.mean(axis=0), atol=1e-4)


def test_a_folder_of_sog_is_replaced_as_a_whole_or_not_at_all(
    tree_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    meta = tmp_path / "web" / "meta.json"
    meta.parent.mkdir()
    taken = meta.with_name("sh0.webp")
    taken.write_bytes(b"precious")
    assert convert(tree_file, meta) == 1
    assert "sh0.webp exists, add --overwrite to replace it" in capsys.readouterr().err
    assert [each.name for each in meta.parent.iterdir()] == ["sh0.webp"]
    assert convert(tree_file, meta, "--overwrite") == 0
    assert meta.with_name("shN_labels.webp").exists()
    plain = tmp_path / "plain-lod.spz"
    plain.write_bytes(b"".join(spz.encode(Scene(*quick.build(random_splats(40))))))
    assert convert(plain, meta, "--overwrite") == 0
    names = ["means_l.webp", "means_u.webp", "meta.json", "quats.webp", "scales.webp", "sh0.webp"]
    assert sorted(each.name for each in meta.parent.iterdir()) == names  # those of SH are gone
    assert len(read_scene(meta)) == 40


def test_fractional_bits_and_version_can_be_chosen(tree_file: Path, tmp_path: Path) -> None:
    assert convert(tree_file, tmp_path / "back.spz", "--leaves", "--spz-version", 3, "--fractional-bits", 8) == 0
    back = read_scene(tmp_path / "back.spz")
    assert (back.header["version"], back.header["fractional_bits"]) == (3, 8)


def test_leaves_that_cannot_be_drawn_are_written_too(tmp_path: Path) -> None:
    splats = random_splats(50)
    splats.opacity[:10] = 1e-4  # becomes 0 in the file
    scene = Scene(*quick.build(splats))
    (tmp_path / "scene-lod.spz").write_bytes(b"".join(spz.encode(scene)))
    assert convert(tmp_path / "scene-lod.spz", tmp_path / "back.spz", "--leaves") == 0
    assert len(read_scene(tmp_path / "back.spz").splats) == 50
