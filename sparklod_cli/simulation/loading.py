"""`Loader`: visitors who open a page with scenes and wait in front of a camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..tables.columns import Row
from ..viewers.cut import TreeCut
from ..viewers.network import ChunkStream
from ..viewers.scenes import Cut, Scenes
from ..viewers.viewer_settings import LodSettings, StreamingSettings
from .frames import StreamedCuts
from .results import LOADING

#: The share of a cut that makes a picture almost what it will be; chosen.
MOST = 0.9


@dataclass(frozen=True)
class Arrival:
    """State when a chunk has arrived.

    Attributes:
        seconds: since the page was opened.
        bytes: that have arrived so far, of headers too.
        share: 0..1 of the splats of the whole cut that are resident.
        resident: (chunks,) bool, of all trees.
    """

    seconds: float
    bytes: int
    share: float
    resident: NDArray[np.bool_]


class Loader(StreamedCuts):
    """Visitors who open a page with scenes, each in front of a camera, and wait; see `StreamedCuts`.

    Args:
        seconds: since they opened the page, for `cut`.
    """

    def __init__(
        self, scenes: Scenes, settings: LodSettings, streaming: StreamingSettings | None = None, seconds: float = 0.0
    ) -> None:
        super().__init__(scenes, settings, streaming)
        self.seconds = seconds

    def arrivals(self, camera: Camera) -> Iterator[Arrival]:
        """Yield the state at the beginning and after each arrival of a chunk, as long as any are wanted.

        The camera rests. As soon as a chunk has arrived, the viewer finds the cut again, with the chunks that it has;
        Spark does so with the next picture that it draws.
        """
        per_chunk = self._splats_of(self.find(camera))
        total = max(1, int(per_chunk.sum()))
        stream = ChunkStream(self.chunks, self.streaming.network, capacity=self.streaming.chunk_cache)
        stream.want([])
        while True:
            resident = stream.cache.resident()
            yield Arrival(stream.now, stream.received, float(per_chunk[resident].sum()) / total, resident)
            stream.want(self.find(camera, resident).wanted())
            while not stream.take_arrivals():
                if not stream.step():
                    return

    def load(self, camera: Camera) -> Row:
        """Return the waits, `LOADING`, of a visitor who stays at a camera; None if a cut never fits the cache."""
        figures: Row = dict.fromkeys(column.name for column in LOADING)
        for arrival in self.arrivals(camera):
            if figures["first_picture_s"] is None and self.chunks.shows(arrival.resident):
                figures["first_picture_s"] = arrival.seconds
            for name, share in (("resident_90", MOST), ("resident_all", 1)):
                if figures[f"{name}_s"] is None and arrival.share >= share:
                    figures[f"{name}_s"], figures[f"{name}_bytes"] = arrival.seconds, arrival.bytes
            if arrival.share == 1:
                break
        return {column.name: column.rounded(figures[column.name]) for column in LOADING}

    def cut(self, camera: Camera) -> Cut:
        """Return what a visitor sees after `seconds`."""
        resident = np.zeros(len(self.chunks.sizes), np.bool_)
        for arrival in self.arrivals(camera):
            if arrival.seconds > self.seconds:
                break
            resident = arrival.resident
        return self.scenes.cut_of(self.find(camera, resident))

    def _splats_of(self, cut: TreeCut) -> NDArray[np.int64]:
        """Return the (chunks,) numbers of splats of a cut in each chunk of all trees."""
        counts = np.zeros(len(self.chunks.sizes), np.int64)
        scenes = [loaded for loaded in self.scenes.of_instance if loaded.kind is not None]
        for loaded, view, nodes in zip(scenes, cut.views, cut.indices(), strict=True):
            chunks, splats = np.unique(loaded.chunk_of(nodes.astype(np.int64)) - loaded.first_chunk, return_counts=True)
            counts[int(view["chunk_base"]) + chunks] += splats
        return counts
