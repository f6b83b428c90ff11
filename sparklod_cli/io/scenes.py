"""Writes scenes as splat files, each whole or not at all, in one file or in several."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..codecs.encoder import Encoder, Get
from ..codecs.formats import Format
from ..codecs.options import WriteOptions
from ..model.scene import Scene
from ..support.addresses import Address, Place
from ..support.progress import Progress, silent
from .together import SinkTogether, sink_together
from .writing import Sink, sink

if TYPE_CHECKING:
    from ..codecs.rad.rad_reader import RadReader


@dataclass(frozen=True)
class SceneSink:
    """Writes a scene.

    Attributes:
        form: that is written.
        whole: writes one file; None for several.
        together: writes a header and the files that it names; None for one file.
        stem: of the names of chunks.
    """

    form: Format
    whole: Sink | None
    together: SinkTogether | None
    stem: str

    def __call__(self, scene: Scene, options: WriteOptions, *, threads: int = 1, progress: Progress = silent) -> int:
        """Writes a scene and returns how many bytes it wrote.

        Raises:
            OutputError: see `scene_sink`; and what the codec raises.
        """
        codec = self.form.codec()
        if self.whole is not None:
            return self.whole(codec.encode(scene, options, threads=threads, progress=progress))
        assert self.together is not None
        if self.form.unbundled is not None:
            files = codec.encode_files(scene, options, threads=threads, progress=progress)
            return self.together((name, (content,)) for name, content in files)
        return self.together(codec.encode_chunked(scene, options, self.stem, threads=threads, progress=progress))

    def repack(self, chunks: RadReader) -> int:
        """Write the chunks of a RAD file as they stand, and return how many bytes were written.

        Raises:
            OutputError: see `scene_sink`.
        """
        if self.whole is not None:
            return self.whole(chunks.in_one_file())
        assert self.together is not None
        return self.together(chunks.in_files(self.stem))

    def assemble(self, encoder: Encoder, get: Get, *, threads: int = 1, progress: Progress = silent) -> int:
        """Writes a tree whose windows are encoded, and returns how many bytes it wrote.

        Args:
            encoder: of the tree, in the format of this sink.
            get: reads the results of the windows.
            threads: to compress on.
            progress: told of what is written.

        Raises:
            OutputError: see `scene_sink`.
        """
        if self.whole is not None:
            return self.whole(encoder.pieces(get, threads=threads, progress=progress))
        assert self.together is not None
        return self.together(self.form.codec().assemble_chunked(encoder, get, self.stem, progress=progress))


def scene_sink(path: Place, form: Format, *, chunked: bool = False, overwrite: bool) -> SceneSink:
    """What writes a scene in a format. Fails now if the output cannot be written later.

    Args:
        path: of the file, or of the header where `chunked`; - is standard output, for one file. One that is called as
            the `unbundled` of the format has the other files beside it.
        form: that is written.
        chunked: with each chunk in a file of its own, beside the header; of RAD.
        overwrite: replace files that exist.

    Raises:
        OutputError: see `sink` and `sink_together`. Writing raises that, too, and what the codec raises.
    """
    stem = path.stem if isinstance(path, Address) else Path(os.path.realpath(path)).stem
    if chunked or path.name.lower() == form.unbundled:
        return SceneSink(form, None, sink_together(path, overwrite=overwrite), stem)
    return SceneSink(form, sink(path, overwrite=overwrite), None, stem)
