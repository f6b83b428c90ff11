"""`Simulation`: the frames of a viewer along a camera path, and their outputs."""

from __future__ import annotations

import functools
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..cameras.sources import CameraPath
from ..model import TOTAL
from ..system.output import write_file
from ..system.progress import Progress, silent
from ..system.threads import ordered_map
from ..tables.columns import Filter, Row
from ..viewers.chunk_cache import ChunkCache, Chunks
from ..viewers.cut import TreeCut, Viewer
from ..viewers.frame_statistics import Changes, CutStatistics, measure
from ..viewers.loaded_scene import STREAMED_SOG, TILES, TREE
from ..viewers.scenes import CutFinder, Scenes
from ..viewers.viewer_settings import LodSettings, StreamingSettings
from .results import COLUMNS, OF_BUDGETS, OF_TREES, Extremes, FrameOutputs, Moment, add_extremes, moments_of

if TYPE_CHECKING:
    from ..viewers.network import ChunkStream


class StreamedCuts(CutFinder):
    """Cuts of a viewer that fetches the chunks of scenes, for one camera after another; never continuous ones.

    Scenes without cuts are there from the beginning. Without `streaming` everything is resident.

    Raises:
        UnfitError: the budget, or the cache, is too small for the roots; or there are too many instances.
    """

    settings: LodSettings
    viewer: Viewer
    remembers = False

    def __init__(self, scenes: Scenes, settings: LodSettings, streaming: StreamingSettings | None = None) -> None:
        self.streaming = streaming or StreamingSettings()
        super().__init__(scenes, settings, remembers=self.remembers and not self.streaming.network.instant)
        held = scenes.with_cuts
        self.chunks = Chunks(
            [loaded.requests for loaded in held],
            [loaded.headers for loaded in held],
            rooted=scenes.kind == TREE,
            fetchers=held[0].fetchers,
            connections=held[0].connections,
        )
        ChunkCache(self.chunks, self.streaming.chunk_cache)  # raises what would fail later


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


#: Nodes per row of Spark's index texture.
ROW = 16_384

#: A cut with its statistics, as a whole and by instance.
MeasuredCut = tuple[TreeCut, CutStatistics, list[CutStatistics]]


class Simulation(StreamedCuts):
    """A viewer that moves along a camera path through scenes that all have cuts."""

    remembers = True

    def run(
        self, path: CameraPath, *, by_instance: bool = False, threads: int = 1, progress: Progress = silent
    ) -> Iterator[SimulatedFrame]:
        """Yield the frames of a path, in order; with `by_instance` also the rows of single instances.

        Cuts are found on several threads, some frames ahead; anything that depends on the previous frame is done in
        order. If chunks are missing, the cut is found again with the resident ones.
        """
        cache, stream = ChunkCache(self.chunks, self.streaming.chunk_cache), None
        if not self.streaming.network.instant:
            from ..viewers.network import ChunkStream

            start, network = path.cameras[0].time, self.streaming.network
            stream = ChunkStream(self.chunks, network, capacity=self.streaming.chunk_cache, start=start)
            cache = stream.cache
        changes = Changes(self.viewer.forest, self.viewer.instances)
        # Loads or compiles the kernels, so that the time of the first frame does not include it.
        self.viewer.cut(path.cameras[0], budget=len(self.viewer.instances))
        found = ordered_map(functools.partial(self._find, by_instance=by_instance), path.cameras, threads)
        for at, (number, camera, ideal) in enumerate(zip(path.numbers, path.cameras, found, strict=True)):
            if stream is not None:
                stream.advance(max(camera.time, stream.now))
            headers = 0 if at else sum(map(sum, self.chunks.headers))
            drawn, resident, cells = self._fetched(camera, ideal, cache, stream, headers)
            rows = self._rows(number, camera, drawn, changes.next(drawn[0]))
            rows[0] |= cells
            whole = drawn[1]
            in_front = 1 - whole.behind / whole.selected if whole.selected else 1.0
            if self.scenes.kind != TREE:
                none = (*OF_TREES, *(OF_BUDGETS if self.scenes.kind == TILES else ()))
                rows = [row | dict.fromkeys(none) for row in rows]
            rows = [{column.name: column.rounded(row.get(column.name)) for column in COLUMNS} for row in rows]
            yield SimulatedFrame(number, camera, drawn[0], resident, rows, in_front)
            progress("traverse", at + 1, len(path.cameras), "frame")

    def _find(self, camera: Camera, resident: NDArray[np.bool_] | None = None, *, by_instance: bool) -> MeasuredCut:
        cut = self.find(camera, resident)
        return cut, *measure(self.viewer.forest, cut, camera, by_instance=by_instance)

    def _fetched(
        self, camera: Camera, ideal: MeasuredCut, cache: ChunkCache, stream: ChunkStream | None, headers: int
    ) -> tuple[MeasuredCut, NDArray[np.bool_], Row]:
        """Return the cut with the resident chunks, these chunks, and the cells of the row that describe chunks.

        Without a stream there is no network: the chunks that fit the cache arrive at once, after so many bytes of
        `headers`.
        """
        requested, arrived, received, complete_in = ideal[0].wanted(), list[int](), headers, None
        if stream is None:
            cache.want(requested)
            arrived = cache.missing()
            received += sum(self.chunks.sizes[chunk] for chunk in arrived)
            for chunk in arrived:
                cache.arrive(chunk)
        drawn, resident = ideal, cache.resident()
        # What is drawn of detail levels depends on what was drawn before, as long as files are missing.
        if not resident[requested].all() or (self.scenes.kind == STREAMED_SOG and stream is not None):
            drawn = self._find(camera, resident, by_instance=bool(ideal[2]))
        if stream is not None:
            stream.want(drawn[0].wanted())  # a viewer discovers chunks through resident ones
            arrived, received = stream.take_arrivals(), stream.take_bytes()
            complete_in = stream.complete_in(requested)
        cells: Row = {
            "chunks_touched": len(cache.requested),
            "chunks_new": len(arrived),
            "bytes_new": received,
            "chunks_resident": int(cache.resident().sum()),
            "complete_in_s": complete_in,
        }
        return drawn, resident, cells

    def _rows(
        self, number: int, camera: Camera, drawn: MeasuredCut, changes: Sequence[tuple[int, int | None, int]]
    ) -> list[Row]:
        """Return the row of all instances, without the chunk cells, then one per instance, if requested."""
        (cut, whole, parts), settings = drawn, self.settings
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
        now, kept, then = zip(*changes, strict=True)
        total = sum(now), None if None in kept else sum(kept), sum(then)
        names = (instance.name for instance in self.scenes.instances)
        of_instances = zip(names, parts, changes, strict=True) if parts else ()
        rows = list[Row]()
        for name, measured, (selected, retained, before) in [(TOTAL, whole, total), *of_instances]:
            added, removed, churn = selected, 0, None
            if retained is not None:
                added, removed = selected - retained, before - retained
                churn = (added + removed) / (selected + before) if selected + before else 0.0
            cells = {"added": added, "removed": removed, "churn": churn}
            cells |= {
                "interior": measured.selected - measured.leaves,
                "budget_used": measured.selected / settings.budget,
            }
            rows.append(where | {"instance": name} | vars(measured) | cells)
        rows[0] |= {
            "stop_reason": cut.reason,
            "pixel_scale_min": cut.least,
            "missing": cut.missing,
            "traverse_ms": 1000 * cut.seconds,
        }
        return rows


