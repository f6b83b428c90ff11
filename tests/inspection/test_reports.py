"""Reports on RAD, Streamed SOG and arrays for viewers (encodings, levels, sizes), and on the chunks of any file."""

from __future__ import annotations

import csv
import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparklod_cli
from sparklod_cli.cli import run
from sparklod_cli.codecs import ply
from sparklod_cli.codecs.formats import ENCODINGS
from sparklod_cli.codecs.rad import rad_writer as codec
from sparklod_cli.inspection import headers
from sparklod_cli.inspection.report import CHUNK_COLUMNS, NAMED_FORMATS, Report, ReportSettings, inspect
from sparklod_cli.io.reading import read_parts, read_scene
from sparklod_cli.model.gaussian import spark_size
from sparklod_cli.model.scene import Scene
from sparklod_cli.tables.columns import Row
from tests.conftest import FIXTURES, Capture, real_scene
from tests.inspection import streamed_sog_files
from tests.inspection.rad_files import CHUNK, FAULTS, PALETTE, RANGES, Rad, column, tree, with_chunk, with_fields
from tests.inspection.streamed_sog_files import COUNTS, regions
from tests.inspection.test_schema import VALIDATOR
from tests.scenes import random_splats

EVERYTHING = ReportSettings(chunks=True, values=True, all_quantities=True, check=True)


def reported(path: Path, **settings: Any) -> Report:
    return inspect(path, ReportSettings(**settings))[0]


# --- RAD --------------------------------------------------------------------------------------------------------------


def facts_of(path: Path) -> headers.RadFacts:
    facts = reported(path, headers_only=True).rad
    assert facts is not None
    return facts


@pytest.mark.parametrize("chunked", [False, True])
def test_the_facts_are_those_of_the_headers(chunked: bool, tmp_path: Path) -> None:
    written = replace(tree(CHUNK + 8, max_sh=1), stem="a" if chunked else None)
    header, chunks = written.packed()
    facts = facts_of(written.write(tmp_path / "a.rad"))
    sizes = sorted(map(len, chunks))
    assert facts.chunked is chunked
    assert facts.bytes == len(header) + sum(sizes) == sum(path.stat().st_size for path in tmp_path.iterdir())
    assert (facts.header_bytes, facts.first_bytes) == (len(header), len(header) + len(chunks[0]))
    assert facts.chunk_size == CHUNK
    assert facts.chunk_bytes == headers.ChunkBytes(sizes[0], round(sum(sizes) / 2), sizes[1])
    assert (facts.palette, facts.comment, facts.ranges) == (0, None, RANGES)
    assert list(facts.properties) == [column.name for column in written.chunks[0].columns]
    for name, found in facts.properties.items():
        columns = [column for chunk in written.chunks for column in chunk.columns if column.name == name]
        assert found.encoding == columns[0].encoding
        assert found.bytes == sum(len(column.packed) for column in columns)
        assert found.share == round(found.bytes / facts.bytes, 4)
        assert (found.min, found.max) == (columns[0].fields.get("min"), columns[0].fields.get("max"))


def test_chunks_may_differ(tmp_path: Path) -> None:
    def change(chunk: Any) -> Any:
        wider = {"min": -1.0, "max": 3.0}
        chunk = chunk.changed("rgb", lambda each: replace(each, fields=wider))
        return chunk.changed("orientation", lambda each: replace(each, encoding="f16", data=bytes(8 * 6)))

    path = with_chunk(tree(CHUNK + 8), 1, change).write(tmp_path / "a.rad")
    properties = facts_of(path).properties
    assert properties["orientation"].encoding == "oct88r8, f16"
    assert (properties["rgb"].min, properties["rgb"].max) == (-1, 3)


def test_a_comment_is_shown_on_a_line_and_shortened(tmp_path: Path, capsys: Capture) -> None:
    comment = "made by\n\x1b[31m" + "me " * 400
    path = with_fields(tree(24), comment=comment).write(tmp_path / "a.rad")
    found = facts_of(path).comment
    assert found is not None
    assert found.startswith("made by \\x1b[31mme me")
    assert len(found) == 500
    assert run(["inspect", str(path)]) == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) < 180


