"""Writes scenes as splat files, each whole or not at all, in one file or with chunks in files of their own."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Protocol

from ..codecs.formats import Format
from ..codecs.options import WriteOptions
from ..model.scene import Scene
from ..support.addresses import Address, Place
from ..support.progress import Progress, silent
from .together import sink_together
from .writing import sink


class SceneSink(Protocol):
    """Writes a scene and returns how many bytes it wrote."""

    def __call__(
        self, scene: Scene, options: WriteOptions, *, threads: int = 1, progress: Progress = silent
    ) -> int: ...


def scene_sink(path: Place, form: Format, *, chunked: bool = False, overwrite: bool) -> SceneSink:
    """The function that writes a scene in a format. Fails now if the output cannot be written later.

    Args:
        path: of the file, or of the header where `chunked`; - is standard output, for one file.
        form: that is written.
        chunked: with each chunk in a file of its own, beside the header; of RAD.
        overwrite: replace files that exist.

    Raises:
        OutputError: see `sink` and `sink_together`. The function itself raises that, too, and what the codec raises.
    """
    if not chunked:
        whole = sink(path, overwrite=overwrite)
        return lambda scene, options, *, threads=1, progress=silent: whole(
            form.codec().encode(scene, options, threads=threads, progress=progress)
        )
    together = sink_together(path, overwrite=overwrite)
    stem = path.stem if isinstance(path, Address) else Path(os.path.realpath(path)).stem
    return lambda scene, options, *, threads=1, progress=silent: together(
        form.codec().encode_chunked(scene, options, stem, threads=threads, progress=progress)
    )
