"""`sparklod inspect` as a shell sees it: exit codes, and what goes where."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from sparklod_cli.cli import run
from sparklod_cli.figures import pyvista_scene, tree_plot
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
        ([TREE, "--sh", "0", "--stats"], "--stats cannot be used with expectations unless --json is given"),
        ([TREE, "--check", "--json", "--format", "github"], "--format cannot be used with --"),
        ([TREE, "--check", "--field", "splats", "--format", "text"], "--format cannot be used with --"),
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
    assert err == f"{TREE}: nothing is wrong with its 9 nodes\n"


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
    done = sparklod(TREE, "--field", "tree.leaves", "--check", "--require-lod")
    assert (done.returncode, done.stdout, done.stderr) == (0, "6\n", "")


def test_the_paths_of_page_and_picture_are_printed(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def drawn(*args: object, **kwargs: object) -> tree_plot.DescribedPicture:
        return tree_plot.DescribedPicture(b"\x89PNG" * 100, "all leaves: 6 nodes; coloured by level")

    monkeypatch.setattr(tree_plot, "plot", drawn)
    monkeypatch.setattr(pyvista_scene, "load_pyvista", lambda: None)  # which may be missing
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
def test_wrong_suffixes_of_page_and_picture_are_refused(
    option: str, name: str, tmp_path: Path, capsys: Capture
) -> None:
    assert run(["inspect", str(FIXTURES / "one.ply"), option, str(tmp_path / name)]) == 2
    assert f"{name}' does not end in ." in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
