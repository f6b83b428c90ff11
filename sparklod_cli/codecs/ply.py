"""PLY of 3D Gaussian Splatting, as Inria's code, nerfstudio, gsplat, splat-transform and others write it.

A vertex is a splat, with scalar properties in any order; notes name the properties and elements that are ignored.
PlayCanvas's compressed PLY is read, too.
"""

from __future__ import annotations

import functools
import io
import re
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from ..model import MAX_SH_DEGREE
from ..model.gaussian import normalized_quat
from ..model.scene import Scene
from ..model.sh import degree_of, notes_on_degree
from ..model.splats import FloatArray
from ..system.errors import FormatError, NotSplatsError, PromiseError, TruncatedError
from ..system.progress import Progress, silent
from ..system.threads import blocks_of, ordered_map
from ..system.units import count_of
from ..system.untrusted import quoted
from . import quantize
from .formats import DEFAULTS, WriteOptions
from .reader import (
    HARMLESS,
    Note,
    OpenFile,
    Reader,
    RowBuffer,
    Rows,
    comment_of,
    encode_rows,
    left_out,
    read_comment,
    rows_of,
)

Coding = Callable[[FloatArray], FloatArray]

#: Indices of properties in a vertex.
Places = slice | list[int]

#: Columns of `Splats`, the properties of each, and its decode and encode.
COLUMNS: tuple[tuple[str, tuple[str, ...], Coding, Coding], ...] = (
    ("center", ("x", "y", "z"), np.asarray, np.asarray),
    ("rgb", ("f_dc_0", "f_dc_1", "f_dc_2"), quantize.decode_dc, quantize.encode_dc),
    ("opacity", ("opacity",), quantize.decode_logit, quantize.encode_logit),
    ("scale", ("scale_0", "scale_1", "scale_2"), quantize.decode_log, quantize.encode_log),
    ("quat_xyzw", ("rot_1", "rot_2", "rot_3", "rot_0"), normalized_quat, np.asarray),  # rot_0 is w; of any length
)
REQUIRED = tuple(name for _, names, _, _ in COLUMNS for name in names)

SCALES = ("scale_0", "scale_1", "scale_2")

#: Colours of 0 to 255, read if those of SH are missing, as in files of nerfstudio's --ply-color-mode rgb.
PLAIN_RGB = ("red", "green", "blue")

#: Standard deviation, world units, of the filter with which Mip-Splatting smooths each splat when it draws it. The
#: scales and opacities of its "fused" files include it already. Source: its scene/gaussian_model.py.
FILTER = "filter_3D"

#: The element of Apple's SHARP whose value is 1 for linear colours and 0 for sRGB.
COLOR_SPACE = "color_space"

#: Prefix of the properties that CloudCompare writes.
PREFIX = "scalar_"

#: Most missing properties that an error names.
FEW = 4

#: Thickness of disks (2D Gaussian Splatting) over the smaller of their two scales: less than a pixel if a disk is
#: smaller than a picture, and above 0, whose logarithm formats do not store. Chosen.
THIN = np.float32(1e-3)

#: NaN and infinity as C libraries of Windows write them: "-nan(ind)", "1.#QNAN", "-1.#INF00".
WINDOWS_NAN = re.compile(rb"(?<!\S)([+-]?)(?:nan\([^\s()]*\)|1[.,]#(inf)?\w*)(?!\S)", re.IGNORECASE)

#: Largest header, bytes; that of a splat file has some 1,500.
MAX_HEADER = 1 << 20

#: Most digits of a count: Python refuses to convert numbers of several thousand digits.
MAX_DIGITS = 100

#: Modes of `PlyHeader`, by the comments of trainers in lower case.
MODES = {f"splatrendermode: {mode}".encode(): mode for mode in ("mip", "2dgs", "default")}
MODES |= {b"antialiased 1": "mip", b"antialiased 0": "default"}


