"""Writing a tree as 3D Tiles: its cuts, divided into tiles."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ..codecs.options import WriteOptions
from ..io.writing import SinkTogether
from ..lod.tile_settings import TileSettings
from ..model.tile_scene import TileScene
from ..support.progress import Progress
from ..support.threads import on_threads
from .output import BakeOutput, Encode
from .records import BuiltTree, Clock, WrittenTiles, WrittenTree


@dataclass(frozen=True)
class TileOutput(BakeOutput):
    """3D Tiles."""

    settings: TileSettings
    options: WriteOptions
    sink: SinkTogether

    def write(self, tree: BuiltTree, encode: Encode, clock: Clock, threads: int, progress: Progress) -> WrittenTree:
        """Make the tiles of a tree and write them."""
        from ..codecs.tiles_3d.codec import encode_files
        from ..lod.tiles import make

        scene = tree.scene
        assert scene.tree is not None
        with on_threads(threads):
            made = make(scene.splats, scene.tree, self.settings, progress=progress)
        made = dataclasses.replace(made, antialiased=scene.antialiased, up=scene.up)
        clock.end("tiles")
        size = self.sink(encode_files(made, self.options, threads=threads, progress=progress))
        clock.end("write")
        return WrittenTree(output_format="3d-tiles", bytes=size, tiles=_written(made))


def _written(made: TileScene) -> WrittenTiles:
    """Return the statistics of tiles that were written."""
    levels = int(made.level.max()) + 1
    splats = tuple(int(made.counts[made.at_level(level)].sum()) for level in range(levels))
    placed = not np.array_equal(made.transform, np.eye(4))
    return WrittenTiles(made.tiles, levels, splats, float(made.errors[0]), placed)
