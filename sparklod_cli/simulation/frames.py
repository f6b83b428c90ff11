"""Goes along a camera path and tells, frame by frame, what a viewer would draw."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..cameras.path import CameraPath
from ..lod.cut_statistics import Changes, Measured, measure
from ..lod.traversal import Cones, Cut, Frustum, Traversal, View, pixel_limit
from ..support.parallel import ordered_map
from ..support.progress import Progress, silent
from ..support.units import count_of
from ..tables.columns import Row
from ..world import TOTAL, World
from .chunk_cache import Chunks
from .columns import COLUMNS
from .streaming import Network, Stream

#: A cut has the number of an instance as a uint16.
MOST_INSTANCES = 65_535


@dataclass(frozen=True)
class LodSettings:
    """How a viewer is set.

    Attributes:
        budget: how many splats it draws at most, all instances together.
        foveation: how pixel scales count by direction, where an instance does not have its own.
        pixel_scale_limit: nodes of this pixel scale are not divided; None for the size of a pixel.
        render_scale: what the size of a pixel is multiplied by, Spark's `lodRenderScale`.
        network: what brings chunks.
        chunk_cache: how many chunks it holds; None for all.
    """

    budget: int
    foveation: Cones | Frustum = field(default_factory=Cones)
    pixel_scale_limit: float | None = None
    render_scale: float = 1.0
    network: Network = field(default_factory=Network)
    chunk_cache: int | None = None

    def smallest(self, camera: Camera) -> float:
        """The pixel scale at or under which it divides nothing."""
        if self.pixel_scale_limit is not None:
            return self.pixel_scale_limit
        return pixel_limit(camera.fov_y, camera.height, self.render_scale)


@dataclass(frozen=True)
class Frame:
    """One frame.

    Attributes:
        number: on the path.
        camera: of it.
        cut: what is drawn.
        rows: that of all instances, then those of each, if they are wanted.
        in_front: the share of all that is drawn that lies in front of the camera.
    """

    number: int
    camera: Camera
    cut: Cut
    rows: list[Row]
    in_front: float


@dataclass(frozen=True)
class _Found:
    """A cut, what it is like, as a whole and by instance, and how long it took."""

    cut: Cut
    whole: Measured
    parts: list[Measured]
    seconds: float


def view_of(camera: Camera) -> View:
    """A camera, as far as the traversal cares."""
    return View(camera.camera_to_world, camera.fov_x, camera.fov_y)


class Simulation:
    """A viewer in a world.

    Args:
        world: the trees.
        viewer: how it is set.
        by_instance: rows of single instances are wanted, too.

    Raises:
        ValueError: the budget, or the cache, is too small for even the roots; or there are too many instances.
    """

    def __init__(self, world: World, viewer: LodSettings, *, by_instance: bool = False) -> None:
        instances = world.foveated(viewer.foveation)
        if viewer.budget < len(instances):
            budget = count_of(viewer.budget, "splat")
            raise ValueError(f"a budget of {budget} is less than one for each of {len(instances)} instances")
        if len(instances) > MOST_INSTANCES:
            raise ValueError(f"{len(instances):,} instances are more than {MOST_INSTANCES:,}")
        self.world, self.viewer, self._by_instance = world, viewer, by_instance
        self._traversal = Traversal(world.forest, instances)
        self._level = np.concatenate([tree.level for tree in world.trees])
        self._chunks = Chunks(world.chunk_bytes())
        self._names = [place.name for place in world.placements]
        Stream(self._chunks, viewer.network, capacity=viewer.chunk_cache)  # refuses what would fail at the first frame

    def run(self, path: CameraPath, *, threads: int = 1, progress: Progress = silent) -> Iterator[Frame]:
        """The frames of a path, in order.

        Cuts are found on several threads, some frames ahead; what depends on the frame before is done in order. Where
        chunks are missing, the cut is found once more with what is there.
        """
        stream = Stream(self._chunks, self.viewer.network, capacity=self.viewer.chunk_cache, start=path.cameras[0].time)
        changes = Changes(self.world.forest, self._traversal.instances)
        self._warm_up(path.cameras[0])
        found = ordered_map(self._find, path.cameras, threads)
        for at, (number, camera, ideal) in enumerate(zip(path.numbers, path.cameras, found, strict=True)):
            stream.advance(max(camera.time, stream.now))
            drawn, chunks = self._fetched(camera, ideal, stream)
            rows = self._rows(number, camera, drawn, changes.next(drawn.cut))
            rows[0] |= chunks
            whole = drawn.whole
            in_front = 1 - whole.behind / whole.selected if whole.selected else 1.0
            yield Frame(number, camera, drawn.cut, [_rounded(row) for row in rows], in_front)
            progress("traverse", at + 1, len(path.cameras), "frame")

    def _warm_up(self, camera: Camera) -> None:
        """Loads or compiles the kernels, which must not count as the first frame's time."""
        view = view_of(camera)
        self._traversal.cut(view, budget=len(self._traversal.instances))

    @property
    def traversal(self) -> Traversal:
        """What finds its cuts."""
        return self._traversal

    def cut(self, camera: Camera) -> Cut:
        """What a camera would see if all chunks were there."""
        return self._find(camera).cut

    def _find(self, camera: Camera, resident: NDArray[np.bool_] | None = None) -> _Found:
        view = view_of(camera)
        smallest = self.viewer.smallest(camera)
        start = time.perf_counter()
        cut = self._traversal.cut(view, budget=self.viewer.budget, smallest=smallest, resident=resident)
        seconds = time.perf_counter() - start
        whole, parts = measure(
            self.world.forest,
            self._level,
            cut,
            view,
            size=(camera.width, camera.height),
            by_instance=self._by_instance,
        )
        return _Found(cut, whole, parts, seconds)

    def _fetched(self, camera: Camera, ideal: _Found, stream: Stream) -> tuple[_Found, Row]:
        """What is drawn with the chunks that are there, and the cells that tell of them."""
        wanted = ideal.cut.chunks()
        instant = self.viewer.network.instant
        if instant:
            stream.want(wanted)
        drawn = ideal
        if not all(chunk in stream.cache for chunk in wanted):
            drawn = self._find(camera, stream.cache.resident())
        if not instant:
            stream.want(drawn.cut.chunks())  # a viewer learns from the chunks that it has which others there are
        arrived = stream.take_arrivals()
        return drawn, {
            "chunks_touched": len(stream.cache.wanted),
            "chunks_new": len(arrived),
            "bytes_new": self._chunks.bytes_of(arrived),
            "chunks_resident": len(stream.cache),
            "complete_in_s": None if instant else stream.complete_in(wanted),
        }

    def _rows(
        self, number: int, camera: Camera, drawn: _Found, changes: Sequence[tuple[int, int | None, int]]
    ) -> list[Row]:
        """The row of all instances, but for its chunks, and those of each, if they are wanted."""
        cut, viewer = drawn.cut, self.viewer
        where: Row = {"frame": number, "time_s": camera.time, "name": camera.name}
        for name, vector in (("position", camera.position), ("forward", camera.forward)):
            where |= {f"{name}_{axis}": float(value) for axis, value in zip("xyz", vector, strict=True)}
        where |= {
            "fov_y_deg": float(np.degrees(camera.fov_y)),
            "width": camera.width,
            "height": camera.height,
            "budget": viewer.budget,
            "pixel_scale_limit": viewer.smallest(camera),
        }
        selected, kept, before = (None if None in column else sum(column) for column in zip(*changes, strict=True))
        assert selected is not None and before is not None
        total = where | {"instance": TOTAL} | _shape(drawn.whole, viewer.budget) | _change(selected, kept, before)
        total |= {
            "stop_reason": cut.reason,
            "pixel_scale_min": cut.least if np.isfinite(cut.least) else None,
            "missing": cut.missing,
            "traverse_ms": 1000 * drawn.seconds,
        }
        if not self._by_instance:
            return [total]
        return [
            total,
            *(
                where | {"instance": name} | _shape(part, viewer.budget) | _change(*change)
                for name, part, change in zip(self._names, drawn.parts, changes, strict=True)
            ),
        ]


def _shape(measured: Measured, budget: int) -> Row:
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
