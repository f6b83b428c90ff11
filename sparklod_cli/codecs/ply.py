"""PLY of 3D Gaussian Splatting, as Inria's code, nerfstudio, gsplat, splat-transform and others write it.

A vertex is a splat, with scalar properties in any order; properties that are not in the table are ignored.
"""

from __future__ import annotations

import functools
import re
from collections import deque
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import normalized_quat
from ..model.scene import Scene
from ..model.sh import degree_of, notes_on_degree
from ..model.splats import FloatArray, Splats
from ..support.defaults import MAX_SH_DEGREE
from ..support.errors import FormatError, NotSplatsError, TruncatedError
from ..support.parallel import blocks_of
from ..support.progress import Progress, silent
from ..support.untrusted import quoted
from . import quantize
from .clamps import CodeRange
from .content import Content, Scratch, Source, Target
from .file_notes import comment_of, read_comment
from .options import DEFAULTS, WriteOptions
from .ply_header import PlyHeader, offset_of, read_header
from .stream import Positioned, Rows, decode_rows, encode_rows, rows_between, size_of

Coding = Callable[[FloatArray], FloatArray]

#: Columns of `Splats`, the properties that each consists of, and its decode and encode.
COLUMNS: tuple[tuple[str, tuple[str, ...], Coding, Coding], ...] = (
    ("center", ("x", "y", "z"), np.asarray, np.asarray),
    ("rgb", ("f_dc_0", "f_dc_1", "f_dc_2"), quantize.decode_dc, quantize.encode_dc),
    ("opacity", ("opacity",), quantize.decode_logit, quantize.encode_logit),
    ("scale", ("scale_0", "scale_1", "scale_2"), quantize.decode_log, quantize.encode_log),
    ("quat_xyzw", ("rot_1", "rot_2", "rot_3", "rot_0"), normalized_quat, np.asarray),  # rot_0 is w; of any length
)
REQUIRED = tuple(name for _, names, _, _ in COLUMNS for name in names)

#: Missing properties that an error names.
FEW = 4

#: The scale that disks (2D Gaussian Splatting) lack or do not use, across their plane, and what they get in its place,
#: over the smaller of their two scales: less than a pixel wherever a disk is smaller than a picture, and above 0, which
#: formats of logarithms do not hold. Chosen.
ACROSS, THIN = "scale_2", np.float32(1e-3)


def open_content(source: Source) -> Content:
    """Open a PLY file. An ascii file is unpacked to `scratch`, as binary rows.

    Raises:
        FormatError: the file is not PLY, cut short, or does not hold splats.
    """
    file = source.file
    size = size_of(file)
    header = read_header(file)
    coefficients = _checked_coefficients(header)
    facts = {"properties": len(_row_type(header).names or ()), "ascii": int(header.text)}
    facts |= {"big_endian": int(header.byte_order == ">"), "trailing_bytes": header.check_size(size)}
    degree, count = degree_of(coefficients), header.count("vertex")
    # Splats of 2D Gaussian Splatting have two scales, or a third that does not count.
    disks = header.mode == "2dgs" or ACROSS not in (_row_type(header).names or ())
    unpack = _unpacking(_row_type(header), coefficients, disks=disks)
    rows = _rows(file, header, source.scratch)

    def fill(target: Target, threads: int, progress: Progress) -> None:
        some = rows(target.start, target.stop)
        decode_rows(some, lambda part, rows: unpack(rows, target.rows(part)), count, threads, progress)

    noted = read_comment(header.note)
    notes = notes_on_degree(degree) + noted.problems
    notes += ("its disks (2D Gaussian Splatting) are read as splats a thousandth as thick",) if disks else ()
    return Content(count, min(degree, MAX_SH_DEGREE), "PLY", fill, header.mode == "mip", notes, facts, noted.up)


def _unpacking(row_type: np.dtype[Any], coefficients: int, *, disks: bool) -> Callable[[NDArray[Any], Splats], None]:
    """Return the function that fills the columns of splats from rows."""
    names = list(row_type.names or ())
    places = {
        column: _run([names.index(name) for name in parts if not (disks and name == ACROSS)])
        for column, parts, _, _ in COLUMNS
    }
    rest = _run([names.index(f"f_rest_{index}") for index in range(3 * coefficients)])  # all of red's come first

    # Converters write infinite logits and logarithms for an opacity of 0 or 1 and a scale of 0.
    @np.errstate(over="ignore", invalid="ignore")
    def unpack(rows: NDArray[Any], splats: Splats) -> None:
        matrix = _matrix(rows)
        for column, _, decode_column, _ in COLUMNS:
            out = getattr(splats, column)
            if disks and column == "scale":
                out = out[:, :2]
            out[...] = decode_column(matrix[:, places[column]]).reshape(out.shape)
        if disks:
            splats.scale[:, 2] = THIN * splats.scale[:, :2].min(axis=1)
        sh = matrix[:, rest].reshape(len(rows), 3, coefficients)
        splats.sh[:] = sh[:, :, : splats.sh.shape[1]].transpose(0, 2, 1)

    return unpack


def _matrix(rows: NDArray[Any]) -> FloatArray:
    """Return (n, properties) float32 of structured rows, without a copy if all their fields are float32."""
    names = rows.dtype.names or ()
    if rows.flags.c_contiguous and all(rows.dtype[name] == np.float32 for name in names):
        return rows.view(np.float32).reshape(len(rows), len(names))
    matrix = np.empty((len(rows), len(names)), np.float32)
    for index, name in enumerate(names):
        matrix[:, index] = rows[name]
    return matrix


