"""Cuts, pictures, traversals and comparisons of the API: those of the commands, for trees and Streamed SOG."""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparklod_cli as sparklod
from sparklod_cli.tables.columns import Column, Row
from tests.commands.cli import NAMED, Cli
from tests.lod.trees import row_of_regions
from tests.part_files import write_streamed

CAMERA = sparklod.Camera.look_at((0.5, -1.0, 4.0), (0.0, 0.0, 0.0), size=(160, 120))
VIEW, CAMERAS = "--look-at 0.5,-1,4:0,0,0 --size 160x120", "sparklod.json"


def cell_text(column: Column, row: Row) -> str:
    """Return a cell as in a CSV file."""
    return "" if row[column.name] is None else format(row[column.name], column.digits)


def rows_of(name: str) -> list[dict[str, str]]:
    with Path(name).open(newline="") as file:
        return list(csv.DictReader(file))


def without_time(rows: Any) -> list[dict[str, Any]]:
    return [{name: cell for name, cell in row.items() if name != "traverse_ms"} for row in rows]


def test_a_cut_is_within_its_budget(scene: sparklod.Scene, held: sparklod.Tree) -> None:
    for budget in (1, 37, 500, 10**9):
        cut = sparklod.cut(held, CAMERA, budget=budget)
        assert len(cut) == len(cut.splats) == len(cut.nodes[0]) == len(np.unique(cut.nodes[0])) <= budget
    assert len(sparklod.cut(held, CAMERA, budget=0.25)) <= int(held.tree.is_leaf.sum()) // 4
    assert repr(sparklod.cut(held, CAMERA, budget="5%")).startswith("Cut(")
    assert len(sparklod.cut(scene, CAMERA, budget=300)) == len(scene)  # of a scene without a tree


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["float16", "ext", "packed"])
def test_cuts_in_a_precision_are_those_of_the_command(
    precision: str, file: Path, held: sparklod.Tree, cli: Cli
) -> None:
    """A tree that was read knows how its file holds scales."""
    cli(f"traverse {file} --camera-path {CAMERAS} --budget 300 --precision {precision} --no-timing -o a.csv")
    exact, rounded = (
        sparklod.traverse(held, sparklod.read_cameras(NAMED[CAMERAS]), budget=300, **how)
        for how in ({}, {"precision": precision})
    )
    assert [str(row["pixel_scale_min"]) for row in rounded] == [row["pixel_scale_min"] for row in rows_of("a.csv")]
    assert rounded.column("pixel_scale_min") != exact.column("pixel_scale_min")


def test_pictures_are_those_of_the_command(file: Path, held: sparklod.Tree, cli: Cli) -> None:
    for options, drawn in (
        ("--full", held),
        ("--budget 400", sparklod.cut(held, CAMERA, budget=400)),
        ("--budget 400 --continuous", sparklod.cut(held, CAMERA, budget=400, continuous=True)),
    ):
        cli(f"render {file} {VIEW} {options} -o a.npy -f")
        ours = sparklod.render(drawn, CAMERA)
        assert ours.shape == (120, 160, 4) and ours.dtype == np.float32 and ours[..., 3].any()
        assert np.array_equal(ours, np.load("a.npy"))


@pytest.mark.slow
def test_rows_are_those_of_the_command(file: Path, held: sparklod.Tree, cli: Cli) -> None:
    cli(f"traverse {file} --camera-path {CAMERAS} --budget 300 --no-timing -o a.csv")
    cameras, theirs = sparklod.read_cameras(NAMED[CAMERAS]), rows_of("a.csv")
    frames = sparklod.traverse(held, cameras, budget=300)
    # A tree in memory is as large as its columns, not as its file.
    columns = [column for column in frames.columns if column.name not in ("traverse_ms", "instance", "bytes_new")]
    for ours, row in zip(frames, theirs, strict=True):
        assert {column.name: cell_text(column, ours) for column in columns}.items() <= row.items()
    assert frames.summary().frames == len(frames)
    read_anew = sparklod.traverse(sparklod.Instance(file, "demo-lod"), cameras, budget=300)
    assert [row["bytes_new"] for row in read_anew] == [int(row["bytes_new"]) for row in theirs]
    cli(f"traverse {file} --orbit 4 --size 160x120 --budget 300 -o b.csv")
    orbit = sparklod.orbit(held, count=4, size=(160, 120))
    assert [f"{camera.position[0]:.6f}" for camera in orbit] == [row["position_x"] for row in rows_of("b.csv")]
    one, three = (sparklod.traverse(held, orbit, budget=300, threads=threads) for threads in (1, 3))
    assert without_time(one) == without_time(three)