def test_a_readable_report_and_a_page_have_the_properties(tmp_path: Path, capsys: Capture) -> None:
    path, html = PALETTE.write(tmp_path / "a.rad"), tmp_path / "page.html"
    assert run(["inspect", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"{path}  RAD LoD, ")
    for part in ("stored     one file, header", "palette    24 entries of SH", "rgbMin 0, rgbMax 1", "lodOpacity on"):
        assert any(part in line for line in lines), part
    (scales,) = (line.split() for line in lines if line.startswith("    scales"))
    assert (scales[1], scales[-3:]) == ("ln_0r8", ["-12", "to", "9"])
    assert run(["inspect", str(path), "--html", str(html), "-q"]) == 0
    page = html.read_text("utf-8")
    for part in ("Properties", "ln_0r8", "sh2_code", "Entries of the palette of SH", "Size needed for a first picture"):
        assert part in page


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("rad.properties.sh1_code.encoding", "s8"),
        ("rad.ranges.lnScaleMax", "9.0"),
        ("format", "RAD LoD"),
    ],
)
def test_a_field_of_the_headers_needs_no_data(
    name: str, expected: str, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: object, **options: object) -> None:
        raise AssertionError("the file is decoded")

    monkeypatch.setattr(codec, "open_content", fail)
    path = PALETTE.write(tmp_path / "a.rad")
    assert run(["inspect", str(path), "--field", name]) == 0
    assert capsys.readouterr().out.strip() == expected


HEADER_FIELDS = ["bytes", "splats", "sh_degree", "format", "bytes_per_splat", "compression_ratio"]


def test_headers_alone_give_what_the_whole_file_gives(tmp_path: Path, detail: Path) -> None:
    for path, part in ((replace(PALETTE, stem="a").write(tmp_path / "a.rad"), "rad"), (detail, "streamed_sog")):
        short, whole = (reported(path, headers_only=headers_only) for headers_only in (True, False))
        for name in (*HEADER_FIELDS, part):
            assert short.value_at(name) == whole.value_at(name)


def test_siblings_in_two_chunks_are_counted(tmp_path: Path) -> None:
    for count, split in ((CHUNK + 8, 1), (CHUNK, 0)):
        assert reported(tree(count).write(tmp_path / "a.rad")).value_at("tree.split_siblings") == split


@pytest.mark.parametrize(
    ("name", "encoding", "data", "code"),
    [
        ("scales", "ln_0r8", bytes([150]) * 72, None),
        ("scales", "ln_0r8", bytes([1]) * 72, "values.scale-clamped"),
        ("scales", "ln_0r8", bytes([0]) * 72, "values.invisible"),
        ("center", "f16", np.full(72, 65504, "<f2").tobytes(), "values.center-clamped"),
    ],
)
def test_values_at_an_end_of_their_range_are_found(
    name: str, encoding: str, data: bytes, code: str | None, tmp_path: Path
) -> None:
    report = reported(column(tree(24), name, encoding=encoding, data=data).write(tmp_path / "a.rad"), check=True)
    found = {finding.code for finding in report.findings or []} - {"tree.size"}
    assert found == set() if code is None else code in found


# --- Streamed SOG -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def detail(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A manifest of Streamed SOG beside its chunk files."""
    return streamed_sog_files.folder(sh_degree=1).write(tmp_path_factory.mktemp("streamed"))


@pytest.fixture(scope="module")
def report(detail: Path) -> Report:
    return reported(detail, values=True)


def sizes(path: Path, *folders: str) -> int:
    return sum(file.stat().st_size for name in folders for file in (path.parent / name).iterdir())


def test_levels_are_counted_in_splats_regions_files_and_bytes(detail: Path, report: Report) -> None:
    for level, found in enumerate(report.value_at("streamed_sog.levels")):
        splats = sum(row[level] for row in COUNTS)
        assert (found["splats"], found["regions"], found["files"]) == (splats, 2, 1)
        assert found["share"] == round(splats / sum(row[0] for row in COUNTS), 4)
        assert found["bytes"] == sizes(detail, f"{level}_0")


