"""The table of the chunks says what each covers."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.inspection import chunks
from sparklod_cli.io import examine_scene
from sparklod_cli.model.gaussian import spark_size
from sparklod_cli.model.scene import Scene
from tests.conftest import FIXTURES, Capture
from tests.inspection.rad_files import CHUNK, tree
from tests.scenes import random_splats

GOLDEN = FIXTURES / "golden" / "sh1-tree.rad"


def parents_of(scene: Scene) -> dict[int, int]:
    assert scene.tree is not None
    found = {}
    for node, (count, start) in enumerate(zip(scene.tree.child_count, scene.tree.child_start, strict=True)):
        found |= dict.fromkeys(range(int(start), int(start) + int(count)), node)
    return found


def depth_of(node: int, parents: dict[int, int]) -> int:
    return 0 if node not in parents else 1 + depth_of(parents[node], parents)


def test_rows_are_what_can_be_counted_by_hand() -> None:
    scene = examine_scene(GOLDEN)
    assert scene.tree is not None
    step, parents, size = scene.header["chunk_size"], parents_of(scene), spark_size(scene.splats)
    rows = chunks.rows_of(scene)
    assert len(rows) == scene.header["chunks"] > 1
    for number, row in enumerate(rows):
        nodes = range(number * step, min(len(scene), (number + 1) * step))
        center = scene.splats.center[nodes]
        depths = [depth_of(node, parents) for node in nodes]
        elsewhere = {parents[node] // step for node in nodes if node in parents} - {number}
        assert (row["chunk"], row["base"], row["splats"]) == (number, nodes[0], len(nodes))
        assert row["leaves"] == sum(bool(scene.tree.is_leaf[node]) for node in nodes)
        assert row["bytes"] == (scene.chunk_bytes or ())[number]
        assert [row[f"min_{axis}"] for axis in "xyz"] == pytest.approx(center.min(axis=0), rel=1e-5)
        assert [row[f"max_{axis}"] for axis in "xyz"] == pytest.approx(center.max(axis=0), rel=1e-5)
        assert row["extent"] == pytest.approx(np.linalg.norm(center.max(axis=0) - center.min(axis=0)), rel=1e-5)
        assert (row["size_min"], row["size_max"]) == pytest.approx((size[nodes].min(), size[nodes].max()), rel=1e-5)
        assert (row["depth_min"], row["depth_max"]) == (min(depths), max(depths))
        assert row["parent_chunks"] == len(elsewhere)


def test_other_formats_have_the_chunks_of_a_viewer() -> None:
    rows = chunks.rows_of(Scene(random_splats(CHUNK + 3)))
    assert [row["splats"] for row in rows] == [CHUNK, 3]
    assert {row[name] for row in rows for name in ("bytes", "leaves", "depth_max", "parent_chunks")} == {None}
    assert chunks.rows_of(Scene(random_splats(0))) == []


def test_what_is_not_finite_is_empty() -> None:
    splats = random_splats(3)
    splats.center[1, 0] = np.nan
    (row,) = chunks.rows_of(Scene(splats))
    assert (row["min_x"], row["max_x"], row["extent"]) == (None, None, None)
    assert row["min_y"] is not None


def test_the_table_is_printed_and_written(tmp_path: Path, capsys: Capture) -> None:
    path = tree(CHUNK + 8).write(tmp_path / "a.rad")
    output = tmp_path / "chunks.csv"
    assert run(["inspect", str(path), "--chunks", "--chunks-out", str(output), "-q"]) == 0
    head, first, second = (line.split() for line in capsys.readouterr().out.splitlines())
    assert head[:4] == ["chunk", "base", "splats", "leaves"]
    assert (first[:3], second[:3]) == (["0", "0", "65,536"], ["1", "65,536", "8"])
    with output.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [column.name for column in chunks.COLUMNS] == list(rows[0])
    assert [row["splats"] for row in rows] == ["65536", "8"]
    assert run(["inspect", str(path), "--chunks", "--json"]) == 0
    plain = json.loads(capsys.readouterr().out)
    assert [str(row["extent"]) for row in plain["chunks"]] == [row["extent"] for row in rows]


def test_the_table_without_a_tree_has_no_empty_columns(capsys: Capture) -> None:
    assert run(["inspect", str(FIXTURES / "sh0.ply"), "--chunks", "-q"]) == 0
    head, row = capsys.readouterr().out.splitlines()
    assert head.split() == ["chunk", "base", "splats", "extent", "size_min", "size_max"]
    assert len(row.split()) == 6


def test_the_table_of_a_chunked_file_is_that_of_the_whole_one(tmp_path: Path) -> None:
    whole, chunked = tree(CHUNK + 8), replace(tree(CHUNK + 8), stem="a")
    one, other = (examine_scene(rad.write(tmp_path / f"{name}.rad")) for rad, name in ((whole, "w"), (chunked, "c")))
    assert chunks.rows_of(one) == chunks.rows_of(other)


def test_the_table_of_what_has_no_splats_is_refused(tmp_path: Path, capsys: Capture) -> None:
    source = FIXTURES / "sh0.ply"
    assert run(["build-lod", str(source), "--encoding", "lodtree", "-o", str(tmp_path / "a.npz"), "-q"]) == 0
    assert run(["inspect", str(tmp_path / "a.npz"), "--chunks", "-q"]) == 1
    assert "its chunks cannot be told" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--chunks", "--field", "splats"], "--chunks cannot be used with --field"),
        (["--chunks-out", "a.png"], "tables are written as .csv, .json, .parquet"),
        ([str(GOLDEN), "--chunks-out", "a.csv"], "--chunks-out takes one file, not 2"),
    ],
)
def test_options_that_exclude_each_other_are_usage_errors(options: list[str], message: str, capsys: Capture) -> None:
    assert run(["inspect", str(GOLDEN), *options]) == 2
    assert message in capsys.readouterr().err
