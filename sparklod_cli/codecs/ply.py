"""PLY as 3D Gaussian Splatting writes it: Inria's code, nerfstudio, gsplat, splat-transform and their kin.

One vertex a splat, of scalar properties in any order; properties that are not in the table are ignored.
"""

from __future__ import annotations

import io
import mmap
import re
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from ..errors import FormatError
from ..gaussian import normalized_quat
from ..limits import MAX_SH_DEGREE
from ..parallel import chunks_of, for_chunks
from ..progress import Progress, silent
from ..scene import Scene
from ..sh import SH_C0, degree_of, notes_on_degree
from ..splats import FloatArray, Splats

Decoder = Callable[[FloatArray], FloatArray]

MAX_HEADER = 1 << 20


def _sigmoid(logit: FloatArray) -> FloatArray:
    return 1 / (1 + np.exp(-logit))


def _display(dc: FloatArray) -> FloatArray:
    return dc * np.float32(SH_C0) + np.float32(0.5)


#: Column of `Splats`, the properties that it is made of, and how.
COLUMNS: tuple[tuple[str, tuple[str, ...], Decoder], ...] = (
    ("center", ("x", "y", "z"), np.copy),
    ("scale", ("scale_0", "scale_1", "scale_2"), np.exp),  # logarithms
    ("quat_xyzw", ("rot_1", "rot_2", "rot_3", "rot_0"), normalized_quat),  # w first in the file, of any length
    ("opacity", ("opacity",), _sigmoid),  # logit
    ("rgb", ("f_dc_0", "f_dc_1", "f_dc_2"), _display),  # constant SH term
)
REQUIRED = tuple(name for _, names, _ in COLUMNS for name in names)


@dataclass(frozen=True)
class Header:
    """What comes before the data: element descriptions without their data, and how many rows each has."""

    elements: dict[str, tuple[PlyElement, int]]
    text: bool
    byte_order: str
    size: int

    @property
    def vertices(self) -> int:
        return self.elements["vertex"][1]

    def row_type(self, name: str) -> np.dtype[Any] | None:
        """Type of a row, or None where rows have lists and so no fixed size."""
        element = self.elements[name][0]
        has_list = any(isinstance(prop, PlyListProperty) for prop in element.properties)
        return None if has_list else np.dtype(element.dtype(self.byte_order))


def decode(file: BinaryIO, *, threads: int = 1, progress: Progress = silent) -> Scene:
    """Reads a PLY file; binary ones are memory-mapped.

    Raises:
        FormatError: it is not PLY, cut short, or not of Gaussian splats.
    """
    header = _read_header(file)
    coefficients = _checked_coefficients(header)
    _check_size(header, file.seek(0, io.SEEK_END) - header.size)
    degree, count = degree_of(coefficients), header.vertices
    splats = Splats.empty(count, min(degree, MAX_SH_DEGREE))

    def report(done: int) -> None:
        progress("reading", done, count, "splat")

    if header.text:
        for part, rows in _text_rows(file, header):
            _decode_rows(rows, splats, part, coefficients)
            report(part.stop)
    else:
        data = _binary_rows(file, header)
        for_chunks(lambda part: _decode_rows(data[part], splats, part, coefficients), count, threads, report)
    return Scene(splats, format="PLY", notes=notes_on_degree(degree))


def _decode_rows(rows: NDArray[Any], out: Splats, part: slice, channel_stride: int) -> None:
    """Fills rows `part` of the columns from structured rows; f_rest holds all red coefficients first."""
    # Infinite logits and logarithms are what converters write for an opacity of 0 or 1 and a scale of 0.
    with np.errstate(over="ignore", invalid="ignore"):
        for column, names, decoder in COLUMNS:
            raw = np.stack([rows[name] for name in names], axis=1).astype(np.float32, copy=False)
            getattr(out, column)[part] = decoder(raw).reshape(getattr(out, column)[part].shape)
        for coefficient in range(out.sh.shape[1]):
            for channel in range(3):
                out.sh[part, coefficient, channel] = rows[f"f_rest_{channel * channel_stride + coefficient}"]


