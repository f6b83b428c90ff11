"""Interfaces and helpers for writing a file in windows, whether its splats are in memory or not.

Each window is encoded alone, on any thread or machine, and its result stays in memory or in a store that machines
share. The pieces of the file are then made of the results.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..model.lod_tree import CHUNK_NODES, LodTree
from ..model.scene import NodeStream, Scene
from ..model.splats import Splats
from ..system.progress import Progress
from ..system.threads import blocks_of, ordered_map
from . import clamps
from .options import WriteOptions

if TYPE_CHECKING:  # Python 3.10 has none
    from typing import Self

#: The result of a window: arrays by name.
Encoded = dict[str, NDArray[Any]]


class Named(Protocol):
    """Arrays by name, such as `Encoded`; each may be read again."""

    def __getitem__(self, name: str, /) -> NDArray[Any]: ...


class Windows(Protocol):
    """Results of the windows of a file by number: a list of them, or those in a store."""

    def __getitem__(self, number: int, /) -> Named: ...


#: Name of the array that counts what a window clamps, see `clamps.tally`.
CLAMPED = "clamped"


@dataclass(frozen=True, eq=False)
class Encoder(ABC):
    """Encoder of the windows of one file. It can be pickled.

    Attributes:
        count: splats of the file, which are nodes where there is a tree.
        sh_degree: of all splats.
        tree: whether there is one.
        antialiased, up: as in `Scene`.
        options: with nothing left open.
        ranges: values beyond them are counted, see `clamps.tally`; empty for no count.
    """

    count: int
    sh_degree: int
    tree: bool
    antialiased: bool
    up: str | None
    options: WriteOptions
    ranges: tuple[clamps.CodeRange, ...] = ()

    @classmethod
    def of(cls, scene: Scene | NodeStream, options: WriteOptions, ranges: tuple[clamps.CodeRange, ...]) -> Self:
        """Return the encoder of a scene, of which nothing is read."""
        if isinstance(scene, NodeStream):
            count, sh_degree, tree = scene.count, scene.sh_degree, True
        else:
            count, sh_degree, tree = len(scene), scene.splats.sh_degree, scene.tree is not None
        return cls(count, sh_degree, tree, scene.antialiased, scene.up, options, ranges)

    @abstractmethod
    def codes(self, splats: Splats, tree: LodTree | None, start: int) -> Encoded:
        """Encode a window, see `encode`."""

    def encode(self, splats: Splats, tree: LodTree | None, start: int) -> Encoded:
        """Encode a window, and count what that clamps.

        Args:
            tree: of the window, whose children have the numbers of the file; None where the file has no tree.
            start: number of the first splat; the start of one of `windows_of`.
        """
        encoded = self.codes(splats, tree, start)
        if self.ranges:
            encoded[CLAMPED] = clamps.tally(splats, self.ranges, None if tree is None else tree.is_leaf)
        return encoded

    @abstractmethod
    def pieces(self, windows: Windows, *, threads: int, progress: Progress) -> Iterator[bytes]:
        """Return the bytes of the file, piece by piece, made of the results of all windows."""


class Stored(Protocol):
    """Codes of a tree's file as they stand in it, with which nodes can be written again bit for bit."""

    def like(self, options: WriteOptions) -> WriteOptions:
        """Return the options, and where they leave a choice open, that of the file."""

    def keeping(self, encoder: Any, unchanged: NDArray[np.bool_]) -> Encoder:
        """Return an encoder of as many nodes in the same order that gives (N,) `unchanged` ones their old codes."""


def windows_of(count: int) -> list[slice]:
    """Return the windows of a file of so many splats."""
    return blocks_of(count, CHUNK_NODES)


def results(encoder: Encoder, scene: Scene, threads: int, progress: Progress, stage: str) -> Iterator[Encoded]:
    """Encode all windows of a scene in order, a few ahead; `stage` is the word for it that `progress` gets."""
    windows = windows_of(encoder.count)
    tree = scene.tree
    rows = ((scene.splats.rows(part), None if tree is None else tree.rows(part), part.start) for part in windows)
    encoded = ordered_map(lambda arguments: encoder.encode(*arguments), rows, threads)
    for part, result in zip(windows, encoded, strict=True):
        progress(stage, part.stop, encoder.count, "splat")
        yield result
