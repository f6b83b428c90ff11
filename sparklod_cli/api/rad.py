"""RAD files in parts: the header alone, one chunk alone, and the order of nodes for streaming."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .. import io
from ..model.scene import Scene, Tree
from ..model.splats import FloatArray
from ..support.errors import FormatError, memory_errors_translated
from ..support.parallel import on_threads
from .arguments import scene_like
from .files import naming
from .progress import Told, telling

if TYPE_CHECKING:
    from ..codecs.rad.codec import RadChunk
    from ..codecs.rad.records import RadHeader


def read_rad_header(path: Path | str) -> RadHeader:
    """Reads the header of a RAD file and nothing else; the chunks need not be there.

    Args:
        path: of a .rad file, whole or with chunks in files of their own.

    Raises:
        FormatError: it cannot be read, is no such header, or promises what cannot be.
    """
    path = Path(path)
    with naming(path):
        return io.read_rad_header(path)


def read_rad_chunk(path: Path | str, number: int, *, palette: FloatArray | None = None) -> RadChunk:
    """Reads the header of a RAD file and the bytes of one chunk, as a viewer does that streams it.

    Args:
        path: of a .rad file, whole or with chunks in files of their own.
        number: of the chunk, from 0; `read_rad_header(path).chunks` has them all.
        palette: (codes, K, 3) SH coefficients, the `palette` of chunk 0, where the file has one. Without it, the other
            chunks of such a file have `labels` and no SH.

    Raises:
        FormatError: the header or the chunk cannot be read, or is broken.
        TypeError: the number is not a whole one.
        ValueError: there is no such chunk, or the palette is of another SH degree than the file.
    """
    path = Path(path)
    if isinstance(number, bool) or not isinstance(number, (int, np.integer)):
        raise TypeError(f"number is {number!r}; give a whole number, which counts chunks from 0")
    with naming(path), memory_errors_translated():
        return io.read_rad_chunk(path, number, palette=palette)


def arrange_chunks(tree: Scene, *, threads: int | None = None, progress: Told = None) -> Tree:
    """A tree with its nodes in the order for streaming: `write` and other formats keep the order that nodes have.

    A chunk of a RAD is the next 65,536 nodes, so this order decides how many chunks a viewer fetches. docs/streaming.md
    compares it with others; `build-lod --format rad` writes trees in it.

    Args:
        tree: its nodes in any order that a tree may have: children are consecutive and after their parent.
        threads: to work on; None for all processors. The order does not depend on it.
        progress: called with how much is done.

    Raises:
        FormatError: the scene has no tree.
        TreeError: the tree is broken.
    """
    links = scene_like(tree).tree
    if links is None:
        raise FormatError("the scene has no Level-of-Detail tree; build_lod makes one")
    links.validate()
    with on_threads(threads), telling(progress) as told, memory_errors_translated():
        from ..lod.chunk_order import arrange

        splats, links = arrange(tree.splats, links, progress=told)
    return Tree(splats, links, tree.antialiased, up=tree.up)
