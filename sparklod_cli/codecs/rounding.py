"""Splats as they are after an encoding of Spark's, or of a file: to see what its rounding does."""

from __future__ import annotations

import io
from pathlib import Path

from ..model.scene import Scene
from ..model.splats import Splats
from ..support.errors import FormatError
from . import spz
from .gpu import ext_splats, packed_splats


def after(through: str | None, file: Path, scene: Scene, threads: int = 1) -> Splats:
    """The splats of a scene, encoded and decoded.

    Args:
        through: one of `defaults.THROUGH`: PackedSplats as Spark has them for such a scene, ExtSplats, or SPZ as
            build-lod writes it; None leaves them as they are.
        file: that the scene is of, for errors.
        scene: with a tree or without.
        threads: to work on.

    Raises:
        FormatError: SPZ cannot hold them; names the file.
    """
    if through == "packed":
        encoding = packed_splats.Encoding(lod_opacity=scene.tree is not None)
        return packed_splats.unpack(
            packed_splats.pack(scene.splats, encoding, threads=threads), encoding, threads=threads
        )
    if through == "ext":
        return ext_splats.unpack(ext_splats.pack(scene.splats, threads=threads), threads=threads)
    if through == "spz":
        try:
            # The bytes live for a moment only, so they need not be small.
            data = b"".join(spz.encode(scene, spz.Options(compression_level=1, threads=threads)))
        except FormatError as error:
            raise FormatError(f"{file}: {error}") from None
        return spz.decode(io.BytesIO(data), threads=threads).splats
    return scene.splats
