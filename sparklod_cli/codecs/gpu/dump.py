"""Baked trees as arrays of words in the layouts of viewers, for engines that upload them unchanged."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...model.scene import Scene
from ...system.errors import FormatError
from ...system.untrusted import quoted, quoted_value
from .. import rgba
from ..zip_folder import ZIP_ERRORS
from . import data_texture, ext_splats, lod_tree, packed_splats

Arrays = dict[str, NDArray[Any]]


def pack(scene: Scene, encoding: str, threads: int = 1) -> Arrays:
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
    return lod_tree.pack(scene.splats, scene.tree, threads=threads)


def encode(arrays: Arrays, *, raw: bool = False) -> Iterator[bytes]:
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
        layout = rgba.read_layout(data)
        if layout is None:
            raise FormatError("is not a .npy file")
        return rgba.read_values(data, layout)
    except (*ZIP_ERRORS, OSError) as error:
        raise FormatError(f"its member {quoted_value(member.filename)} is damaged: {quoted(error)}") from None
    except FormatError as error:
        raise type(error)(f"its member {quoted_value(member.filename)} {error}") from None
