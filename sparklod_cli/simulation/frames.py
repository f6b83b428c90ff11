"""Frames of a viewer along a camera path (`Simulation`), and waits of visitors while a page loads (`Loader`)."""

from __future__ import annotations

import functools
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..cameras.sources import CameraPath
from ..lod.kernels import cut_statistics as kernels
from ..lod.kernels.cut import CutNodes
from ..model import TOTAL
from ..system.output import write_file
from ..system.progress import Progress, silent
from ..system.threads import ordered_map
from ..tables.columns import Filter, Row
from ..viewers.loaded_scene import STREAMED_SOG, TILES, TREE, Forest, TreeCut, TreeInstance, Viewer
from ..viewers.scenes import Cut, CutFinder, Scenes
from ..viewers.streaming import ChunkCache, Chunks, ChunkStream
from ..viewers.viewer_settings import LodSettings, StreamingSettings, pixel_limit
from .results import COLUMNS, LOADING, OF_BUDGETS, OF_TREES, Extremes, FrameOutputs, Moment, add_extremes, moments_of


class SimulatedFrame(NamedTuple):
    """A frame of a simulation: its camera, cut, and rows of the table.

    Attributes:
        number: of the frame on the path.
        resident: (chunks,) bool, of all scenes, the chunks that the cut was found with.
        rows: the row of all instances together, then one per instance, if requested.
    """

    number: int
    camera: Camera
    cut: TreeCut
    resident: NDArray[np.bool_]
    rows: list[Row]


#: Nodes per row of Spark's index texture.
ROW = 16_384


class Simulation(CutFinder):
    """A viewer that fetches the chunks of scenes, for one camera after another; its cuts are never continuous.

    Scenes without cuts are resident from the beginning. Without `streaming` everything is.

    Raises:
        UnfitError: the budget, or the cache, is too small for the roots; or there are too many instances.
    """

    settings: LodSettings
    viewer: Viewer
    #: Whether cuts are found along a path, each beginning with what the one before it drew.
    remembers = True

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
        ChunkCache(self.chunks, self.streaming.chunk_cache)  # raises the errors of a cache that is too small

    def run(
        self, path: CameraPath, *, by_instance: bool = False, threads: int = 1, progress: Progress = silent
    ) -> Iterator[SimulatedFrame]:
        """Yield the frames of a path through scenes that all have cuts; `by_instance` adds rows of single instances.

        Cuts are found on several threads, some frames ahead; all else depends on the previous frame and is computed in
        order. If chunks are missing, the cut is found again with the resident ones.
        """
        cache, stream = ChunkCache(self.chunks, self.streaming.chunk_cache), None
        if not self.streaming.network.instant:
            start, network = path.cameras[0].time, self.streaming.network
            stream = ChunkStream(self.chunks, network, capacity=self.streaming.chunk_cache, start=start)
            cache = stream.cache
        changes = Changes(self.viewer.forest, self.viewer.instances)
        # Loads or compiles the kernels now, so that the time of the first frame does not include it.
        self.viewer.cut(path.cameras[0], budget=len(self.viewer.instances))
        found = ordered_map(functools.partial(self._find, by_instance=by_instance), path.cameras, threads)
        for at, (number, camera, ideal) in enumerate(zip(path.numbers, path.cameras, found, strict=True)):
            if stream is not None:
                stream.advance(max(camera.time, stream.now))
            headers = 0 if at else sum(map(sum, self.chunks.headers))
            drawn, resident, cells = self._fetched(camera, ideal, cache, stream, headers)
            rows = self._rows(number, camera, drawn, changes.next(drawn[0]))
            rows[0] |= cells
            if self.scenes.kind != TREE:
                none = (*OF_TREES, *(OF_BUDGETS if self.scenes.kind == TILES else ()))
                rows = [row | dict.fromkeys(none) for row in rows]
            rows = [{column.name: column.rounded(row.get(column.name)) for column in COLUMNS} for row in rows]
            yield SimulatedFrame(number, camera, drawn[0], resident, rows)
            progress("traverse", at + 1, len(path.cameras), "frame")

    def _find(self, camera: Camera, resident: NDArray[np.bool_] | None = None, *, by_instance: bool) -> MeasuredCut:
        cut = self.find(camera, resident)
        return cut, *measure(self.viewer.forest, cut, camera, by_instance=by_instance)

    def _fetched(
        self, camera: Camera, ideal: MeasuredCut, cache: ChunkCache, stream: ChunkStream | None, headers: int
    ) -> tuple[MeasuredCut, NDArray[np.bool_], Row]:
        """Return the cut with the resident chunks, these chunks, and the cells of the row that describe chunks.

        Without a stream there is no network: all chunks that fit the cache arrive at once. `headers` is the number of
        bytes of headers that are received with this frame.
        """
        requested, arrived, received, complete_in = ideal[0].wanted(), list[int](), headers, None
        if stream is None:
            cache.want(requested)
            arrived = cache.missing()
            received += sum(self.chunks.sizes[chunk] for chunk in arrived)
            for chunk in arrived:
                cache.arrive(chunk)
        drawn, resident = ideal, cache.resident()
        # Detail levels depend on those of the previous frame, as long as files are missing.
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
            cells = {"added": added, "removed": removed, "churn": churn, "budget_used": selected / settings.budget}
            rows.append(where | {"instance": name} | measured | cells)
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
    together, most = list[Row](), Extremes()
    extremes: dict[str, SimulatedFrame] = {}  # by criterion, and the first frame

    def rows() -> Iterator[Row]:
        for frame in simulation.run(path, by_instance=by_instance, threads=threads, progress=progress):
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
    drawn = [(cast("int", row["behind"]), cast("int", row["selected"])) for row in together]
    return together, float(np.mean([1 - behind / selected if selected else 1.0 for behind, selected in drawn])), note


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
    from ..images import charts, scene_plots

    frames = [extremes[criterion] for criterion in (*(moment.criterion for moment in moments), "first")]
    # The first that draws anything, as none does before the first chunk has arrived.
    frame = next((each for each in frames if len(each.cut)), frames[0])
    cut = simulation.scenes.cut_of(frame.cut)
    scene = scene_plots.PathScene(
        path.cameras,
        cut.splats,
        np.concatenate([part.depth for part in cut.parts]),
        path.numbers.index(frame.number),
        "tree depth" if simulation.scenes.kind == TREE else "level",
    )
    marked = {moment.criterion: moment.frame for moment in moments}
    return charts.plot(rows, marked, simulation.scenes.title, scene)


