"""Outputs in parts that viewers load as needed: a Streamed SOG of regions at several levels, and 3D Tiles."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..codecs.formats import ENVIRONMENT, folders_of
from ..codecs.options import WriteOptions
from ..lod.part_settings import DetailSettings, TileSettings
from ..model.scene import Scene
from ..model.splats import Splats
from ..system.output import Output
from ..system.progress import Progress
from ..system.threads import on_threads


@dataclass(frozen=True)
class WrittenLevel:
    """Detail level of a Streamed SOG: splats of all regions, their share of level 0, and the largest error."""

    splats: int
    share: float
    worst_error: float


@dataclass(frozen=True)
class WrittenDetail:
    """Detail levels of a Streamed SOG.

    Attributes:
        levels: full detail first.
        chunks: number of folders.
        environment: number of splats that are always drawn.
    """

    levels: tuple[WrittenLevel, ...]
    regions: int
    chunks: int
    environment: int


@dataclass(frozen=True)
class WrittenTiles:
    """Tiles of a tileset.

    Attributes:
        splats: of each level's cut, the root's first; the last has full detail.
        error: geometric error of the root.
        georeferenced: the tileset stands on the Earth.
    """

    tiles: int
    levels: int
    splats: tuple[int, ...]
    error: float
    georeferenced: bool


def write_levels(
    scene: Scene,
    environment: Splats | None,
    out: Output,
    settings: DetailSettings,
    options: WriteOptions,
    end: Callable[[str], None],
    threads: int,
    progress: Progress,
) -> tuple[int, WrittenDetail]:
    """Make the levels of a tree and write them as a Streamed SOG; return the bytes of its files, and their record.

    Args:
        end: called with the name of each stage before the last one, when it is done.
    """
    from ..codecs.streamed_sog.codec import encode_files
    from ..lod.detail_levels import make
    from .region_errors import measured

    assert scene.tree is not None
    with on_threads(threads):
        made = make(scene.splats, scene.tree, settings, progress=progress)
    end("levels")
    errors = measured(made, threads=threads, progress=progress)
    end("errors")
    antialiased, up = scene.antialiased, scene.up
    made = dataclasses.replace(made, errors=errors, environment=environment, antialiased=antialiased, up=up)
    size, names = 0, list[str]()
    with out:
        for name, pieces in encode_files(made, options, settings, threads=threads, progress=progress):
            size += out.write(name, pieces)
            names.append(name)
    splats, worst = made.counts.sum(axis=0).tolist(), errors.max(axis=0).tolist()
    levels = tuple(
        WrittenLevel(count, round(count / splats[0], 6), error) for count, error in zip(splats, worst, strict=True)
    )
    chunks = len({*folders_of(names)} - {ENVIRONMENT})
    return size, WrittenDetail(levels, made.regions, chunks, 0 if environment is None else len(environment))


def write_tiles(
    scene: Scene,
    out: Output,
    settings: TileSettings,
    options: WriteOptions,
    end: Callable[[str], None],
    threads: int,
    progress: Progress,
) -> tuple[int, WrittenTiles]:
    """Make the tiles of a tree and write them as 3D Tiles; see `write_levels`."""
    from ..codecs.tiles_3d.codec import encode_files
    from ..lod.tiles import make

    assert scene.tree is not None
    with on_threads(threads):
        made = make(scene.splats, scene.tree, settings, progress=progress)
    made = dataclasses.replace(made, antialiased=scene.antialiased, up=scene.up)
    end("tiles")
    with out:
        files = encode_files(made, options, threads=threads, progress=progress)
        size = sum(out.write(*file) for file in files)
    levels = int(made.level.max()) + 1
    splats = tuple(int(made.counts[made.at_level(level)].sum()) for level in range(levels))
    georeferenced = not np.array_equal(made.transform, np.eye(4))
    return size, WrittenTiles(made.tiles, levels, splats, float(made.errors[0]), georeferenced)