def test_bytes_are_those_of_all_files_and_of_the_coarsest_level(detail: Path, report: Report) -> None:
    facts, manifest = report.value_at("streamed_sog"), detail.stat().st_size
    assert report.bytes == facts["bytes"] == manifest + sizes(detail, "0_0", "1_0", "2_0", "env")
    assert facts["manifest_bytes"] == manifest
    assert facts["first_bytes"] == manifest + sizes(detail, "2_0", "env")
    files = sorted(sizes(detail, f"{level}_0") for level in range(3))
    assert facts["file_bytes"] == dict(zip(("min", "median", "max"), files, strict=True))
    assert facts["environment"] == {"splats": 5, "bytes": sizes(detail, "env")}


def test_splats_and_values_are_those_of_full_detail_and_the_environment(detail: Path, report: Report) -> None:
    scene = read_scene(detail)
    assert report.splats == len(scene) == sum(row[0] for row in COUNTS) + 5
    assert report.value_at("values.box.max") == pytest.approx(scene.splats.center.max(axis=0), rel=1e-5)
    assert report.value_at("streamed_sog.splats") == sum(map(sum, COUNTS))
    assert (report.format, report.sh_degree) == ("Streamed SOG 1", 1)


def test_regions_have_quantiles_of_splats_and_edges(detail: Path, report: Report) -> None:
    facts, scene = report.value_at("streamed_sog"), read_parts(detail)
    edges = np.ptp(scene.bounds, axis=1).max(axis=1)
    for name, values in (("region_splats", scene.counts[:, 0]), ("region_edge", edges)):
        found = facts[name]
        assert (found["min"], found["max"]) == pytest.approx((values.min(), values.max()), rel=1e-5)
        assert found["mean"] == pytest.approx(values.mean(), rel=1e-5)
        assert found["p50"] in (found["min"], found["max"])  # the value of a region, not one between two
    assert (facts["regions"], facts["depth"]) == (2, 1)
    assert facts["bound"]["min"] == scene.bounds[:, 0].min(axis=0).tolist()


def test_errors_are_weighted_by_splats_of_full_detail(tmp_path: Path) -> None:
    def change(manifest: dict[str, Any]) -> None:
        for node, error in zip(regions(manifest), (0.5, 0.25), strict=True):
            node["errors"] = [0, error, 2 * error]

    levels = reported(streamed_sog_files.SOUND.changed(change).write(tmp_path)).value_at("streamed_sog.levels")
    full, small = (row[0] for row in COUNTS)
    assert small < 0.25 * (full + small)  # so that quartiles are those of the large region
    assert levels[0]["errors"] == dict.fromkeys(("min", "p25", "p50", "p75", "max", "mean"), 0.0)
    mean = (0.5 * full + 0.25 * small) / (full + small)
    expected = {"min": 0.25, "p25": 0.5, "p50": 0.5, "p75": 0.5, "max": 0.5, "mean": pytest.approx(mean, rel=1e-5)}
    assert levels[1]["errors"] == expected
    without = streamed_sog_files.folder(errors=False).write(tmp_path)
    assert reported(without).value_at("streamed_sog.levels.1.errors") is None


def test_a_readable_report_and_a_page_have_a_table_of_the_levels(tmp_path: Path, capsys: Capture) -> None:
    named = streamed_sog_files.SOUND.having(asset={"generator": "<script>alert(1)</script>"}).write(tmp_path)
    page = tmp_path / "page.html"
    assert run(["inspect", str(named)]) == 0
    lines = capsys.readouterr().out.splitlines()
    (head,) = (number for number, line in enumerate(lines) if line.startswith("  levels "))
    assert " ".join(lines[head].split()) == "levels splats share regions files size err. p25 p50 p75"
    assert lines[head + 2].split()[:5] == ["1", "18", "8.0", "%", "2"]
    assert "  environment 5 splats, " in "\n".join(lines)
    assert run(["inspect", str(named), "--html", str(page), "-q"]) == 0
    text = page.read_text("utf-8")
    assert "Detail levels" in text and "Longest edge" in text
    assert "<script>" not in text


