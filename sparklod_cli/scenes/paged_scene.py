"""`PagedScene`, a tree of which only the chunks are read that cuts need; and what such scenes cover."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..cameras.framing import SAMPLE
from ..io.rad_file import RadFile
from ..model.balls import USED, Balls, balls_of
from ..model.instances import Instance
from ..model.lod_tree import LodTree
from ..model.scene import Scene
from ..model.splats import Splats
from .loaded_scene import Index, LoadedScene
from .pages import Pages


@dataclass(frozen=True, eq=False)
class PagedScene(LoadedScene):
    """A tree that may be larger than memory; `scene` and `splats` have no rows.

    Attributes:
        pages: its nodes and splats.
    """

    pages: Pages = field(kw_only=True)

    @property
    def depth(self) -> NDArray[np.int32]:
        """(N,) edges from the root to each node that was read, and to their children."""
        return self.pages.depth

    @property
    def count(self) -> int:
        """N."""
        return self.pages.count

    @functools.cached_property
    def leaves(self) -> Index:
        """(M,) indices of full detail, for which the children of all nodes are read."""
        return self.pages.leaves()

    @functools.cached_property
    def leaf_count(self) -> int:
        """M."""
        return self.pages.leaf_count()

    def rows(self, index: Index) -> Splats:
        """Some splats, in the space of the scene, by their indices, ascending."""
        return self.pages.splats(index)


def empty_scene(file: RadFile) -> Scene:
    """What is known of the scene of a file before its chunks are read."""
    tree = LodTree(np.zeros(0, np.uint16), np.zeros(0, np.uint32))
    header = file.header
    splats = Splats.empty(0, header.max_sh)
    return Scene(
        splats,
        tree,
        header.noted.antialiased,
        file.format,
        header.noted.problems,
        dict(file.about),
        file.chunk_bytes,
        up=header.noted.up,
    )


def sampled_balls(instances: Sequence[Instance], scenes: Sequence[LoadedScene]) -> Balls:
    """What the splats of instances cover, as many as cameras look at: those that they take of all.

    Args:
        instances: at least one.
        scenes: that each is of.
    """
    counts = [loaded.leaf_count for loaded in scenes]
    while True:
        every = max(sum(counts) // SAMPLE, 1)
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        samples = [_Sample(int(start), every) for start in starts[:-1]]
        for loaded in dict.fromkeys(scenes):
            of_loaded = [at for at, each in enumerate(scenes) if each is loaded]
            for splats, leaves in _leaves_of(loaded):
                for at in of_loaded:
                    samples[at].add(balls_of(splats, leaves, instances[at].object_to_world))
        found = [sample.count for sample in samples]
        if found == counts:
            break
        counts = found  # some are not finite, and do not count
    whole = Balls.concat(part for sample in samples for part in sample.parts)
    low = np.min([sample.low for sample in samples], axis=0)
    high = np.max([sample.high for sample in samples], axis=0)
    return Balls(whole.center, whole.radius, np.stack([low, high]), max(sample.largest for sample in samples))


class _Sample:
    """Evenly spaced balls of an instance, and the ends of all of them.

    Args:
        start: number of its first ball among those of all instances.
        every: one is taken of so many.
    """

    def __init__(self, start: int, every: int) -> None:
        self._start, self._every = start, every
        self.count, self.largest = 0, 0.0
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)
        self.parts: list[Balls] = [Balls(np.empty((0, 3)), np.empty(0))]

    def add(self, balls: Balls) -> None:
        """Adds some in order."""
        first = -(self._start + self.count) % self._every
        self.parts.append(Balls(balls.center[first :: self._every].copy(), balls.radius[first :: self._every].copy()))
        self.count += len(balls.radius)
        self.largest = max(self.largest, float(balls.radius.max(initial=0)))
        self.low = np.minimum(self.low, balls.center.min(axis=0, initial=np.inf))
        self.high = np.maximum(self.high, balls.center.max(axis=0, initial=-np.inf))


def _leaves_of(loaded: LoadedScene) -> Iterator[tuple[Splats, Index]]:
    """Splats of a scene, and which of them are its leaves."""
    if not isinstance(loaded, PagedScene):
        yield loaded.splats, loaded.leaves
        return
    for splats, tree in loaded.pages.blocks(USED):
        yield splats, np.flatnonzero(tree.is_leaf)
