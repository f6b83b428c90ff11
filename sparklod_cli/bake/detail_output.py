"""Writing a tree as a Streamed SOG: its regions at several detail levels, their errors, and chunk files."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from ..codecs.file_names import ENVIRONMENT, folders_of
from ..codecs.options import WriteOptions
from ..io.writing import Files, SinkTogether
from ..lod.detail_rule import DetailSettings
from ..model.scene import DetailScene, Scene
from ..model.splats import Splats
from ..support.progress import Progress
from ..support.threads import on_threads
from .output import BakeOutput, Encode
from .records import BuiltTree, Clock, WrittenDetail, WrittenLevel, WrittenTree


def detail_levels(
    scene: Scene,
    environment: Splats | None,
    settings: DetailSettings,
    clock: Clock,
    *,
    threads: int,
    progress: Progress,
) -> DetailScene:
    """Return regions of a tree at several detail levels, with their errors, and an environment, if any."""
    from ..lod.detail_levels import make
    from .region_errors import measured

    assert scene.tree is not None
    with on_threads(threads):
        made = make(scene.splats, scene.tree, settings, progress=progress)
    clock.end("levels")
    errors = measured(made, threads=threads, progress=progress)
    clock.end("errors")
    antialiased, up = scene.antialiased, scene.up
    return dataclasses.replace(made, errors=errors, environment=environment, antialiased=antialiased, up=up)


@dataclass(frozen=True)
class DetailOutput(BakeOutput):
    """A Streamed SOG."""

    settings: DetailSettings
    options: WriteOptions
    sink: SinkTogether

    def write(self, tree: BuiltTree, encode: Encode, clock: Clock, threads: int, progress: Progress) -> WrittenTree:
        """Make the levels of a tree and write them."""
        return self.write_levels(tree.scene, tree.environment, clock, threads, progress)

    def write_levels(
        self, scene: Scene, environment: Splats | None, clock: Clock, threads: int, progress: Progress
    ) -> WrittenTree:
        """Make the levels of a tree and write them, with the splats of an environment."""
        from ..codecs.streamed_sog.codec import encode_files

        made = detail_levels(scene, environment, self.settings, clock, threads=threads, progress=progress)
        names: list[str] = []
        files = encode_files(made, self.options, self.settings, threads=threads, progress=progress)
        size = self.sink(_noted(files, names))
        clock.end("write")
        return WrittenTree(output_format="streamed-sog", bytes=size, detail=_written_detail(made, names))


def _noted(files: Files, names: list[str]) -> Iterator[tuple[str, Iterable[bytes]]]:
    """Yield the same files; their names are added to a list."""
    for name, pieces in files:
        names.append(name)
        yield name, pieces


def _written_detail(made: DetailScene, names: list[str]) -> WrittenDetail:
    """Return the statistics of a scene that was written to files of these names."""
    assert made.errors is not None
    splats, errors = made.counts.sum(axis=0).tolist(), made.errors.max(axis=0).tolist()
    return WrittenDetail(
        levels=tuple(
            WrittenLevel(count, round(count / splats[0], 6), error) for count, error in zip(splats, errors, strict=True)
        ),
        regions=made.regions,
        chunks=len({*folders_of(names)} - {ENVIRONMENT}),
        environment=0 if made.environment is None else len(made.environment),
    )
