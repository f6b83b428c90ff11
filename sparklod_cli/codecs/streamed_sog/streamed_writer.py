"""Writes Streamed SOG: the runs of a scene at several detail levels, side by side in chunks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ...model import morton
from ...model.scene import Bounds, DetailScene, Scene
from ...model.splats import Splats
from ...system.errors import FormatError
from ...system.progress import Progress, silent
from ...system.threads import ordered_map
from .. import quantize
from ..file_names import ENVIRONMENT_FILE, MANIFEST, META, chunk_folder
from ..file_notes import note_of
from ..options import WriteOptions
from ..sog import codec as sog
from .manifest import VERSION, Bound, Manifest, ManifestNode, Run, serialise

#: Chunks that are encoded at a time: each takes some 0.5 KB a splat with SH of degree 2, measured.
TOGETHER = 2


class Divided(Protocol):
    """Division of a scene into regions, for the manifest; `lod.detail_rule.DetailSettings` is one."""

    @property
    def chunk_splats(self) -> int:
        """A chunk is closed when it has more splats than this."""

    @property
    def extent(self) -> float:
        """Longest side, in world units, beyond which a region is divided."""

    @property
    def min_splats(self) -> int:
        """A region of fewer splats is not divided for its extent."""


@dataclass(frozen=True)
class ChunkPlan:
    """Chunk to write: its folder, the detail level of its runs, and the regions whose runs it has, side by side."""

    folder: str
    level: int
    regions: range


def encode_files(
    scene: DetailScene,
    options: WriteOptions,
    settings: Divided,
    *,
    threads: int = 1,
    progress: Progress = silent,
) -> Iterator[tuple[str, Iterable[bytes]]]:
    """Return the files of a scene by name, which has a folder ("0_0/meta.json"); lod-meta.json comes last.

    Within a run, splats are in Morton order. The bytes are the same for any number of threads.

    Args:
        scene: whose splats are valid.

    Raises:
        FormatError: SOG cannot hold the splats, or float32, as viewers have it, not the bounds of the regions.
    """
    reach = float(np.abs(scene.bounds).max())
    if reach > float(quantize.LARGEST):
        raise FormatError(
            f"its regions reach {reach:.3g}, and viewers hold at most {quantize.LARGEST:.3g}; scale it down"
        )
    plans = planned(scene, settings.chunk_splats)
    total = len(scene.splats) + (0 if scene.environment is None else len(scene.environment))
    together = min(threads, TOGETHER)

    def encoded(plan: ChunkPlan | None) -> tuple[int, list[tuple[str, bytes]]]:
        """Return the files of a chunk; of the environment for None."""
        part = scene.environment if plan is None else _ordered(scene, plan)
        assert part is not None
        one = Scene(part, antialiased=scene.antialiased, up=scene.up)
        inside = max(1, threads // together)
        if plan is None:
            return len(part), [(ENVIRONMENT_FILE, b"".join(sog.encode(one, options, threads=inside)))]
        files = sog.encode_files(one, options, threads=inside, in_order=True)
        return len(part), [(f"{plan.folder}/{name}", data) for name, data in files]

    jobs: list[ChunkPlan | None] = [*plans]
    if scene.environment is not None:
        jobs.append(None)
    done = 0
    for count, files in ordered_map(encoded, jobs, together):
        for name, data in files:
            yield name, [data]
        done += count
        progress("writing", done, total, "splat")
    yield MANIFEST, [serialise(manifest_of(scene, plans, settings))]


def planned(scene: DetailScene, chunk_splats: int) -> list[ChunkPlan]:
    """Return the chunks of a scene: those of each level have its runs, region by region, until one is large enough."""
    plans = list[ChunkPlan]()
    for level in range(scene.levels):
        number = first = size = 0
        for region in range(scene.regions):
            size += int(scene.counts[region, level])
            if size > chunk_splats or (size and region == scene.regions - 1):
                plans.append(ChunkPlan(chunk_folder(level, number), level, range(first, region + 1)))
                number, first, size = number + 1, region + 1, 0
    return plans


def _ordered(scene: DetailScene, plan: ChunkPlan) -> Splats:
    """Return the splats of a chunk, each run in Morton order."""
    runs = (scene.run(region, plan.level) for region in plan.regions)
    index = [run.start + morton.order(scene.splats.center[run]) for run in runs if run.start < run.stop]
    return scene.splats.take(np.concatenate(index))


def manifest_of(scene: DetailScene, plans: list[ChunkPlan], settings: Divided) -> Manifest:
    """Return the manifest of a scene in these chunks."""
    runs: list[dict[int, Run]] = [{} for _ in range(scene.regions)]
    for number, plan in enumerate(plans):
        offset = 0
        for region in plan.regions:
            count = int(scene.counts[region, plan.level])
            if count:
                runs[region][plan.level] = Run(number, offset, count)
            offset += count
    counts = scene.counts.sum(axis=0).tolist()
    head = {
        "version": VERSION,
        "asset": note_of(up=scene.up)
        | {
            "chunkGaussians": settings.chunk_splats,
            "chunkExtent": int(settings.extent) if settings.extent == int(settings.extent) else settings.extent,
            "chunkMinGaussians": settings.min_splats,
        },
        "count": sum(counts),
        "counts": counts,
        "lodErrors": scene.errors is not None,
    }
    environment = None if scene.environment is None else ENVIRONMENT_FILE
    filenames = tuple(f"{plan.folder}/{META}" for plan in plans)
    return Manifest(scene.levels, filenames, tuple(_nodes(scene, runs)), environment, head)


def _nodes(scene: DetailScene, runs: list[dict[int, Run]]) -> list[ManifestNode]:
    """Return the tree of a scene, root first and depth first; an inner node has the union of the bounds below."""
    corners = _inner_bounds(scene)
    nodes, children = list[ManifestNode](), list[list[int]]()
    waiting = [(0 if len(scene.children) else -1, -1)]
    while waiting:
        place, parent = waiting.pop()
        if parent >= 0:
            children[parent].append(len(nodes))
        number = len(nodes)
        children.append([])
        if place < 0:
            region = -1 - place
            errors = None if scene.errors is None else scene.errors[region].tolist()
            nodes.append(ManifestNode(_bound(scene.bounds[region]), (), runs[region], errors, parent))
        else:
            nodes.append(ManifestNode(_bound(corners[place]), (), None, None, parent))
            waiting += [(int(child), number) for child in scene.children[place][::-1]]
    return [replace(node, children=tuple(below)) for node, below in zip(nodes, children, strict=True)]


def _inner_bounds(scene: DetailScene) -> Bounds:
    """Return (R - 1, 2, 3) the bounds of inner nodes: those of children, which come after their parents, first."""
    bounds = np.empty((len(scene.children), 2, 3))
    for number in reversed(range(len(bounds))):
        below = [bounds[child] if child >= 0 else scene.bounds[-1 - child] for child in scene.children[number]]
        bounds[number] = np.minimum(below[0][0], below[1][0]), np.maximum(below[0][1], below[1][1])
    return bounds


def _bound(corners: Bounds) -> Bound:
    (a, b, c), (d, e, f) = corners.tolist()
    return (a, b, c), (d, e, f)
