"""Tables of chunks, and reports that are made chunk by chunk."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from sparklod_cli.cli import run
from sparklod_cli.codecs.rad.rad_reader import RadReader
from sparklod_cli.inspection import blocks as blocks_of
from sparklod_cli.inspection.blocks import ReportBlocks, merged
from sparklod_cli.inspection.report import Report, ReportSettings, inspect
from sparklod_cli.inspection.tree import TreeColumns
from sparklod_cli.inspection.values import LEVELS, Numbers
from sparklod_cli.io.rad_file import reopened
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.gaussian import spark_size
from sparklod_cli.model.scene import Scene
from tests.conftest import FIXTURES, Capture, real_scene
from tests.inspection.rad_files import CHUNK, Rad, tree
from tests.inspection.test_rad_faults import FAULTS, column
from tests.scenes import random_splats

GOLDEN = FIXTURES / "golden" / "sh1-tree.rad"


def rows_of(scene: Scene) -> list[dict[str, Any]]:
    blocks = ReportBlocks.of(scene)
    nodes = TreeColumns.of(blocks) if blocks.is_tree and blocks.count else None
    if nodes is not None:
        merged(blocks.map(nodes.add, (), 1))
    return blocks_of.chunk_table(
        list(blocks.map(blocks_of.chunk_row, (), 1)), scene.chunk_bytes, nodes and (nodes.tree, nodes.size)
    )


def parents_of(scene: Scene) -> dict[int, int]:
    assert scene.tree is not None
    found = {}
    for node, (count, start) in enumerate(zip(scene.tree.child_count, scene.tree.child_start, strict=True)):
        found |= dict.fromkeys(range(int(start), int(start) + int(count)), node)
    return found


def depth_of(node: int, parents: dict[int, int]) -> int:
    return 0 if node not in parents else 1 + depth_of(parents[node], parents)


def test_rows_are_what_can_be_counted_by_hand() -> None:
    scene = read_scene(GOLDEN, validate=False)
    assert scene.tree is not None
    step, parents, size = scene.header["chunk_size"], parents_of(scene), spark_size(scene.splats)
    rows = rows_of(scene)
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
    rows = rows_of(Scene(random_splats(CHUNK + 3)))
    assert [row["splats"] for row in rows] == [CHUNK, 3]
    assert {row[name] for row in rows for name in ("bytes", "leaves", "depth_max", "parent_chunks")} == {None}
    assert rows_of(Scene(random_splats(0))) == []


def test_what_is_not_finite_is_empty() -> None:
    splats = random_splats(3)
    splats.center[1, 0] = np.nan
    (row,) = rows_of(Scene(splats))
    assert (row["min_x"], row["max_x"], row["extent"]) == (None, None, None)
    assert row["min_y"] is not None


def test_the_table_is_printed_and_written(tmp_path: Path, capsys: Capture) -> None:
    path = tree(CHUNK + 8).write(tmp_path / "a.rad")
    output = tmp_path / "chunks.csv"
    assert run(["inspect", str(path), "--chunks", "--chunks-out", str(output), "-q"]) == 0
    head, first, second = (line.split() for line in capsys.readouterr().out.splitlines())
    assert head[:3] == ["chunk", "splats", "leaves"]
    assert (first[:2], second[:2]) == (["0", "65,536"], ["1", "8"])
    with output.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [column.name for column in blocks_of.CHUNK_COLUMNS] == list(rows[0])
    assert [row["splats"] for row in rows] == ["65536", "8"]
    assert run(["inspect", str(path), "--chunks", "--json"]) == 0
    plain = json.loads(capsys.readouterr().out)
    assert [str(row["extent"]) for row in plain["chunks"]] == [row["extent"] for row in rows]


def test_the_table_without_a_tree_has_no_empty_columns(capsys: Capture) -> None:
    assert run(["inspect", str(FIXTURES / "sh0.ply"), "--chunks", "-q"]) == 0
    head, row = capsys.readouterr().out.splitlines()
    assert head.split() == ["chunk", "splats", "extent", "size", "to"]
    assert len(row.split()) == 5


def test_the_table_of_a_chunked_file_is_that_of_the_whole_one(tmp_path: Path) -> None:
    whole, chunked = tree(CHUNK + 8), replace(tree(CHUNK + 8), stem="a")
    one, other = (
        read_scene(rad.write(tmp_path / f"{name}.rad"), validate=False) for rad, name in ((whole, "w"), (chunked, "c"))
    )
    assert rows_of(one) == rows_of(other)


def test_the_table_of_what_has_no_splats_is_refused(tmp_path: Path, capsys: Capture) -> None:
    source = FIXTURES / "golden" / "tree-v3.spz"
    assert run(["convert", str(source), str(tmp_path / "a.npz"), "--layout", "lodtree", "-q"]) == 0
    assert run(["inspect", str(tmp_path / "a.npz"), "--chunks", "-q"]) == 1
    assert "its chunks are unknown" in capsys.readouterr().err


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


EVERYTHING = ReportSettings(chunks=True, values=True, all_quantities=True, check=True)
PLAIN = ReportSettings()


def both(path: Path, settings: ReportSettings = EVERYTHING) -> list[Report]:
    return [inspect(path, replace(settings, at_once=at_once), threads=2)[0] for at_once in (True, False)]


def random_tree(seed: int, *, links: bool) -> Rad:
    """Ten chunks whose numbers are any bits, in some files those of the tree, too."""
    rng = np.random.default_rng(seed)
    rad = tree(240, chunk=24, max_sh=2, palette=bool(seed % 2))
    names = {"center": 12, "alpha": 2, "rgb": 3, "scales": 3, "orientation": 3}
    if links:
        names |= {"child_count": 2, "child_start": 4}
    for number in range(10):
        for name, size in names.items():
            data = rng.integers(0, 256, 24 * size, dtype=np.uint8)
            if name in ("child_count", "child_start") and rng.random() < 0.8:  # mostly small numbers
                data.reshape(-1, 24)[1:] = 0
            rad = column(rad, name, number, data=data.tobytes())
    return rad


@pytest.mark.parametrize("name", FAULTS)
def test_of_files_with_faults(name: str, tmp_path: Path) -> None:
    one, other = both(FAULTS[name][0].write(tmp_path / "a.rad"))
    assert one == other
    assert one.findings


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # any bits are numbers
@pytest.mark.parametrize("links", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_of_files_with_any_numbers(seed: int, links: bool, tmp_path: Path) -> None:
    path = random_tree(seed, links=links).write(tmp_path / "a.rad")
    for settings in (EVERYTHING, PLAIN):
        one, other = both(path, settings)
        assert repr(one) == repr(other)  # NaN differs from itself
        assert one.tree is not None


@pytest.mark.parametrize("name", ["golden/sh3-rad/sh3.rad", "rad/biker-spark.rad", "rad/playbot-125k-spark/p-lod.rad"])
def test_of_sound_files(name: str) -> None:
    path = FIXTURES / name if name.startswith("golden") else real_scene(name)
    one, other = both(path)
    assert one == other
    assert one.values is not None
    assert one.chunks


def test_of_a_file_without_a_tree_and_of_one_without_splats(tmp_path: Path) -> None:
    for rad in (FAULTS["children without a tree"][0], replace(tree(24), chunks=(), fields={"count": 0})):
        one, other = both(rad.write(tmp_path / "a.rad"))
        assert one == other


def test_large_files_are_read_by_chunk_and_others_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tree(240, chunk=24).write(tmp_path / "a.rad")
    _, scene = inspect(path, EVERYTHING)
    assert scene is not None
    monkeypatch.setattr("sparklod_cli.io.rad_file.available_memory", lambda: 40_000)
    report, scene = inspect(path, EVERYTHING)
    assert scene is None
    assert report.splats == 240
    assert inspect(path, replace(EVERYTHING, at_once=True))[1] is not None


def test_a_chunk_is_what_all_of_them_have_in_its_place(tmp_path: Path) -> None:
    path = tree(240, chunk=24, max_sh=1, palette=True).write(tmp_path / "a.rad")
    with path.open("rb") as file:
        closed = RadReader.open(file)
    with reopened(path, closed) as reader:
        for number, (start, splats, nodes) in enumerate(reader.chunks({"center", "sh"}, thorough=True, threads=2)):
            some, tree_of_some, _ = reader.chunk(number, {"center"})
            assert start == 24 * number
            assert np.array_equal(splats.center, some.center)
            assert splats.sh.any()
            assert not some.sh.any()
            assert nodes is not None
            assert tree_of_some is not None
            assert np.array_equal(nodes.child_start, tree_of_some.child_start)


def numbers_of(kind: str) -> st.SearchStrategy[np.ndarray]:
    elements = arrays.from_dtype(np.dtype(kind), allow_nan=False, allow_infinity=False)
    return arrays.arrays(kind, st.integers(1, 60), elements=elements | st.sampled_from([0.0, -0.0, 1.0, 1.5]))


def summary_of(values: np.ndarray, limit: float, step: int, *, centred: bool = False) -> dict[str, float]:
    numbers = Numbers(limit, centred=centred)
    for start in range(0, len(values), step):
        numbers.add(values[start : start + step])
    assert numbers.count == np.isfinite(values).sum()
    return numbers.summary()


@pytest.mark.filterwarnings("ignore:overflow")
@given(st.one_of(numbers_of("<f4"), numbers_of("<f8")), st.integers(1, 20))
@example(np.array([-0.0, 0.0, 0.0], np.float32), 2)
def test_percentiles_of_numbers_that_are_kept_are_those_of_numpy(values: np.ndarray, step: int) -> None:
    found, wide = summary_of(values, len(values), step), values.astype(np.float64)
    assert list(found) == [*LEVELS, "mean"]
    for name, level in LEVELS.items():
        assert found[name] == pytest.approx(np.percentile(wide, level), rel=6e-6, abs=1e-320)
        assert found[name] or not np.signbit(found[name])  # no -0, whose place among zeros is not fixed
    assert found["mean"] == pytest.approx(wide.mean(), rel=6e-6, abs=1e-9 * float(np.abs(wide).max()))


@pytest.mark.parametrize("origin", [0, 500_000])
@pytest.mark.parametrize("kind", ["<f4", "<f8"])
def test_percentiles_of_more_numbers_are_off_by_less_than_a_hundredth(kind: str, origin: int) -> None:
    rng = np.random.default_rng(0)
    away = (rng.normal(size=5_000) * np.exp(rng.normal(size=5_000))).astype(np.float32)
    away[:3] = np.nan, np.inf, -np.inf
    values = (origin + away).astype(kind)
    found, finite = summary_of(values, 100, 64, centred=True), values[np.isfinite(values)].astype(np.float64)
    for name, level in LEVELS.items():
        expected = np.percentile(finite, level)
        assert found[name] == pytest.approx(expected, abs=0.009 * abs(expected - origin) + 5e-6 * abs(expected) + 2e-3)
    assert found["mean"] == pytest.approx(finite.mean(), rel=1e-5)


def test_numbers_beyond_float32_are_counted() -> None:
    found = summary_of(np.array([1e-60, 1.0, 1e60, np.inf]), 1, 2)
    assert [found[name] for name in ("min", "p50", "max")] == pytest.approx([0, 1, 3.40282e38], rel=1e-5)
