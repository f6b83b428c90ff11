"""Assertions about reports, from options and from files, one a line."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest

from sparklod_cli.cli import run
from sparklod_cli.inspection.report import (
    NoFieldError,
    Report,
    ReportSettings,
    check_expectations,
    inspect,
    parse_expectation,
    read_expectations,
)
from sparklod_cli.system.errors import SparklodError
from tests.conftest import FIXTURES, Capture

TREE, PLAIN = FIXTURES / "golden" / "hand-tree-v3.spz", FIXTURES / "golden" / "sh3-v3.spz"


def written(folder: Path, text: str, name: str = "expect.txt") -> Path:
    path = folder / name
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def tree() -> Report:
    """Nine nodes, of which six are leaves, and two edges from the root to the deepest."""
    return inspect(TREE, ReportSettings(values=True, all_quantities=True))[0]


@pytest.fixture(scope="module")
def plain() -> Report:
    return inspect(PLAIN, ReportSettings(values=True))[0]


def codes(report: Report, *texts: str) -> list[str]:
    return [finding.code for finding in check_expectations(report, [parse_expectation(text) for text in texts])]


@pytest.mark.parametrize(
    ("path", "left", "holds", "fails", "code"),
    [
        (TREE, "bytes<=", TREE.stat().st_size, TREE.stat().st_size - 1, "expect.bytes"),
        (TREE, "leaves>=", 6, 7, "expect.splats"),
        (TREE, "leaves<=", 6, 5, "expect.splats"),
        (TREE, "sh==", 0, 1, "expect.sh"),
        (TREE, "lod==", "true", "false", "expect.lod"),
        (TREE, "growth<=", 1.5, 1.4, "expect.growth"),
        (TREE, "tree.depth==", 2, 3, "expect.value"),
        (PLAIN, "leaves>=", 60, 61, "expect.splats"),
        (PLAIN, "leaves<=", 60, 59, "expect.splats"),
        (PLAIN, "sh==", 3, 2, "expect.sh"),
        (PLAIN, "lod==", "false", "true", "expect.lod"),
    ],
)
def test_each_expectation_holds_or_gives_its_code(
    path: Path, left: str, holds: object, fails: object, code: str, capsys: Capture
) -> None:
    assert run(["inspect", str(path), "--assert", f"{left}{holds}"]) == 0
    out, err = capsys.readouterr()
    assert (out, err.startswith(f"{path}: OK: ")) == ("", True)
    assert run(["inspect", str(path), "--assert", f"{left}{fails}"]) == 3
    out, err = capsys.readouterr()
    assert out.startswith(f"{path}: error: {code}: ")
    assert (out.count("\n"), err) == (1, "")


def test_every_expectation_that_fails_is_reported(tree: Report, plain: Report) -> None:
    texts = ("bytes<=1", "leaves<=1", "sh==3", "lod==false", "growth<=1", "splats==1")
    found = check_expectations(tree, [parse_expectation(text) for text in texts])
    assert [each.code.removeprefix("expect.") for each in found] == ["bytes", "splats", "sh", "lod", "growth", "value"]
    assert found[1].message == "leaves<=1: leaves is 6"
    assert found[4].message == "growth<=1: growth is 1.5"
    assert found[5].message == "splats==1: splats is 9"
    assert codes(plain, "growth<=9") == ["expect.growth"]  # there is none without a tree


def test_an_unreadable_file_is_not_checked_further() -> None:
    report, scene = inspect(FIXTURES / "points.ply", ReportSettings())
    assert scene is None
    assert codes(report, "leaves>=1", "lod==true", "splats==3") == []


@pytest.mark.parametrize(
    ("way", "holds", "fails"),
    [
        ("format", '=="SPZ 3 LoD"', '=="SPZ 2 LoD"'),
        ("splats", "==9", "==10"),
        ("antialiased", "==false", "==true"),
        ("tree.depth", "==2", "==3"),
        ("tree.levels.1.nodes", "==3", "==4"),
        ("tree.levels.1.nodes", "!=4", "!=3"),
        ("tree.children.3", "==2", "==1"),
        ("header.fractional_bits", "==12", "==13"),
        ("values.non_finite", "==0", "==1"),
        ("values.box.max.0", "==4.0", "==4.1"),
        ("values.quantities.opacity.max", "<=4", "<=0.5"),
        ("tree.growth", ">=1.5", ">=1.51"),
        ("tree.growth", "<1.6", "<1.5"),
        ("notes", "==[]", '==["SH degree 4 is cut to 3"]'),
        ("header.comment", '!="a<b"', '=="a<b"'),
    ],
)
def test_values_of_the_report_are_met_or_give_a_finding(tree: Report, way: str, holds: str, fails: str) -> None:
    if way == "header.comment":
        tree = dataclasses.replace(tree, header={"comment": "a>b"})  # type: ignore[dict-item]
    assert codes(tree, way + holds) == []
    (found,) = check_expectations(tree, [parse_expectation(way + fails)])
    assert found.code == "expect.value"
    assert found.message.startswith(f"{way}{fails}: {way} is ")


@pytest.mark.parametrize("way", ["format", "antialiased", "values.box", "tree.children"])
def test_a_minimum_of_a_value_that_is_not_a_number_fails(tree: Report, way: str) -> None:
    assert codes(tree, f"{way}>=0") == ["expect.value"]


@pytest.mark.parametrize("way", ["", "nothing", "tree.", "tree.levels.99", "tree.levels.x", "splats.0", "format.0"])
def test_a_path_that_the_report_has_not_is_an_error(tree: Report, way: str) -> None:
    with pytest.raises(NoFieldError, match=f"the report has no {way}"):
        tree.value_at(way)


@pytest.mark.parametrize(
    ("arguments", "status", "out"),
    [
        ("TREE --assert lod==true", 0, ""),
        ("TREE PLAIN --assert lod==true", 3, "PLAIN: error: expect.lod: lod==true: lod is false\n"),
        ("ORPHAN --assert lod==true", 3, "ORPHAN: error: tree.orphan: node 9 has no parent\n"),
        ("SINGLE --assert lod==true --fail-on warning", 0, ""),
        ("SINGLE --assert lod==true --check --fail-on warning", 3, "SINGLE: warning: tree.single-child: "),
        (
            "TREE --leaves-of PLAIN",
            3,
            "TREE: error: expect.leaves: 6 leaves, but 60 splats of the original can be drawn\n",
        ),
        (
            "PLAIN TREE --assert tree.depth==2",
            3,
            "PLAIN: error: expect.value: tree.depth==2: the report has no tree.depth",
        ),
        ("PLAIN --assert values.quantities.sh1.max<=9", 0, ""),
        (
            "PLAIN --assert values.box.min.0>=99",
            3,
            "PLAIN: error: expect.value: values.box.min.0>=99: values.box.min.0 is -",
        ),
    ],
)
def test_files_are_checked_with_their_expectations(arguments: str, status: int, out: str, capsys: Capture) -> None:
    files = {
        "TREE": TREE,
        "PLAIN": PLAIN,
        "ORPHAN": FIXTURES / "faults" / "tree-orphan.spz",
        "SINGLE": FIXTURES / "faults" / "tree-single-child.spz",
    }
    assert run(["inspect", *(str(files.get(word, word)) for word in arguments.split())]) == status
    for name, path in files.items():
        out = out.replace(name, str(path))
    found = capsys.readouterr().out
    assert found.startswith(out) if out else not found


@pytest.mark.parametrize("original", ["missing.ply", FIXTURES / "points.ply"])
def test_an_original_that_cannot_be_read_is_named(original: object, capsys: Capture) -> None:
    assert run(["inspect", str(TREE), "--leaves-of", str(original)]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"error: {original}: ")


def test_a_file_has_an_assertion_a_line(tmp_path: Path, tree: Report) -> None:
    texts = ["nodes<5M", 'format=="SPZ 3 LoD"', "tree.growth<=1.5"]
    path = written(
        tmp_path, '\ufeff# of all trees\n\nnodes<5M\r\n  format=="SPZ 3 LoD"  \n  # tree.depth==9\ntree.growth<=1.5'
    )
    assert read_expectations(path) == [parse_expectation(text) for text in texts]
    assert check_expectations(tree, read_expectations(path)) == []
    assert read_expectations(written(tmp_path, "")) == read_expectations(written(tmp_path, "", "empty.toml")) == []


OLD = """
max_bytes = 1_000
min_splats = 1
max_splats = 10
sh = 0
lod = true
max_growth = 1.5

