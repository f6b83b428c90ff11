"""`Viewer`: fetches the chunks of scenes, `Loader`: while a page loads, `Simulation`: along a camera path."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..cameras.sources import CameraPath
from ..model.instances import TOTAL
from ..system.progress import Progress, silent
from ..system.threads import ordered_map
from ..tables.columns import Row
from ..viewers.cut import TreeCut, Viewer
from ..viewers.frame_statistics import Changes, CutStatistics, measure
from ..viewers.loaded_scene import STREAMED_SOG, TILES, TREE
from ..viewers.network import Chunks, ChunkStream
from ..viewers.scenes import Cut, CutFinder, Scenes
from ..viewers.viewer_settings import LodSettings, StreamingSettings
from .results import COLUMNS, LOADING, OF_BUDGETS, OF_TREES

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


class StreamedCuts(CutFinder):
    """Cuts of a viewer that fetches the chunks of scenes, for one camera after another.

    Args:
        scenes: with trees or detail levels; others are there from the beginning.
        settings: of the cuts; continuous cuts are not simulated.
        streaming: network and cache; everything is resident unless given.

    Raises:
        ValueError: the budget, or the cache, is too small for the roots; or there are too many instances.
    """

    settings: LodSettings
    viewer: Viewer
    remembers = False

    def __init__(self, scenes: Scenes, settings: LodSettings, streaming: StreamingSettings | None = None) -> None:
        self.streaming = streaming or StreamingSettings()
        super().__init__(scenes, settings, remembers=self.remembers and not self.streaming.network.instant)
        self.chunks = chunks_of(scenes)
        self.stream()  # raises what would fail later

    def stream(self, start: float = 0.0) -> ChunkStream:
        return ChunkStream(self.chunks, self.streaming.network, capacity=self.streaming.chunk_cache, start=start)


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

        The camera rests. As soon as a chunk has arrived, the viewer looks for the chunks that the cut needs, as far as
        it can tell from those that it has; Spark does so with the next picture that it draws.
        """
        per_chunk = self._splats_of(self.find(camera))
        total = max(1, int(per_chunk.sum()))
        stream = self.stream()
        stream.want([])
        while True:
            resident = stream.cache.resident()
            yield Arrival(stream.now, stream.received, float(per_chunk[resident].sum()) / total, resident)
            stream.want(self.find(camera, resident).wanted())
            while not stream.take_arrivals():
                if not stream.step():
                    return

    def load(self, camera: Camera) -> Row:
        """Return the waits, `LOADING`, of a visitor who stays at a camera; None for what never fits into the cache."""
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
        resident = np.zeros(len(self.chunks), np.bool_)
        for arrival in self.arrivals(camera):
            if arrival.seconds > self.seconds:
                break
            resident = arrival.resident
        return self.scenes.cut_of(self.find(camera, resident))

    def _splats_of(self, cut: TreeCut) -> NDArray[np.int64]:
        """Return the (chunks,) numbers of splats of a cut in each chunk of all trees."""
        counts = np.zeros(len(self.chunks), np.int64)
        scenes = [loaded for loaded in self.scenes.of_instance if loaded.kind is not None]
        for loaded, view, nodes in zip(scenes, cut.views, cut.indices(), strict=True):
            chunks, splats = np.unique(loaded.chunk_of(nodes.astype(np.int64)) - loaded.first_chunk, return_counts=True)
            counts[int(view["chunk_base"]) + chunks] += splats
        return counts


def chunks_of(scenes: Scenes) -> Chunks:
    """Return the chunks of scenes with cuts, and what a viewer needs before it can ask for them."""
    held = scenes.with_cuts
    return Chunks(
        [loaded.requests for loaded in held],
        [loaded.headers for loaded in held],
        rooted=scenes.kind == TREE,
        fetchers=held[0].fetchers,
        connections=held[0].connections,
    )


@dataclass(frozen=True)
class SimulatedFrame:
    """One frame.

    Attributes:
        number: number of the frame on the path.
        resident: (chunks,) bool, of all trees, the chunks that the cut was found with.
        rows: the row of all instances together, then one per instance, if requested.
        in_front: share of the drawn splats in front of the camera.
    """

    number: int
    camera: Camera
    cut: TreeCut
    resident: NDArray[np.bool_]
    rows: list[Row]
    in_front: float


@dataclass(frozen=True)
class _MeasuredCut:
    """A cut with its statistics, as a whole and by instance."""

    cut: TreeCut
    whole: CutStatistics
    parts: list[CutStatistics]


