"""`sparklod inspect`: reports, fields, charts and pages, findings, assertions, and what can be an input."""

from __future__ import annotations

import base64
import io
import re
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sparklod_cli.api import reports
from sparklod_cli.codecs import spz
from sparklod_cli.codecs.formats import WriteOptions
from sparklod_cli.images import pyvista_scene, scene_plots
from sparklod_cli.inspection.findings import Finding
from sparklod_cli.inspection.report import NAMED_FORMATS, SHORT_NAMES
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.system.errors import SparklodError
from tests.commands.cli import NAMED, Cli

#: A tree of nine nodes, of which six are leaves; a scene without a tree; files with one error, warning and note.
TREE, PLAIN = "hand-tree-v3.spz", "sh2.ply"
CORRUPT, BROKEN, WARNED, NOTED = "spz-flipped-bit.spz", "tree-orphan.spz", "spz-flags.spz", "tree-fine-first.spz"
MISSING = "missing.spz: cannot be read: no such file or directory"


# --- Reports ----------------------------------------------------------------------------------------------------------


def test_a_report_is_on_standard_output_and_has_the_parts_that_options_name(cli: Cli) -> None:
    done = cli(f"inspect {TREE} {PLAIN}")
    tree, plain = done.out.split(f"{PLAIN}  PLY, ")
    assert done.err == "" and tree.startswith(f"{TREE}  SPZ 3 LoD, 0.2 kB\n")
    facts = "9 nodes, SH 0", "12 fractional bits", "6 leaves, 3 inner nodes, growth 1.500, depth 2", "3: 2, 2: 1"
    assert all(fact in tree for fact in facts)
    assert all(fact in plain for fact in ("60 splats, SH 2", "box", "scale", "opacity", "anisotropy"))
    assert "depth" not in plain and "sh1" not in plain
    rows = {line.split()[0] for line in cli(f"inspect {PLAIN} --stats").out.splitlines()}
    assert {"x", "scale_min", "size", "blue", "sh1", "sh2"} <= rows
    lines = [line.strip() for line in cli(f"inspect {PLAIN} --histogram sh1 --histogram opacity").out.splitlines()]
    assert 0 < lines.index("sh1") < lines.index("opacity") < len(lines) - 1


@pytest.mark.parametrize(
    ("file", "without", "with_check"),
    [(TREE, 0, 0), (CORRUPT, 1, 3), ("missing.spz", 1, 3), (BROKEN, 0, 3), (WARNED, 0, 0), (NOTED, 0, 0)],
)
def test_the_exit_status_says_whether_a_file_is_sound(file: str, without: int, with_check: int, cli: Cli) -> None:
    for form in ("", "--json"):
        cli(f"inspect {file} {form}", status=without)
        cli(f"inspect {file} --check {form}", status=with_check)
    if with_check == 0:  # notes never fail
        cli(f"inspect {file} --check --fail-on error")
        cli(f"inspect {file} --check --fail-on warning", status=3 if file == WARNED else 0)


def test_an_unreadable_file_does_not_stop_the_others(cli: Cli) -> None:
    done = cli(f"inspect missing.spz {TREE} {CORRUPT} {PLAIN}", status=1)
    heads = [line.split("  ")[0] for line in done.out.splitlines() if not line.startswith(" ")]
    assert heads == [TREE, PLAIN]
    assert done.err == f"error: {MISSING}\nerror: {CORRUPT}: corrupt gzip data: its checksum is wrong\n"
    done = cli(f"inspect missing.spz {TREE} {BROKEN} {WARNED} --check", status=3)
    assert done.out.splitlines() == [
        f"missing.spz: error: file.unreadable: {MISSING.partition(': ')[2]}",
        f"{BROKEN}: error: tree.orphan: node 9 has no parent",
        f"{WARNED}: warning: container.flags: the header sets flags 0x0c, which have no meaning",
    ]
    assert done.err == f"{TREE}: OK: 9 nodes, no problems found\n"


def test_quiet_prints_only_what_options_name(cli: Cli) -> None:
    assert cli(f"inspect -q {TREE} {BROKEN} --check", status=3)[1:] == (
        f"{BROKEN}: error: tree.orphan: node 9 has no parent\n",
        "",
    )
    for options, out in (
        *((options, r"") for options in ("--check", "", "--stats")),
        ("--field tree.leaves", r"6\n"),
        ("--json", r"{.*}\n"),
        ("--histogram opacity", r"\s*opacity\n(.*\n)+"),
    ):
        done = cli(f"inspect -q {TREE} {options}")
        assert re.fullmatch(out, done.out) and done.err == "", options
    assert cli(f"inspect -q {CORRUPT}", status=1).err.startswith(f"error: {CORRUPT}")