@dataclass(frozen=True)
class PlyHeader:
    """A PLY header.

    Attributes:
        elements: elements without their data, by name.
        counts: number of rows of each element.
        row_types: type of the rows of each element, with names without `PREFIX`, and floats for all properties of ascii
            files; None if rows have lists, and so no fixed size.
        text: the data are ascii.
        size: size of the header, bytes.
        note: the first comment that is a JSON object; empty without one.
        mode: how the trainer draws the splats: "mip" (with the opacity compensation of Mip-Splatting), "2dgs" (as
            disks) or "default", from Brush's last comment "SplatRenderMode: MODE" or Postshot's "antialiased 0|1".
    """

    elements: dict[str, PlyElement]
    counts: dict[str, int]
    row_types: dict[str, np.dtype[Any] | None]
    text: bool
    byte_order: str
    size: int
    note: bytes = b""
    mode: str = "default"

    def check_size(self, size: int) -> int:
        """Check that a file of `size` bytes can hold all rows, before memory is allocated for them.

        Returns the number of bytes after the last row; 0 if it is unknown.
        """
        need = self.size - int(self.text)  # the last separator of an ascii file is optional
        for name, row_type in self.row_types.items():
            least = row_type.itemsize if row_type else 1
            if self.text:  # at least a digit and a separator for each value
                least = 2 * max(1, len(self.elements[name].properties))
            need += self.counts[name] * least
        if need > size:
            raise TruncatedError(f"cut short: {need - size:,} bytes are missing of what the header announces")
        return 0 if self.text or None in self.row_types.values() else size - need


def read_header(file: BinaryIO) -> PlyHeader:
    """Read a header up to and including the line end_header."""
    text = line = b""
    while line.strip() != b"end_header":
        line = file.readline(MAX_HEADER)
        text += line
        if not text.startswith(b"ply"):
            raise FormatError("not a PLY file")
        if not line or len(text) > MAX_HEADER:
            raise TruncatedError("the PLY header does not end")
    # plyfile gets the header without comments, which may have any encoding, and with counts of 0, so that it does not
    # read the data.
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
    elements = {element.name: element for element in parsed}
    row_types = dict[str, np.dtype[Any] | None]()
    for element in parsed:
        fields = {}
        names = {each.name for each in element.properties}
        for each in element.properties:
            plain, kind = each.name.removeprefix(PREFIX) or each.name, np.dtype(each.dtype(parsed.byte_order))
            if parsed.text and kind.itemsize < 8:
                kind = np.dtype("<f4")  # programs write "200.0" for properties of whole numbers
            fields[each.name if plain in names else plain] = kind
        has_lists = any(isinstance(each, PlyListProperty) for each in element.properties)
        row_types[element.name] = None if has_lists else np.dtype([*fields.items()])
    named_counts = {element.name: count for element, count in zip(parsed, counts, strict=True)}
    return PlyHeader(elements, named_counts, row_types, parsed.text, parsed.byte_order, len(text), note, mode)


def offset_of(file: BinaryIO, header: PlyHeader, name: str) -> int:
    """Return the position of the rows of an element in a binary file; reads the lengths of all lists before them."""
    at = header.size
    for other, row_type in header.row_types.items():
        if other == name:
            break
        if row_type is not None:
            at += header.counts[other] * row_type.itemsize
            continue
        file.seek(at)
        for _ in range(header.counts[other]):
            _skip_row(file, header.elements[other], header.byte_order)
        at = file.tell()
    return at


def first_value(file: BinaryIO, header: PlyHeader, name: str) -> float | None:
    """Return the first value of an element that has rows; None for ascii files and for files that have lists."""
    row_type = header.row_types[name]
    if header.text or row_type is None or None in header.row_types.values():
        return None
    file.seek(offset_of(file, header, name))
    data = file.read(row_type.itemsize)
    if len(data) < row_type.itemsize:
        raise TruncatedError(f"cut short inside its element {name}")
    return float(np.frombuffer(data, row_type)[0][0])


