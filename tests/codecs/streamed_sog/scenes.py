"""Scenes at several detail levels, and their files, for the tests of Streamed SOG."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from typing import BinaryIO

import numpy as np

from sparklod_cli.codecs import streamed_sog as codec
from sparklod_cli.codecs.options import DEFAULTS
from sparklod_cli.lod.tree_settings import DetailSettings
from sparklod_cli.model.scene import DetailScene
from sparklod_cli.system.errors import FormatError
from tests.scenes import random_splats

#: Splats of each region at each level: there are empty runs, and a region that has only the last level.
COUNTS = np.array([[40, 12, 3], [1, 1, 0], [30, 0, 4], [0, 0, 2], [25, 9, 9]])

#: A tree of five regions that is not balanced.
CHILDREN = np.array([[-1, 1], [2, -5], [-2, 3], [-3, -4]])

#: Chunks of each level in `COUNTS` are closed when they have more splats than this.
SETTINGS = DetailSettings(chunk_splats=45, extent=2.5, min_splats=10)


def detail_scene(*, sh_degree: int = 1, environment: int = 6, errors: bool = True) -> DetailScene:
    """A scene of `COUNTS`."""
    splats = random_splats(int(COUNTS.sum()), sh_degree=sh_degree, seed=3)
    low = np.arange(5.0)[:, None] - [1 / 3, 2 / 7, 1e-9]
    return DetailScene(
        splats,
        COUNTS,
        np.stack([low, low + np.array([1, np.pi, 0.1])], axis=1),
        CHILDREN,
        np.array([[0, 0.1, 0.25]] * 5) if errors else None,
        random_splats(environment, sh_degree=sh_degree, seed=4) if environment else None,
    )


def files_of(scene: DetailScene, *, threads: int = 1) -> dict[str, bytes]:
    """What is written of a scene, in order."""
    files = codec.encode_files(scene, DEFAULTS, SETTINGS, threads=threads)
    return {name: b"".join(pieces) for name, pieces in files}


def open_companion(files: Mapping[str, bytes]) -> Callable[[str], BinaryIO]:
    """What opens files by name."""

    def opened(name: str) -> BinaryIO:
        if name not in files:
            raise FormatError(f"there is no {name!r:.40}")
        return io.BytesIO(files[name])

    return opened


def levels_of(files: Mapping[str, bytes], *, threads: int = 1) -> DetailScene:
    """What is read of files."""
    return codec.decode_parts(io.BytesIO(files["lod-meta.json"]), threads=threads, open_companion=open_companion(files))
