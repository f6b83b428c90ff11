"""JSON and TOML of strangers: a value that can be worked with, or a ValueError of one line."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.system.untrusted import MAX_DEPTH, parse_json, quoted_value, well_formed

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


def nested(depth: int, opening: str, closing: str, inner: str = "1") -> str:
    return opening * depth + inner + closing * depth


@pytest.mark.parametrize(("opening", "closing"), [("[", "]"), ('{"a":', "}"), ('[{"a":', "}]")])
def test_json_nested_more_than_64_deep_is_refused(opening: str, closing: str) -> None:
    each = opening.count("[") + opening.count("{")
    repr(parse_json(nested(MAX_DEPTH // each, opening, closing)))
    for depth in (MAX_DEPTH // each + 1, 900, 3000, 100_000):
        with pytest.raises(ValueError, match="it is nested more than 64 deep"):
            parse_json(nested(depth, opening, closing))


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