# --- Assertions -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("form", "text", "holds"),
    [
        ("RAD", "chunk_bytes<=1MB", True),
        ("RAD", "chunk_bytes<100", False),
        ("RAD", "first_bytes<2k", True),
        ("RAD", "chunked==true", False),
        ("RAD", "palette>0", True),
        ("RAD", 'rad.properties.center.encoding=="f16"', False),
        ("Streamed SOG", "levels==3", True),
        ("Streamed SOG", "levels>3", False),
        ("Streamed SOG", "regions<=2", True),
        ("Streamed SOG", "first_bytes<1kB", False),
        ("Streamed SOG", "chunk_bytes<1kB", False),
    ],
)
def test_assertions_hold_or_not(
    form: str, text: str, holds: bool, detail: Path, tmp_path: Path, capsys: Capture
) -> None:
    path = PALETTE.write(tmp_path / "a.rad") if form == "RAD" else detail
    assert run(["inspect", str(path), "--assert", text]) == (0 if holds else 3)
    assert ("expect." in capsys.readouterr().out) == (not holds)


@pytest.mark.parametrize(("name", "form"), NAMED_FORMATS.items())
def test_other_formats_have_no_such_names(name: str, form: str, capsys: Capture) -> None:
    assert run(["inspect", str(FIXTURES / "golden" / "tree-v3.spz"), "--assert", f"{name}==1"]) == 3
    assert f"the file is not {form}" in capsys.readouterr().out


# --- Chunks -----------------------------------------------------------------------------------------------------------


def rows_of(path: Path, **settings: Any) -> list[Row]:
    rows = reported(path, chunks=True, **settings).chunks
    assert rows is not None
    return rows


def parents_of(scene: Scene) -> dict[int, int]:
    assert scene.tree is not None
    found = {}
    for node, (count, start) in enumerate(zip(scene.tree.child_count, scene.tree.child_start, strict=True)):
        found |= dict.fromkeys(range(int(start), int(start) + int(count)), node)
    return found


def depth_of(node: int, parents: dict[int, int]) -> int:
    return 0 if node not in parents else 1 + depth_of(parents[node], parents)


@pytest.mark.parametrize("at_once", [True, False])
def test_rows_of_chunks_are_those_counted_node_by_node(at_once: bool) -> None:
    path = FIXTURES / "golden" / "sh1-tree.rad"
    scene = read_scene(path, validate=False)
    assert scene.tree is not None
    step, parents, size = scene.header["chunk_size"], parents_of(scene), spark_size(scene.splats)
    rows = rows_of(path, at_once=at_once)
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


def test_other_formats_have_the_chunks_of_a_viewer(tmp_path: Path) -> None:
    path = tmp_path / "scene.splat"
    sparklod_cli.write(path, Scene(random_splats(CHUNK + 3)))
    rows = rows_of(path)
    assert [row["splats"] for row in rows] == [CHUNK, 3]
    assert {row[name] for row in rows for name in ("bytes", "leaves", "depth_max", "parent_chunks")} == {None}
    assert rows_of(FIXTURES / "faults" / "no-splats.ply") == []


def test_numbers_that_are_not_finite_are_empty_cells(tmp_path: Path) -> None:
    splats, path = random_splats(3), tmp_path / "scene.ply"
    splats.center[1, 0] = np.nan
    path.write_bytes(b"".join(ply.encode(Scene(splats))))
    (row,) = rows_of(path)
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
    assert [column.name for column in CHUNK_COLUMNS] == list(rows[0])
    assert [row["splats"] for row in rows] == ["65536", "8"]
    assert run(["inspect", str(path), "--chunks", "--json"]) == 0
    plain = json.loads(capsys.readouterr().out)
    assert [str(row["extent"]) for row in plain["chunks"]] == [row["extent"] for row in rows]


def test_the_table_without_a_tree_has_no_empty_columns(capsys: Capture) -> None:
    assert run(["inspect", str(FIXTURES / "sh0.ply"), "--chunks", "-q"]) == 0
    head, row = capsys.readouterr().out.splitlines()
    assert head.split() == ["chunk", "splats", "extent", "size", "to"]
    assert len(row.split()) == 5


def test_the_chunks_of_a_chunked_file_are_those_of_the_whole_one(tmp_path: Path) -> None:
    whole, chunked = tree(CHUNK + 8), replace(tree(CHUNK + 8), stem="c")
    assert rows_of(whole.write(tmp_path / "w.rad")) == rows_of(chunked.write(tmp_path / "c.rad"))


def test_the_table_of_what_has_no_splats_is_refused(tmp_path: Path, capsys: Capture) -> None:
    source = FIXTURES / "golden" / "tree-v3.spz"
    assert run(["convert", str(source), str(tmp_path / "a.npz"), "--layout", "lodtree", "-q"]) == 0
    assert run(["inspect", str(tmp_path / "a.npz"), "--chunks", "-q"]) == 1
    assert "its chunks are unknown" in capsys.readouterr().err