def test_threads_do_not_change_a_report(cli: Cli) -> None:
    line = f"inspect demo.ply {TREE} --json --stats --check --threads"
    assert len({cli(f"{line} {threads}").out for threads in (1, 2, 5)}) == 1


def test_json_is_one_object_and_one_line_a_file(cli: Cli) -> None:
    done = cli(f"inspect --json missing.spz {TREE} {PLAIN}", status=1)
    missing, tree, plain = done.records
    assert done.err == f"error: {MISSING}\n"
    assert [record["file"] for record in done.records] == ["missing.spz", TREE, PLAIN]
    assert {record["schema_version"] for record in done.records} == {1}
    assert tree.keys() == missing.keys() == plain.keys()
    assert (tree["format"], tree["splats"], tree["tree"]["leaves"]) == ("SPZ 3 LoD", 9, 6)
    assert tree["bytes"] == NAMED[TREE].stat().st_size
    assert tree["findings"] is tree["values"] is plain["tree"] is missing["format"] is missing["bytes"] is None
    assert [found["code"] for found in missing["findings"]] == ["file.unreadable"]
    done = cli(f"inspect --json --stats --check --assert sh==1 {BROKEN}", status=3)
    assert [(found["severity"], found["code"], found["index"]) for found in done.json["findings"]] == [
        ("error", "tree.orphan", 9),
        ("error", "expect.sh", None),
    ]
    assert {"x", "scale", "size", "blue"} <= set(done.json["values"]["quantities"]) and done.err == ""
    assert cli(f"inspect --json --check {TREE}").json["findings"] == []


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("splats", "9"),
        ("format", "SPZ 3 LoD"),
        ("antialiased", "false"),
        ("tree.growth", "1.5"),
        ("tree.levels.1", '{"nodes": 3, "leaves": 1, "size": '),
        ("tree.levels.2.leaves", "5"),
        ("header.flags", "128"),
        ("values.quantities.x.max", "4.0"),
        ("values.box.min", "[0.0, -2.0, 1.0]"),
        ("values", '{"box": {"min": '),
        ("notes", "[]"),
        ("findings", "[]"),
        ("bytes", str(NAMED[TREE].stat().st_size)),
    ],
)
def test_a_field_is_printed_as_a_script_wants_it(field: str, value: str, cli: Cli) -> None:
    done = cli(f"inspect {TREE} --field {field}")
    assert done.out.startswith(value) and (done.out.count("\n"), done.err) == (1, "")


def test_a_field_missing_in_one_file_does_not_stop_the_others(cli: Cli) -> None:
    done = cli(f"inspect {TREE} missing.spz {PLAIN} --field splats", status=1)
    assert done[1:] == ("9\n60\n", f"error: {MISSING}\n")
    assert cli(f"inspect {BROKEN} --check --field splats", status=3).out == "10\n"
    done = cli(f"inspect {PLAIN} {TREE} --field tree.leaves", status=1)
    assert done.out == "6\n" and re.match(f"error: {PLAIN}: .*the report has no tree.leaves", done.err)


def test_every_finding_is_an_annotation_for_github(cli: Cli) -> None:
    done = cli(f"inspect --check --format github {CORRUPT} {BROKEN} {WARNED} {NOTED} {TREE}", status=3)
    lines = done.out.splitlines()
    assert [line.split(" ")[0] for line in lines] == ["::error", "::error", "::warning", "::notice"]
    assert lines[1] == f"::error file={BROKEN},title=tree.orphan::node 9 has no parent"


