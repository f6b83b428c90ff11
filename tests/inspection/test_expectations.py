"""Expectations, and files of them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from sparklod_cli.cli import run
from sparklod_cli.inspection.expectations import ExpectationError, Expectations, check, read
from sparklod_cli.inspection.report import NoFieldError, Report, ReportSettings, inspect
from sparklod_cli.system.errors import SparklodError
from tests.conftest import FIXTURES, Capture
from tests.inspection.expected import DEPTH, LEAVES, NODES, PLAIN, TREE, written


def codes(report: Report, **expected: Any) -> list[str]:
    return [found.code for found in check(report, Expectations(**expected))]


def test_each_expectation_of_a_tree_holds_or_gives_its_code(tree: Report) -> None:
    size = TREE.stat().st_size
    assert codes(tree) == []
    for name, holds, fails, code in [
        ("max_bytes", size, size - 1, "expect.bytes"),
        ("min_splats", LEAVES, LEAVES + 1, "expect.splats"),
        ("max_splats", LEAVES, LEAVES - 1, "expect.splats"),
        ("sh", 0, 1, "expect.sh"),
        ("lod", True, False, "expect.lod"),
        ("max_growth", NODES / LEAVES, 1.4, "expect.growth"),
    ]:
        assert codes(tree, **{name: holds}) == []
        assert codes(tree, **{name: fails}) == [code]


def test_each_expectation_of_plain_splats_holds_or_gives_its_code(plain: Report) -> None:
    for name, holds, fails, code in [
        ("min_splats", 60, 61, "expect.splats"),
        ("max_splats", 60, 59, "expect.splats"),
        ("sh", 3, 2, "expect.sh"),
        ("lod", False, True, "expect.lod"),
    ]:
        assert codes(plain, **{name: holds}) == []
        assert codes(plain, **{name: fails}) == [code]
    assert codes(plain, max_growth=9.0) == ["expect.growth"]  # there is none without a tree


def test_every_expectation_that_fails_is_reported(tree: Report) -> None:
    expected = {"max_bytes": 1, "max_splats": 1, "sh": 3, "lod": False, "max_growth": 1, "values": {"splats": 1}}
    found = check(tree, Expectations(**expected))
    assert [each.code.removeprefix("expect.") for each in found] == ["bytes", "splats", "sh", "lod", "growth", "value"]
    assert found[1].message == "leaves<=1: leaves is 6"
    assert found[4].message == "growth<=1: growth is 1.5"
    assert found[5].message == "splats==1: splats is 9"


def test_an_unreadable_file_is_not_checked_further() -> None:
    report, scene = inspect(FIXTURES / "points.ply", ReportSettings())
    assert scene is None
    assert codes(report, min_splats=1, lod=True, values={"splats": 3}) == []


@pytest.mark.parametrize(
    ("way", "holds", "fails"),
    [
        ("format", "SPZ 3 LoD", "SPZ 2 LoD"),
        ("splats", NODES, NODES + 1),
        ("antialiased", False, True),
        ("tree.depth", DEPTH, 3),
        ("tree.levels.1.nodes", 3, 4),
        ("tree.children", {"min": 0}, None),
        ("tree.children.3", 2, 1),
        ("header.fractional_bits", 12, 13),
        ("values.non_finite", 0, 1),
        ("values.box.max.0", 4.0, 4.1),
        ("values.quantities.opacity.max", {"max": 4.0}, {"max": 0.5}),
        ("tree.growth", {"min": 1.5}, {"min": 1.51}),
        ("tree.growth", {"min": 1.2, "max": 1.8}, {"min": 1.2, "max": 1.4}),
        ("tree.growth", {"max": 2}, {"max": 1}),
        ("notes", [], ["SH degree 4 is cut to 3"]),
    ],
)
def test_values_of_the_report_are_met_or_give_a_finding(tree: Report, way: str, holds: Any, fails: Any) -> None:
    if way == "tree.children":  # a table has no least and no most
        assert codes(tree, values={way: holds}) == ["expect.value"]
        return
    assert codes(tree, values={way: holds}) == []
    (found,) = check(tree, Expectations(values={way: fails}))
    assert found.code == "expect.value"
    ends = {"min": ">=", "max": "<="}
    asked = [f"{ends[end]}{most}" for end, most in fails.items()] if isinstance(fails, dict) else []
    assert found.message.startswith(tuple(f"{way}{each}: {way} is " for each in asked or [f"=={json.dumps(fails)}"]))


def test_a_minimum_of_a_value_that_is_not_a_number_fails(tree: Report) -> None:
    for way in ("format", "antialiased", "values.box"):
        assert codes(tree, values={way: {"min": 0}}) == ["expect.value"]


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


OPTIONS = [
    (["--max-bytes", TREE.stat().st_size], ["--max-bytes", 10], "expect.bytes"),
    (["--min-splats", LEAVES], ["--min-splats", NODES], "expect.splats"),
    (["--max-splats", LEAVES], ["--max-splats", 1], "expect.splats"),
    (["--sh", 0], ["--sh", 3], "expect.sh"),
    (["--max-growth", 1.5], ["--max-growth", 1.49], "expect.growth"),
]


@pytest.mark.parametrize(("holds", "fails", "code"), OPTIONS, ids=[option[0][0] for option in OPTIONS])
def test_every_option_passes_and_fails_with_its_code(
    holds: list[Any], fails: list[Any], code: str, capsys: Capture
) -> None:
    assert run(["inspect", str(TREE), *map(str, holds)]) == 0
    out, err = capsys.readouterr()
    assert (out, err) == ("", f"{TREE}: OK: 9 nodes, no problems found\n")
    assert run(["inspect", str(TREE), *map(str, fails)]) == 3
    out, err = capsys.readouterr()
    assert out.startswith(f"{TREE}: error: {code}: ")
    assert (out.count("\n"), err) == (1, "")


def test_leaves_can_be_those_of_another_file(tmp_path: Path, capsys: Capture) -> None:
    splats = tmp_path / "splats.spz"
    assert run(["build-lod", "--unlod", str(TREE), "-o", str(splats), "-q"]) == 0
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
    assert run(["inspect", str(TREE), "--require-lod"]) == 0
    assert run(["inspect", str(TREE), str(PLAIN), "--require-lod"]) == 3
    assert capsys.readouterr().out == f"{PLAIN}: error: expect.lod: lod==true: lod is false\n"


def test_options_win_over_the_file(tmp_path: Path, capsys: Capture) -> None:
    path = written(tmp_path, '{"max_splats": 1, "sh": 0, "values": {"tree.depth": 2}}')
    assert run(["inspect", str(TREE), "--expect", str(path)]) == 3
    assert run(["inspect", str(TREE), "--expect", str(path), "--max-splats", "6"]) == 0
    assert run(["inspect", str(TREE), "--expect", str(path), "--max-splats", "6", "--sh", "2"]) == 3
    assert "expect.sh" in capsys.readouterr().out


def test_an_expectation_is_that_there_are_no_errors_either(capsys: Capture) -> None:
    broken, warned = (FIXTURES / "faults" / f"{name}.spz" for name in ("tree-orphan", "tree-single-child"))
    assert run(["inspect", str(broken), "--require-lod"]) == 3
    assert capsys.readouterr().out == f"{broken}: error: tree.orphan: node 9 has no parent\n"
    assert run(["inspect", str(warned), "--require-lod", "--fail-on", "warning"]) == 0
    assert capsys.readouterr().out == ""
    assert run(["inspect", str(warned), "--require-lod", "--check", "--fail-on", "warning"]) == 3
    assert "tree.single-child" in capsys.readouterr().out


def test_expected_values_are_computed_without_stats(tmp_path: Path, capsys: Capture) -> None:
    path = written(tmp_path, '{"values": {"values.quantities.sh1.max": {"max": 9}, "values.box.min.0": {"min": 99}}}')
    assert run(["inspect", str(PLAIN), "--expect", str(path)]) == 3
    said = "values.box.min.0>=99: values.box.min.0 is -"
    assert capsys.readouterr().out.startswith(f"{PLAIN}: error: expect.value: {said}")


def test_a_path_missing_in_one_file_does_not_stop_the_others(tmp_path: Path, capsys: Capture) -> None:
    path = written(tmp_path, '{"values": {"tree.depth": 2}}')
    assert run(["inspect", str(PLAIN), str(TREE), "--expect", str(path)]) == 3
    out, err = capsys.readouterr()
    assert "the report has no tree.depth" in out
    assert f"{TREE}: OK: 9 nodes" in err


EVERY = Expectations(
    max_bytes=1000,
    min_splats=1,
    max_splats=10,
    sh=0,
    lod=True,
    max_growth=1.5,
    values={"tree.depth": 2, "tree.growth": {"min": 1, "max": 1.5}, "format": "SPZ 3 LoD"},
    asserts=("nodes<5M", 'format=="SPZ 3 LoD"'),
)
AS_TOML = """
max_bytes = 1000
min_splats = 1
max_splats = 10
sh = 0
lod = true
max_growth = 1.5
assert = ["nodes<5M", 'format=="SPZ 3 LoD"']

