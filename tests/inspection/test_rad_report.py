"""What a report says of a RAD file: encodings, sizes, ranges, and what can be expected of them."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs.rad import rad_reader
from sparklod_cli.codecs.rad import rad_writer as codec
from sparklod_cli.inspection import headers, leaves
from sparklod_cli.inspection.headers import PropertyFacts
from sparklod_cli.inspection.html import FileSection, page
from sparklod_cli.inspection.report import ReportSettings, inspect
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.scene import Scene
from tests.conftest import FIXTURES, Capture, real_scene
from tests.inspection.rad_files import CHUNK, RANGES, Rad, tree, with_chunk, with_fields

PALETTE = tree(24, max_sh=2, palette=True)


def facts_of(path: Path) -> headers.RadFacts:
    facts = inspect(path, ReportSettings(headers_only=True))[0].rad
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


def test_a_person_reads_what_is_stored_how(tmp_path: Path, capsys: Capture) -> None:
    path = PALETTE.write(tmp_path / "a.rad")
    assert run(["inspect", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"{path}  RAD LoD, ")
    for part in ("stored     one file, header", "palette    24 entries of SH", "rgbMin 0, rgbMax 1", "lodOpacity on"):
        assert any(part in line for line in lines), part
    (scales,) = (line.split() for line in lines if line.startswith("    scales"))
    assert scales[1] == "ln_0r8"
    assert scales[-3:] == ["-12", "to", "9"]


def test_the_page_has_the_properties(tmp_path: Path) -> None:
    report, _ = inspect(PALETTE.write(tmp_path / "a.rad"), ReportSettings())
    text = page([FileSection(report.as_dict())])
    for part in (
        "Properties",
        "ln_0r8",
        "sh2_code",
        "Entries of the palette of SH",
        "<td>24</td>",
        "Size needed for a first picture",
    ):
        assert part in text


FIELDS = {
    "rad.chunked": "false",
    "rad.palette": "24",
    "rad.properties.sh1_code.encoding": "s8",
    "rad.ranges.lnScaleMax": "9.0",
    "format": "RAD LoD",
    "splats": "24",
    "sh_degree": "2",
}


@pytest.mark.parametrize(("name", "expected"), FIELDS.items())
def test_a_field_of_the_headers_needs_no_data(
    name: str, expected: str, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: object, **options: object) -> None:
        raise AssertionError("the file is decoded")

    monkeypatch.setattr(codec, "open_content", fail)
    path = PALETTE.write(tmp_path / "a.rad")
    assert run(["inspect", str(path), "--field", name]) == 0
    assert capsys.readouterr().out.strip() == expected


@pytest.mark.parametrize(
    "name", ["bytes", "splats", "sh_degree", "format", "bytes_per_splat", "compression_ratio", "rad"]
)
def test_headers_alone_give_what_the_whole_file_gives(name: str, tmp_path: Path) -> None:
    path = replace(PALETTE, stem="a").write(tmp_path / "a.rad")
    short, scene = inspect(path, ReportSettings(headers_only=True))
    whole, _ = inspect(path, ReportSettings())
    assert scene is None
    assert short.value_at(name) == whole.value_at(name)


def test_the_headers_of_many_chunks_are_not_kept(tmp_path: Path) -> None:
    path = tree(24 * 50, chunk=24).write(tmp_path / "a.rad")
    with path.open("rb") as file:
        header, _ = rad_reader.scan_header(file, lambda name: file)
        chunks = rad_reader.scan_chunks(file, lambda name: file, header, paddings=True)
        first, _ = next(chunks)
        assert first is not None
        assert first.base == 0
        assert file.tell() < header.bytes + header.chunks[0].bytes + header.chunks[1].bytes


EXPECTED: list[tuple[str, bool]] = [
    ("chunk_bytes<=1MB", True),
    ("chunk_bytes<100", False),
    ("first_bytes<2k", True),
    ("chunked==true", False),
    ("palette>0", True),
    ("rad.chunk_bytes.max<1MB", True),
    ('rad.properties.center.encoding=="f32"', True),
    ('rad.properties.center.encoding=="f16"', False),
    ("rad.properties.sh1_code.share<0.001", False),
    ("tree.split_siblings==0", True),
]


@pytest.mark.parametrize(("text", "holds"), EXPECTED)
def test_what_can_be_expected(text: str, holds: bool, tmp_path: Path, capsys: Capture) -> None:
    path = PALETTE.write(tmp_path / "a.rad")
    assert run(["inspect", str(path), "--assert", text]) == (0 if holds else 3)
    out = capsys.readouterr().out
    assert ("expect.value" in out) == (not holds)


@pytest.mark.parametrize("name", ["chunk_bytes", "first_bytes", "chunked", "palette"])
def test_other_formats_have_no_chunks_to_expect_something_of(name: str, capsys: Capture) -> None:
    assert run(["inspect", str(FIXTURES / "golden" / "tree-v3.spz"), "--assert", f"{name}==1"]) == 3
    assert "the file is not RAD" in capsys.readouterr().out


def test_siblings_in_two_chunks_are_counted(tmp_path: Path) -> None:
    report, _ = inspect(tree(CHUNK + 8).write(tmp_path / "a.rad"), ReportSettings())
    assert report.value_at("tree.split_siblings") == 1
    report, _ = inspect(tree(CHUNK).write(tmp_path / "a.rad"), ReportSettings())
    assert report.value_at("tree.split_siblings") == 0


def test_scales_at_an_end_of_their_range_are_found(tmp_path: Path) -> None:
    path = tree(24).write(tmp_path / "a.rad")
    for code, expected in ((150, []), (1, ["values.scale-clamped"]), (0, ["values.invisible"])):
        clamped = with_chunk(
            tree(24),
            0,
            lambda chunk, code=code: chunk.changed("scales", lambda each: replace(each, data=bytes([code]) * 72)),
        )
        report, _ = inspect(clamped.write(path), ReportSettings(check=True))
        assert [found.code for found in report.findings or [] if found.code != "tree.size"] == expected


def test_coordinates_at_the_end_of_float16_are_found(tmp_path: Path) -> None:
    data = np.full(72, 65504, "<f2").tobytes()
    clamped = with_chunk(
        tree(24), 0, lambda chunk: chunk.changed("center", lambda each: replace(each, encoding="f16", data=data))
    )
    report, _ = inspect(clamped.write(tmp_path / "a.rad"), ReportSettings(check=True))
    assert "values.center-clamped" in [found.code for found in report.findings or []]


# --- Leaves -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_leaves_of_a_file_that_spark_wrote_are_the_splats_of_its_scene(capsys: Capture) -> None:
    tree, original = real_scene("rad/playbot-125k-spark/p-lod.rad"), real_scene("playbot-125k.ply")
    assert run(["inspect", str(tree), "--leaves-of", str(original)]) == 0
    capsys.readouterr()


ENCODINGS = [
    "",
    "--rad-center f16 --rad-alpha f16 --rad-rgb f16 --rad-scales ln_f16 --rad-orientation f16 --rad-sh f16",
    "--rad-center f32 --rad-alpha f32 --rad-rgb f32 --rad-scales f32 --rad-orientation f32 --rad-sh f32",
    "--rad-center f16_lebytes --rad-alpha r8 --rad-rgb r8_delta --rad-sh s8_delta",
    "--cluster-sh 8",
    "--format rad-chunked",
]


@pytest.mark.parametrize("options", ENCODINGS)
@pytest.mark.parametrize("name", ["sh3.ply", "needle.ply"])
def test_files_that_we_write_have_no_findings_and_the_leaves_of_their_scenes(
    name: str, options: str, tmp_path: Path, capsys: Capture
) -> None:
    source, path = str(FIXTURES / name), str(tmp_path / "a.rad")
    assert run(["build-lod", source, "-o", path, "-q", *options.split()]) == 0
    assert run(["inspect", path, "--check", "--leaves-of", source, "--fail-on", "warning"]) == 0
    other = str(FIXTURES / "sh2.ply")
    assert run(["inspect", path, "--leaves-of", other]) == 3
    assert capsys.readouterr().out.count("expect.leaves") == 1


def leaves_of(path: Path, change: Callable[[Scene], Scene]) -> list[str]:
    """Messages on a file whose original is its own leaves, changed."""
    original = change(read_scene(path))
    return [found.message for found in leaves.check(read_scene(path, validate=False), original, facts_of(path))]


GOLDEN = FIXTURES / "golden" / "sh1-tree.rad"


def test_the_leaves_of_a_file_are_its_own() -> None:
    assert leaves_of(GOLDEN, lambda scene: scene) == []


@pytest.mark.parametrize("column", ["center", "scale", "quat_xyzw", "opacity", "rgb", "sh"])
def test_a_leaf_with_another_value_is_found(column: str) -> None:
    def change(scene: Scene) -> Scene:
        assert scene.tree is not None
        leaf = int(np.flatnonzero(scene.tree.is_leaf)[-1])
        values = getattr(scene.splats, column).copy()
        if column == "quat_xyzw":
            values[leaf] = [0.6, 0, 0, 0.8]
        elif column == "opacity":
            values[leaf] = 0.5 * values[leaf] + 0.3
        else:
            values[leaf] = values[leaf][..., ::-1].copy() * 0.5
        return dataclasses.replace(scene, splats=dataclasses.replace(scene.splats, **{column: values}))

    found = leaves_of(GOLDEN, change)
    assert len(found) == 1
    assert "1 leaves are not splats of the original" in found[0]


def test_leaves_in_several_encodings_cannot_be_compared() -> None:
    facts = facts_of(GOLDEN)
    mixed = PropertyFacts("f16, f32", 1, 0.1, None, None)
    facts = replace(facts, properties=facts.properties | {"center": mixed})
    (found,) = leaves.check(read_scene(GOLDEN, validate=False), read_scene(GOLDEN), facts)
    assert "center in several encodings" in found.message


def test_json_has_the_facts(tmp_path: Path, capsys: Capture) -> None:
    path = Rad(PALETTE.chunks, 2, PALETTE.fields).write(tmp_path / "a.rad")
    assert run(["inspect", str(path), "--json"]) == 0
    plain = json.loads(capsys.readouterr().out)
    assert plain["rad"]["properties"]["sh_label"]["encoding"] == "u16"
    assert plain["bytes"] == path.stat().st_size