def test_no_name_ends_an_annotation_or_begins_a_command(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    finding = Finding("tree.orphan", "100% of it\r\nis: lost, all")
    cli.put("50%, a:b\n::stop.spz", NAMED[BROKEN].read_bytes())
    assert cli("inspect --check", "50%, a:b\n::stop.spz", status=3).out.count("\n") == 1
    monkeypatch.setattr("sparklod_cli.inspection.tree.link_findings", lambda *_: [finding])
    done = cli("inspect --check --format github", "50%, a:b\n::stop.spz", status=3)
    name = "50%25%2C a%3Ab%0A%3A%3Astop.spz"
    assert done.out == f"::error file={name},title=tree.orphan::100%25 of it%0D%0Ais: lost, all\n"


# --- Pages and pictures -----------------------------------------------------------------------------------------------


def test_the_paths_of_page_and_picture_are_printed(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    picture = scene_plots.DescribedPicture(b"\x89PNG" * 100, "all leaves: 6 nodes; coloured by level")
    monkeypatch.setattr(scene_plots, "plot", lambda *_, **__: picture)
    monkeypatch.setattr(pyvista_scene, "load_pyvista", lambda: None)  # which may be missing
    done = cli(f"inspect {TREE} --plot a.png --html a.html")
    size = (cli.folder / "a.html").stat().st_size / 1e3
    assert done.out == ""  # the report is on the page
    assert done.err.splitlines() == [
        f"{TREE}: OK: 9 nodes, no problems found",
        "a.png  all leaves: 6 nodes, 0.4 kB",
        f"a.html  page of 1 file, {size:.1f} kB",
    ]
    assert "a.html  page of 2 files, " in cli(f"inspect {TREE} {TREE} --html a.html -f").err
    assert cli(f"inspect {TREE} --plot a.png --html a.html -fq")[1:] == ("", "")


def test_a_page_without_pyvista_has_no_plot_and_says_why(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent() -> None:
        raise SparklodError("no pyvista")

    monkeypatch.setattr(pyvista_scene, "load_pyvista", absent)
    lines = cli(f"inspect {WARNED} --html a.html").err.splitlines()
    assert lines[:2] == [f"{WARNED}: 1 warning", f"{WARNED}: no plot of the tree on the page: no pyvista"]
    assert "container.flags" in Path("a.html").read_text()
    assert "container.flags" not in cli(f"inspect {WARNED} --html a.html -f --stats").out


@pytest.mark.parametrize(("file", "drawings"), [("tree-v3.spz", 1), (PLAIN, 1), (BROKEN, 0), (CORRUPT, 0)])
def test_a_page_shows_the_scene_where_it_can_be_drawn(file: str, drawings: int, cli: Cli) -> None:
    done = cli(f"inspect {file} no-splats.ply --html a.html", status=0 if file != CORRUPT else 1)
    assert "in a way that it should not" not in done.err
    image = r'<img alt="Drawing of The scene from its front" src="data:image/png;base64,([^"]+)">'
    found = re.findall(image, Path("a.html").read_text("utf-8"))
    assert len(found) == drawings
    for data in found:
        picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))))
        assert picture.shape[:2] == (384, 512)
        assert np.count_nonzero(picture[..., :3].max(axis=2) > 20) > 500  # it is not black


@pytest.mark.parametrize("nodes", [1000, 1001, 50_000])
def test_the_report_of_a_deep_chain_is_bounded(nodes: int, cli: Cli) -> None:
    """A tree of nodes with one child each has as many levels as nodes; reports say how many they leave out."""
    splats = Splats.empty(nodes, 0)
    for name, value in (("center", 1), ("scale", 0.1), ("quat_xyzw", 0.5), ("opacity", 0.5), ("rgb", 0.5)):
        getattr(splats, name)[:] = value
    count, start = np.ones(nodes, np.uint16), np.arange(1, nodes + 1, dtype=np.uint32)
    count[-1] = start[-1] = 0
    cli.put("a.spz", b"".join(spz.encode(Scene(splats, LodTree(count, start)), WriteOptions(compression_level=1))))
    left_out = max(0, nodes - 1000)
    text = cli("inspect a.spz --html a.html --stats").out
    assert f"depth {nodes - 1}" in text and f"and {nodes - 64:,} more" in text and len(text) < 10_000
    html = Path("a.html").read_text()
    assert len(html) < 600_000 and f"<dt>Depth</dt><dd>{nodes - 1:,}<" in html
    assert (f"{left_out:,} greater depths are not listed" in html) == bool(left_out)
    done = cli("inspect a.spz --json")
    tree = done.json["tree"]
    assert (tree["depth"], len(tree["levels"]), tree["levels_left_out"]) == (nodes - 1, min(nodes, 1000), left_out)
    assert len(done.out) < 100_000


# --- Inputs -----------------------------------------------------------------------------------------------------------


def test_an_unpacked_sog_counts_as_one_file(cli: Cli) -> None:
    size = sum(path.stat().st_size for path in NAMED["sh1-sog"].iterdir())
    folder, meta = cli("inspect sh1-sog sh1-sog/meta.json --json").records
    assert (folder["bytes"], folder["splats"], folder["format"]) == (size, 60, "SOG 2")
    assert folder | {"file": ""} == meta | {"file": ""}
    cli(f"inspect sh1-sog --check --assert bytes<={size}")
    cli(f"inspect sh1-sog --assert bytes<={size - 1}", status=3)
    (cli.folder / "sh1-sog/quats.webp").unlink()
    assert cli("inspect sh1-sog ./ --check", status=3).out.splitlines() == [
        "sh1-sog: error: container.corrupt: 'quats.webp', which it names, cannot be read: no such file or directory",
        ".: error: file.unreadable: cannot be read: is a directory, without the meta.json of an unpacked SOG, a"
        " lod-meta.json or a tileset.json",
    ]