[values]
"tree.depth" = 2
"""

OLD_JSON = '{"max_bytes": 1000, "min_splats":1, "max_splats": 10, "sh": 0, "lod": true, "max_growth": 1.5}'


@pytest.mark.parametrize(("name", "text"), [("expect.toml", OLD), ("expect.JSON", OLD_JSON)])
def test_an_old_file_is_refused_with_its_new_lines(name: str, text: str, tmp_path: Path, tree: Report) -> None:
    with pytest.raises(SparklodError, match="as TOML or JSON, which are no longer read") as caught:
        read_expectations(written(tmp_path, text, name))
    lines = "bytes<=1000, leaves>=1, leaves<=10, sh==0, lod==true, growth<=1.5"
    assert f"one a line: {lines}, NAME==VALUE" in str(caught.value)
    assert read_expectations(written(tmp_path, lines.replace(", ", "\n"), name))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nodes<", "line 1: 'nodes<' is not an assertion like 'nodes<=5M'"),
        ("nodes<5\n\nnode<5", "line 3: 'node<5': there is no 'node' in a report, did you mean nodes"),
        ("lod = true", "line 1: 'lod = true': = is not one of <= >= == != < >"),
        ("nodes==9" + "9" * 5000, "is too large"),
        ("nodes==1e999", "is too large"),
        ("notes==[", "is not a list or an object of JSON"),
        ("notes==" + "[" * 100_000, "is not a list or an object of JSON"),
        ("format==\"\u001b", "is not a text in double quotes"),
        ("x" * 100_000 + "==1", "xxx"),
        (" " * 100_000 + "==1", "is not an assertion"),
    ],
)  # fmt: skip
def test_an_unknown_expectation_is_an_error_that_names_the_file(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(SparklodError) as caught:
        read_expectations(path)
    assert str(caught.value).startswith(str(path))
    assert message in str(caught.value)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < len(str(path)) + 600


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", None])
def test_a_file_that_cannot_be_read_is_an_error_that_names_it(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "expect.txt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SparklodError) as caught:
        read_expectations(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("wanted", ["1" + "0" * 400 + "e-300", '"\\ud800"', '["' + "x" * 10**5 + '"]', "[NaN]"])
def test_odd_values_are_not_met_and_no_error(wanted: str, tmp_path: Path, capsys: Capture) -> None:
    for name in ("splats", "tree.levels"):
        assert run(["inspect", str(TREE), "--expect", str(written(tmp_path, f"{name}=={wanted}")), "-q"]) == 3
        (line,) = capsys.readouterr().out.splitlines()
        assert ": error: expect.value: " in line
        assert len(line) < len(str(TREE)) + 600


@pytest.mark.parametrize("source", ["/dev/zero", "/dev/null", "/proc/kcore", "."])
def test_expectations_must_be_a_regular_file_below_a_size(source: str, capsys: Capture) -> None:
    if not Path(source).exists():
        pytest.skip(f"there is no {source}")
    assert run(["inspect", str(TREE), "--expect", source]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert re.match(f"error: {source} (cannot be read: (it is a pipe|is a directory)|is larger than 16 MiB)", line)


@pytest.mark.parametrize("text", ["byte<=1", "{"])
def test_a_bad_file_of_expectations_fails_before_anything_is_read(text: str, tmp_path: Path, capsys: Capture) -> None:
    path = written(tmp_path, text)
    assert run(["inspect", str(TREE), "--expect", str(path)]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"error: {path}")