# --- Reports by chunk are those of the whole file ---------------------------------------------------------------------


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
def test_reports_by_chunk_of_files_with_faults(name: str, tmp_path: Path) -> None:
    one, other = both(FAULTS[name][0].write(tmp_path / "a.rad"))
    assert one == other
    assert one.findings


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # any bits are numbers
@pytest.mark.parametrize("links", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_reports_by_chunk_of_files_with_any_numbers(seed: int, links: bool, tmp_path: Path) -> None:
    path = random_tree(seed, links=links).write(tmp_path / "a.rad")
    for settings in (EVERYTHING, ReportSettings()):
        one, other = both(path, settings)
        assert repr(one) == repr(other)  # NaN differs from itself
        assert one.tree is not None


@pytest.mark.parametrize("name", ["golden/sh3-rad/sh3.rad", "rad/biker-spark.rad", "rad/playbot-125k-spark/p-lod.rad"])
def test_reports_by_chunk_of_sound_files(name: str) -> None:
    one, other = both(FIXTURES / name if name.startswith("golden") else real_scene(name))
    assert one == other
    assert one.values is not None
    assert one.chunks


def test_reports_by_chunk_of_a_file_without_splats(tmp_path: Path) -> None:
    one, other = both(replace(tree(24), chunks=(), fields={"count": 0}).write(tmp_path / "a.rad"))
    assert one == other


def test_large_files_are_read_by_chunk_and_others_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tree(240, chunk=24).write(tmp_path / "a.rad")
    _, scene = inspect(path, EVERYTHING)
    assert scene is not None
    monkeypatch.setattr("sparklod_cli.codecs.rad.rad_reader.available_memory", lambda: 40_000)
    report, scene = inspect(path, EVERYTHING)
    assert scene is None
    assert report.splats == 240
    assert inspect(path, replace(EVERYTHING, at_once=True))[1] is not None


# --- Arrays for viewers, as `convert --layout` writes them ------------------------------------------------------------

SCENE = FIXTURES / "sh3.ply"


@pytest.fixture(scope="module")
def arrays(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the same tree as SPZ and in every encoding."""
    folder = tmp_path_factory.mktemp("arrays")
    tree = str(folder / "tree.spz")
    assert run(["build-lod", str(SCENE), "-q", "-o", tree]) == 0
    for each in ENCODINGS:
        assert run(["convert", tree, str(folder / f"{each}.npz"), "-q", "--layout", each]) == 0
    return folder


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_encoding_has_as_many_splats_as_the_tree_and_no_findings(
    encoding: str, arrays: Path, tmp_path: Path, capsys: Capture
) -> None:
    path = arrays / f"{encoding}.npz"
    report, _ = inspect(path, replace(EVERYTHING, chunks=False))
    assert report.splats == reported(arrays / "tree.spz").splats
    assert report.findings == []
    assert report.bytes == path.stat().st_size
    VALIDATOR.validate(json.loads(json.dumps(report.as_dict())))
    (note,) = report.notes
    assert "has no child indices" in note or "it has centres" in note
    assert run(["inspect", str(path)]) == 0
    assert note.partition(",")[0] in capsys.readouterr().out
    assert run(["inspect", str(path), "--html", str(tmp_path / "page.html"), "--assert", "nodes>1"]) == 0


@pytest.mark.parametrize("encoding", ["packed", "ext"])
def test_arrays_of_whole_splats_have_their_values(encoding: str, arrays: Path) -> None:
    tree, report = (reported(arrays / name, values=True) for name in ("tree.spz", f"{encoding}.npz"))
    assert tree.values is not None
    assert report.values is not None
    assert (report.sh_degree, report.tree) == (3, None)
    for name, statistic in itertools.product(("scale", "opacity"), ("min", "p50", "max")):
        expected = tree.values.quantities[name][statistic]
        assert report.values.quantities[name][statistic] == pytest.approx(expected, rel=0.06, abs=0.02)


def test_arrays_of_nodes_have_the_facts_of_the_tree(arrays: Path) -> None:
    tree, facts = (reported(arrays / name).tree for name in ("tree.spz", "lodtree.npz"))
    assert tree is not None
    assert facts is not None
    for name in ("leaves", "inner", "growth", "depth", "children", "chunks"):
        assert getattr(facts, name) == getattr(tree, name)
    assert facts.more_than_opaque is None
    for mine, other in zip(facts.levels, tree.levels, strict=True):
        assert (mine.nodes, mine.leaves) == (other.nodes, other.leaves)
        assert mine.size == pytest.approx(other.size, rel=0.05)


@pytest.mark.parametrize(
    ("command", "status", "message"),
    [
        ("inspect lodtree.npz --leaves-of ORIGINAL", 3, "the file does not contain all of its splats"),
        ("inspect texture.npz --leaves-of ORIGINAL", 3, "the file does not contain all of its splats"),
        ("inspect texture.npz --assert growth<2", 3, "growth<2: the file has no tree"),
        ("build-lod packed.npz", 1, "it holds arrays for a viewer and no scene; use the file that they were made of"),
        ("traverse packed.npz", 1, "it holds arrays for a viewer and no scene; use the file that they were made of"),
        ("render packed.npz", 1, "it holds arrays for a viewer and no scene; use the file that they were made of"),
    ],
)
def test_arrays_are_no_scene(
    command: str, status: int, message: str, arrays: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(arrays)
    assert run(command.replace("ORIGINAL", str(SCENE)).split()) == status
    assert message in "".join(capsys.readouterr())


def test_words_without_a_header_are_refused(tmp_path: Path, capsys: Capture) -> None:
    for suffix in (".bin", ".raw"):
        path = tmp_path / f"tree{suffix}"
        assert run(["convert", str(SCENE), str(path), "-q", "--layout", "ext"]) == 0
        assert run(["inspect", str(path)]) == 1
        message = "a file with this suffix has only words, as convert --layout writes them, without a header"
        assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"other": np.zeros((3, 4), np.uint32)}, "its arrays (other) match no layout"),
        ({"packed": np.zeros((3, 5), np.uint32)}, "packed is uint32[3, 5], expected uint32[3, 4]"),
        ({"packed": np.zeros((3, 4))}, "packed is float64[3, 4], expected uint32[3, 4]"),
        ({"ext0": np.zeros((3, 4), np.uint32)}, "no array ext1"),
        ({"lod_tree": np.uint32(3)}, "lod_tree is uint32[], expected"),
        ({"texture": np.zeros((3, 4), np.uint32)}, "texture is uint32[3, 4], expected"),
        ({"packed": np.array([None])}, "not a .npy file of plain numbers"),
    ],
)
def test_arrays_of_another_shape_are_refused(
    arrays: dict[str, np.ndarray], message: str, tmp_path: Path, capsys: Capture
) -> None:
    np.savez(tmp_path / "odd.npz", **arrays)
    assert run(["inspect", str(tmp_path / "odd.npz")]) == 1
    assert message in capsys.readouterr().err
    assert run(["inspect", str(tmp_path / "odd.npz"), "--check"]) == 3


@pytest.mark.parametrize("name", ["packed", "lod_tree"])
def test_empty_arrays_have_a_finding(name: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "empty.npz", **{name: np.zeros((0, 4), np.uint32)})
    findings = reported(tmp_path / "empty.npz", values=True, check=True).findings or []
    assert [finding.code for finding in findings] == ["values.empty"]


@pytest.mark.parametrize("seed", range(20))
def test_damaged_arrays_are_errors_of_a_line(seed: int, arrays: Path, tmp_path: Path) -> None:
    data = bytearray((arrays / "ext.npz").read_bytes())
    rng = np.random.default_rng(seed)
    for place in rng.integers(0, len(data), 8):
        data[place] = rng.integers(256)
    (tmp_path / "damaged.npz").write_bytes(data[: int(rng.integers(len(data) // 2, len(data) + 1))])
    assert run(["inspect", str(tmp_path / "damaged.npz"), "--check", "--json"]) in (0, 3)


def test_compressed_arrays_are_refused_before_they_are_unpacked(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "bomb.npz", packed=np.zeros((1 << 20, 4), np.uint32))
    assert "is compressed" in (reported(tmp_path / "bomb.npz").findings or [])[0].message
