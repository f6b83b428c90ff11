"""Cuts, pictures, traversals and comparisons of the public interface: those of the commands."""

from __future__ import annotations

import csv
import io
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparklod_cli as sparklod
from sparklod_cli.tables.columns import Column, Row
from tests.api.runs import SIZE, VIEW, camera, command, without_time
from tests.conftest import FIXTURES

pytestmark = pytest.mark.slow


def cell_text(column: Column, row: Row) -> str:
    """As in a CSV file."""
    return "" if row[column.name] is None else format(row[column.name], column.digits)


def test_a_cut_is_within_its_budget(held: sparklod.Tree) -> None:
    for budget in (1, 37, 500, 10**9):
        cut = sparklod.cut(held, camera(), budget=budget)
        assert len(cut) == len(cut.splats) == len(cut.nodes[0]) <= budget
        assert len(np.unique(cut.nodes[0])) == len(cut)
    leaves = int(held.tree.is_leaf.sum())
    assert len(sparklod.cut(held, camera(), budget=0.25)) <= leaves // 4
    assert repr(sparklod.cut(held, camera(), budget="5%")).startswith("Cut(")


@pytest.mark.parametrize("budget", [0, -3, 1.5, 0.0, "nothing"])
def test_invalid_budgets_are_refused(held: sparklod.Tree, budget: Any) -> None:
    with pytest.raises(ValueError, match=r"budget|neither"):
        sparklod.cut(held, camera(), budget=budget)


@pytest.mark.parametrize("precision", ["float16", "ext", "packed"])
def test_cuts_in_another_precision_are_those_of_the_command(
    file: Path, held: sparklod.Tree, tmp_path: Path, precision: str
) -> None:
    """A tree that was read knows how its file holds scales."""
    path = FIXTURES / "cameras" / "sparklod.json"
    half = ["--camera-path", path, "--budget", 300, "--precision", precision, "--no-timing"]
    command("traverse", file, *half, "-o", tmp_path / "theirs.csv", "-q")
    theirs = list(csv.DictReader(io.StringIO((tmp_path / "theirs.csv").read_text())))
    frames = sparklod.traverse(held, sparklod.read_cameras(path), budget=300, precision=precision)
    assert [str(row["pixel_scale_min"]) for row in frames] == [row["pixel_scale_min"] for row in theirs]
    exact = sparklod.traverse(held, sparklod.read_cameras(path), budget=300)
    assert frames.column("pixel_scale_min") != exact.column("pixel_scale_min")
    with pytest.raises(ValueError, match="no precision"):
        sparklod.cut(held, camera(), precision="float8")


@pytest.mark.parametrize("full", [False, True])
def test_a_picture_is_what_the_command_draws(file: Path, held: sparklod.Tree, tmp_path: Path, full: bool) -> None:
    what = ["--full"] if full else ["--budget", 400]
    size = f"{SIZE[0]}x{SIZE[1]}"
    command("render", file, "--look-at", VIEW, "--size", size, *what, "-o", tmp_path / "theirs.npy", "-q")
    drawn = held if full else sparklod.cut(held, camera(), budget=400)
    ours = sparklod.render(drawn, camera())
    assert ours.shape == (*SIZE[::-1], 4) and ours.dtype == np.float32
    assert ours[..., 3].any()
    assert np.array_equal(ours, np.load(tmp_path / "theirs.npy"))


def test_continuous_cuts_are_those_of_the_command(file: Path, held: sparklod.Tree, tmp_path: Path) -> None:
    size = f"{SIZE[0]}x{SIZE[1]}"
    view = ["--look-at", VIEW, "--size", size, "--budget", 400, "--continuous"]
    command("render", file, *view, "-o", tmp_path / "theirs.npy", "-q")
    ours = sparklod.render(sparklod.cut(held, camera(), budget=400, continuous=True), camera())
    assert np.array_equal(ours, np.load(tmp_path / "theirs.npy"))


def test_more_splats_are_nearer_to_full_detail(scene: sparklod.Scene, held: sparklod.Tree) -> None:
    full = sparklod.render(scene, camera())
    found = [
        sparklod.psnr(sparklod.render(sparklod.cut(held, camera(), budget=share), camera()), full)
        for share in (0.05, 0.3, 1.0)
    ]
    assert found == sorted(found)
    assert sparklod.psnr(full, full) == 100
    assert sparklod.ssim(full, full) == pytest.approx(1)
    with pytest.raises(ValueError, match="shapes"):
        sparklod.psnr(full, full[1:])