#: A cut with its statistics, as a whole and by instance.
MeasuredCut = tuple[TreeCut, Row, list[Row]]


def measure(forest: Forest, cut: TreeCut, view: Camera, *, by_instance: bool = False) -> tuple[Row, list[Row]]:
    """Return the statistics of a cut found for `view` as a whole and, optionally, of each instance in it.

    They are cells of `simulation.results.COLUMNS`. Levels are None if no node is selected, projected sizes if none is
    inside the frustum.
    """
    pixels = view.width * view.height
    counts = np.empty((len(cut.views), kernels.COUNTS), np.int64)
    sizes, owners = np.empty(len(cut.node), np.float32), np.empty(len(cut.node), np.uint16)
    screen = kernels.Screen(
        np.float32(math.tan(view.fov_x / 2)),
        np.float32(math.tan(view.fov_y / 2)),
        np.float32(pixel_limit(view.fov_y, view.height)),
        float(pixels),
    )
    nodes = CutNodes(cut.node, cut.limit.view(np.int32), cut.instance)
    found = kernels.measure_cut(forest.nodes, forest.depth, cut.views, nodes, screen, counts, sizes, owners)
    sizes, owners = sizes[:found], owners[:found]
    total = counts.sum(axis=0)
    total[kernels.DEPTH_MIN] = counts[:, kernels.DEPTH_MIN].min()
    total[kernels.DEPTH_MAX] = counts[:, kernels.DEPTH_MAX].max()
    whole = _measured(total, sizes, pixels)
    if not by_instance:
        return whole, []
    order = np.argsort(owners, kind="stable")
    parts = np.split(sizes[order], np.cumsum(np.bincount(owners, minlength=len(cut.views)))[:-1])
    return whole, [_measured(row, part, pixels) for row, part in zip(counts, parts, strict=True)]


