"""Simulation of loading a page with trees or Streamed SOG, arrival by arrival."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..lod.settings import LodSettings
from ..lod.traversal import TreeCut
from ..scenes.finder import CutFinder, view_of
from ..scenes.loaded import Cut, Scenes
from ..tables.columns import Row
from .results import LOADING
from .streaming import Chunks, ChunkStream, header_answers
from .streaming_settings import StreamingSettings

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


class Viewer:
    """A viewer that fetches the chunks of scenes, for one camera after another.

    Args:
        scenes: with trees or detail levels; others are there from the beginning.
        settings: of the cuts; continuous cuts are not simulated.
        streaming: network and cache; everything is resident unless given.
        remembers: cuts are found one after the other, along a path; see `Scenes.traversal`.

    Raises:
        ValueError: the budget, or the cache, is too small for the roots; or there are too many instances.
    """

    def __init__(
        self,
        scenes: Scenes,
        settings: LodSettings,
        streaming: StreamingSettings | None = None,
        *,
        remembers: bool = False,
    ) -> None:
        self.scenes, self.settings = scenes, settings
        self._streaming = streaming or StreamingSettings()
        self._traversal = scenes.traversal(settings, remembers=remembers and not self._streaming.network.instant)
        self._chunks = chunks_of(scenes)
        self._stream()  # raises what would fail later

    def _stream(self, start: float = 0.0) -> ChunkStream:
        """Return a stream that starts at a time in seconds."""
        return ChunkStream(self._chunks, self._streaming.network, capacity=self._streaming.chunk_cache, start=start)

    def _cut(self, camera: Camera, resident: NDArray[np.bool_] | None = None) -> TreeCut:
        """Return the cut with the resident chunks, all unless given."""
        limit = self.settings.limit(camera.fov_y, camera.height)
        return self._traversal.cut(view_of(camera), budget=self.settings.budget, smallest=limit, resident=resident)


class Loader(Viewer):
    """A visitor who opens a page with scenes and waits in front of a camera; see `Viewer`."""

    def arrivals(self, camera: Camera) -> Iterator[Arrival]:
        """Yield the state at the beginning and after each arrival of a chunk, as long as any are wanted.

        The camera rests. As soon as a chunk has arrived, the viewer looks for the chunks that the cut needs, as far as
        it can tell from those that it has; Spark does so with the next picture that it draws.
        """
        per_chunk = self._splats_of(self._cut(camera))
        total = max(1, int(per_chunk.sum()))
        stream = self._stream()
        stream.want([])
        while True:
            resident = stream.cache.resident()
            yield Arrival(stream.now, stream.received, float(per_chunk[resident].sum()) / total, resident)
            stream.want(self._cut(camera, resident).chunks())
            while not stream.take_arrivals():
                if not stream.step():
                    return

    def load(self, camera: Camera) -> Row:
        """Return the waits, `LOADING`, of a visitor who stays at a camera; None for what never fits into the cache."""
        figures: Row = dict.fromkeys(column.name for column in LOADING)
        for arrival in self.arrivals(camera):
            if figures["first_picture_s"] is None and self._chunks.shows(arrival.resident):
                figures["first_picture_s"] = arrival.seconds
            for name, share in (("resident_90", MOST), ("resident_all", 1)):
                if figures[f"{name}_s"] is None and arrival.share >= share:
                    figures[f"{name}_s"], figures[f"{name}_bytes"] = arrival.seconds, arrival.bytes
            if arrival.share == 1:
                break
        return {column.name: column.rounded(figures[column.name]) for column in LOADING}

    def cut_after(self, camera: Camera, seconds: float) -> Cut:
        """Return what is drawn for a camera so many seconds after the page was opened in front of it."""
        resident = np.zeros(len(self._chunks), np.bool_)
        for arrival in self.arrivals(camera):
            if arrival.seconds > seconds:
                break
            resident = arrival.resident
        return self.scenes.cut_of(self._cut(camera, resident))

    def _splats_of(self, cut: TreeCut) -> NDArray[np.int64]:
        """Return the (chunks,) numbers of splats of a cut in each chunk of all trees."""
        counts = np.zeros(len(self._chunks), np.int64)
        scenes = [loaded for loaded in self.scenes.of_instance if loaded.has_cuts]
        for loaded, view, nodes in zip(scenes, cut.views, cut.indices(), strict=True):
            chunks, splats = np.unique(loaded.chunk_of(nodes.astype(np.int64)) - loaded.first_chunk, return_counts=True)
            counts[int(view["chunk_base"]) + chunks] += splats
        return counts


class LoadingCuts(Loader):
    """Cuts of visitors some time after they opened the page, one visitor for each camera; a `CutSource`.

    Args:
        seconds: since then.

    Raises:
        ValueError: as `Loader`.
    """

    def __init__(self, scenes: Scenes, settings: LodSettings, streaming: StreamingSettings, seconds: float) -> None:
        super().__init__(scenes, settings, streaming)
        self._seconds = seconds

    def cut(self, camera: Camera) -> Cut:
        """Return what the visitor in front of a camera sees."""
        return self.cut_after(camera, self._seconds)

    def candidates(self) -> Cut:
        """Return the nodes visible to any camera."""
        return CutFinder(self.scenes, self.settings).candidates()


def chunks_of(scenes: Scenes) -> Chunks:
    """Return the chunks of scenes with cuts, and what a viewer needs before it can ask for them."""
    if scenes.in_runs:
        manifests = [[loaded.manifest_bytes] if loaded.manifest_bytes else [] for loaded in scenes.in_runs]
        requests = [loaded.requests for loaded in scenes.in_runs]
        kind = type(scenes.in_runs[0])
        return Chunks.of_requests(requests, manifests, fetchers=kind.fetchers, connections=kind.connections)
    return Chunks(
        [tree.chunk_bytes() for tree in scenes.trees],
        [header_answers(tree.header_bytes, tree.bytes) for tree in scenes.trees],
    )
