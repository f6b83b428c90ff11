"""What `sparklod inspect` prints for scripts: JSON and fields."""

from __future__ import annotations

import pytest

from tests.commands.inspect.runs import BROKEN, MISSING, PLAIN, TREE, inspect, records
from tests.conftest import Capture


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
