"""Files of expectations: how they are read, and what is refused."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from sparklod_cli.cli import run
from sparklod_cli.inspection.expectations import ExpectationError, Expectations, check, read
from sparklod_cli.inspection.report import Report
from sparklod_cli.support.errors import SparklodError
from tests.conftest import Capture
from tests.inspection.expected import TREE, written

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
