"""Expectations of files, which are assertions about reports, and files of them."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest

from sparklod_cli.cli import run
from sparklod_cli.inspection.expectations import ExpectationError, check, parse, read
from sparklod_cli.inspection.report import NoFieldError, Report, ReportSettings, inspect
from sparklod_cli.system.errors import SparklodError
from tests.conftest import FIXTURES, Capture
from tests.inspection.expected import DEPTH, LEAVES, NODES, PLAIN, TREE, written


def codes(report: Report, *texts: str) -> list[str]:
    return [found.code for found in check(report, [parse(text) for text in texts])]


@pytest.mark.parametrize(
    ("left", "holds", "fails", "code"),
    [
        ("bytes<=", TREE.stat().st_size, TREE.stat().st_size - 1, "expect.bytes"),
        ("leaves>=", LEAVES, LEAVES + 1, "expect.splats"),
        ("leaves<=", LEAVES, LEAVES - 1, "expect.splats"),
        ("sh==", 0, 1, "expect.sh"),
        ("lod==", "true", "false", "expect.lod"),
        ("growth<=", NODES / LEAVES, 1.4, "expect.growth"),
        ("tree.depth==", DEPTH, 3, "expect.value"),
    ],
)
def test_each_expectation_of_a_tree_holds_or_gives_its_code(
    left: str, holds: object, fails: object, code: str, tree: Report, capsys: Capture
) -> None:
    assert codes(tree) == []
    assert codes(tree, f"{left}{holds}") == []
    assert codes(tree, f"{left}{fails}") == [code]
    assert run(["inspect", str(TREE), "--assert", f"{left}{holds}"]) == 0
    assert capsys.readouterr() == ("", f"{TREE}: OK: 9 nodes, no problems found\n")
    assert run(["inspect", str(TREE), "--assert", f"{left}{fails}"]) == 3
    out, err = capsys.readouterr()
    assert out.startswith(f"{TREE}: error: {code}: ")
    assert (out.count("\n"), err) == (1, "")


def test_each_expectation_of_plain_splats_holds_or_gives_its_code(plain: Report) -> None:
    for left, holds, fails, code in [
        ("leaves>=", 60, 61, "expect.splats"),
        ("leaves<=", 60, 59, "expect.splats"),
        ("sh==", 3, 2, "expect.sh"),
        ("lod==", "false", "true", "expect.lod"),
    ]:
        assert codes(plain, f"{left}{holds}") == []
        assert codes(plain, f"{left}{fails}") == [code]
    assert codes(plain, "growth<=9") == ["expect.growth"]  # there is none without a tree


def test_every_expectation_that_fails_is_reported(tree: Report) -> None:
    texts = ("bytes<=1", "leaves<=1", "sh==3", "lod==false", "growth<=1", "splats==1")
    found = check(tree, [parse(text) for text in texts])
    assert [each.code.removeprefix("expect.") for each in found] == ["bytes", "splats", "sh", "lod", "growth", "value"]
    assert found[1].message == "leaves<=1: leaves is 6"
    assert found[4].message == "growth<=1: growth is 1.5"
    assert found[5].message == "splats==1: splats is 9"


def test_an_unreadable_file_is_not_checked_further() -> None:
    report, scene = inspect(FIXTURES / "points.ply", ReportSettings())
    assert scene is None
    assert codes(report, "leaves>=1", "lod==true", "splats==3") == []


@pytest.mark.parametrize(
    ("way", "holds", "fails"),
    [
        ("format", '=="SPZ 3 LoD"', '=="SPZ 2 LoD"'),
        ("splats", f"=={NODES}", f"=={NODES + 1}"),
        ("antialiased", "==false", "==true"),
        ("tree.depth", f"=={DEPTH}", "==3"),
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
    (found,) = check(tree, [parse(way + fails)])
    assert found.code == "expect.value"
    assert found.message.startswith(f"{way}{fails}: {way} is ")


@pytest.mark.parametrize("way", ["format", "antialiased", "values.box", "tree.children"])
def test_a_minimum_of_a_value_that_is_not_a_number_fails(tree: Report, way: str) -> None:
    assert codes(tree, f"{way}>=0") == ["expect.value"]


@pytest.mark.parametrize("way", ["", "nothing", "tree.", "tree.levels.99", "tree.levels.x", "splats.0", "format.0"])
def test_a_path_that_the_report_has_not_is_an_error(tree: Report, way: str) -> None:
    with pytest.raises(NoFieldError, match=f"the report has no {way}"):
        tree.value_at(way)


def test_a_path_leads_to_a_value_of_the_report(tree: Report) -> None:
    plain = tree.as_dict()
    assert tree.value_at("tree.levels.0") == plain["tree"]["levels"][0]
    assert tree.value_at("tree.levels.2.leaves") == 5
    assert tree.value_at("tree.children.2") == 1
    assert tree.value_at("values.box.min.2") == 1.0
    assert tree.value_at("findings") is None


def test_leaves_can_be_those_of_another_file(tmp_path: Path, capsys: Capture) -> None:
    splats = tmp_path / "splats.spz"
    assert run(["convert", str(TREE), str(splats), "--leaves", "-q"]) == 0
    assert run(["inspect", str(TREE), "--leaves-of", str(splats)]) == 0
    assert capsys.readouterr().out == ""
    assert run(["inspect", str(TREE), "--leaves-of", str(PLAIN)]) == 3
    assert (
        capsys.readouterr().out
        == f"{TREE}: error: expect.leaves: 6 leaves, but 60 splats of the original can be drawn\n"
    )


@pytest.mark.parametrize("original", ["missing.ply", FIXTURES / "points.ply"])
def test_an_original_that_cannot_be_read_is_named(original: object, capsys: Capture) -> None:
    assert run(["inspect", str(TREE), "--leaves-of", str(original)]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"error: {original}: ")


def test_a_tree_can_be_required(capsys: Capture) -> None:
    assert run(["inspect", str(TREE), "--assert", "lod==true"]) == 0
    assert run(["inspect", str(TREE), str(PLAIN), "--assert", "lod==true"]) == 3
    assert capsys.readouterr().out == f"{PLAIN}: error: expect.lod: lod==true: lod is false\n"


def test_an_expectation_is_that_there_are_no_errors_either(capsys: Capture) -> None:
    broken, warned = (FIXTURES / "faults" / f"{name}.spz" for name in ("tree-orphan", "tree-single-child"))
    assert run(["inspect", str(broken), "--assert", "lod==true"]) == 3
    assert capsys.readouterr().out == f"{broken}: error: tree.orphan: node 9 has no parent\n"
    assert run(["inspect", str(warned), "--assert", "lod==true", "--fail-on", "warning"]) == 0
    assert capsys.readouterr().out == ""
    assert run(["inspect", str(warned), "--assert", "lod==true", "--check", "--fail-on", "warning"]) == 3
    assert "tree.single-child" in capsys.readouterr().out


def test_expected_values_are_computed_without_stats(tmp_path: Path, capsys: Capture) -> None:
    path = written(tmp_path, "values.quantities.sh1.max<=9\nvalues.box.min.0>=99\n")
    assert run(["inspect", str(PLAIN), "--expect", str(path)]) == 3
    said = "values.box.min.0>=99: values.box.min.0 is -"
    assert capsys.readouterr().out.startswith(f"{PLAIN}: error: expect.value: {said}")


def test_a_path_missing_in_one_file_does_not_stop_the_others(tmp_path: Path, capsys: Capture) -> None:
    path = written(tmp_path, "tree.depth==2")
    assert run(["inspect", str(PLAIN), str(TREE), "--expect", str(path)]) == 3
    out, err = capsys.readouterr()
    assert "the report has no tree.depth" in out
    assert f"{TREE}: OK: 9 nodes" in err


def test_a_file_has_an_assertion_a_line(tmp_path: Path, tree: Report) -> None:
    texts = ["nodes<5M", 'format=="SPZ 3 LoD"', "tree.growth<=1.5"]
    path = written(
        tmp_path, '\ufeff# of all trees\n\nnodes<5M\r\n  format=="SPZ 3 LoD"  \n  # tree.depth==9\ntree.growth<=1.5'
    )
    assert read(path) == [parse(text) for text in texts]
    assert check(tree, read(path)) == []
    assert read(written(tmp_path, "")) == read(written(tmp_path, "", "empty.toml")) == []


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
    with pytest.raises(ExpectationError, match="as TOML or JSON, which are no longer read") as caught:
        read(written(tmp_path, text, name))
    lines = "bytes<=1000, leaves>=1, leaves<=10, sh==0, lod==true, growth<=1.5"
    assert f"one a line: {lines}, NAME==VALUE" in str(caught.value)
    assert read(written(tmp_path, lines.replace(", ", "\n"), name))


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
        read(path)
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
        read(path)
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
