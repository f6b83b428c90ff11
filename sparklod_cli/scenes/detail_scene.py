"""`LoadedDetail`, a scene at several detail levels that is looked at."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..io import LevelFiles
from ..lod.detail_loading import DetailFiles
from ..model.scene import DetailScene, Scene
from ..model.splats import COLUMNS, Splats
from .loaded_scene import Index, LoadedScene


@dataclass(frozen=True, eq=False)
class LoadedDetail(LoadedScene):
    """A scene at several detail levels; `scene` and `splats` have those of all levels, then the environment.

    Attributes:
        detail: its regions.
        files: where its splats are.
    """

    detail: DetailScene = field(kw_only=True)
    files: DetailFiles = field(kw_only=True)

    @property
    def has_cuts(self) -> bool:
        return True

    @functools.cached_property
    def depth(self) -> NDArray[np.int32]:
        """(N,) the detail level of each splat; 0 of the environment."""
        levels = np.repeat(np.arange(self.detail.levels, dtype=np.int32), self.detail.counts.sum(axis=0))
        return np.concatenate([levels, np.zeros(self.count - len(levels), np.int32)])

    @functools.cached_property
    def leaves(self) -> Index:
        """(M,) indices of full detail: level 0, and the environment."""
        return np.flatnonzero(self.depth == 0)

    @property
    def chunks(self) -> int:
        """How many chunk files it has."""
        return len(self.files.sizes)

    def chunk_of(self, index: Index) -> NDArray[np.int64]:
        """(M,) numbers of the chunk files that some splats are in."""
        return self.first_chunk + self._file[index]

    @functools.cached_property
    def _file(self) -> NDArray[np.int64]:
        file = np.repeat(self.files.of_run.T.ravel(), self.detail.counts.T.ravel())
        return np.concatenate([file, np.full(self.count - len(file), self.files.environment or 0)])

    def chunk_bytes(self) -> NDArray[np.int64]:
        """(chunks,) bytes of each chunk file."""
        return self.files.sizes


def whole_scene(detail: DetailScene) -> Scene:
    """All levels and the environment as one plain scene."""
    parts = [detail.splats] if detail.environment is None else [detail.splats, detail.environment]
    splats = parts[0] if len(parts) == 1 else Splats.concat([part.with_max_sh(_degree(parts)) for part in parts])
    return Scene(splats, None, detail.antialiased, detail.format, detail.notes, detail.header, up=detail.up)


def files_of(found: LevelFiles) -> DetailFiles:
    """The chunk files of a manifest; regions are in its order."""
    manifest = found.manifest
    of_run = np.full((sum(1 for _ in manifest.regions()), manifest.levels), -1, np.int64)
    for row, (_, node) in zip(of_run, manifest.regions(), strict=True):
        for level, run in (node.runs or {}).items():
            if run.count:
                row[level] = run.file
    environment = None if manifest.environment is None else len(manifest.filenames)
    return DetailFiles(of_run, np.array(found.sizes, np.int64), environment, found.bytes)


def files_in_memory(detail: DetailScene) -> DetailFiles:
    """Files of a scene that was in memory: one for each level, of the bytes of its columns, and the environment."""
    of_run = np.where(detail.counts > 0, np.arange(detail.levels), -1)
    sizes = [_bytes_of(detail.splats) * int(count) // max(1, len(detail.splats)) for count in detail.counts.sum(axis=0)]
    if detail.environment is None:
        return DetailFiles(of_run, np.array(sizes, np.int64))
    return DetailFiles(of_run, np.array([*sizes, _bytes_of(detail.environment)], np.int64), detail.levels)


def _degree(parts: list[Splats]) -> int:
    return min(part.sh_degree for part in parts)


def _bytes_of(splats: Splats) -> int:
    return sum(getattr(splats, name).nbytes for name in COLUMNS)