def _measured(row: NDArray[np.int64], sizes: NDArray[np.float32], pixels: int) -> Row:
    """Return the statistics of a cut for a row of the table.

    Args:
        row: counts, see `kernels.COUNTS`.
        sizes: projected sizes of the splats inside the frustum, pixels.
        pixels: number of pixels of the picture.
    """
    selected, leaves, frontier, in_frustum, outside, behind, least, levels, most, area = row.tolist()
    percentiles: list[float | None] = [None, None]
    if len(sizes):  # interpolated linearly between two sizes each
        places = [share * (len(sizes) - 1) for share in (0.50, 0.95)]
        pairs = [(int(at), min(int(at) + 1, len(sizes) - 1)) for at in places]
        found = np.empty((len(pairs), 2), np.float32)
        kernels.select(sizes, np.array(pairs, np.int64).ravel(), found.ravel())
        percentiles = [
            below + (at - int(at)) * (above - below) if above > below else below  # both may be infinite
            for at, (below, above) in zip(places, found.tolist(), strict=True)
        ]
    return {
        "selected": selected,
        "leaves": leaves,
        "interior": selected - leaves,
        "frontier": frontier,
        "in_frustum": in_frustum,
        "outside": outside,
        "behind": behind,
        "level_min": least if selected else None,
        "level_mean": levels / selected if selected else None,
        "level_max": most if selected else None,
        "projected_px_p50": percentiles[0],
        "projected_px_p95": percentiles[1],
        "overdraw_estimate": area / kernels.AREA_PARTS / pixels,
    }


class Changes:
    """Compares each cut with the one before it."""

    def __init__(self, forest: Forest, instances: Sequence[TreeInstance]) -> None:
        sizes = np.diff(forest.node_base)
        # A bit for each node; each instance begins with a new word.
        words = np.cumsum([0, *(-(-int(sizes[instance.tree]) // 32) for instance in instances)])
        self._base = (32 * words[:-1]).astype(np.int64)
        self._drawn, self._before = (np.zeros(int(words[-1]), np.uint32) for _ in range(2))
        self._last: tuple[NDArray[np.uint32], NDArray[np.uint16]] | None = None
        self._counts = [0] * len(instances)

    def next(self, cut: TreeCut) -> list[tuple[int, int | None, int]]:
        """Return for each instance: nodes in this cut, nodes in both this and the last cut, and nodes in the last cut.

        The second is None for the first cut.
        """
        found = np.empty((len(self._base), 2), np.int64)
        old = self._last or (cut.node[:0], cut.instance[:0])
        kernels.replace_drawn(self._drawn, self._before, self._base, cut.node, cut.instance, *old, found)
        first = self._last is None
        result = [
            (new, None if first else same, before)
            for (new, same), before in zip(found.tolist(), self._counts, strict=True)
        ]
        self._drawn, self._before = self._before, self._drawn
        self._last, self._counts = (cut.node, cut.instance), found[:, 0].tolist()
        return result


#: Share of a cut with which a picture is nearly complete; chosen.
MOST = 0.9


class Arrival(NamedTuple):
    """State of a page when a chunk has arrived.

    Attributes:
        seconds: since the page was opened.
        bytes: received so far, headers included.
        share: 0..1 of the splats of the whole cut that are resident.
        resident: (chunks,) bool, of all scenes.
    """

    seconds: float
    bytes: int
    share: float
    resident: NDArray[np.bool_]


class Loader(Simulation):
    """Visitors who open a page with scenes, each in front of a camera at rest, and wait.

    Args:
        seconds: since they opened the page, for `cut`.
    """

    remembers = False

    def __init__(
        self, scenes: Scenes, settings: LodSettings, streaming: StreamingSettings | None = None, seconds: float = 0.0
    ) -> None:
        super().__init__(scenes, settings, streaming)
        self.seconds = seconds

    def arrivals(self, camera: Camera) -> Iterator[Arrival]:
        """Yield the state at the beginning and after each arrival of a chunk, as long as any are wanted.

        As soon as a chunk has arrived, the viewer finds the cut again, with the resident chunks; Spark does so with the
        next picture that it draws.
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
        """Return the waits of a visitor, `LOADING`; those for a whole cut that never fits the cache are None."""
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
        """Return the cut that a visitor sees after `seconds`."""
        resident = np.zeros(len(self.chunks.sizes), np.bool_)
        for arrival in self.arrivals(camera):
            if arrival.seconds > self.seconds:
                break
            resident = arrival.resident
        return self.scenes.cut_of(self.find(camera, resident))

    def _splats_of(self, cut: TreeCut) -> NDArray[np.int64]:
        """Return (chunks,) int64, the splats of a cut in each chunk of all scenes."""
        counts = np.zeros(len(self.chunks.sizes), np.int64)
        scenes = [loaded for loaded in self.scenes.of_instance if loaded.kind is not None]
        for loaded, view, nodes in zip(scenes, cut.views, cut.indices(), strict=True):
            chunks, splats = np.unique(loaded.chunk_of(nodes.astype(np.int64)) - loaded.first_chunk, return_counts=True)
            counts[int(view["chunk_base"]) + chunks] += splats
        return counts