@pytest.mark.slow
def test_a_comparison_is_that_of_the_command(scene: sparklod.Scene, file: Path, held: sparklod.Tree, cli: Cli) -> None:
    cli(f"render {file} {VIEW} --compare --budget 5%,300 -o a.csv")
    table = sparklod.compare(held, None, [CAMERA], budgets=[0.05, 300])
    for ours, row in zip(table, rows_of("a.csv"), strict=True):
        assert {column.name: cell_text(column, ours) for column in table.columns} == row
    assert [each.text for each in table.summary()] == ["5%", "300"]
    own, other = (sparklod.compare(held, full, [CAMERA], budgets=[1.0]).column("psnr")[0] for full in (None, scene))
    assert own == 100 > other > 30  # type: ignore[operator]


def test_instances_stand_where_they_are_put(held: sparklod.Tree) -> None:
    there = np.eye(4)
    there[:3, 3] = 1, 0, 0
    both = [sparklod.Instance(held, "here"), sparklod.Instance(held, "there", there)]
    cut = sparklod.cut(both, CAMERA, budget=500)
    assert len(cut.nodes) == 2 and len(cut) <= 500
    rows = sparklod.traverse(both, [CAMERA], budget=500, by_instance=True)
    assert [row["instance"] for row in rows] == ["total", "here", "there"]
    assert [row["selected"] for row in rows] == [len(cut), *map(len, cut.nodes)]
    unnamed = sparklod.traverse([held, held], [CAMERA], budget=500, by_instance=True)
    assert [row["instance"] for row in unnamed] == ["total", "scene", "scene 2"]


def test_tables_are_shown_in_notebooks_and_data_frames(held: sparklod.Tree, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = sparklod.traverse(held, [CAMERA] * 30, budget=300)
    html = frames._repr_html_()
    assert html.count("<tr>") == 1 + 20 + 1 and "…" in html and repr(frames) in html
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    data = frames.to_pandas()
    assert list(data.columns) == [column.name for column in frames.columns]
    assert data["selected"].tolist() == frames.column("selected")
    assert pandas.isna(data["churn"][0]) and not pandas.isna(data["churn"][1])
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(sparklod.SparklodError, match="pip install pandas"):
        frames.to_pandas()


def test_views_of_scenes_at_several_detail_levels(tmp_path: Path) -> None:
    """Six regions of 64, 32 and 16 splats, and 5 splats around them."""
    camera = sparklod.Camera.look_at([0, 0, -6], [0, 0, 0], size=(48, 32))
    scene = row_of_regions(environment=5)
    for viewed in (scene, sparklod.Instance(write_streamed(tmp_path, scene))):
        assert len(sparklod.cut(viewed, camera)) == 6 * 64 + 5
        cut = sparklod.cut(viewed, camera, budget=200)
        assert 150 < len(cut) <= 205 and cut.reason == "budget"
        assert sparklod.render(cut, camera).shape == (32, 48, 4)
        (row,) = sparklod.traverse(viewed, [camera], budget=200)
        assert row["selected"] == len(cut) and row["budget"] == 200
        coarse, full = sparklod.compare(viewed, None, [camera], budgets=[0.3, 1.0]).column("psnr")
        assert coarse < full == 100
    for rule, splats in (({"mode": "limit", "base_distance": 0.1}, 16), ({"finest": 1}, 32)):
        lod = sparklod.LodSettings(detail=sparklod.DetailRule(**rule))  # type: ignore[arg-type]
        assert len(sparklod.cut(scene, camera, settings=lod)) == 6 * splats + 5
    with pytest.raises(sparklod.FormatError, match="scene: it is not a Level-of-Detail tree"):
        sparklod.traverse(scene.scene(), [camera])
