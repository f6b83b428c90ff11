"""`sparklod inspect` as a shell sees it: exit codes, and what goes where."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs import spz
from sparklod_cli.inspection import plot
from sparklod_cli.inspection import report as reports
from sparklod_cli.inspection.findings import CODES, Finding
from sparklod_cli.scene import Scene
from sparklod_cli.splats import Splats
from sparklod_cli.tree import LodTree
from tests.conftest import FIXTURES, ROOT

TREE, PLAIN = FIXTURES / "golden" / "hand-tree-v3.spz", FIXTURES / "sh2.ply"
FOLDER = FIXTURES / "golden" / "sh1-sog"
FAULTS = FIXTURES / "faults"
CORRUPT, WARNED, NOTED = FAULTS / "spz-flipped-bit.spz", FAULTS / "spz-flags.spz", FAULTS / "tree-fine-first.spz"
BROKEN, MISSING = FAULTS / "tree-orphan.spz", FAULTS / "missing.spz"


def inspect(*arguments: object) -> int:
    return run(["inspect", *map(str, arguments)])


Said = pytest.CaptureFixture[str]


def test_a_person_gets_a_report_on_standard_output(capsys: Said) -> None:
    assert inspect(TREE, PLAIN) == 0
    out, err = capsys.readouterr()
    assert err == ""
    tree, plain = out.split(f"{PLAIN}  PLY, ")
    assert tree.startswith(f"{TREE}  SPZ 3 LoD, 0.2 kB\n")
    for fact in (
        "9 nodes, SH 0",
        "12 fractional bits",
        "6 leaves, 3 inner nodes, growth 1.500, 3 levels",
        "3: 2, 2: 1",
    ):
        assert fact in tree
    for fact in ("60 splats, SH 2", "box", "scale", "opacity", "anisotropy"):
        assert fact in plain
    assert "levels" not in plain


def test_more_quantities_are_asked_for(capsys: Said) -> None:
    assert inspect(PLAIN, "--stats") == 0
    out = capsys.readouterr().out
    rows = [line.split()[0] for line in out.splitlines()]
    assert {"x", "scale_min", "size", "blue", "sh1", "sh2"} <= set(rows)
    assert inspect(PLAIN) == 0
    assert "sh1" not in capsys.readouterr().out


def test_histograms_are_asked_for_by_name(capsys: Said) -> None:
    assert inspect(PLAIN, "--histogram", "sh1", "--histogram", "opacity") == 0
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert 0 < lines.index("sh1") < lines.index("opacity") < len(lines) - 1


@pytest.mark.parametrize(
    ("file", "without", "with_check"),
    [(TREE, 0, 0), (CORRUPT, 1, 3), (MISSING, 1, 3), (BROKEN, 0, 3), (WARNED, 0, 0), (NOTED, 0, 0)],
    ids=lambda value: getattr(value, "name", None),
)
def test_exit_codes(file: Path, without: int, with_check: int, capsys: Said) -> None:
    assert inspect(file) == without
    assert inspect(file, "--json") == without
    assert inspect(file, "--check") == with_check
    assert inspect(file, "--check", "--json") == with_check
    if file == WARNED:
        assert inspect(file, "--check", "--fail-on", "error") == 0
        assert inspect(file, "--check", "--fail-on", "warning") == 3
    if file == NOTED:  # notes never fail
        assert inspect(file, "--check", "--fail-on", "warning") == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "Missing argument"),
        ([TREE, "--json", "--field", "splats"], "--field and --json exclude each other"),
        ([TREE, PLAIN, "--plot", "out.png"], "--plot takes one file, not 2"),
        ([TREE, "--check", "--fail-on", "note"], "--fail-on"),
        ([TREE, "--check", "--format", "gitlab"], "--format"),
        ([TREE, "--fail-on", "warning"], "--fail-on needs --check or an expectation"),
        ([TREE, "--format", "github"], "--format needs --check or an expectation"),
        ([TREE, "--json", "--histogram", "scale"], "--histogram is for a person"),
        ([TREE, "--field", "splats", "--histogram", "scale"], "--histogram is for a person"),
        ([TREE, "--check", "--stats"], "--check prints findings; with --stats that is possible only as --json"),
        ([TREE, "--sh", "0", "--stats"], "expectations print findings; with --stats that is possible only as --json"),
        ([TREE, "--check", "--json", "--format", "github"], "--format is of findings in lines"),
        ([TREE, "--check", "--field", "splats", "--format", "text"], "--format is of findings in lines"),
        ([TREE, "--plot-level", "3"], "--plot-level needs --plot or --html"),
        ([TREE, "--plot-by", "size"], "--plot-by needs --plot or --html"),
        ([TREE, "--plot-by", "taste"], "--plot-by"),
        ([TREE, "--plot-level", "-1"], "--plot-level"),
        ([TREE, "--max-bytes", "-1"], "--max-bytes"),
        ([TREE, "--max-bytes", "1 mile"], "--max-bytes"),
        ([TREE, "--min-splats", "few"], "--min-splats"),
        ([TREE, "--sh", "4"], "--sh"),
        ([TREE, "--max-growth", "0.9"], "--max-growth"),
        ([TREE, "--max-growth", "nan"], "--max-growth"),
        ([TREE, "--threads", "0"], "--threads"),
        ([TREE, "--histogram", "beauty"], "--histogram knows"),
    ],
)
def test_wrong_usage_is_exit_code_2(arguments: list[object], message: str, capsys: Said) -> None:
    assert inspect(*arguments) == 2
    assert message in capsys.readouterr().err


def test_what_cannot_be_read_does_not_stop_the_others(capsys: Said) -> None:
    assert inspect(MISSING, TREE, CORRUPT, PLAIN) == 1
    out, err = capsys.readouterr()
    assert [line for line in out.splitlines() if not line.startswith(" ")] == [
        f"{TREE}  SPZ 3 LoD, 0.2 kB",
        f"{PLAIN}  PLY, {PLAIN.stat().st_size / 1e3:.1f} kB",
    ]
    assert err == (
        f"error: {MISSING}: cannot be read: no such file or directory\n"
        f"error: {CORRUPT}: corrupt gzip data: Error -3 while decompressing data: incorrect data check\n"
    )


def test_findings_are_data_and_what_is_good_is_talk(capsys: Said) -> None:
    assert inspect("--check", MISSING, TREE, BROKEN, WARNED) == 3
    out, err = capsys.readouterr()
    assert out.splitlines() == [
        f"{MISSING}: error: file.unreadable: cannot be read: no such file or directory",
        f"{BROKEN}: error: tree.orphan: node 9 is nobody's child",
        f"{WARNED}: warning: container.flags: the header has flags 0x0c, which mean nothing",
    ]
    assert err == f"{TREE}: nothing is wrong with its 9 nodes\n"


def test_quiet_prints_what_is_asked_for_by_name_only(capsys: Said) -> None:
    assert inspect("--check", "-q", TREE, BROKEN) == 3
    out, err = capsys.readouterr()
    assert (out.count("\n"), err) == (1, "")
    assert inspect("--check", "-q", TREE) == 0
    assert capsys.readouterr() == ("", "")
    assert inspect("-q", TREE) == 0
    assert inspect("-q", TREE, "--stats") == 0
    assert capsys.readouterr() == ("", "")
    assert inspect("-q", TREE, "--field", "tree.leaves") == 0
    assert capsys.readouterr() == ("6\n", "")
    assert inspect("-q", TREE, "--json") == 0
    out, err = capsys.readouterr()
    assert (len(records(out)), err) == (1, "")
    assert inspect("-q", TREE, "--histogram", "opacity") == 0
    out, err = capsys.readouterr()
    assert (out.split()[0], err) == ("opacity", "")
    assert inspect("-q", CORRUPT) == 1  # errors are said whatever is asked for
    assert capsys.readouterr().err.startswith(f"error: {CORRUPT}")


def records(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


def test_json_is_an_object_a_line_and_a_file(capsys: Said) -> None:
    assert inspect("--json", TREE, MISSING, PLAIN) == 1
    out, err = capsys.readouterr()
    tree, missing, plain = records(out)
    assert err == f"error: {MISSING}: cannot be read: no such file or directory\n"
    assert [record["file"] for record in (tree, missing, plain)] == [str(TREE), str(MISSING), str(PLAIN)]
    assert {record["schema_version"] for record in (tree, missing, plain)} == {1}
    assert (tree["format"], tree["splats"], tree["bytes"]) == ("SPZ 3 LoD", 9, TREE.stat().st_size)
    assert tree["tree"]["leaves"] == 6
    assert tree["findings"] is tree["values"] is plain["tree"] is None
    assert (missing["format"], missing["bytes"]) == (None, None)
    assert [found["code"] for found in missing["findings"]] == ["file.unreadable"]
    assert tree.keys() == missing.keys() == plain.keys()


def test_json_has_what_is_asked_for(capsys: Said) -> None:
    assert inspect("--json", "--stats", "--check", "--sh", "1", BROKEN) == 3
    out, err = capsys.readouterr()
    (record,) = records(out)
    assert err == ""
    assert [(found["severity"], found["code"], found["index"]) for found in record["findings"]] == [
        ("error", "tree.orphan", 9),
        ("error", "expect.sh", None),
    ]
    assert set(record["values"]["quantities"]) >= {"x", "scale", "size", "blue"}
    assert inspect("--json", "--check", TREE) == 0
    assert records(capsys.readouterr().out)[0]["findings"] == []


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
        ("bytes", str(TREE.stat().st_size)),
    ],
)
def test_a_field_is_printed_as_a_script_wants_it(field: str, value: str, capsys: Said) -> None:
    assert inspect(TREE, "--field", field) == 0
    out, err = capsys.readouterr()
    assert out.startswith(value)
    assert (out.count("\n"), err) == (1, "")


def test_fields_of_several_files(capsys: Said) -> None:
    assert inspect(TREE, MISSING, PLAIN, "--field", "splats") == 1
    out, err = capsys.readouterr()
    assert out.splitlines() == ["9", "60"]
    assert err == f"error: {MISSING}: cannot be read: no such file or directory\n"
    assert inspect(BROKEN, "--check", "--field", "splats") == 3
    assert capsys.readouterr().out == "10\n"


def test_a_field_that_one_file_has_not_does_not_stop_the_others(capsys: Said) -> None:
    assert inspect(PLAIN, TREE, "--field", "tree.leaves") == 1
    out, err = capsys.readouterr()
    assert out == "6\n"
    assert err.startswith(f"error: {PLAIN}: ")
    assert "the report has no tree.leaves" in err


def test_a_field_that_there_is_not(capsys: Said) -> None:
    assert inspect(TREE, "--field", "tree.leafs") == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert "the report has no tree.leafs" in err


def test_annotations_of_github(capsys: Said) -> None:
    assert inspect("--check", "--format", "github", CORRUPT, BROKEN, WARNED, NOTED, TREE) == 3
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert [line.split(" ")[0] for line in lines] == ["::error", "::error", "::warning", "::notice"]
    assert lines[1] == f"::error file={BROKEN},title=tree.orphan::node 9 is nobody's child"
    assert err == f"{TREE}: nothing is wrong with its 9 nodes\n"


def test_annotations_are_escaped(tmp_path: Path, capsys: Said, monkeypatch: pytest.MonkeyPatch) -> None:
    """A name could end the annotation, or begin another command."""
    path = tmp_path / "50%, a:b\n::stop.spz"
    shutil.copy(BROKEN, path)
    monkeypatch.setitem(CODES, "tree.orphan", CODES["tree.orphan"])
    monkeypatch.setattr(
        "sparklod_cli.inspection.tree._link_findings",
        lambda *_: [Finding("tree.orphan", "100% of it\r\nis: lost, all")],
    )
    monkeypatch.chdir(tmp_path)
    assert inspect("--check", "--format", "github", path.name) == 3
    name = "50%25%2C a%3Ab%0A%3A%3Astop.spz"
    assert capsys.readouterr().out == f"::error file={name},title=tree.orphan::100%25 of it%0D%0Ais: lost, all\n"


def test_a_line_is_a_finding_whatever_the_name_is(tmp_path: Path, capsys: Said) -> None:
    path = tmp_path / "two\nlines.spz"
    shutil.copy(BROKEN, path)
    assert inspect("--check", path) == 3
    assert capsys.readouterr().out.count("\n") == 1


def test_an_unpacked_sog(tmp_path: Path, capsys: Said) -> None:
    assert inspect(FOLDER, FOLDER / "meta.json", "--json") == 0
    folder, meta = records(capsys.readouterr().out)
    size = sum(path.stat().st_size for path in FOLDER.iterdir())
    assert (folder["bytes"], folder["splats"], folder["format"]) == (size, 60, "SOG 2")
    assert folder | {"file": ""} == meta | {"file": ""}
    assert inspect(FOLDER, "--check", "--max-bytes", size) == 0
    assert inspect(FOLDER, "--max-bytes", size - 1) == 3
    broken = tmp_path / "sog"
    shutil.copytree(FOLDER, broken)
    (broken / "quats.webp").unlink()
    capsys.readouterr()
    assert inspect(broken, tmp_path, "--check") == 3
    assert capsys.readouterr().out.splitlines() == [
        f"{broken}: error: container.corrupt: 'quats.webp', which it names, cannot be read: no such file or directory",
        f"{tmp_path}: error: file.unreadable: cannot be read: is a directory, without the meta.json of an unpacked SOG",
    ]


def test_standard_input_and_devices_are_not_read(capsys: Said) -> None:
    assert inspect("-", "--check") == 3
    assert inspect("/dev/null", "--check") == 3
    assert capsys.readouterr().out.count(": error: file.unreadable: ") == 2


@pytest.mark.parametrize("name", ["no-splats.ply", "no-splats.spz"])
def test_files_of_no_splats(name: str, capsys: Said) -> None:
    assert inspect(FAULTS / name) == 0
    assert "0 splats, SH 0" in capsys.readouterr().out
    assert inspect(FAULTS / name, "--json", "--stats") == 0
    (record,) = records(capsys.readouterr().out)
    assert (record["splats"], record["values"]["box"], record["bytes_per_splat"]) == (0, None, None)
    assert inspect(FAULTS / name, "--check") == 3
    assert capsys.readouterr().out == f"{FAULTS / name}: error: values.empty: there are no splats\n"


def test_scenes_are_let_go_of_before_the_next_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    read = reports.inspect
    seen: list[weakref.ref[object]] = []

    def look(*arguments: Any, **settings: Any) -> Any:
        assert not any(scene() for scene in seen[:-1])
        report, scene = read(*arguments, **settings)
        seen.append(weakref.ref(scene))
        return report, scene

    monkeypatch.setattr(reports, "inspect", look)
    assert inspect(*[TREE] * 4, "--json") == 0
    assert len(seen) == 4


def test_threads_change_nothing(capsys: Said) -> None:
    printed = set()
    for threads in (1, 2, 5):
        assert inspect(FIXTURES / "demo.ply", TREE, "--json", "--stats", "--check", "--threads", threads) == 0
        printed.add(capsys.readouterr().out)
    assert len(printed) == 1


def test_as_a_process() -> None:
    def sparklod(*arguments: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "sparklod_cli", "inspect", *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)

    done = sparklod(BROKEN, TREE, "--check")
    assert (done.returncode, done.stdout.count("\n"), done.stderr.count("\n")) == (3, 1, 1)
    assert "Traceback" not in done.stderr
    done = sparklod(TREE, "--field", "tree.leaves", "--check", "--require-lod")
    assert (done.returncode, done.stdout, done.stderr) == (0, "6\n", "")


def chain(nodes: int) -> bytes:
    """A tree of nodes with a single child each: a file of bytes that are all alike, and as many levels as nodes."""
    splats = Splats.empty(nodes, 0)
    for name, value in (("center", 1), ("scale", 0.1), ("quat_xyzw", 0.5), ("opacity", 0.5), ("rgb", 0.5)):
        getattr(splats, name)[:] = value
    count, start = np.ones(nodes, np.uint16), np.arange(1, nodes + 1, dtype=np.uint32)
    count[-1] = start[-1] = 0
    return b"".join(spz.encode(Scene(splats, LodTree(count, start)), spz.Options(compression_level=1)))


@pytest.mark.parametrize("nodes", [999, 1000, 1001, 50_000])
def test_a_chain_is_told_of_in_bounds(nodes: int, tmp_path: Path, capsys: Said) -> None:
    """Reports do not grow with the levels of a tree, and say how many they leave out."""
    path, page = tmp_path / "chain.spz", tmp_path / "page.html"
    path.write_bytes(chain(nodes))
    left_out = max(0, nodes - 1000)
    assert inspect(path, "--html", page) == 0
    text = capsys.readouterr().out
    assert f"{nodes:,} levels" in text
    assert f"and {nodes - 64:,} more" in text
    assert len(text) < 10_000
    html = page.read_text()
    assert len(html) < 600_000
    assert (f"{left_out:,} more levels are left out" in html) == bool(left_out)
    assert f"<dt>Levels</dt><dd>{nodes:,}<" in html
    assert inspect(path, "--json") == 0
    out = capsys.readouterr().out
    tree = json.loads(out)["tree"]
    assert (tree["depth"], len(tree["levels"]), tree["levels_left_out"]) == (nodes - 1, min(nodes, 1000), left_out)
    assert len(out) < 100_000


def test_a_page_and_a_picture_are_said(tmp_path: Path, capsys: Said, monkeypatch: pytest.MonkeyPatch) -> None:
    def drawn(*args: object, **kwargs: object) -> plot.Picture:
        return plot.Picture(b"\x89PNG" * 100, "all leaves: 6 nodes; coloured by level")

    monkeypatch.setattr(plot, "plot", drawn)
    page, picture = tmp_path / "page.html", tmp_path / "picture.png"
    assert inspect(TREE, "--plot", picture, "--html", page) == 0
    first, second = capsys.readouterr().err.splitlines()
    assert first == f"{picture}  all leaves: 6 nodes, 0.4 kB"
    assert second == f"{page}  page of 1 file, {page.stat().st_size / 1e3:.1f} kB"
    assert inspect(TREE, TREE, "--html", page, "--overwrite") == 0
    assert f"{page}  page of 2 files, " in capsys.readouterr().err
    assert inspect(TREE, "--plot", picture, "--html", page, "--overwrite", "-q") == 0
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(("option", "name"), [("--html", "page.spz"), ("--plot", "picture.html")])
def test_an_output_is_what_its_name_says(
    option: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["inspect", str(FIXTURES / "one.ply"), option, str(tmp_path / name)]) == 2
    assert f"{name}' does not end in ." in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
