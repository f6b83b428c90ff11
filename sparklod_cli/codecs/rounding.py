"""Splats after a round trip through an encoding of Spark's or of a file: shows what its rounding does.

Imports nothing heavy: `--help` names the encodings.
"""

from __future__ import annotations

import functools
import io
from collections.abc import Callable
from typing import TYPE_CHECKING

from ..system.errors import FormatError
from .formats import WRITABLE
from .options import WriteOptions

if TYPE_CHECKING:
    from pathlib import Path

    from ..model.scene import Scene
    from ..model.splats import Splats


def _packed(scene: Scene, threads: int) -> Splats:
    from .gpu import packed_splats

    encoding = packed_splats.of_scene(scene)
    arrays = packed_splats.pack(scene.splats, encoding, threads=threads)
    return packed_splats.unpack(arrays, encoding, threads=threads)


def _ext(scene: Scene, threads: int) -> Splats:
    from .gpu import ext_splats

    return ext_splats.unpack(ext_splats.pack(scene.splats, threads=threads), threads=threads)


def _file(form: str, scene: Scene, threads: int) -> Splats:
    from .reader import decode_file

    codec = WRITABLE[form].codec()
    options = WriteOptions(compression_level=1)  # the bytes live for a moment only, so they need not be small
    data = b"".join(codec.encode(scene, options, threads=threads))
    splats: Splats = decode_file(codec, io.BytesIO(data), threads=threads).splats
    return splats


#: Round trips by the name that `--through` knows: PackedSplats as Spark has them for such a scene, ExtSplats, and SPZ
#: and RAD as build-lod writes them.
ROUND_TRIPS: dict[str, Callable[[Scene, int], Splats]] = {
    "packed": _packed,
    "ext": _ext,
    "spz": functools.partial(_file, ".spz"),
    "rad": functools.partial(_file, ".rad"),
}


def after(through: str | None, file: Path, scene: Scene, threads: int = 1) -> Splats:
    """Encode and decode the splats of a scene.

    Raises:
        FormatError: SPZ cannot hold the splats, or some are invalid; names the file.
    """
    if through is None:
        return scene.splats
    from ..model.splats import describe_invalid

    invalid = scene.splats.invalid()
    if invalid:  # of a tree: those of plain files are left out
        raise FormatError(f"{file}: {describe_invalid(invalid)}; no encoding holds such splats")
    try:
        return ROUND_TRIPS[through](scene, threads)
    except FormatError as error:
        raise FormatError(f"{file}: {error}") from None
