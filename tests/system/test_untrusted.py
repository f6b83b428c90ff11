"""Texts and JSON from outside: nothing acts on a terminal or a CI log, and whatever is parsed can be worked with."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.cli import run
from sparklod_cli.commands.console import for_screen
from sparklod_cli.system.untrusted import MAX_DEPTH, MOST, parse_json, printable, quoted_value, shortened, well_formed
from tests.conftest import FIXTURES

TREE, PLAIN = FIXTURES / "golden" / "tree-v3.spz", FIXTURES / "one.ply"
LOOK = ("--look-at", "0,-1,4:0,0,0")
Said = pytest.CaptureFixture[str]

#: Any text, with half surrogate pairs, and what is looked for more often than chance would have it.
TEXTS = st.lists(st.one_of(st.text(st.characters()), st.sampled_from(["::", "##[", "\x1b[2J", "\u202e", "\udce9"])))

EVIL = {
    "escape": "a\x1b[31m\x9b2Jb",
    "line": "a\n::error::b",
    "command": "::error::b",
    "old command": "##[error]b",
    "return": "a\r\bb",
    "direction": "a\u202eb\u2066",
    "bytes": os.fsdecode(b"caf\xe9"),
    "long": "n" * 240,
}


@given(TEXTS.map("".join), st.none() | st.integers(40, 200))
def test_printable_text_is_one_line_without_commands(text: str, most: int | None) -> None:
    shown = printable(text, most)
    assert shown.isprintable()
    shown.encode()
    assert "##[" not in shown
    assert not shown.lstrip().startswith("::")
    assert most is None or len(shown) <= most
    assert printable(shown, most) == shown


@given(st.text(st.characters(codec="ascii", exclude_categories=["Cc"])).filter(lambda text: not set(text) & set("#:")))
def test_plain_text_stays_as_it_is(text: str) -> None:
    assert printable(text) == text


def test_control_characters_are_spelt_as_in_python_and_long_texts_keep_both_ends() -> None:
    assert printable("a\n\x1b\x9b\u202e\U000e0001\udce9é 漢") == r"a\n\x1b\x9b\u202e\U000e0001\xe9é 漢"
    short = shortened("begin" + "x" * 10_000 + "end", 100)
    assert (len(short), short[:5], short[-3:]) == (100, "begin", "end")


def is_harmless(text: str) -> bool:
    lines = text.split("\n")
    return all(
        line.isprintable() and not line.lstrip().startswith("::error::b") and "##[" not in line for line in lines
    )


@pytest.mark.skipif(sys.platform != "linux", reason="names of any bytes are of Linux")
@pytest.mark.parametrize("name", EVIL)
def test_no_command_prints_a_file_name_raw(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Said
) -> None:
    monkeypatch.chdir(tmp_path)
    evil = EVIL[name]
    Path(f"{evil}.spz").write_bytes(TREE.read_bytes())
    Path(f"{evil}.ply").write_bytes(PLAIN.read_bytes())
    Path(f"{evil}.json").write_text("{")
    tree, plain, broken, missing = f"{evil}.spz", f"{evil}.ply", f"{evil}.json", f"{evil}.no"
    for arguments, status in (
        (["build-lod", plain], 0),
        (["build-lod", plain], 1),  # exists
        (["build-lod", missing, "--json"], 1),
        (["build-lod", plain, f"--{evil}"], 2),
        (["build-lod", plain, "--method", evil], 2),
        (["build-lod", plain, "-o", f"out.{evil}"], None),
        (["build-lod", plain, "-o", f"{plain}/{evil}.spz"], 1),  # under a file
        (["inspect", tree], 0),
        (["inspect", tree, "--json"], 0),
        (["inspect", tree, "--field", "file"], 0),
        (["inspect", missing], 1),
        (["inspect", missing, tree, "--check"], 3),
        (["inspect", tree, "--expect", broken], 1),
        (["traverse", tree, *LOOK, "-v", "--summary"], 0),
        (["traverse", missing, *LOOK], 1),
        (["traverse", tree, "--camera-path", broken], 1),
        (["traverse", "--scene", broken, *LOOK], 1),
        (["render", missing, *LOOK], 1),
        (["render", tree, *LOOK, "-o", f"{evil}.tiff"], 2),
        (["render", tree, *LOOK, "--size", "8x8"], 0),
    ):
        found = run(arguments)
        out, err = capsys.readouterr()
        assert status is None or found == status, (arguments, out, err)
        assert is_harmless(out) if "--json" not in arguments else out[:-1].isprintable(), (arguments, out)
        assert is_harmless(err), (arguments, err)
        assert all(len(line) <= MOST + 20 for line in err.split("\n")), arguments


def test_a_file_name_cannot_start_another_annotation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Said
) -> None:
    monkeypatch.chdir(tmp_path)
    for evil in EVIL.values():
        assert run(["inspect", f"{evil}.no", "--check", "--format", "github"]) == 3
        out = capsys.readouterr().out
        assert out.count("\n") == 1
        assert out.startswith("::error file=")
        assert out[:-1].isprintable()


def test_tables_for_a_screen_have_no_control_characters() -> None:
    pieces = [b"frame,name\n", "0,\x1b[2Ja\rb\n1,\u202e\n".encode()]
    assert b"".join(for_screen(pieces)) == b"frame,name\n0,\\x1b[2Ja\\rb\n1,\\u202e\n"


# --- JSON -------------------------------------------------------------------------------------------------------------

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**18), 10**18) | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)

#: Texts as JSON may spell them: with halves of surrogate pairs.
ANY_TEXT = st.text(st.characters(min_codepoint=0xD000, max_codepoint=0xE0FF, exclude_categories=()))


@given(VALUES)
def test_valid_json_is_read_as_by_python(value: Any) -> None:
    assert parse_json(json.dumps(value)) == value
    assert parse_json(json.dumps(value, ensure_ascii=False).encode()) == value


@pytest.mark.parametrize(("opening", "closing"), [("[", "]"), ('{"a":', "}"), ('[{"a":', "}]")])
def test_json_nested_more_than_64_deep_is_refused(opening: str, closing: str) -> None:
    each = opening.count("[") + opening.count("{")
    most = MAX_DEPTH // each
    repr(parse_json(opening * most + "1" + closing * most))
    for depth in (most + 1, 900, 3000, 100_000):
        with pytest.raises(ValueError, match="it is nested more than 64 deep"):
            parse_json(opening * depth + "1" + closing * depth)


@pytest.mark.parametrize("digits", ["9" * 20, "9" * 5000, "-" + "9" * 5000, "1" + "0" * 4000])
def test_numbers_of_too_many_digits_are_floats(digits: str) -> None:
    """Arithmetic with whole numbers of thousands of digits would take long."""
    for value in parse_json(f'[{digits}, {{"a": {digits}}}]'):
        assert isinstance(value["a"] if isinstance(value, dict) else value, float)


@given(st.recursive(ANY_TEXT, lambda inner: st.lists(inner) | st.dictionaries(ANY_TEXT, inner), max_leaves=9))
def test_texts_can_be_written(value: Any) -> None:
    json.dumps(parse_json(json.dumps(value)), ensure_ascii=False).encode()


def test_surrogates_can_be_kept() -> None:
    assert parse_json(r'{"\ud800": ["a\udcff.spz", "\ud83d\ude00"]}') == {"\ufffd": ["a\ufffd.spz", "\U0001f600"]}
    assert parse_json(r'["a\udcff.spz"]', keep_surrogates=True) == ["a\udcff.spz"]
    assert parse_json('["a\ud800"]') == ["a\ufffd"]


@pytest.mark.parametrize(
    "data", [b"\xff\xfe{\x00", b"\xff\xfe{\x00}", b'"\xed\xa0\x80"', b"", b"{", b"[1,]", "\ufeff", "\0"]
)
def test_invalid_json_is_a_value_error_of_one_line(data: str | bytes) -> None:
    with pytest.raises(ValueError) as caught:
        parse_json(data)
    assert "\n" not in str(caught.value)


def test_a_byte_order_mark_is_no_harm() -> None:
    assert parse_json(b'\xef\xbb\xbf{"a": 1}') == {"a": 1}


def test_quoted_values_are_short() -> None:
    deep: list[Any] = []
    for _ in range(100_000):
        deep = [deep]
    for value in (deep, "x" * 10**6, ["\x1b[2J" * 99] * 99, {"a" * 999: [1e300] * 999}):
        assert len(quoted_value(value)) <= 100
        assert quoted_value(value).isprintable()
    assert quoted_value("a.spz") == "'a.spz'"
    assert well_formed("a\ud800b") == "a\ufffdb"
