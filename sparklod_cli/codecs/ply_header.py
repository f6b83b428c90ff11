"""What all kinds of PLY share: the header, and how its elements lie in the file."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from ..support.errors import FormatError, PromiseError, TruncatedError
from ..support.untrusted import quoted

MAX_HEADER = 1 << 20

#: Digits of a count; Python makes no number of some thousands.
MAX_DIGITS = 100


@dataclass(frozen=True)
class Header:
    """What comes before the data: element descriptions without their data, and how many rows each has."""

    elements: dict[str, tuple[PlyElement, int]]
    text: bool
    byte_order: str
    size: int

    def count(self, name: str) -> int:
        """Rows of an element, 0 where there is none of this name."""
        return self.elements[name][1] if name in self.elements else 0

    def row_type(self, name: str) -> np.dtype[Any] | None:
        """Type of a row, or None where rows have lists and so no fixed size."""
        element = self.elements[name][0]
        has_list = any(isinstance(prop, PlyListProperty) for prop in element.properties)
        return None if has_list else np.dtype(element.dtype(self.byte_order))

    def offset(self, name: str) -> int | None:
        """Where an element's rows begin in a binary file; None where rows of unknown sizes come before them."""
        at = self.size
        for other, (_, count) in self.elements.items():
            if other == name:
                break
            row_type = self.row_type(other)
            if row_type is None:
                return None
            at += count * row_type.itemsize
        return at

    def check_size(self, size: int) -> int:
        """Raises `FormatError` where `size` bytes cannot hold what is promised, before memory is asked for.

        Returns how many bytes are left over, as far as that can be told.
        """
        need = self.size
        for name, (element, count) in self.elements.items():
            row_type = self.row_type(name)
            if self.text:
                need += count * 2 * max(1, len(element.properties))  # a digit and a separator a value
            else:
                need += count * (row_type.itemsize if row_type else 1)
        missing = need - size - (1 if self.text else 0)  # the last separator may be missing
        if missing > 0:
            raise TruncatedError(f"cut short: {missing:,} bytes are missing of what the header promises")
        return 0 if self.text or any(self.row_type(name) is None for name in self.elements) else -missing


def read_header(file: BinaryIO) -> Header:
    """Reads up to the line end_header, leaving the file behind it.

    Raises:
        FormatError: it is not a PLY header.
    """
    text = line = b""
    while line.strip() != b"end_header":
        line = file.readline(MAX_HEADER)
        text += line
        if not text.startswith(b"ply"):
            raise FormatError("not a PLY file")
        if not line or len(text) > MAX_HEADER:
            raise TruncatedError("the PLY header does not end")
    # plyfile gets what it must parse: no comments, which may be in any encoding, and counts of 0, as it would read all
    # data otherwise, and text value by value.
    lines, counts = [], []
    for words in map(bytes.split, text.splitlines()):
        if words[:1] == [b"element"]:
            if len(words) != 3 or not words[2].isdigit():
                raise FormatError("bad PLY header: expected element, a name and a count")
            if len(words[2]) > MAX_DIGITS:
                raise PromiseError(f"the header promises a count of {len(words[2]):,} digits")
            counts.append(int(words[2]))
            words[2] = b"0"
        if words and words[0] not in (b"comment", b"obj_info"):
            lines.append(b" ".join(words))
    try:
        parsed = PlyData.read(io.BytesIO(b"\n".join(lines) + b"\n"))
    except (PlyParseError, ValueError) as error:
        raise FormatError(f"bad PLY header: {quoted(error)}") from None
    elements = {element.name: (element, count) for element, count in zip(parsed, counts, strict=True)}
    return Header(elements, parsed.text, parsed.byte_order, len(text))
