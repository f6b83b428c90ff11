"""`NodeStream`, the nodes of a tree that does not fit into memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from .lod_tree import LodTree
from .splats import Splats


@dataclass(frozen=True, eq=False)
class NodeStream:
    """The M nodes of a tree in their final order, read window by window.

    Attributes:
        count: M.
        sh_degree: of all windows.
        antialiased, up: as in `Scene`.
        read: called with a range of nodes, returns them and their tree columns, whose `child_start` counts from the
            first node of the whole tree; may be called again, from several threads at once.
    """

    count: int
    sh_degree: int
    antialiased: bool
    read: Callable[[int, int], tuple[Splats, LodTree]]
    up: str | None = None
