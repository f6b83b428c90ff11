"""The Range header of a request for a file (RFC 9110, section 14)."""

from __future__ import annotations

import re
from dataclasses import dataclass

#: One range of bytes: from a first to a last one, from a first one on, or so many at the end.
ONE = re.compile(r"bytes\s*=\s*([0-9]*)\s*-\s*([0-9]*)\s*", re.IGNORECASE | re.ASCII)

#: Digits of a number of bytes; any number of more digits is beyond every file.
DIGITS = 18


@dataclass(frozen=True)
class Span:
    """Bytes of a file.

    Attributes:
        first: of them, from 0.
        count: how many; 0 where the file has none of those that are asked for.
    """

    first: int
    count: int


def span_of(text: str | None, size: int) -> Span | None:
    """The bytes that a Range header asks for; None where the whole file is sent.

    That is where there is no header, or where it is one that a server may ignore: of another unit, with several
    ranges, or broken.

    Args:
        text: of the header.
        size: of the file.
    """
    found = ONE.fullmatch(text.strip()) if text is not None else None
    if found is None:
        return None
    first, last = found.groups()
    if first:
        begin = _number(first)
        end = _number(last) if last else max(begin, size)
        if end < begin:
            return None
        return Span(begin, max(0, min(end, size - 1) - begin + 1))
    if last:
        count = min(_number(last), size)
        return Span(size - count, count)
    return None


def _number(digits: str) -> int:
    digits = digits.lstrip("0")
    return int(digits or "0") if len(digits) <= DIGITS else 10**DIGITS
