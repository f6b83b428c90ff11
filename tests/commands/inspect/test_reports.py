"""Reports of `sparklod inspect`: text, JSON, annotations, fields, charts and pictures."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sparklod_cli.cli import run
from sparklod_cli.images import pyvista_scene, scene_plots
from sparklod_cli.inspection.findings import CODES, Finding
from sparklod_cli.system.errors import SparklodError
from tests.commands.inspect.runs import BROKEN, CORRUPT, MISSING, NOTED, PLAIN, TREE, WARNED, inspect, records
from tests.conftest import FIXTURES, ROOT, Capture


def test_a_person_gets_a_report_on_standard_output(capsys: Capture) -> None:
    assert inspect(TREE, PLAIN) == 0
    out, err = capsys.readouterr()
    assert err == ""
    tree, plain = out.split(f"{PLAIN}  PLY, ")
    assert tree.startswith(f"{TREE}  SPZ 3 LoD, 0.2 kB\n")
    for fact in (
        "9 nodes, SH 0",
        "12 fractional bits",
        "6 leaves, 3 inner nodes, growth 1.500, depth 2",
        "3: 2, 2: 1",
    ):
        assert fact in tree
    for fact in ("60 splats, SH 2", "box", "scale", "opacity", "anisotropy"):
        assert fact in plain
    assert "depth" not in plain


def test_stats_adds_quantities(capsys: Capture) -> None:
    assert inspect(PLAIN, "--stats") == 0
    out = capsys.readouterr().out
    rows = [line.split()[0] for line in out.splitlines()]
    assert {"x", "scale_min", "size", "blue", "sh1", "sh2"} <= set(rows)
    assert inspect(PLAIN) == 0
    assert "sh1" not in capsys.readouterr().out


def test_histograms_are_printed_by_name(capsys: Capture) -> None:
    assert inspect(PLAIN, "--histogram", "sh1", "--histogram", "opacity") == 0
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert 0 < lines.index("sh1") < lines.index("opacity") < len(lines) - 1


@pytest.mark.parametrize(
    ("file", "without", "with_check"),
    [(TREE, 0, 0), (CORRUPT, 1, 3), (MISSING, 1, 3), (BROKEN, 0, 3), (WARNED, 0, 0), (NOTED, 0, 0)],
    ids=lambda value: getattr(value, "name", None),
)
def test_the_exit_code_says_whether_a_file_was_read_and_checked(
    file: Path, without: int, with_check: int, capsys: Capture
) -> None:
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
        ([TREE, "--json", "--field", "splats"], "--field cannot be used with --json"),
        ([TREE, PLAIN, "--plot", "out.png"], "--plot takes one file, not 2"),
        ([TREE, "--check", "--fail-on", "note"], "--fail-on"),
        ([TREE, "--check", "--format", "gitlab"], "--format"),
        ([TREE, "--fail-on", "warning"], "--fail-on needs --check or an expectation"),
        ([TREE, "--format", "github"], "--format needs --check or an expectation"),
        ([TREE, "--json", "--histogram", "scale"], "--histogram cannot be used with --"),
        ([TREE, "--field", "splats", "--histogram", "scale"], "--histogram cannot be used with --"),
        ([TREE, "--check", "--stats"], "--stats cannot be used with --check unless --json is given"),
        ([TREE, "--assert", "sh==0", "--stats"], "--stats cannot be used with expectations unless --json is given"),
        ([TREE, "--check", "--json", "--format", "github"], "--format cannot be used with --"),
        ([TREE, "--check", "--field", "splats", "--format", "text"], "--format cannot be used with --"),
        ([TREE, "--plot-level", "3"], "--plot-level needs --plot or --html"),
        ([TREE, "--plot-by", "size"], "--plot-by needs --plot or --html"),
        ([TREE, "--plot-by", "taste"], "--plot-by"),
        ([TREE, "--plot-level", "-1"], "--plot-level"),
        ([TREE, "--assert", "bytes<1 mile"], "--assert 'bytes<1 mile': '1 mile' is not a number"),
        ([TREE, "--assert", "growth<nan"], "--assert 'growth<nan': 'nan' is not a number"),
        ([TREE, "--threads", "0"], "--threads"),
        ([TREE, "--histogram", "beauty"], "--histogram: there is no quantity"),
    ],
)
def test_wrong_usage_of_inspect_is_exit_code_2(arguments: list[object], message: str, capsys: Capture) -> None:
    assert inspect(*arguments) == 2
    assert message in capsys.readouterr().err


def test_an_unreadable_file_does_not_stop_the_others(capsys: Capture) -> None:
    assert inspect(MISSING, TREE, CORRUPT, PLAIN) == 1
    out, err = capsys.readouterr()
    assert [line for line in out.splitlines() if not line.startswith(" ")] == [
        f"{TREE}  SPZ 3 LoD, 0.2 kB",
        f"{PLAIN}  PLY, {PLAIN.stat().st_size / 1e3:.1f} kB",
    ]
    assert err == (
        f"error: {MISSING}: cannot be read: no such file or directory\n"
        f"error: {CORRUPT}: corrupt gzip data: its checksum is wrong\n"
    )


def test_findings_go_to_stdout_and_good_news_to_stderr(capsys: Capture) -> None:
    assert inspect("--check", MISSING, TREE, BROKEN, WARNED) == 3
    out, err = capsys.readouterr()
    assert out.splitlines() == [
        f"{MISSING}: error: file.unreadable: cannot be read: no such file or directory",
        f"{BROKEN}: error: tree.orphan: node 9 has no parent",
        f"{WARNED}: warning: container.flags: the header sets flags 0x0c, which have no meaning",
    ]
    assert err == f"{TREE}: OK: 9 nodes, no problems found\n"


def test_quiet_prints_only_what_options_name(capsys: Capture) -> None:
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


def test_threads_do_not_change_a_report(capsys: Capture) -> None:
    printed = set()
    for threads in (1, 2, 5):
        assert inspect(FIXTURES / "demo.ply", TREE, "--json", "--stats", "--check", "--threads", threads) == 0
        printed.add(capsys.readouterr().out)
    assert len(printed) == 1


def test_a_process_prints_findings_and_exits_3() -> None:
    def sparklod(*arguments: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "sparklod_cli", "inspect", *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)

    done = sparklod(BROKEN, TREE, "--check")
    assert (done.returncode, done.stdout.count("\n"), done.stderr.count("\n")) == (3, 1, 1)
    assert "Traceback" not in done.stderr
    done = sparklod(TREE, "--field", "tree.leaves", "--check", "--assert", "lod==true")
    assert (done.returncode, done.stdout, done.stderr) == (0, "6\n", "")


def test_the_paths_of_page_and_picture_are_printed(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def drawn(*args: object, **kwargs: object) -> scene_plots.DescribedPicture:
        return scene_plots.DescribedPicture(b"\x89PNG" * 100, "all leaves: 6 nodes; coloured by level")

    monkeypatch.setattr(scene_plots, "plot", drawn)
    monkeypatch.setattr(pyvista_scene, "load_pyvista", lambda: None)  # which may be missing
    page, picture = tmp_path / "page.html", tmp_path / "picture.png"
    assert inspect(TREE, "--plot", picture, "--html", page) == 0
    out, err = capsys.readouterr()
    assert out == ""  # the report is on the page
    verdict, first, second = err.splitlines()
    assert verdict == f"{TREE}: OK: 9 nodes, no problems found"
    assert first == f"{picture}  all leaves: 6 nodes, 0.4 kB"
    assert second == f"{page}  page of 1 file, {page.stat().st_size / 1e3:.1f} kB"
    assert inspect(TREE, TREE, "--html", page, "--overwrite") == 0
    assert f"{page}  page of 2 files, " in capsys.readouterr().err
    assert inspect(TREE, "--plot", picture, "--html", page, "--overwrite", "-q") == 0
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(("option", "name"), [("--html", "page.spz"), ("--plot", "picture.html")])
def test_wrong_suffixes_of_page_and_picture_are_refused(
    option: str, name: str, tmp_path: Path, capsys: Capture
) -> None:
    assert run(["inspect", str(FIXTURES / "one.ply"), option, str(tmp_path / name)]) == 2
    assert f"{name}' does not end in ." in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_every_finding_is_an_annotation_for_github(capsys: Capture) -> None:
    assert inspect("--check", "--format", "github", CORRUPT, BROKEN, WARNED, NOTED, TREE) == 3
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert [line.split(" ")[0] for line in lines] == ["::error", "::error", "::warning", "::notice"]
    assert lines[1] == f"::error file={BROKEN},title=tree.orphan::node 9 has no parent"
    assert err == f"{TREE}: OK: 9 nodes, no problems found\n"


def test_no_name_ends_an_annotation_or_begins_a_command(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A name could end the annotation, or begin another command."""
    path = tmp_path / "50%, a:b\n::stop.spz"
    shutil.copy(BROKEN, path)
    monkeypatch.setitem(CODES, "tree.orphan", CODES["tree.orphan"])
    monkeypatch.setattr(
        "sparklod_cli.inspection.tree.link_findings",
        lambda *_: [Finding("tree.orphan", "100% of it\r\nis: lost, all")],
    )
    monkeypatch.chdir(tmp_path)
    assert inspect("--check", "--format", "github", path.name) == 3
    name = "50%25%2C a%3Ab%0A%3A%3Astop.spz"
    assert capsys.readouterr().out == f"::error file={name},title=tree.orphan::100%25 of it%0D%0Ais: lost, all\n"


