"""The header of PLY files of all kinds, and where their elements lie."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from ..system.errors import FormatError, PromiseError, TruncatedError
from ..system.untrusted import quoted

#: Largest header, bytes; that of a splat file has some 1,500.
MAX_HEADER = 1 << 20

#: Most digits of a count: Python refuses to convert numbers of several thousand digits.
MAX_DIGITS = 100

#: Comments of trainers in lower case, and the mode of `PlyHeader` that each means.
MODES = {f"splatrendermode: {mode}".encode(): mode for mode in ("mip", "2dgs", "default")}
MODES |= {b"antialiased 1": "mip", b"antialiased 0": "default"}


@dataclass(frozen=True)
class PlyHeader:
    """A PLY header.

    Attributes:
        elements: descriptions of the elements without their data, and the number of rows of each, by name.
        text: whether the data are ascii.
        byte_order: "<" or ">" of binary data.
        size: bytes of the header.
        note: the first comment that is a JSON object; empty without one.
        mode: how trainers say that the splats are drawn, "mip" (with the opacity compensation of Mip-Splatting), "2dgs"
            (as disks) or "default"; Brush's last comment "SplatRenderMode: MODE" or Postshot's "antialiased 0|1".
    """

    elements: dict[str, tuple[PlyElement, int]]
    text: bool
    byte_order: str
    size: int
    note: bytes = b""
    mode: str = "default"

    def count(self, name: str) -> int:
        """Return the number of rows of an element; 0 if it is missing."""
        return self.elements[name][1] if name in self.elements else 0

    def row_type(self, name: str) -> np.dtype[Any] | None:
        """Return the type of a row; None if rows have lists, and so no fixed size."""
        element = self.elements[name][0]
        has_list = any(isinstance(prop, PlyListProperty) for prop in element.properties)
        return None if has_list else np.dtype(element.dtype(self.byte_order))

    def check_size(self, size: int) -> int:
        """Check that a file of `size` bytes can hold all rows, before memory is allocated for them.

        Returns:
            Bytes after the last row; 0 if their number is unknown.
        """
        need = self.size
        for name, (element, count) in self.elements.items():
            row_type = self.row_type(name)
            if self.text:
                need += count * 2 * max(1, len(element.properties))  # at least a digit and a separator for each value
            else:
                need += count * (row_type.itemsize if row_type else 1)
        missing = need - size - (1 if self.text else 0)  # the last separator is optional
        if missing > 0:
            raise TruncatedError(f"cut short: {missing:,} bytes are missing of what the header announces")
        return 0 if self.text or any(self.row_type(name) is None for name in self.elements) else -missing


def read_header(file: BinaryIO) -> PlyHeader:
    """Read a header, and leave the file behind the line end_header."""
    text = line = b""
    while line.strip() != b"end_header":
        line = file.readline(MAX_HEADER)
        text += line
        if not text.startswith(b"ply"):
            raise FormatError("not a PLY file")
        if not line or len(text) > MAX_HEADER:
            raise TruncatedError("the PLY header does not end")
    # plyfile gets the header without comments, which may be in any encoding, and with counts of 0: otherwise it would
    # read all the data, and text value by value.
    lines, counts, note, mode = [], [], b"", "default"
    for words in map(bytes.split, text.splitlines()):
        if words[:1] == [b"element"]:
            if len(words) != 3 or not words[2].isdigit():
                raise FormatError("bad PLY header: an element needs a name and a count")
            if len(words[2]) > MAX_DIGITS:
                raise PromiseError(f"its header announces a count of {len(words[2]):,} digits")
            counts.append(int(words[2]))
            words[2] = b"0"
        if words[:1] == [b"comment"] and words[1:] and words[1].startswith(b"{"):
            note = note or b" ".join(words[1:])
        if words[:1] == [b"comment"]:
            mode = MODES.get(b" ".join(words[1:]).lower(), mode)
        if words and words[0] not in (b"comment", b"obj_info"):
            lines.append(b" ".join(words))
    try:
        parsed = PlyData.read(io.BytesIO(b"\n".join(lines) + b"\n"))
    except (PlyParseError, ValueError) as error:
        raise FormatError(f"bad PLY header: {quoted(error)}") from None
    elements = {element.name: (element, count) for element, count in zip(parsed, counts, strict=True)}
    return PlyHeader(elements, parsed.text, parsed.byte_order, len(text), note, mode)


def offset_of(file: BinaryIO, header: PlyHeader, name: str) -> int:
    """Return where rows of an element begin in a binary file; lists before them are read for their sizes."""
    at = header.size
    for other, (element, count) in header.elements.items():
        if other == name:
            break
        row_type = header.row_type(other)
        if row_type is not None:
            at += count * row_type.itemsize
            continue
        file.seek(at)
        for _ in range(count):
            _skip_row(file, element, header.byte_order)
        at = file.tell()
    return at


def first_value(file: BinaryIO, header: PlyHeader, name: str) -> float | None:
    """Return the first value of an element that has rows; None in ascii files and files of lists, read row by row."""
    if header.text or any(header.row_type(other) is None for other in header.elements):
        return None
    row_type = np.dtype(header.elements[name][0].dtype(header.byte_order))
    file.seek(offset_of(file, header, name))
    data = file.read(row_type.itemsize)
    if len(data) < row_type.itemsize:
        raise TruncatedError(f"cut short inside its element {name}")
    return float(np.frombuffer(data, row_type)[0][0])


def _skip_row(file: BinaryIO, element: PlyElement, byte_order: str) -> None:
    for each in element.properties:
        if not isinstance(each, PlyListProperty):
            file.seek(np.dtype(each.dtype(byte_order)).itemsize, io.SEEK_CUR)
            continue
        length, values = (np.dtype(kind) for kind in each.list_dtype(byte_order))
        if length.kind not in "iu":
            raise FormatError(f"bad PLY header: lists of its element {element.name} are counted in {length}")
        data = file.read(length.itemsize)
        if len(data) < length.itemsize:
            raise TruncatedError(f"cut short inside its element {element.name}")
        size = int(np.frombuffer(data, length)[0])
        if size < 0:
            raise FormatError(f"bad PLY data: a list of {size} values in its element {element.name}")
        file.seek(size * values.itemsize, io.SEEK_CUR)
