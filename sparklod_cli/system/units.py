"""Parse bandwidths, times, sizes and counts with units; format numbers for messages."""

from __future__ import annotations

import math
import re

#: Factors of prefixes, whose case does not matter: m cannot mean a thousandth of a bit.
PREFIXES = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}
PREFIXES |= {"ki": 1 << 10, "mi": 1 << 20, "gi": 1 << 30, "ti": 1 << 40}

NUMBER = r"(?P<number>(?:[0-9]{1,30}(?:\.[0-9]{0,30})?|\.[0-9]{1,30})(?:[eE][+-]?[0-9]{1,2})?)\s*"
PREFIX = r"(?P<prefix>(?:[kKmMgGtT][iI]?)?)"
COUNT = rf"{NUMBER}(?P<prefix>[kKmMgGtT]?)"
SIZE = rf"{NUMBER}{PREFIX}(?i:B|bytes?)?"
TIME = rf"{NUMBER}(?P<unit>ms|s)"
BANDWIDTH = rf"{NUMBER}{PREFIX}(?P<unit>(?i:bits?|bytes?)|b|B)(?:/s|ps)?"

#: Digits in groups of three, whose separator means a decimal point in other countries.
GROUPED = re.compile(r"[0-9]{1,3}(?:([.,'_ \u00a0\u2019\u202f])[0-9]{3})(?:\1[0-9]{3})*")


def count_of(count: int, noun: str, plural: str | None = None) -> str:
    """Return a count with its noun: "1 node", "1,234 nodes", or "2 leaves" with this plural."""
    return f"{count:,} {noun if count == 1 else plural or noun + 's'}"


def percent_of(share: float, digits: int = 3) -> str:
    """Return a share as a percentage with this many significant digits and no exponent: "12.3 %"."""
    text = f"{float(f'{100 * share:.{digits}g}'):,.9f}"
    return f"{text.rstrip('0').rstrip('.')} %"


def format_size(size: float) -> str:
    """Return a number of bytes in units of powers of 1000: "12.3 GB", "2.9 MB", "0.1 MB" or "2.0 kB"."""
    for name, power, least in (("GB", 1e9, 1e9), ("MB", 1e6, 1e5)):
        if size >= least:
            return f"{size / power:,.1f} {name}"
    return f"{size / 1e3:.1f} kB"


def megabytes(size: float) -> str:
    """Return a number of bytes, rounded up, as a value for --memory: "224MB"."""
    return f"{math.ceil(size / 1e6)}MB"


def format_duration(seconds: float) -> str:
    """Return a time as "12 s", "12 min" or "3 h 5 min"."""
    if round(seconds) < 60:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def parse_bandwidth(text: str) -> float:
    """Parse a bandwidth such as 20Mbit, 20Mbit/s, 20Mbps (bits) or 2.5MB/s, 2.5MBps, 2.5Mbyte (bytes) to bytes/s.

    The letter b is a bit and B a byte; the case of words does not matter. k, M, G and T are powers of 1000, or of 1024
    with an i. Other texts, and a bandwidth of 0, raise `ValueError`.
    """
    match = re.fullmatch(BANDWIDTH, text.strip())
    if match is None:
        raise ValueError(
            f"{text!r} is not a bandwidth: a number and a unit, such as 20Mbit (bits/s) or 2.5MB/s (bytes/s)"
        )
    value = float(match["number"]) * PREFIXES[match["prefix"].lower()]
    if not value > 0:
        raise ValueError(f"{text!r} is not a bandwidth above 0")
    unit = match["unit"]
    return value if unit == "B" or unit.lower().startswith("byte") else value / 8


def parse_time(text: str) -> float:
    """Parse a time such as 60ms or 0.1s to seconds; raise `ValueError` for other texts.

    A number without a unit is an error: some tools mean seconds by it, others milliseconds.
    """
    match = re.fullmatch(TIME, text.strip())
    if match is None:
        raise ValueError(f"{text!r} is not a time: a number, 0 or more, and a unit, such as 60ms or 0.1s")
    value = float(match["number"])
    return value / 1000 if match["unit"] == "ms" else value


def parse_count(text: str) -> int:
    """Parse a whole number such as 65536, 500k or 1.5M, with powers of 1000; raise `ValueError` for other texts."""
    return _whole(COUNT, text, "is not a count: a whole number, such as 500000, 500k or 1.5M")


def parse_size(text: str) -> int:
    """Parse a number of bytes such as 3000000, 3M, 3 MB or 3MiB; raise `ValueError` for other texts."""
    return _whole(SIZE, text, "is not a size: whole bytes, such as 3000000, 3MB or 3MiB")


def check_grouping(text: str) -> None:
    """Raise `ValueError` for digits in groups, such as 500.000 or 500,000, which may mean 500 as well."""
    if GROUPED.fullmatch(text.strip()):
        digits = re.sub("[^0-9]", "", text)
        also = f" or {digits[:-3]}k" if digits.endswith("000") else ""
        raise ValueError(f"{text!r} has digits in groups; did you mean {digits}{also}?")


def _whole(pattern: str, text: str, otherwise: str) -> int:
    from fractions import Fraction  # takes milliseconds to load, and every command loads this module

    check_grouping(text)
    match = re.fullmatch(pattern, text.strip())
    value = Fraction(match["number"]) * PREFIXES[match["prefix"].lower()] if match else Fraction(-1, 2)
    if value.denominator != 1:
        raise ValueError(f"{text!r} {otherwise}")
    return int(value)
