"""Files of arrays: layouts in a viewer's memory as .npz or raw words, colours and opacities as .npy or raw numbers."""

from __future__ import annotations

import io
import math
import os
import tokenize
import warnings
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from ..model.scene import Scene
from ..model.splats import FloatArray
from ..system.errors import FormatError, TruncatedError
from ..system.units import count_of
from ..system.untrusted import quoted, quoted_value
from . import data_texture, ext_splats, packed_splats, spark_nodes
from .zip_folder import ZIP_ERRORS

#: Largest header of a .npy file, bytes; that of a two-dimensional array has 118.
MAX_HEADER = 1 << 12

_READERS = {
    (1, 0): npy_format.read_array_header_1_0,
    (2, 0): npy_format.read_array_header_2_0,
    (3, 0): npy_format.read_array_header_2_0,  # differs in the names of records only, of which there are none
}


@dataclass(frozen=True)
class ArrayLayout:
    """Layout of an array in a file: shape, type, and whether the first index runs fastest."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    fortran_order: bool = False


def read_layout(file: BinaryIO) -> ArrayLayout | None:
    """Read the header of a .npy file, which is left at its numbers; None for another file, left at its beginning.

    Raises:
        FormatError: the header is not that of an array of plain numbers; the text continues a sentence about the file.
    """
    file.seek(0)
    is_npy = file.read(len(npy_format.MAGIC_PREFIX)) == npy_format.MAGIC_PREFIX
    file.seek(0)
    if not is_npy:
        return None
    try:
        version = npy_format.read_magic(file)
        if version not in _READERS:
            raise FormatError("is a .npy file of an unknown version")
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # of types by their former names
            shape, fortran_order, dtype = _READERS[version](file, max_header_size=MAX_HEADER)
    except (Warning, ValueError, TypeError, SyntaxError, RecursionError, MemoryError, tokenize.TokenError):
        raise FormatError("is not a .npy file of plain numbers: its header is malformed") from None
    if dtype.kind not in "biufc" or min(shape, default=0) < 0:
        raise FormatError(f"is not a .npy file of plain numbers: its header says {dtype} {shape}")
    return ArrayLayout(shape, dtype, fortran_order)


def read_values(file: BinaryIO, layout: ArrayLayout) -> NDArray[Any]:
    """Read the array at the current position of a file; raises `TruncatedError`, see `read_layout`."""
    size = math.prod(layout.shape) * layout.dtype.itemsize
    data = file.read(size)
    if len(data) < size:
        raise TruncatedError(f"ends {size - len(data):,} bytes before its last number")
    values: NDArray[Any] = np.frombuffer(data, layout.dtype)
    return values.reshape(layout.shape, order="F" if layout.fortran_order else "C")


def decode_rgba(file: BinaryIO, count: int, rows: slice | None = None) -> FloatArray:
    """Read colours and opacities for the `count` splats of a scene, or for a range: (n, 4) float32, 0..1.

    The type of a raw file follows from its size.

    Raises:
        FormatError: the format, length or values are wrong; the text continues a sentence about the file.
    """
    layout = read_layout(file) or _raw_layout(file, count)
    shape, dtype = layout.shape, layout.dtype
    if len(shape) != 2 or shape[1] != 4 or (dtype != np.uint8 and dtype.kind != "f"):
        raise FormatError(f"has {dtype}{list(shape)}, expected uint8 or floats [{count}, 4]")
    if shape[0] != count:
        raise FormatError(f"has colours for {count_of(shape[0], 'splat')}, the scene has {count:,}")
    if rows is not None and not layout.fortran_order:
        file.seek(rows.start * 4 * dtype.itemsize, os.SEEK_CUR)
        layout, rows = ArrayLayout((rows.stop - rows.start, 4), dtype), None
    values = read_values(file, layout)[rows or slice(None)]
    most = 255 if values.dtype == np.uint8 else 1
    if not ((values >= 0) & (values <= most)).all():
        raise FormatError("has values that are not 0..1")
    return np.ascontiguousarray(values, np.float32) / np.float32(most)


def _raw_layout(file: BinaryIO, count: int) -> ArrayLayout:
    size = os.fstat(file.fileno()).st_size
    if size == 16 * count:
        return ArrayLayout((count, 4), np.dtype("<f4"))
    if size % 4:
        raise FormatError(f"has {size:,} bytes, which are not four a splat")
    return ArrayLayout((size // 4, 4), np.dtype(np.uint8))


Arrays = dict[str, NDArray[Any]]


def pack_layout(scene: Scene, encoding: str, threads: int = 1) -> Arrays:
    """Return the uint32 arrays, by name, of a scene in one of `formats.ENCODINGS`, see docs/formats/memory.md.

    Raises ValueError if the encoding is that of a tree, and the scene has none.
    """
    if encoding == "packed":
        return packed_splats.pack(scene.splats, packed_splats.of_scene(scene), threads=threads)
    if encoding == "ext":
        return ext_splats.pack(scene.splats, threads=threads)
    if encoding == "texture":  # which does not hold the children of a tree
        return data_texture.pack(scene.splats, threads=threads)
    if scene.tree is None:
        raise ValueError("the scene has no tree")
    return spark_nodes.pack(scene.splats, scene.tree, threads=threads)


def encode_arrays(arrays: Arrays, *, raw: bool = False) -> Iterator[bytes]:
    """Return the bytes of a .npz file, the same for the same arrays; or, if `raw`, their little-endian words alone."""
    if raw:
        yield from (words.astype("<u4", copy=False).tobytes() for words in arrays.values())
        return
    file = io.BytesIO()
    np.savez(file, **arrays)  # type: ignore[arg-type]
    yield file.getvalue()


def decode_npz(file: BinaryIO) -> Arrays | None:
    """Read the arrays of a .npz file; None if the file is something else.

    Raises `FormatError` if an array is compressed, cut short or of no plain numbers.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            if not members or not all(member.filename.endswith(".npy") for member in members):
                return None
            return {member.filename.removesuffix(".npy"): _member(archive, member) for member in members}
    except ZIP_ERRORS:
        return None


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    # Stored members cannot claim more than the file has; compressed ones could, and build-lod writes none.
    if member.compress_type != zipfile.ZIP_STORED or member.flag_bits & 1:
        raise FormatError(f"its member {quoted_value(member.filename)} is compressed, unlike those of convert --layout")
    try:
        with archive.open(member) as file:
            data = io.BytesIO(file.read())
        layout = read_layout(data)
        if layout is None:
            raise FormatError("is not a .npy file")
        return read_values(data, layout)
    except (*ZIP_ERRORS, OSError) as error:
        raise FormatError(f"its member {quoted_value(member.filename)} is damaged: {quoted(error)}") from None
    except FormatError as error:
        raise type(error)(f"its member {quoted_value(member.filename)} {error}") from None