def _skip_row(file: BinaryIO, element: PlyElement, byte_order: str) -> None:
    """Move past a row of a binary element with lists."""
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


def open_content(source: OpenFile) -> Reader:
    """Open a PLY file, compressed or not. An ascii file is unpacked to binary rows in `OpenFile.scratch`."""
    file = source.file
    header = read_header(file)
    if any(each.name == VERTEX[0] for element in header.elements.values() for each in element.properties):
        return _open_compressed(source, header)
    if "vertex" not in header.elements:
        raise NotSplatsError("its PLY header has no element vertex")
    row_type = header.row_types["vertex"]
    if row_type is None:
        raise NotSplatsError("its vertices have list properties, which splats do not have")
    names = row_type.names or ()
    columns = _columns(names, header.mode)
    numbered = sum(1 for name in names if re.fullmatch(r"f_rest_\d+", name))
    rest = [f"f_rest_{index}" for index in range(numbered)]
    if numbered % 3 or not {*rest} <= {*names}:
        raise FormatError(f"{numbered} f_rest properties; expected f_rest_0, f_rest_1 and so on, a multiple of 3")
    facts = {"properties": len(names), "ascii": int(header.text)}
    facts |= {"big_endian": int(header.byte_order == ">"), "trailing_bytes": header.check_size(source.size)}
    degree, count = degree_of(numbered // 3), header.counts["vertex"]
    needed = {part for parts, _ in columns.values() for part in parts} | {*rest, FILTER}
    offset = 0 if header.text else offset_of(file, header, "vertex")
    places = {name: (_places(names, parts), decode) for name, (parts, decode) in columns.items()}
    rest_places = _places(names, rest)
    text_rows = functools.partial(_text_rows, file, header, row_type, needed)

    def fill(target: RowBuffer, threads: int, progress: Progress) -> None:
        span = row_type, target.start, target.stop, count, "vertices"
        if not header.text:
            rows = rows_of(source.read_at, offset, *span)
        elif source.scratch is None or target.once:
            rows = text_rows()
        else:
            rows = rows_of(source.scratch(lambda: (some.tobytes() for _, some in text_rows())).read_at, 0, *span)
        unpack = functools.partial(_unpack, target, places, rest_places)
        for done in ordered_map(unpack, rows, threads):
            progress("reading", done, count, "splat")

    noted = read_comment(header.note)
    notes = notes_on_degree(degree) + noted.problems + _notes(file, header, names, needed)
    kept, antialiased = min(degree, MAX_SH_DEGREE), header.mode == "mip"
    return Reader(count, kept, "PLY", fill, antialiased, notes, facts, noted.up, concurrent=True)


def _notes(file: BinaryIO, header: PlyHeader, names: Collection[str], needed: Collection[str]) -> tuple[str, ...]:
    """Return notes on data that is ignored, or read in another way than its program means it."""
    notes, harmless = tuple[str, ...](), HARMLESS
    if SCALES[1] in needed and SCALES[2] not in needed:
        notes += ("its disks (2D Gaussian Splatting) are read as splats a thousandth as thick",)
        harmless = HARMLESS | {SCALES[2]}
    if FILTER in names:
        notes += (Note(f"the 3D filter of Mip-Splatting ({FILTER}) is applied to its scales and opacities"),)
    elements = [name for name, count in header.counts.items() if count and name != "vertex"]
    space = first_value(file, header, COLOR_SPACE) if COLOR_SPACE in elements else None
    if space is not None:
        elements.remove(COLOR_SPACE)
        notes += (f"its colours are linear ({COLOR_SPACE}), and are read as sRGB: too dark",) if space else ()
    if properties := {*names} - {*needed} - harmless:
        notes += left_out("property", "properties", properties)
    return notes + left_out("element", "elements", elements) if elements else notes


def _columns(names: Collection[str], mode: str) -> dict[str, tuple[tuple[str, ...], Coding]]:
    """Return the properties and the decode of each column of `Splats`, for vertices with these properties.

    Splats with one scale are balls, which need no rotation; those with two are disks, see `THIN`.
    """
    have, columns = {*names}, dict[str, tuple[tuple[str, ...], Coding]]()
    widths = (2, 1) if mode == "2dgs" else (3, 2, 1)
    scales = SCALES[: next((width for width in widths if have.issuperset(SCALES[:width])), 3)]
    if SCALES[2] in have and len(scales) < 2:
        scales = SCALES  # one is missing
    for name, parts, decode, _ in COLUMNS:
        if name == "rgb" and have.isdisjoint(parts) and have.issuperset(PLAIN_RGB):
            columns[name] = PLAIN_RGB, lambda values: values / np.float32(255)
        elif name == "scale":
            columns[name] = scales, decode
        elif name != "quat_xyzw" or len(scales) > 1 or not have.isdisjoint(parts):
            columns[name] = parts, decode
    missing = [part for parts, _ in columns.values() for part in parts if part not in have]
    if missing:
        what = "a point cloud or a mesh, not Gaussian splats" if "x" in have else "not Gaussian splats"
        if not have.isdisjoint(REQUIRED[3:]):
            what = "Gaussian splats that are not complete"
        more = f" and {len(missing) - FEW} more" if len(missing) > FEW else ""
        raise NotSplatsError(f"{what}: its vertices have no {', '.join(missing[:FEW])}{more}")
    return columns


# Converters write infinite logits and logarithms for an opacity of 0 or 1 and a scale of 0.
@np.errstate(over="ignore", invalid="ignore")
def _unpack(target: RowBuffer, places: Mapping[str, tuple[Places, Coding]], rest_places: Places, block: Rows) -> int:
    """Decode a block of vertices; return the number of the vertex after it.

    Args:
        places: places of the properties of each column, and its decode.
        rest_places: places of the SH coefficients, all of red first.
    """
    part, rows = block
    splats, names = target.rows(part), rows.dtype.names or ()
    if rows.flags.c_contiguous and all(rows.dtype[name] == np.float32 for name in names):
        matrix: FloatArray = rows.view(np.float32).reshape(len(rows), len(names))  # not copied
    else:
        matrix = np.stack([rows[name].astype(np.float32) for name in names], axis=1)
    for name, (place, decode) in places.items():
        values, out = decode(matrix[:, place]), getattr(splats, name)
        if name == "scale":
            scales = values.shape[1]
            out = out[:, :scales]
        out[...] = values.reshape(out.shape)
    if scales == 1:
        splats.scale[:, 1:] = splats.scale[:, :1]
    if "quat_xyzw" not in places:
        splats.quat_xyzw[:] = (0, 0, 0, 1)
    if FILTER in names:
        smoothing = matrix[:, names.index(FILTER)]
        _smooth(splats.scale[:, :2] if scales == 2 else splats.scale, splats.opacity, smoothing)
    if scales == 2:
        splats.scale[:, 2] = THIN * splats.scale[:, :2].min(axis=1)
    rest = matrix[:, rest_places]
    sh = rest.reshape(len(rows), 3, rest.shape[1] // 3)
    splats.sh[:] = sh[:, :, : splats.sh.shape[1]].transpose(0, 2, 1)
    return part.stop


def _smooth(scale: FloatArray, opacity: FloatArray, size: FloatArray) -> None:
    """Convolve splats with balls of (N,) standard deviations, see `FILTER`; the integral of each splat stays."""
    smooth = np.hypot(scale, size[:, None])
    opacity *= np.divide(scale, smooth, out=np.ones_like(smooth), where=smooth > 0).prod(axis=1)
    scale[...] = smooth


def _places(names: Sequence[str], parts: Sequence[str]) -> Places:
    """Return the indices of parts among names; as a slice, which makes no copy, if they are consecutive."""
    places = [names.index(part) for part in parts]
    first = places[0] if places else 0
    end = first + len(places)
    return slice(first, end) if places == list(range(first, end)) else places


def _text_rows(file: BinaryIO, header: PlyHeader, row_type: np.dtype[Any], needed: Collection[str]) -> Iterator[Rows]:
    """Read the vertices of an ascii file in blocks; plyfile's own reader is slow, value by value in Python."""
    vertices = header.counts["vertex"]
    file.seek(header.size)
    for name, count in header.counts.items():
        if name == "vertex":
            break
        deque(islice(file, count), maxlen=0)
    for part in blocks_of(vertices):
        lines = list(islice(file, part.stop - part.start))
        if part.start + len(lines) < part.stop:
            raise TruncatedError(f"cut short after {part.start + len(lines):,} of {vertices:,} vertices")
        if not all(map(bytes.strip, lines)):  # numpy would skip them
            raise FormatError(f"an empty line among the vertices after vertex {part.start:,}")
        try:
            rows = _parsed(lines, row_type, needed)
        except ValueError as error:
            raise FormatError(f"bad PLY data after vertex {part.start:,}: {quoted(error)}") from None
        yield part, rows


def _parsed(lines: list[bytes], row_type: np.dtype[Any], needed: Collection[str]) -> NDArray[Any]:
    """Parse vertices; if that fails, try again without ignored properties and with `WINDOWS_NAN` replaced."""
    load = functools.partial(np.loadtxt, dtype=row_type, ndmin=1, comments=None)
    try:
        return load(lines)
    except ValueError:
        are_needed = [name in needed for name in row_type.names or ()]
        return load([_mended(line, are_needed) for line in lines])


def _mended(line: bytes, are_needed: Sequence[bool]) -> bytes:
    """Replace ignored values of a line by 0, and each `WINDOWS_NAN` by nan or inf."""
    words = WINDOWS_NAN.sub(lambda match: match[1] + (match[2] or b"nan"), line).split()
    if len(words) != len(are_needed):
        return line
    return b" ".join(word if is_needed else b"0" for word, is_needed in zip(words, are_needed, strict=True))


def settled(scene: Scene, options: WriteOptions) -> WriteOptions:
    """Return the options unchanged, since PLY has none; raises `FormatError` for a tree, which PLY cannot store."""
    if scene.tree is not None:
        raise FormatError("PLY holds no Level-of-Detail tree")
    return options


def encode(
    scene: Scene, options: WriteOptions = DEFAULTS, *, threads: int = 1, progress: Progress = silent
) -> Iterator[bytes]:
    """Yield the bytes of a binary PLY file in the layout of Inria's trainer.

    All numbers are finite: `quantize.FAR` replaces infinite logits and logarithms, of opacities of 0 and 1 and scales
    of 0, and decodes to the same values.
    """
    settled(scene, options)
    splats = scene.splats
    rest = [f"f_rest_{index}" for index in range(3 * splats.sh.shape[1])]
    rotation = ["rot_0", "rot_1", "rot_2", "rot_3"]
    names = [*REQUIRED[:3], "nx", "ny", "nz", *REQUIRED[3:6], *rest, *REQUIRED[6:10], *rotation]
    row_type = np.dtype([(name, "<f4") for name in names])
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [] if scene.up is None else [f"comment {comment_of(up=scene.up)}"]
    lines += ["comment SplatRenderMode: mip"] if scene.antialiased else []
    lines += [f"element vertex {len(splats)}"]
    lines += [f"property float {name}" for name in names]
    yield "".join(f"{line}\n" for line in [*lines, "end_header"]).encode()

    def rows_of_part(part: slice) -> bytes:
        rows = np.zeros(part.stop - part.start, row_type)  # normals are 0: viewers ignore them
        for column, names, _, encoder in COLUMNS:
            values = encoder(getattr(splats, column)[part]).reshape(len(rows), -1)
            for name, numbers in zip(names, values.T, strict=True):
                rows[name] = numbers
        for name, numbers in zip(rest, splats.sh[part].transpose(0, 2, 1).reshape(len(rows), -1).T, strict=True):
            rows[name] = numbers
        return rows.tobytes()

    yield from encode_rows(rows_of_part, len(splats), threads, progress)


# Compressed PLY: four words per splat, relative to the bounds of its chunk.

#: Splats per chunk.
CHUNK_SPLATS = 256

#: Properties of a splat, uint32 each.
VERTEX = ("packed_position", "packed_rotation", "packed_scale", "packed_color")

#: Properties of a chunk: the bounds of each quantity. Old files have no bounds of colours.
BOUNDS = {
    "position": ("min_x", "min_y", "min_z", "max_x", "max_y", "max_z"),
    "scale": ("min_scale_x", "min_scale_y", "min_scale_z", "max_scale_x", "max_scale_y", "max_scale_z"),  # logarithms
    "color": ("min_r", "min_g", "min_b", "max_r", "max_g", "max_b"),
}


def _open_compressed(source: OpenFile, header: PlyHeader) -> Reader:
    """Open a compressed PLY file, with or without bounds of colours and SH."""
    count, coefficients = _check_compressed(header)
    trailing = header.check_size(source.size)
    degree, names = degree_of(coefficients), ("chunk", "vertex", "sh")[: 3 if coefficients else 2]
    offsets = {name: offset_of(source.file, header, name) for name in names}

    def read(name: str, start: int, stop: int) -> Iterator[Rows]:
        row_type = header.row_types[name]
        assert row_type is not None
        return rows_of(source.read_at, offsets[name], row_type, start, stop, header.counts[name])

    bounds = _bounds(read("chunk", 0, -(-count // CHUNK_SPLATS)))

    def fill(target: RowBuffer, threads: int, progress: Progress) -> None:
        @np.errstate(invalid="ignore", over="ignore")  # absurd bounds overflow
        def unpack(block: Rows) -> int:
            part, rows = block
            splats, words = target.rows(part), {name: rows[name].astype(np.uint32) for name in VERTEX}
            center = quantize.decode_unorm_11_10_11(words["packed_position"])
            splats.center[:] = _within(bounds["position"], part, center)
            log_scale = quantize.decode_unorm_11_10_11(words["packed_scale"])
            splats.scale[:] = quantize.decode_log(_within(bounds["scale"], part, log_scale))
            splats.quat_xyzw[:] = quantize.decode_quat_2_10_10_10(words["packed_rotation"])[:, [1, 2, 3, 0]]
            rgba = quantize.decode_unorm_8888(words["packed_color"])
            splats.rgb[:] = _within(bounds["color"], part, rgba[:, :3])
            splats.opacity[:] = rgba[:, 3]
            return part.stop

        def unpack_sh(block: Rows) -> int:
            part, rows = block
            codes = rows.view(np.uint8).reshape(len(rows), 3, coefficients)  # all of red come first
            sh = target.rows(part).sh
            sh[:] = quantize.decode_centred_8(codes[:, :, : sh.shape[1]].transpose(0, 2, 1))
            return part.stop

        steps = (("vertex", unpack), ("sh", unpack_sh)) if coefficients else (("vertex", unpack),)
        for name, step in steps:
            for done in ordered_map(step, read(name, target.start, target.stop), threads):
                progress("reading", done, count, "splat")

    facts = {"chunks": header.counts["chunk"], "color_bounds": int(bounds["color"] is not None)}
    facts["trailing_bytes"] = trailing
    kept, notes = min(degree, MAX_SH_DEGREE), notes_on_degree(degree) + _compressed_left_out(header)
    return Reader(count, kept, "compressed PLY", fill, header.mode == "mip", notes, facts, concurrent=True)


def _compressed_left_out(header: PlyHeader) -> tuple[str, ...]:
    """Return notes on the properties and elements of a compressed PLY that are ignored."""
    read = {"vertex": {*VERTEX}, "chunk": {name for names in BOUNDS.values() for name in names}}
    properties = [
        each.name
        for name, names in read.items()
        for each in header.elements[name].properties
        if each.name not in names | HARMLESS
    ]
    elements = [name for name, count in header.counts.items() if count and name not in {*read, "sh"}]
    return left_out("property", "properties", properties) + left_out("element", "elements", elements)


def _within(bounds: FloatArray | None, part: slice, unit: FloatArray) -> FloatArray:
    """Map (n, 3) values 0..1 of a range of splats to the bounds of their chunks, (chunks, 6) low and high x y z."""
    if bounds is None:
        return unit
    of_chunks = bounds[part.start // CHUNK_SPLATS : -(-part.stop // CHUNK_SPLATS)]
    first = part.start % CHUNK_SPLATS
    low, high = np.split(np.repeat(of_chunks, CHUNK_SPLATS, axis=0)[first : first + len(unit)], 2, axis=1)
    return quantize.between(unit, low, high)


def _bounds(blocks: Iterator[Rows]) -> dict[str, FloatArray | None]:
    """Return the bounds of all chunks, (chunks, 6), by the keys of `BOUNDS`; None for missing ones."""
    rows = np.concatenate([rows for _, rows in blocks] or [np.empty(0)])
    have = rows.dtype.names or ()
    return {
        what: np.stack([rows[name] for name in names], axis=1).astype(np.float32) if names[0] in have else None
        for what, names in BOUNDS.items()
    }


def _check_compressed(header: PlyHeader) -> tuple[int, int]:
    """Check the elements; return the number of splats and of SH coefficients per channel."""
    if header.text:
        raise FormatError("an ascii compressed PLY, but the format is binary")
    count = header.counts.get("vertex", 0)
    _check_types(header, "vertex", VERTEX, np.uint32)
    chunk_names = {*BOUNDS["position"], *BOUNDS["scale"]}
    have = set(_check_types(header, "chunk", tuple(chunk_names), np.float32))
    if have & {*BOUNDS["color"]}:
        _check_types(header, "chunk", BOUNDS["color"], np.float32)
    if header.counts["chunk"] * CHUNK_SPLATS < count:
        chunks = count_of(header.counts["chunk"], "chunk")
        raise FormatError(f"{chunks} of {CHUNK_SPLATS} cannot hold {count_of(count, 'splat')}")
    if "sh" not in header.elements:
        return count, 0
    row_type = header.row_types["sh"]
    names = tuple(f"f_rest_{index}" for index in range(len(row_type.names or ()) if row_type else 1))
    if _check_types(header, "sh", names, np.uint8) != names:
        raise FormatError("the properties of its element sh are not f_rest_0, f_rest_1 and so on")
    if len(names) % 3 or header.counts["sh"] != count:
        rows, splats = count_of(header.counts["sh"], "row"), count_of(count, "splat")
        raise FormatError(f"its element sh has {rows} of {len(names)} values for {splats}")
    return count, len(names) // 3


def _check_types(header: PlyHeader, element: str, names: tuple[str, ...], kind: type[np.generic]) -> tuple[str, ...]:
    """Check that an element has properties of these names, all of one type; return the names of all its properties."""
    row_type = header.row_types.get(element)
    have: tuple[str, ...] = (row_type.names or ()) if row_type else ()
    bad = [name for name in names if row_type is None or name not in have or row_type[name].newbyteorder("=") != kind]
    if bad:
        raise FormatError(f"its element {element} has no {', '.join(sorted(bad))} of type {np.dtype(kind)}")
    return have