def _run(places: list[int]) -> slice | list[int]:
    """Return a slice if the places are consecutive, since indexing with it makes no copy; otherwise the list."""
    first = places[0] if places else 0
    run = slice(first, first + len(places))
    return run if places == list(range(run.start, run.stop)) else places


def _checked_coefficients(header: PlyHeader) -> int:
    """Check that the vertices are splats, and return the number of SH coefficients per channel."""
    if "vertex" not in header.elements:
        raise NotSplatsError("its PLY header has no element vertex")
    have = _row_type(header).names or ()
    missing = [name for name in REQUIRED if name not in have]
    if missing and missing != [ACROSS]:
        what = "a point cloud or a mesh, not Gaussian splats" if "x" in have else "not Gaussian splats"
        more = f" and {len(missing) - FEW} more" if len(missing) > FEW else ""
        raise NotSplatsError(f"{what}: its vertices have no {', '.join(missing[:FEW])}{more}")
    rest = sum(1 for name in have if re.fullmatch(r"f_rest_\d+", name))
    expected = {f"f_rest_{index}" for index in range(rest)}
    if rest % 3 or not expected.issubset(have):
        raise FormatError(f"{rest} f_rest properties; expected f_rest_0, f_rest_1 and so on, a multiple of 3")
    return rest // 3


def _row_type(header: PlyHeader) -> np.dtype[Any]:
    row_type = header.row_type("vertex")
    if row_type is None:
        raise NotSplatsError("its vertices have list properties, which splats do not have")
    return row_type


def _rows(file: BinaryIO, header: PlyHeader, scratch: Scratch | None) -> Callable[[int, int], Iterator[Rows]]:
    """Return the function that reads the vertices from a number to another."""
    row_type, count = _row_type(header), header.count("vertex")

    def opened() -> tuple[Positioned, int]:
        """Return a file of binary rows, and where they begin."""
        if not header.text:
            return Positioned(file), offset_of(file, header, "vertex")
        assert scratch is not None
        return Positioned(scratch(lambda: (rows.tobytes() for _, rows in _text_rows(file, header)))), 0

    def between(start: int, stop: int) -> Iterator[Rows]:
        if header.text and scratch is None:
            return _text_rows(file, header)
        source, offset = once()
        return rows_between(source, offset, row_type, start, stop, count, "vertices")

    once = functools.lru_cache(1)(opened)
    return between


def _text_rows(file: BinaryIO, header: PlyHeader) -> Iterator[Rows]:
    """Read the vertices of an ascii file in blocks; plyfile's own reader takes value by value in Python."""
    row_type, vertices = _row_type(header), header.count("vertex")
    file.seek(header.size)
    for name, (_, count) in header.elements.items():
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
            rows = np.loadtxt(lines, dtype=row_type, ndmin=1, comments=None)
        except ValueError as error:
            raise FormatError(f"bad PLY data after vertex {part.start:,}: {quoted(error)}") from None
        yield part, rows


def settled(scene: Scene, options: WriteOptions) -> WriteOptions:
    """Return the options: PLY has no choices; raises `FormatError` if the scene is a tree, which PLY cannot hold."""
    if scene.tree is not None:
        raise FormatError("PLY holds no Level-of-Detail tree")
    return options


def held(options: WriteOptions, sh_degree: int) -> tuple[CodeRange, ...]:
    """Return the values that PLY holds without clamping them: all, so there is no range."""
    return ()


def encode(
    scene: Scene, options: WriteOptions = DEFAULTS, *, threads: int = 1, progress: Progress = silent
) -> Iterator[bytes]:
    """Return the bytes of a binary PLY file in the layout of Inria's trainer, piece by piece.

    All numbers are finite: for opacities of 0 and 1 and scales of 0, whose logits and logarithms are infinite, those of
    `quantize.FAR` are written, which decode to the same values.

    Raises:
        FormatError: the scene is a tree, which PLY cannot hold.
    """
    settled(scene, options)
    splats = scene.splats
    row_type = np.dtype([(name, "<f4") for name in _inria_properties(splats.sh.shape[1])])
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [] if scene.up is None else [f"comment {comment_of(up=scene.up)}"]
    lines += ["comment SplatRenderMode: mip"] if scene.antialiased else []
    lines += [f"element vertex {len(splats)}"]
    lines += [f"property float {name}" for name in row_type.names or ()]
    yield "".join(f"{line}\n" for line in [*lines, "end_header"]).encode()
    yield from encode_rows(lambda part: _encode(splats, part, row_type), len(splats), threads, progress)


def _inria_properties(coefficients: int) -> list[str]:
    rest = [f"f_rest_{index}" for index in range(3 * coefficients)]
    rotation = ["rot_0", "rot_1", "rot_2", "rot_3"]
    return [*REQUIRED[:3], "nx", "ny", "nz", *REQUIRED[3:6], *rest, *REQUIRED[6:10], *rotation]


def _encode(splats: Splats, part: slice, row_type: np.dtype[Any]) -> bytes:
    rows = np.zeros(part.stop - part.start, row_type)  # normals are 0: viewers ignore them
    for column, names, _, encoder in COLUMNS:
        for name, values in zip(names, encoder(getattr(splats, column)[part]).reshape(len(rows), -1).T, strict=True):
            rows[name] = values
    sh = splats.sh[part].transpose(0, 2, 1).reshape(len(rows), -1)
    for index in range(sh.shape[1]):
        rows[f"f_rest_{index}"] = sh[:, index]
    return rows.tobytes()