def test_a_line_is_a_finding_whatever_the_name_is(tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "two\nlines.spz"
    shutil.copy(BROKEN, path)
    assert inspect("--check", path) == 3
    assert capsys.readouterr().out.count("\n") == 1


def test_json_is_one_object_and_one_line_a_file(capsys: Capture) -> None:
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


def test_json_has_the_parts_that_options_ask_for(capsys: Capture) -> None:
    assert inspect("--json", "--stats", "--check", "--assert", "sh==1", BROKEN) == 3
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
def test_a_field_is_printed_as_a_script_wants_it(field: str, value: str, capsys: Capture) -> None:
    assert inspect(TREE, "--field", field) == 0
    out, err = capsys.readouterr()
    assert out.startswith(value)
    assert (out.count("\n"), err) == (1, "")


def test_a_field_of_several_files_is_a_line_each(capsys: Capture) -> None:
    assert inspect(TREE, MISSING, PLAIN, "--field", "splats") == 1
    out, err = capsys.readouterr()
    assert out.splitlines() == ["9", "60"]
    assert err == f"error: {MISSING}: cannot be read: no such file or directory\n"
    assert inspect(BROKEN, "--check", "--field", "splats") == 3
    assert capsys.readouterr().out == "10\n"


def test_a_field_missing_in_one_file_does_not_stop_the_others(capsys: Capture) -> None:
    assert inspect(PLAIN, TREE, "--field", "tree.leaves") == 1
    out, err = capsys.readouterr()
    assert out == "6\n"
    assert err.startswith(f"error: {PLAIN}: ")
    assert "the report has no tree.leaves" in err


def test_an_unknown_field_is_an_error(capsys: Capture) -> None:
    assert inspect(TREE, "--field", "tree.leafs") == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert "the report has no tree.leafs" in err


def test_the_page_has_the_report_and_the_terminal_a_verdict(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def absent() -> None:
        raise SparklodError("no pyvista")

    monkeypatch.setattr(pyvista_scene, "load_pyvista", absent)
    page = tmp_path / "page.html"
    assert inspect(WARNED, "--html", page) == 0
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines() == [
        f"{WARNED}: 1 warning",
        f"{WARNED}: no plot of the tree on the page: no pyvista",
        f"{page}  page of 1 file, {page.stat().st_size / 1e3:.1f} kB",
    ]
    assert "container.flags" in page.read_text()
    assert inspect(WARNED, "--html", page, "--overwrite", "--stats") == 0
    assert "container.flags" not in capsys.readouterr().out  # the report, and no findings