def test_rows_are_those_of_the_commands_table(file: Path, held: sparklod.Tree, tmp_path: Path) -> None:
    path = FIXTURES / "cameras" / "sparklod.json"
    command(
        "traverse", file, "--camera-path", path, "--budget", 300, "--no-timing", "-o", tmp_path / "theirs.csv", "-q"
    )
    frames = sparklod.traverse(held, sparklod.read_cameras(path), budget=300)
    theirs = list(csv.DictReader(io.StringIO((tmp_path / "theirs.csv").read_text())))
    columns = [column for column in frames.columns if column.name != "traverse_ms"]
    streamed = ("bytes_new",)  # a tree in memory is as large as its columns, not as its file
    for ours, row in zip(frames, theirs, strict=True):
        for column in columns:
            if column.name not in ("instance", *streamed):
                assert cell_text(column, ours) == row[column.name], column.name
    assert frames.summary().frames == len(frames)
    read_anew = sparklod.traverse(sparklod.Instance(file, "demo-lod"), sparklod.read_cameras(path), budget=300)
    assert [row["bytes_new"] for row in read_anew] == [int(row["bytes_new"]) for row in theirs]


def test_rows_do_not_depend_on_threads(held: sparklod.Tree) -> None:
    cameras = sparklod.orbit(held, count=5, size=SIZE)
    one, three = (sparklod.traverse(held, cameras, budget=300, threads=threads) for threads in (1, 3))
    assert without_time(one) == without_time(three)


def test_an_orbit_is_that_of_the_command(file: Path, held: sparklod.Tree, tmp_path: Path) -> None:
    command("traverse", file, "--orbit", 4, "--size", "160x120", "--budget", 300, "-o", tmp_path / "theirs.csv", "-q")
    theirs = list(csv.DictReader(io.StringIO((tmp_path / "theirs.csv").read_text())))
    cameras = sparklod.orbit(held, count=4, size=SIZE)
    assert [f"{camera.position[0]:.6f}" for camera in cameras] == [row["position_x"] for row in theirs]


def test_a_comparison_is_that_of_the_command(file: Path, held: sparklod.Tree, tmp_path: Path) -> None:
    size = f"{SIZE[0]}x{SIZE[1]}"
    view = ["--look-at", VIEW, "--size", size]
    command("render", file, *view, "--compare", "--budget", "5%,300", "-o", tmp_path / "theirs.csv", "-q")
    table = sparklod.compare(held, None, [camera()], budgets=[0.05, 300])
    theirs = list(csv.DictReader(io.StringIO((tmp_path / "theirs.csv").read_text())))
    for ours, row in zip(table, theirs, strict=True):
        assert {column.name: cell_text(column, ours) for column in table.columns} == row
    assert [each.text for each in table.summary()] == ["5%", "300"]


def test_full_detail_may_be_another_scene(scene: sparklod.Scene, held: sparklod.Tree) -> None:
    (own,) = sparklod.compare(held, None, [camera()], budgets=[1.0])
    (other,) = sparklod.compare(held, scene, [camera()], budgets=[1.0])
    assert own["psnr"] == 100 > other["psnr"] > 30  # type: ignore[operator]


def test_instances_stand_where_they_are_put(held: sparklod.Tree) -> None:
    there = np.eye(4)
    there[:3, 3] = 1, 0, 0
    both = [sparklod.Instance(held, "here"), sparklod.Instance(held, "there", there)]
    cut = sparklod.cut(both, camera(), budget=500)
    assert len(cut.nodes) == 2 and len(cut) <= 500
    rows = sparklod.traverse(both, [camera()], budget=500, by_instance=True)
    assert [row["instance"] for row in rows] == ["total", "here", "there"]
    assert [row["selected"] for row in rows] == [len(cut), *map(len, cut.nodes)]
    unnamed = sparklod.traverse([held, held], [camera()], budget=500, by_instance=True)
    assert [row["instance"] for row in unnamed] == ["total", "scene", "scene 2"]


def test_instances_are_of_files_or_scenes(file: Path) -> None:
    assert sparklod.Instance(str(file)).file == file  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="not of int"):
        sparklod.Instance(3)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"shape \(3, 3\); give \(4, 4\)"):
        sparklod.Instance(file, object_to_world=np.eye(3))


def test_plain_scenes_are_not_traversed(scene: sparklod.Scene) -> None:
    with pytest.raises(sparklod.FormatError, match="not a Level-of-Detail tree"):
        sparklod.traverse(scene, [camera()], budget=300)
    assert len(sparklod.cut(scene, camera(), budget=300)) == len(scene)


def test_tables_become_data_frames(held: sparklod.Tree) -> None:
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    frames = sparklod.traverse(held, [camera()] * 3, budget=300)
    data = frames.to_pandas()
    assert list(data.columns) == [column.name for column in frames.columns]
    assert data["selected"].tolist() == frames.column("selected")
    assert pandas.isna(data["churn"][0]) and not pandas.isna(data["churn"][1])


def test_without_pandas_an_error_says_so(held: sparklod.Tree, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(sparklod.SparklodError, match="pip install pandas"):
        sparklod.traverse(held, [camera()], budget=300).to_pandas()