def _read_header(file: BinaryIO) -> Header:
    """Reads up to the line end_header, leaving the file behind it."""
    text = line = b""
    while line.strip() != b"end_header":
        line = file.readline(MAX_HEADER)
        text += line
        if not text.startswith(b"ply"):
            raise FormatError("not a PLY file")
        if not line or len(text) > MAX_HEADER:
            raise FormatError("the PLY header does not end")
    # plyfile gets what it must parse: no comments, which may be in any encoding, and counts of 0, as it would read all
    # data otherwise, and text value by value.
    lines, counts = [], []
    for words in map(bytes.split, text.splitlines()):
        if words[:1] == [b"element"]:
            if len(words) != 3 or not words[2].isdigit():
                raise FormatError("bad PLY header: expected element, a name and a count")
            counts.append(int(words[2]))
            words[2] = b"0"
        if words and words[0] not in (b"comment", b"obj_info"):
            lines.append(b" ".join(words))
    try:
        parsed = PlyData.read(io.BytesIO(b"\n".join(lines) + b"\n"))
    except (PlyParseError, ValueError) as error:
        raise FormatError(f"bad PLY header: {error}") from None
    elements = {element.name: (element, count) for element, count in zip(parsed, counts, strict=True)}
    return Header(elements, parsed.text, parsed.byte_order, len(text))


def _checked_coefficients(header: Header) -> int:
    """SH coefficients a channel, if the vertices are splats."""
    if "vertex" not in header.elements:
        raise FormatError("no vertex element in the PLY header")
    row_type = header.row_type("vertex")
    if row_type is None:
        raise FormatError("the vertices have list properties, splats have none")
    have = row_type.names or ()
    if "chunk" in header.elements and "packed_position" in have:
        raise FormatError("a compressed PLY (PlayCanvas); write it as a plain PLY first, with splat-transform")
    missing = [name for name in REQUIRED if name not in have]
    if missing:
        what = "a point cloud or mesh, not Gaussian splats" if "x" in have else "not Gaussian splats"
        raise FormatError(f"{what}: its vertices have no {', '.join(missing)}")
    rest = sum(1 for name in have if re.fullmatch(r"f_rest_\d+", name))
    expected = {f"f_rest_{index}" for index in range(rest)}
    if rest % 3 or not expected.issubset(have):
        raise FormatError(f"{rest} f_rest properties; expected f_rest_0 on, in a multiple of 3")
    return rest // 3


def _check_size(header: Header, size: int) -> None:
    """Raises `FormatError` where `size` bytes cannot hold what the header promises, before memory is asked for."""
    need = 0
    for name, (element, count) in header.elements.items():
        row_type = header.row_type(name)
        if header.text:
            need += count * 2 * max(1, len(element.properties))  # a digit and a separator a value
        else:
            need += count * (row_type.itemsize if row_type else 1)
    missing = need - size - (1 if header.text else 0)  # the last separator may be missing
    if missing > 0:
        raise FormatError(f"cut short: {missing:,} bytes are missing of what the header promises")


def _binary_rows(file: BinaryIO, header: Header) -> NDArray[Any]:
    """The vertices, memory-mapped where `file` is a real one."""
    offset = header.size
    for name, (_, count) in header.elements.items():
        row_type = header.row_type(name)
        if row_type is None:  # rows of unknown sizes come before the vertices
            return _rows_by_plyfile(file)
        if name == "vertex":
            break
        offset += count * row_type.itemsize
    data: mmap.mmap | bytes
    try:
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError):  # not a file of the system's, or one that cannot be mapped
        file.seek(0)
        data = file.read()
    return np.frombuffer(data, row_type, header.vertices, offset)


def _rows_by_plyfile(file: BinaryIO) -> NDArray[Any]:
    file.seek(0)
    try:
        rows: NDArray[Any] = PlyData.read(file)["vertex"].data
    except (PlyParseError, ValueError) as error:
        raise FormatError(f"bad PLY data: {error}") from None
    return rows


def _text_rows(file: BinaryIO, header: Header) -> Iterator[tuple[slice, NDArray[Any]]]:
    """The vertices of an ascii file in chunks; plyfile's own reader goes value by value in Python."""
    row_type = header.row_type("vertex")
    file.seek(header.size)
    for name, (_, count) in header.elements.items():
        if name == "vertex":
            break
        deque(islice(file, count), maxlen=0)
    for part in chunks_of(header.vertices):
        lines = list(islice(file, part.stop - part.start))
        if part.start + len(lines) < part.stop:
            raise FormatError(f"cut short after {part.start + len(lines):,} of {header.vertices:,} vertices")
        if not all(map(bytes.strip, lines)):  # numpy would skip them
            raise FormatError(f"empty lines among the vertices after {part.start:,}")
        try:
            rows = np.loadtxt(lines, dtype=row_type, ndmin=1, comments=None)
        except ValueError as error:
            raise FormatError(f"bad PLY data after vertex {part.start:,}: {error}") from None
        yield part, rows
