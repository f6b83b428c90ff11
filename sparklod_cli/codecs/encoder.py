"""Interfaces and helpers for writing a file in windows, whether its splats are in memory or not.

A window is encoded by itself, on any thread or machine, and its result kept, in memory, in a file, or in a store that
machines share; then the pieces of the file are made of the results.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..model.lod_tree import CHUNK_NODES, LodTree
from ..model.scene import Scene
from ..model.splats import COLUMNS, Splats
from ..model.streams import NodeStream
from ..support.parallel import blocks_of, ordered_map
from ..support.progress import Progress
from .options import WriteOptions

if TYPE_CHECKING:
    from .clamps import Range

#: The result of a window: arrays by name.
Encoded = dict[str, NDArray[Any]]

#: An array of a window's result, by the window's number and the array's name; may be asked for again.
Get = Callable[[int, str], NDArray[Any]]

#: Name of the array that counts what a window clamps, see `clamps.tally`.
CLAMPED = "clamped"


class Encoder(Protocol):
    """Encodes the windows of one file. It can be pickled."""

    @property
    def count(self) -> int:
        """Splats of the file."""

    @property
    def sh_degree(self) -> int:
        """SH degree of all splats."""

    @property
    def options(self) -> WriteOptions:
        """With nothing left open."""

    @property
    def ranges(self) -> tuple[Range, ...]:
        """Beyond which values are counted, see `clamps.tally`; none unless somebody wants to know."""

    def encode(self, splats: Splats, tree: LodTree | None, start: int) -> Encoded:
        """Encode a window.

        Args:
            splats: of the window, all columns.
            tree: of the window, whose children have the numbers of the file; None where the file has no tree.
            start: number of the first splat; the start of one of `windows_of`.
        """

    def pieces(self, get: Get, *, threads: int, progress: Progress) -> Iterator[bytes]:
        """Return the bytes of the file, piece by piece, made of the results of all windows."""


class Stored(Protocol):
    """Codes of a tree's file as they stand in it, with which nodes can be written again bit for bit."""

    def like(self, options: WriteOptions) -> WriteOptions:
        """Return the options, and where they leave a choice open, that of the file."""

    def keeping(self, encoder: Any, kept: NDArray[np.bool_]) -> Encoder:
        """Return an encoder of as many nodes in the same order that gives (N,) `kept` ones the codes of the file."""


def windows_of(count: int) -> list[slice]:
    """Return the windows of a file of so many splats."""
    return blocks_of(count, CHUNK_NODES)


def rows_of(splats: Splats, tree: LodTree | None, part: slice) -> tuple[Splats, LodTree | None]:
    """Return views of some rows."""
    views = Splats(**{name: getattr(splats, name)[part] for name in COLUMNS})
    return views, None if tree is None else LodTree(tree.child_count[part], tree.child_start[part])


def results(
    encoder: Encoder, scene: Scene | NodeStream, threads: int, progress: Progress, stage: str
) -> Iterator[Encoded]:
    """Encode all windows of a scene in order, a few ahead; `stage` is the word for it that `progress` gets."""

    def encode(part: slice) -> Encoded:
        if isinstance(scene, NodeStream):
            return encoder.encode(*scene.read(part.start, part.stop), part.start)
        return encoder.encode(*rows_of(scene.splats, scene.tree, part), part.start)

    windows = windows_of(encoder.count)
    for part, result in zip(windows, ordered_map(encode, windows, threads), strict=True):
        progress(stage, part.stop, encoder.count, "splat")
        yield result


class Kept:
    """Results of windows, in the order in which they are put, in a temporary file. A context manager.

    Args:
        folder: of the file, which has no name; None for that of the system.
        in_memory: bytes up to which they stay in memory.
    """

    def __init__(self, folder: Path | None = None, in_memory: int = 0) -> None:
        self._places: list[dict[str, tuple[int, np.dtype[Any], tuple[int, ...]]]] = []
        name = None if folder is None else str(folder)
        # A limit of 0 would mean none.
        self._file = tempfile.SpooledTemporaryFile(max(in_memory, 1), dir=name)  # noqa: SIM115

    def __enter__(self) -> Kept:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def put(self, arrays: Encoded) -> None:
        """Add the result of the next window."""
        places = {}
        self._file.seek(0, os.SEEK_END)
        for name, array in arrays.items():
            places[name] = self._file.tell(), array.dtype, array.shape
            self._file.write(np.ascontiguousarray(array).data)
        self._places.append(places)

    def get(self, number: int, name: str) -> NDArray[Any]:
        """Return an array of a result."""
        at, dtype, shape = self._places[number][name]
        self._file.seek(at)
        size = math.prod(shape) * dtype.itemsize
        return np.frombuffer(self._file.read(size), dtype).reshape(shape)