@pytest.mark.parametrize("name", ["no-splats.ply", "no-splats.spz"])
def test_files_without_splats_have_a_report(name: str, cli: Cli) -> None:
    assert "0 splats, SH 0" in cli(f"inspect {name}").out
    record = cli(f"inspect {name} --json --stats").json
    assert (record["splats"], record["values"]["box"], record["bytes_per_splat"]) == (0, None, None)
    assert cli(f"inspect {name} --check", status=3).out == f"{name}: error: values.empty: there are no splats\n"


def test_a_scene_is_freed_before_the_next_is_read(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    read = reports.report_on
    seen: list[weakref.ref[object]] = []

    def look(*arguments: Any, **settings: Any) -> Any:
        assert not any(scene() for scene in seen[:-1])
        report, scene = read(*arguments, **settings)
        seen.append(weakref.ref(scene))
        return report, scene

    monkeypatch.setattr(reports, "report_on", look)
    cli("inspect --json" + " sh1-sog" * 4)
    assert len(seen) == 4


def test_standard_input_is_reported_as_the_file_is(cli: Cli) -> None:
    data = NAMED[TREE].read_bytes()
    named = cli(f"inspect {TREE} --json --stats --check").json
    assert cli("inspect - --json --stats --check", stdin=data).json == named | {"file": "-"}
    assert cli("inspect -", stdin=data).out.startswith("standard input  SPZ 3 LoD, ")
    done = cli("inspect - --assert nodes<5", stdin=data, status=3)
    assert done.out.startswith("standard input: error: expect.value: ")
    assert "error: standard input: the file is empty" in cli("inspect -", stdin=b"", status=1).err
    assert cli("inspect - --json --check", stdin=b"", status=3).json["bytes"] == 0
    assert cli("inspect /dev/null --check", status=3).out.startswith("/dev/null: error: file.unreadable: ")


# --- Assertions -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "holds"),
    [
        *((text, True) for text in ("nodes==9", "growth<=1.5", "lod==true", "bytes<1MiB", 'format=="SPZ 3 LoD"')),
        *((text, True) for text in ("tree.leaves!=5", "values.box.max.0<=4", "nodes<0.01k", "tree.growth<=150%")),
        *((text, False) for text in ("nodes==8", "leaves>6", "depth!=2", "lod==false", "bytes<=0.01kB", "format<3")),
        *((text, False) for text in ('format=="SPZ"', "values.box==3", "antialiased==0", "header.nothing==null")),
    ],
)
def test_an_assertion_that_fails_is_exit_status_3_and_one_line(text: str, holds: bool, cli: Cli) -> None:
    lines = cli(f"inspect {TREE} --assert", text, status=0 if holds else 3).out.splitlines()
    assert len(lines) == (not holds)
    assert all(line.startswith(f"{TREE}: error: expect.") and f"{text}: " in line for line in lines)


@pytest.mark.parametrize("name", SHORT_NAMES)
def test_every_short_name_has_a_value_of_a_tree(name: str, cli: Cli) -> None:
    parts = "sh1-streamed-sog"
    files = {
        "Streamed SOG": parts,
        "RAD": "sh1-tree.rad",
        "RAD, Streamed SOG or 3D Tiles": parts,
        "3D Tiles": "sh1-tiles",
    }
    done = cli(f"inspect {files.get(NAMED_FORMATS.get(name, ''), TREE)} --assert {name}==12345", status=3)
    assert f"{name}==12345: {name} is " in done.out


def test_all_assertions_of_files_and_options_are_checked(cli: Cli) -> None:
    cli.put("expect.txt", "nodes<9\nbytes<=1MB\n")
    out = cli(f"inspect {TREE} --expect expect.txt --assert leaves<6 --assert bytes<=1", status=3).out
    assert out.splitlines() == [
        f"{TREE}: error: expect.value: nodes<9: nodes is 9",
        f"{TREE}: error: expect.splats: leaves<6: leaves is 6",
        f"{TREE}: error: expect.bytes: bytes<=1: bytes is {NAMED[TREE].stat().st_size}",
    ]
    for name in ("growth", "depth"):
        assert f"{name}<99: the file has no tree\n" in cli(f"inspect {PLAIN} --assert {name}<99", status=3).out
    cli(f"inspect {PLAIN} --assert lod==false --assert leaves>1")