class Simulation(StreamedCuts):
    """A viewer that moves along a camera path through scenes that all have cuts."""

    remembers = True

    def __init__(
        self,
        scenes: Scenes,
        settings: LodSettings,
        streaming: StreamingSettings | None = None,
        *,
        by_instance: bool = False,
    ) -> None:
        super().__init__(scenes, settings, streaming)
        self._by_instance = by_instance
        self._names = [instance.name for instance in scenes.instances]

    def run(self, path: CameraPath, *, threads: int = 1, progress: Progress = silent) -> Iterator[SimulatedFrame]:
        """Yield the frames of a path, in order.

        Cuts are found on several threads, some frames ahead; anything that depends on the previous frame is done in
        order. If chunks are missing, the cut is found again with the resident ones.
        """
        stream = self.stream(path.cameras[0].time)
        changes = Changes(self.viewer.forest, self.viewer.instances)
        # Loads or compiles the kernels, so that the time of the first frame does not include it.
        self.viewer.cut(path.cameras[0], budget=len(self.viewer.instances))
        found = ordered_map(self._find, path.cameras, threads)
        for at, (number, camera, ideal) in enumerate(zip(path.numbers, path.cameras, found, strict=True)):
            stream.advance(max(camera.time, stream.now))
            drawn, resident, chunks = self._fetched(camera, ideal, stream)
            rows = self._rows(number, camera, drawn, changes.next(drawn.cut))
            rows[0] |= chunks
            whole = drawn.whole
            in_front = 1 - whole.behind / whole.selected if whole.selected else 1.0
            if self.scenes.kind != TREE:
                none = (*OF_TREES, *(OF_BUDGETS if self.scenes.kind == TILES else ()))
                rows = [row | dict.fromkeys(none) for row in rows]
            rows = [{column.name: column.rounded(row.get(column.name)) for column in COLUMNS} for row in rows]
            yield SimulatedFrame(number, camera, drawn.cut, resident, rows, in_front)
            progress("traverse", at + 1, len(path.cameras), "frame")

    def _find(self, camera: Camera, resident: NDArray[np.bool_] | None = None) -> _MeasuredCut:
        cut, size = self.find(camera, resident), (camera.width, camera.height)
        return _MeasuredCut(cut, *measure(self.viewer.forest, cut, camera, size=size, by_instance=self._by_instance))

    def _fetched(
        self, camera: Camera, ideal: _MeasuredCut, stream: ChunkStream
    ) -> tuple[_MeasuredCut, NDArray[np.bool_], Row]:
        """Return the cut with the resident chunks, these chunks, and the cells of the row that describe chunks."""
        requested = ideal.cut.wanted()
        instant = self.streaming.network.instant
        if instant:
            stream.want(requested)
        drawn, resident = ideal, stream.cache.resident()
        # What is drawn of detail levels depends on what was drawn before, as long as files are missing.
        if not all(chunk in stream.cache for chunk in requested) or (self.scenes.kind == STREAMED_SOG and not instant):
            drawn = self._find(camera, resident)
        if not instant:
            stream.want(drawn.cut.wanted())  # a viewer discovers chunks through those that it has
        arrived = stream.take_arrivals()
        cells: Row = {
            "chunks_touched": len(stream.cache.requested),
            "chunks_new": len(arrived),
            "bytes_new": stream.take_bytes(),
            "chunks_resident": len(stream.cache),
            "complete_in_s": None if instant else stream.complete_in(requested),
        }
        return drawn, resident, cells

    def _rows(
        self, number: int, camera: Camera, drawn: _MeasuredCut, changes: Sequence[tuple[int, int | None, int]]
    ) -> list[Row]:
        """Return the row of all instances, without the chunk cells, then one per instance, if requested."""
        cut, settings = drawn.cut, self.settings
        where: Row = {"frame": number, "time_s": camera.time, "name": camera.name}
        for name, vector in (("position", camera.position), ("forward", camera.forward)):
            where |= {f"{name}_{axis}": float(value) for axis, value in zip("xyz", vector, strict=True)}
        where |= {
            "fov_y_deg": float(np.degrees(camera.fov_y)),
            "width": camera.width,
            "height": camera.height,
            "budget": settings.budget,
            "pixel_scale_limit": settings.limit(camera.fov_y, camera.height),
        }
        selected, retained, before = (None if None in column else sum(column) for column in zip(*changes, strict=True))
        assert selected is not None and before is not None
        total = where | {"instance": TOTAL} | _shape(drawn.whole, settings.budget) | _change(selected, retained, before)
        total |= {
            "stop_reason": cut.reason,
            "pixel_scale_min": cut.least,
            "missing": cut.missing,
            "traverse_ms": 1000 * cut.seconds,
        }
        if not self._by_instance:
            return [total]
        return [
            total,
            *(
                where | {"instance": name} | _shape(part, settings.budget) | _change(*change)
                for name, part, change in zip(self._names, drawn.parts, changes, strict=True)
            ),
        ]


def _shape(measured: CutStatistics, budget: int) -> Row:
    shares: Row = {"interior": measured.selected - measured.leaves, "budget_used": measured.selected / budget}
    return shares | vars(measured)


def _change(selected: int, retained: int | None, before: int) -> Row:
    if retained is None:
        return {"added": selected, "removed": 0, "churn": None}
    added, removed = selected - retained, before - retained
    churn = (added + removed) / (selected + before) if selected + before else 0.0
    return {"added": added, "removed": removed, "churn": churn}
