"""`Scenery`: splat files where they stand, with trees or without, and what of them a viewer draws for a camera."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .cameras.camera import Camera
from .cameras.framing import Balls, balls_of, together
from .codecs.rounding import after
from .lod.continuous import ContinuousCuts, faded
from .lod.traversal import CHUNK_NODES, Matrix
from .model.scene import Scene
from .model.selection import Selection, describe
from .model.splats import Splats
from .simulation.frames import LodSettings, Simulation, view_of
from .support.defaults import PRECISIONS
from .support.errors import InvalidSplatsError
from .support.progress import Progress, silent
from .world import Placement, read_file, world_of

Index = NDArray[np.signedinteger]


@dataclass(frozen=True)
class Source:
    """A file, read once however often it stands.

    Attributes:
        splats: N of the file, as they are drawn: after an encoding, if one is asked for.
        level: (N,) links from the root to each node; None where there is no tree.
        leaves: (M,) indices of what is drawn in full: the leaves, or all.
        first_chunk: number of its first chunk, when those of all files are counted.
    """

    splats: Splats
    level: NDArray[np.int32] | None
    leaves: Index
    first_chunk: int

    @property
    def chunks(self) -> int:
        """How many it has, of 65,536 splats each."""
        return -(-len(self.splats) // CHUNK_NODES)


@dataclass(frozen=True)
class Piece:
    """What is drawn of one placement.

    Attributes:
        source: the file it is of.
        index: (M,) of its splats, those that are drawn.
        splats: M of them, in the space of the file.
        object_to_world: (4, 4) where they stand.
    """

    source: Source
    index: Index
    splats: Splats
    object_to_world: Matrix


class Scenery:
    """Files where they stand, and a viewer.

    Args:
        placements: at least one.
        sources: of each placement.
        simulation: of those of them that are trees, in their order; None draws all leaves.
        notes: what a person should know of the files.
        blend: width of continuous cuts, see `continuous`; None for ordinary ones.

    Attributes:
        notes: what a person should know of the files.
    """

    def __init__(
        self,
        placements: Sequence[Placement],
        sources: Sequence[Source],
        simulation: Simulation | None,
        notes: Sequence[str] = (),
        blend: float | None = None,
    ) -> None:
        self.placements, self.sources, self.notes = list(placements), list(sources), list(notes)
        self._simulation, self._blend = simulation, blend
        self._continuous = ContinuousCuts(simulation.traversal) if simulation is not None and blend else None

    def pieces(self, camera: Camera) -> list[Piece]:
        """What a camera sees: the cut of the trees, and all splats of files that have none."""
        cuts = iter(self._cuts(camera))
        return [
            self._whole[number]
            if self._simulation is None or source.level is None
            else self._piece(number, *next(cuts))
            for number, source in enumerate(self.sources)
        ]

    def drawn(self, camera: Camera) -> list[tuple[Source, Index]]:
        """Of what a camera sees, which splats of which sources, in the order of `pieces`."""
        cuts = iter(self._cuts(camera))
        return [
            (source, source.leaves if self._simulation is None or source.level is None else next(cuts)[0])
            for source in self.sources
        ]

    def _cuts(self, camera: Camera) -> list[tuple[Index, NDArray[np.float64] | None]]:
        """For each tree the nodes that are drawn, and their weights where cuts are continuous."""
        if self._simulation is None:
            return []
        if self._continuous is None or self._blend is None:
            return [(nodes.astype(np.int64), None) for nodes in self._simulation.cut(camera).indices()]
        viewer = self._simulation.viewer
        cut = self._continuous.cut(
            view_of(camera), budget=viewer.budget, smallest=viewer.smallest(camera), width=self._blend
        )
        of_trees = [cut.instance == number for number in range(len(self._simulation.traversal.instances))]
        return [(cut.node[mine].astype(np.int64), cut.weight[mine]) for mine in of_trees]

    def _piece(self, number: int, index: Index, weight: NDArray[np.float64] | None) -> Piece:
        source = self.sources[number]
        splats = source.splats.take(index)
        if weight is not None:
            splats = replace(splats, opacity=faded(splats.opacity, weight))
        return Piece(source, index, splats, self.placements[number].object_to_world)

    @functools.cached_property
    def _whole(self) -> dict[int, Piece]:
        """By placement, what does not depend on the camera."""
        taken: dict[int, Splats] = {}  # of each source once, wherever it stands
        pieces = {}
        for number, (place, source) in enumerate(zip(self.placements, self.sources, strict=True)):
            if self._simulation is None or source.level is None:
                everything = len(source.leaves) == len(source.splats)
                splats = taken.setdefault(
                    id(source), source.splats if everything else source.splats.take(source.leaves)
                )
                pieces[number] = Piece(source, source.leaves, splats, place.object_to_world)
        return pieces

    def candidates(self) -> list[Piece]:
        """All that some camera may see: whole trees where cuts are drawn, else what `pieces` gives."""
        pieces = []
        for number, (place, source) in enumerate(zip(self.placements, self.sources, strict=True)):
            if self._simulation is None or source.level is None:
                pieces.append(self._whole[number])
            else:
                index = np.arange(len(source.splats))
                pieces.append(Piece(source, index, source.splats, place.object_to_world))
        return pieces

    def balls(self) -> Balls:
        """What the splats cover in the world: the leaves of every placement."""
        return together(
            balls_of(source.splats, source.leaves, place.object_to_world)
            for place, source in zip(self.placements, self.sources, strict=True)
        )


def read_scenery(
    placements: Sequence[Placement],
    viewer: LodSettings | None,
    *,
    through: str | None = None,
    blend: float | None = None,
    precision: str = PRECISIONS[0],
    threads: int = 1,
    progress: Progress = silent,
) -> Scenery:
    """Reads files, with trees or without.

    Splats that cannot be drawn are left out of files without trees; `notes` tells how many.

    Args:
        placements: at least one.
        viewer: whose cuts are drawn; None draws all leaves.
        through: one of `defaults.THROUGH`, the encoding after which splats are drawn; cuts are those of the file.
        blend: width of continuous cuts, see `continuous`; None for ordinary ones.
        precision: one of `PRECISIONS`, of what cuts are found with.
        threads: to work on.
        progress: is told how much is done.

    Raises:
        FormatError: a file cannot be read, or its splats do not fit the encoding; names the file.
        TreeError: a tree is broken; names the file.
        InvalidSplatsError: a file has nothing to draw; names it.
        ValueError: the budget is too small for even the roots; or there are too many instances.
    """
    scenes: dict[Path, Scene] = {}
    sources: dict[Path, Source] = {}
    notes: list[str] = []
    chunks = 0
    for file in dict.fromkeys(place.file for place in placements):
        scene = read_file(file, threads=threads, progress=progress)
        notes += (f"{file}: {note}" for note in scene.notes)
        if scene.tree is None:
            scene = _drawable(file, scene, notes)
        scenes[file] = scene
        sources[file] = _source(after(through, file, scene, threads), scene, chunks)
        chunks += sources[file].chunks
    simulation = None
    trees = [place for place in placements if scenes[place.file].tree is not None]
    if viewer is not None and trees:
        simulation = Simulation(world_of(trees, scenes, precision=precision, threads=threads), viewer)
    return Scenery(placements, [sources[place.file] for place in placements], simulation, notes, blend)


def _drawable(file: Path, scene: Scene, notes: list[str]) -> Scene:
    try:
        splats, dropped = Selection(drop_invalid=True).apply(scene.splats)
    except InvalidSplatsError as error:
        raise InvalidSplatsError(f"{file}: {error}") from None
    if dropped:
        notes.append(f"{file}: left out {describe(dropped)}")
    return replace(scene, splats=splats)


def _source(splats: Splats, scene: Scene, first_chunk: int) -> Source:
    if scene.tree is None:
        return Source(splats, None, np.arange(len(splats)), first_chunk)
    return Source(splats, scene.tree.depths(), np.flatnonzero(scene.tree.is_leaf), first_chunk)
