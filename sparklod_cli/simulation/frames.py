"""`Simulation`: the cuts that a viewer draws along a camera path, frame by frame, and the chunks that it fetches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..cameras.path import CameraPath
from ..lod.cut_statistics import Changes, CutStatistics, measure
from ..lod.settings import LodSettings
from ..lod.traversal import TreeCut
from ..model.instances import TOTAL
from ..scenes.finder import view_of
from ..scenes.loaded import Scenes
from ..support.parallel import ordered_map
from ..support.progress import Progress, silent
from ..tables.columns import Row
from .columns import COLUMNS, OF_TREES
from .loading import chunks_of
from .streaming import Stream
from .streaming_settings import StreamingSettings


@dataclass(frozen=True)
class Frame:
    """One frame.

    Attributes:
        number: number of the frame on the path.
        camera: its camera.
        cut: the cut that is drawn.
        resident: (chunks,) bool, of all trees, the chunks that it was found with.
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
    """A cut, and its statistics as a whole and by instance."""

    cut: TreeCut
    whole: CutStatistics
    parts: list[CutStatistics]


class Simulation:
    """A viewer that moves along a camera path through trees.

    Args:
        scenes: scenes that all have cuts: trees, or several detail levels.
        settings: settings of the cuts; continuous cuts are not simulated.
        streaming: network and cache; everything is resident unless given.
        by_instance: make a row per instance, too.

    Raises:
        ValueError: the budget, or the cache, is too small for the roots; or there are too many instances.
    """

    def __init__(
        self,
        scenes: Scenes,
        settings: LodSettings,
        streaming: StreamingSettings | None = None,
        *,
        by_instance: bool = False,
    ) -> None:
        self.scenes, self.settings, self._by_instance = scenes, settings, by_instance
        self._streaming = streaming or StreamingSettings()
        self._traversal = scenes.traversal(settings, remembers=not self._streaming.network.instant)
        self._depth = scenes.depth
        self._chunks = chunks_of(scenes)
        self._names = [instance.name for instance in scenes.instances]
        self._stream()  # raises what would fail at the first frame

    def _stream(self, start: float = 0.0) -> Stream:
        """A stream that starts at a time in seconds."""
        return Stream(self._chunks, self._streaming.network, capacity=self._streaming.chunk_cache, start=start)

    def run(self, path: CameraPath, *, threads: int = 1, progress: Progress = silent) -> Iterator[Frame]:
        """The frames of a path, in order.

        Cuts are found on several threads, some frames ahead; anything that depends on the previous frame is done in
        order. If chunks are missing, the cut is found again with the resident ones.
        """
        stream = self._stream(path.cameras[0].time)
        changes = Changes(self.scenes.forest, self._traversal.instances)
        self._warm_up(path.cameras[0])
        found = ordered_map(self._find, path.cameras, threads)
        for at, (number, camera, ideal) in enumerate(zip(path.numbers, path.cameras, found, strict=True)):
            stream.advance(max(camera.time, stream.now))
            drawn, resident, chunks = self._fetched(camera, ideal, stream)
            rows = self._rows(number, camera, drawn, changes.next(drawn.cut))
            rows[0] |= chunks
            whole = drawn.whole
            in_front = 1 - whole.behind / whole.selected if whole.selected else 1.0
            if self.scenes.details:
                rows = [row | dict.fromkeys(OF_TREES) for row in rows]
            yield Frame(number, camera, drawn.cut, resident, [_rounded(row) for row in rows], in_front)
            progress("traverse", at + 1, len(path.cameras), "frame")

    def _warm_up(self, camera: Camera) -> None:
        """Loads or compiles the kernels, so that the time of the first frame does not include it."""
        view = view_of(camera)
        self._traversal.cut(view, budget=len(self._traversal.instances))

    def _find(self, camera: Camera, resident: NDArray[np.bool_] | None = None) -> _MeasuredCut:
        view = view_of(camera)
        limit = self.settings.limit(camera.fov_y, camera.height)
        cut = self._traversal.cut(view, budget=self.settings.budget, smallest=limit, resident=resident)
        whole, parts = measure(
            self.scenes.forest,
            self._depth,
            cut,
            view,
            size=(camera.width, camera.height),
            by_instance=self._by_instance,
        )
        return _MeasuredCut(cut, whole, parts)

    def _fetched(
        self, camera: Camera, ideal: _MeasuredCut, stream: Stream
    ) -> tuple[_MeasuredCut, NDArray[np.bool_], Row]:
        """The cut with the resident chunks, these chunks, and the cells of the row that describe chunks."""
        wanted = ideal.cut.chunks()
        instant = self._streaming.network.instant
        if instant:
            stream.want(wanted)
        drawn, resident = ideal, stream.cache.resident()
        # What is drawn of detail levels depends on what was drawn before, as long as files are missing.
        if not all(chunk in stream.cache for chunk in wanted) or (self.scenes.details and not instant):
            drawn = self._find(camera, resident)
        if not instant:
            stream.want(drawn.cut.chunks())  # a viewer discovers chunks through those that it has
        arrived = stream.take_arrivals()
        cells: Row = {
            "chunks_touched": len(stream.cache.wanted),
            "chunks_new": len(arrived),
            "bytes_new": stream.take_bytes(),
            "chunks_resident": len(stream.cache),
            "complete_in_s": None if instant else stream.complete_in(wanted),
        }
        return drawn, resident, cells

    def _rows(
        self, number: int, camera: Camera, drawn: _MeasuredCut, changes: Sequence[tuple[int, int | None, int]]
    ) -> list[Row]:
        """The row of all instances together, without the chunk cells, then one per instance, if requested."""
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
        selected, kept, before = (None if None in column else sum(column) for column in zip(*changes, strict=True))
        assert selected is not None and before is not None
        total = where | {"instance": TOTAL} | _shape(drawn.whole, settings.budget) | _change(selected, kept, before)
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
    return {
        "selected": measured.selected,
        "leaves": measured.leaves,
        "interior": measured.selected - measured.leaves,
        "budget_used": measured.selected / budget,
        "frontier": measured.frontier,
        "level_min": measured.level_min,
        "level_mean": measured.level_mean,
        "level_max": measured.level_max,
        "in_frustum": measured.in_frustum,
        "outside": measured.outside,
        "behind": measured.behind,
        "projected_px_p50": measured.px_p50,
        "projected_px_p95": measured.px_p95,
        "overdraw_estimate": measured.overdraw,
    }


def _change(selected: int, kept: int | None, before: int) -> Row:
    if kept is None:
        return {"added": selected, "removed": 0, "churn": None}
    added, removed = selected - kept, before - kept
    return {
        "added": added,
        "removed": removed,
        "churn": (added + removed) / (selected + before) if selected + before else 0.0,
    }


def _rounded(row: Row) -> Row:
    return {column.name: column.rounded(row.get(column.name)) for column in COLUMNS}
