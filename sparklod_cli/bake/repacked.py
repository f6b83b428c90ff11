"""The output of a RAD file whose chunks go into the other container as they stand."""

from __future__ import annotations

from dataclasses import dataclass

from ..codecs.statistics import Statistics
from ..io import SceneSink, opened
from ..model.scene import Scene
from ..model.splats import Splats
from ..support.addresses import Place
from ..support.progress import Progress
from .clock import Clock
from .whole_output import WholeOutput
from .written import WrittenTree


@dataclass(frozen=True)
class Repacked(WholeOutput):
    """A RAD file with the chunks of another one.

    Attributes:
        source: the other file.
        sink: writes it.
    """

    source: Place
    sink: SceneSink

    made = "its chunks are copied"

    def write(
        self,
        scene: Scene,
        environment: Splats | None,
        clock: Clock,
        threads: int,
        progress: Progress,
        counted: Statistics | None = None,
    ) -> WrittenTree:
        """Copies the chunks."""
        with opened(self.source) as (file, form, more):
            chunks = form.codec().RadReader.open(file, **more)
            size = self.sink.repack(chunks)
        clock.end("write")
        return WrittenTree(
            output_format="rad" if chunks.header.chunked else "rad-chunked",
            bytes=size,
            chunks=len(chunks.header.chunks),
            encodings=chunks.encodings,
            sh_codes=chunks.header.sh_code_count,
        )
