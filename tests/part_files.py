"""Scenes at several detail levels and in tiles, and their files: Streamed SOG and 3D Tiles."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from fixtures import by_hand_sog, by_hand_streamed_sog
from sparklod_cli.codecs import tiles_3d
from sparklod_cli.codecs.formats import TILESET, WriteOptions
from sparklod_cli.io.writing import parts_output
from sparklod_cli.lod import parts, quality
from sparklod_cli.lod.tree_settings import TileSettings
from sparklod_cli.model.instances import DetailScene
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.system.errors import FormatError
from tests.codecs.cases import linear
from tests.scenes import random_splats, write_files

#: Splats of each region at each level: there are empty runs, and a region that has only the last level.
COUNTS = np.array([[40, 12, 3], [1, 1, 0], [30, 0, 4], [0, 0, 2], [25, 9, 9]])

#: An unbalanced tree of five regions.
CHILDREN = np.array([[-1, 1], [2, -5], [-2, 3], [-3, -4]])


def detail_scene(*, sh_degree: int = 1, environment: int = 6, errors: bool = True) -> DetailScene:
    """Return a scene of `COUNTS` and `CHILDREN`."""
    low = np.arange(5.0)[:, None] - [1 / 3, 2 / 7, 1e-9]
    return DetailScene(
        random_splats(int(COUNTS.sum()), sh_degree=sh_degree, seed=3),
        COUNTS,
        np.stack([low, low + np.array([1, np.pi, 0.1])], axis=1),
        CHILDREN,
        np.array([[0, 0.1, 0.25]] * 5) if errors else None,
        random_splats(environment, sh_degree=sh_degree, seed=4) if environment else None,
    )


def regions_of(scene: DetailScene) -> list[list[dict[str, Any]]]:
    """Return the splats of each region at each level, as arguments of the writers in `fixtures`."""
    return [
        [linear(Scene(scene.splats.take(scene.run(region, level)))) for level in range(scene.levels)]
        for region in range(scene.regions)
    ]


def write_streamed(folder: Path, scene: DetailScene, *, together: int = 2) -> Path:
    """Write a Streamed SOG with the writers in `fixtures`, and return its manifest.

    Args:
        together: regions whose runs are in one chunk file.
    """
    around = None if scene.environment is None else linear(Scene(scene.environment))
    files = by_hand_streamed_sog.streamed_sog_files(
        regions_of(scene), by_hand_sog.sog_files, environment=around, together=together
    )
    put_files(folder, files)
    return folder / "lod-meta.json"


def tiled(splats: Splats, folder: Path, settings: TileSettings | None = None) -> Path:
    """Write splats of which -y is up as 3D Tiles, and return the tileset.json."""
    made = parts.make_tiles(*quality.build(splats, 2.0), settings or TileSettings())
    files = tiles_3d.encode_files(dataclasses.replace(made, up="-y"), WriteOptions())
    write_files(parts_output(folder / TILESET, overwrite=False), files)
    return folder / TILESET


def put_files(folder: Path, files: Mapping[str, bytes]) -> None:
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)


def open_companion(files: Mapping[str, bytes]) -> Callable[[str], BinaryIO]:
    """Return a function that opens files by name."""

    def opened(name: str) -> BinaryIO:
        if name not in files:
            raise FormatError(f"there is no {name!r:.40}")
        return io.BytesIO(files[name])

    return opened
