"""Scenes of which viewers draw whole runs of splats, each from a file that a manifest names."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..model.gaussian import spark_size
from .cut import Forest, TreeCut, TreeInstance, views_of
from .loaded_scene import LoadedScene


class LoadedRuns(LoadedScene):
    """A scene of which viewers draw whole runs of splats; its chunks are files."""

    @property
    def headers(self) -> tuple[int, ...]:
        return (self.manifest_bytes,) if self.manifest_bytes else ()

    @property
    def manifest_bytes(self) -> int:
        """Bytes of the manifest, which is read before any other file; 0 for a scene in memory."""
        raise NotImplementedError

    @property
    def chunks(self) -> int:
        """Number of files."""
        return len(self.chunk_bytes())

    def fill(self, rows: NDArray[np.void]) -> None:
        """Fill (N,) `NODE` with splats, for statistics of cuts; splats that finer ones replace have a child."""
        splats = self.scene.splats
        rows["x"], rows["y"], rows["z"] = splats.center.T
        rows["size"] = spark_size(splats)
        rows["child_count"] = 1
        rows["child_count"][self.leaves] = 0


def cut_of_runs(
    forest: Forest[Any],
    instances: Sequence[TreeInstance],
    view: Camera,
    nodes: Sequence[NDArray[np.uint32]],
    reason: str,
    missing: int,
    demand: NDArray[np.float32],
    start: float,
) -> TreeCut:
    """Return the cut of these splats of each instance, which `time.perf_counter` timed from `start` on."""
    return TreeCut(
        views=views_of(forest, instances, view),
        node=np.concatenate(nodes),
        instance=np.repeat(np.arange(len(nodes), dtype=np.uint16), [len(each) for each in nodes]),
        limit=np.full(sum(map(len, nodes)), -1, np.float32),
        reason=reason,
        missing=missing,
        least=np.inf,
        stop=None,
        demand=demand,
        seconds=time.perf_counter() - start,
    )
