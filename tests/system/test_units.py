"""Quantities with units."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.system.units import (
    format_duration,
    parse_bandwidth,
    parse_count,
    parse_size,
    parse_time,
    percent_of,
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("20Mbit", 2.5e6),
        ("20Mbit/s", 2.5e6),
        ("20Mbps", 2.5e6),
        ("20 MBit", 2.5e6),  # a word, of any case
        (" 20 Mbits ", 2.5e6),
        ("2.5MB/s", 2.5e6),
        ("2.5MBps", 2.5e6),
        ("2.5 Mbytes/s", 2.5e6),
        ("800Kbit", 1e5),
        ("1Gbit", 1.25e8),
        ("8b", 1.0),
        ("8B", 8.0),
        (".5kB", 500.0),
        ("1e3bit", 125.0),
        ("1MiB/s", 1 << 20),
        ("8Kibit", 1024.0),
        ("1Tbit", 1.25e11),
    ],
)
def test_bandwidths_are_bytes_a_second(text: str, expected: float) -> None:
    assert parse_bandwidth(text) == expected


@pytest.mark.parametrize(
    ("text", "expected"), [("60ms", 0.06), ("0ms", 0.0), ("0.1s", 0.1), ("2 s", 2.0), (" 1e2ms", 0.1)]
)
def test_times_are_seconds(text: str, expected: float) -> None:
    assert parse_time(text) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0", 0),
        ("500K", 500_000),
        ("1.5M", 1_500_000),
        ("1.234567M", 1_234_567),
        ("0.001k", 1),
        ("2 G", 2_000_000_000),
        ("1e6", 1_000_000),
        ("9007199254740993", 9_007_199_254_740_993),  # not a float
    ],
)
def test_counts_may_have_the_units_k_m_and_g(text: str, expected: int) -> None:
    assert parse_count(text) == expected


@pytest.mark.parametrize("space", ["", " ", "  "])
@pytest.mark.parametrize("unit", ["", "B", "b", "bytes"])
@pytest.mark.parametrize(
    ("prefix", "factor"),
    [
        *(("", 1), ("k", 1e3), ("K", 1e3), ("M", 1e6), ("m", 1e6), ("G", 1e9), ("g", 1e9), ("T", 1e12)),
        *(("ki", 1 << 10), ("Ki", 1 << 10), ("Mi", 1 << 20), ("GI", 1 << 30), ("Ti", 1 << 40)),
    ],
)
def test_sizes_are_bytes(prefix: str, factor: float, unit: str, space: str) -> None:
    assert parse_size(f"600{space}{prefix}{unit}") == 600 * factor


#: Texts that are nothing, and for each parser others that it refuses, with what its error says.
BAD = ["", "k", "Mbit", "-1", "-5ms", "-20Mbit", "nan", "inf", "1e999", "1,00", "٣", "1 2", "0x10", "a\nb"]
REFUSED = {
    parse_bandwidth: ("bandwidth", ["20", "20M", "0Mbit", "0.0B/s", "20ibit", "20iB/s", "20Mbit/h", "20Pbit"]),
    parse_time: ("is not a time", ["60", "0", "60us", "60 m", "infs", "60m s"]),
    parse_count: ("is not a count", ["1.5", "1.2345k", "500kk", "500ki", "9" * 40, "1e-1"]),
    parse_size: ("is not a size", ["1.5", "4i", "4iB", "4Gx", "4 G B", "1e-9M"]),
}


@pytest.mark.parametrize("parse", REFUSED)
def test_other_texts_are_refused_in_one_line(parse: Callable[[str], float]) -> None:
    said, more = REFUSED[parse]
    for text in [*BAD, *more]:
        with pytest.raises(ValueError, match=said) as caught:
            parse(text)
        assert "\n" not in str(caught.value)


@given(text=st.text(max_size=12) | st.from_regex(r"[0-9.eE+-]{1,8}[kKmMgGbBits/]{0,6}", fullmatch=True))
@pytest.mark.parametrize("parse", [parse_bandwidth, parse_time, parse_count, parse_size])
def test_any_text_is_understood_or_refused(parse: Callable[[str], float], text: str) -> None:
    with contextlib.suppress(ValueError):
        assert parse(text) >= 0


@pytest.mark.parametrize(
    ("share", "digits", "text"),
    [
        (0.123456, 3, "12.3 %"),
        (0.995, 2, "100 %"),
        (0.99949, 3, "99.9 %"),
        (1.0, 3, "100 %"),
        (12.5, 3, "1,250 %"),
        (2e-7, 3, "0.00002 %"),
        (0.0, 3, "0 %"),
        (0.5, 2, "50 %"),
    ],
)
def test_shares_have_no_exponent(share: float, digits: int, text: str) -> None:
    assert percent_of(share, digits) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "0 s"),
        (12.4, "12 s"),
        (59.9, "1 min"),
        (742, "12 min"),
        (3599, "1 h 0 min"),
        (11_100, "3 h 5 min"),
    ],
)
def test_durations_are_in_the_unit_that_fits(seconds: float, text: str) -> None:
    assert format_duration(seconds) == text