def write_frames(
    simulation: Simulation,
    path: CameraPath,
    outputs: FrameOutputs,
    *,
    by_instance: bool = False,
    threads: int = 1,
    progress: Progress = silent,
    passed: Filter | None = None,
) -> tuple[list[Row], float, str | None]:
    """Simulate a camera path and write the outputs: table and index files frame by frame, then the charts.

    `passed` filters the bytes of a table on standard output. `OutputError` if a file cannot be written.

    Returns:
        the row of all instances together for each frame; the mean share of the drawn splats in front of the camera; and
        why the charts have no picture of the path, None if they have one, or if there are no charts.
    """
    together, in_front, most = list[Row](), list[float](), Extremes()
    extremes: dict[str, SimulatedFrame] = {}  # by criterion, and the first frame

    def rows() -> Iterator[Row]:
        for frame in simulation.run(path, by_instance=by_instance, threads=threads, progress=progress):
            in_front.append(frame.in_front)
            if outputs.indices is not None:
                _write_indices(frame, outputs)
            if outputs.plot is not None:
                extremes.setdefault("first", frame)
                criteria = add_extremes(most, frame.rows[0], is_first=not together)
                extremes.update(dict.fromkeys(criteria, frame))
            together.append(frame.rows[0])
            yield from frame.rows

    outputs.table.write(rows(), passed=passed)
    note = None
    if outputs.plot is not None:
        png, note = _charts(simulation, path, together, moments_of(most), extremes)
        write_file(outputs.plot, [png], overwrite=outputs.overwrite)
    return together, float(np.mean(in_front)), note


def _write_indices(frame: SimulatedFrame, outputs: FrameOutputs) -> None:
    parts = frame.cut.indices()
    for nodes, file in zip(parts, outputs.index_files([frame.number], len(parts)), strict=True):
        if outputs.padded:
            nodes = np.concatenate([nodes, np.zeros(-len(nodes) % ROW, np.uint32)]).reshape(-1, ROW)
        out = io.BytesIO()
        np.save(out, nodes)
        write_file(file, [out.getvalue()], overwrite=outputs.overwrite)


def _charts(
    simulation: Simulation,
    path: CameraPath,
    rows: Sequence[Row],
    moments: Sequence[Moment],
    extremes: Mapping[str, SimulatedFrame],
) -> tuple[bytes, str | None]:
    """Return the charts, with the path over the cut of an extreme frame, and why that picture is missing, if it is."""
    from ..figures import charts
    from ..viewers.loaded_scene import TREE

    frames = [extremes[criterion] for criterion in (*(moment.criterion for moment in moments), "first")]
    # The first that draws anything, as none does before the first chunk has arrived.
    frame = next((each for each in frames if len(each.cut)), frames[0])
    cut = simulation.scenes.cut_of(frame.cut)
    scene = charts.PathScene(
        path.cameras,
        cut.splats,
        np.concatenate([part.depth for part in cut.parts]),
        path.numbers.index(frame.number),
        "tree depth" if simulation.scenes.kind == TREE else "level",
    )
    marked = {moment.criterion: moment.frame for moment in moments}
    return charts.plot(rows, marked, simulation.scenes.title, scene)
