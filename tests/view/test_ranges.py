"""The Range header, against RFC 9110, section 14.1.2."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.view.ranges import Span, span_of

SIZE = 10_000


@pytest.mark.parametrize(
    ("text", "first", "count"),
    [
        ("bytes=0-499", 0, 500),
        ("bytes=500-999", 500, 500),
        ("bytes=-500", 9500, 500),
        ("bytes=9500-", 9500, 500),
        ("bytes=0-0", 0, 1),
        ("bytes=-1", 9999, 1),
        ("bytes=9999-123456", 9999, 1),
        ("bytes=-123456", 0, SIZE),
        ("BYTES = 5 - 7 ", 5, 3),
        ("bytes=000-0001", 0, 2),
    ],
)
def test_the_examples_of_the_standard(text: str, first: int, count: int) -> None:
    assert span_of(text, SIZE) == Span(first, count)


@pytest.mark.parametrize("text", ["bytes=10000-", "bytes=10000-10001", "bytes=-0", f"bytes={'9' * 5000}-"])
def test_a_range_of_nothing_has_no_bytes(text: str) -> None:
    span = span_of(text, SIZE)
    assert span is not None
    assert span.count == 0


@pytest.mark.parametrize(
    "text",
    [
        None,
        "",
        "bytes",
        "bytes=",
        "bytes=-",
        "bytes=5-4",
        "bytes=a-b",
        "items=0-5",
        "bytes=0-4,6-7",
        "bytes=\u0661-\u0662",
    ],
)
def test_what_is_no_single_range_is_ignored(text: str | None) -> None:
    assert span_of(text, SIZE) is None


@given(size=st.integers(0, 50), first=st.integers(0, 60), last=st.integers(0, 60), kind=st.sampled_from("ftx"))
def test_it_is_what_python_slices(size: int, first: int, last: int, kind: str) -> None:
    data = bytes(range(size))
    if kind == "f":
        text, wanted = f"bytes={first}-", data[first:]
    elif kind == "t":
        text, wanted = f"bytes=-{last}", data[max(0, size - last) :]
    elif first <= last:
        text, wanted = f"bytes={first}-{last}", data[first : last + 1]
    else:
        return
    span = span_of(text, size)
    assert span is not None
    assert data[span.first : span.first + span.count] == wanted