[values]
"tree.depth" = 2
"tree.growth" = { min = 1, max = 1.5 }
format = "SPZ 3 LoD"
"""


def test_every_key_is_read_from_json_and_toml(tmp_path: Path, tree: Report) -> None:
    keys = {"assert" if name == "asserts" else name: value for name, value in vars(EVERY).items()}
    as_json = written(tmp_path, json.dumps(keys))
    as_toml = written(tmp_path, AS_TOML, "expect.TOML")
    assert read(as_json) == read(as_toml) == EVERY
    assert check(tree, EVERY) == []
    assert read(written(tmp_path, "{}")) == read(written(tmp_path, "", "empty.toml")) == Expectations()


def test_tables_of_toml_lead_to_values_as_dots_do(tmp_path: Path, tree: Report) -> None:
    """`tree.depth = 2` without quotes is a table of a table, which one easily writes."""
    path = written(tmp_path, "[values]\ntree.depth = 2\ntree.growth.max = 1.5\n", "expect.toml")
    assert check(tree, read(path)) == []
    path = written(tmp_path, "[values.tree]\ndepth = 3\n", "expect.toml")
    assert [found.message for found in check(tree, read(path))] == ["tree.depth==3: tree.depth is 2"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"max_byte": 1}', "max_byte is not one of max_bytes"),
        ('{"require_lod": true}', "require_lod is not one of"),
        ('{"max_bytes": "1"}', "max_bytes cannot be '1'"),
        ('{"max_bytes": 1.5}', "max_bytes cannot be 1.5"),
        ('{"max_bytes": true}', "max_bytes cannot be True"),
        ('{"max_bytes": null}', "max_bytes cannot be None"),
        ('{"sh": [0]}', "sh cannot be"),
        ('{"lod": 1}', "lod cannot be 1"),
        ('{"lod": "yes"}', "lod cannot be 'yes'"),
        ('{"max_growth": "1.5"}', "max_growth cannot be"),
        ('{"max_growth": NaN}', "max_growth cannot be"),
        ('{"max_bytes": -1}', "max_bytes cannot be -1"),
        ('{"values": {"tree.depth": {}}}', "tree.depth"),
        ('{"values": {"tree.depth": {"min": 1, "most": 2}}}', "tree.depth"),
        ('{"values": {"tree.depth": {"min": "9"}}}', "tree.depth"),
        ('{"values": {"tree.depth": {"max": null}}}', "tree.depth"),
        ('{"values": {"tree.depth": {"max": [1]}}}', "tree.depth"),
        ('{"values": {"tree.depth": {"max": true}}}', "tree.depth"),
        ('{"values": {"tree.depth": {"max": NaN}}}', "tree.depth"),
        ('{"values": ["tree.depth"]}', "values cannot be"),
        ('{"assert": "nodes<5"}', "assert cannot be 'nodes<5'"),
        ('{"assert": [5]}', "assert cannot hold 5"),
        ('{"assert": ["nodes<"]}', "'nodes<' is not an assertion like 'nodes<=5M'"),
        ('{"assert": ["node<5"]}', "there is no 'node' in a report, did you mean nodes"),
        ("[]", "is not a table of expectations"),
        ("3", "is not a table of expectations"),
        ("", "is not what it is called"),
        ("{", "is not what it is called"),
        ("max_bytes = 3", "is not what it is called"),
        ("[" * 100_000, "is not what it is called"),
        (f'{{"max_bytes": {"9" * 5000}}}', "max_bytes cannot be 1.79"),
        (f'{{"max_growth": -1{"0" * 4000}}}', "max_growth cannot be -1.79"),
        ('{"max_growth": 1e999}', "max_growth cannot be inf"),
        (f'{{"sh": 1{"0" * 400}}}', "sh cannot be 1.79"),
        ('{"values": ' + '{"a":' * 3000 + "1" + "}" * 3001, "nested more than"),
        ('{"values": ' + '{"a":' * 900 + "1" + "}" * 901, "nested more than"),
        ('{"values": {"' + "x" * 100_000 + '": {}}}', "xxx"),
        (f'{{"{"x" * 100_000}": 1}}', "xxx"),
        ('{"sh": "' + "\\u001b" * 100_000 + '"}', "sh cannot be"),
    ],
)
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
    path = tmp_path / "expect.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SparklodError) as caught:
        read(path)
    assert str(path) in str(caught.value)


def test_bad_toml_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ExpectationError, match="not what it is called"):
        read(written(tmp_path, '{"max_bytes": 1}', "expect.toml"))


@pytest.mark.parametrize(
    "text",
    [
        f"max_bytes = {'9' * 5000}",
        f"max_bytes = 0x{'f' * 5000}",
        "[values]\n" + ".".join("a" * 3000) + " = 1",
        "values = " + "[" * 3000 + "]" * 3000,
        f"max_growth = 1{'0' * 4000}",
        f"max_growth = {'9' * 4000}.5",
    ],
)
def test_hostile_toml_is_an_error_of_one_line(text: str, tmp_path: Path, capsys: Capture) -> None:
    path = written(tmp_path, text, "expect.toml")
    assert run(["inspect", str(TREE), "--expect", str(path)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {path}")
    assert len(line) < len(str(path)) + 600


@pytest.mark.parametrize(
    "wanted", ["9" * 5000, "1" + "0" * 4000, "1e999", "NaN", '"\\ud800"', '["' + "x" * 10**5 + '"]']
)
def test_odd_values_are_not_met_and_no_error(wanted: str, tmp_path: Path, capsys: Capture) -> None:
    for text in (f'{{"values": {{"splats": {wanted}}}}}', f'{{"values": {{"tree.levels": {wanted}}}}}'):
        assert run(["inspect", str(TREE), "--expect", str(written(tmp_path, text)), "-q"]) == 3
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


def test_a_date_equals_no_value(tmp_path: Path, tree: Report) -> None:
    """TOML has them, the report and JSON have not."""
    for text in ("format = 2026-11-21", "format = [2026-11-21]", "splats = 12:00:00"):
        path = written(tmp_path, f"[values]\n{text}\n", "expect.toml")
        with pytest.raises(ExpectationError, match=r"format|splats"):
            check(tree, read(path))


@pytest.mark.parametrize("text", ['{"max_byte": 1}', "{"])
def test_a_bad_file_of_expectations_fails_before_anything_is_read(text: str, tmp_path: Path, capsys: Capture) -> None:
    path = written(tmp_path, text)
    assert run(["inspect", str(TREE), "--expect", str(path)]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"error: {path}")
