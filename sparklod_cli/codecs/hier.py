"""Hierarchies of hierarchical-3d-gaussians (.hier), read as the splats of full detail.

A file has the columns of all splats one after the other, then the nodes of the tree, each of which names a run of
splats. Sources: `hierarchy_loader.cpp`, `writer.cpp` and `traversal.cpp` of graphdeco-inria/gaussian-hierarchy.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import normalized_quat
from ..model.sh import COEFFICIENTS
from ..model.splats import FloatArray
from ..system.errors import FormatError, TruncatedError
from ..system.progress import Progress
from ..system.threads import BLOCK_ROWS, blocks_of, ordered_map
from . import quantize
from .reader import OpenFile, Reader, RowBuffer, rows_of

#: Type of the number of splats, before the columns and negative if numbers are halves, and of that of nodes.
COUNT = np.dtype("<i4")

#: A node: `leaves` splats of the scene from `start` on, then `merged` splats, which stand for its children.
NODE = np.dtype([(name, "<i4") for name in ("depth", "parent", "start", "leaves", "merged", "first_child", "children")])
HALF_NODE = np.dtype(
    [(name, "<i4") for name in ("parent", "start", "first_child")]
    + [(name, "<i2") for name in ("depth", "children", "leaves", "merged")]
)

#: Numbers of the box of a node, which are not read: the lowest and the highest corner, of four numbers each.
BOX_NUMBERS = 8

#: SH degree of all files.
DEGREE = 3

#: The columns in the order of the file: numbers per splat, whether they are floats even in a file of halves, and the
#: decoders of (n, numbers) values to columns of `Splats`.
COLUMNS: tuple[tuple[int, bool, dict[str, Callable[[FloatArray], FloatArray]]], ...] = (
    (3, True, {"center": np.asarray}),
    (4, False, {"quat_xyzw": lambda wxyz: normalized_quat(wxyz)[:, [1, 2, 3, 0]]}),
    (3, False, {"scale": quantize.decode_log}),
    # Linear. The optimiser of hierarchies does not bound it; a leaf is an input splat.
    (1, False, {"opacity": lambda values: np.minimum(values[:, 0], np.float32(1))}),
    (
        3 * (1 + COEFFICIENTS[DEGREE]),
        False,
        {
            "rgb": lambda values: quantize.decode_dc(values[:, :3]),
            "sh": lambda values: values[:, 3:].reshape(len(values), -1, 3),
        },
    ),
)


def open_content(source: OpenFile) -> Reader:
    """Open a hierarchy."""
    count = _count(source, 0)
    is_half, count = count < 0, abs(count)
    number, node = (np.dtype("<f2"), HALF_NODE) if is_half else (np.dtype("<f4"), NODE)
    types = [np.dtype(("<f4" if is_float else number, (numbers,))) for numbers, is_float, _ in COLUMNS]
    starts = COUNT.itemsize + count * np.cumsum([0, *(each.itemsize for each in types)], dtype=np.int64)
    nodes_at = int(starts[-1])
    nodes = _count(source, nodes_at)
    end = nodes_at + COUNT.itemsize + nodes * (node.itemsize + BOX_NUMBERS * number.itemsize)
    if nodes < 0 or end > source.size:
        raise TruncatedError(f"cut short, or no .hier: it announces {count:,} splats in {nodes:,} nodes")
    leaves = _leaves(source, nodes_at + COUNT.itemsize, node, nodes, count)

    def fill(target: RowBuffer, threads: int, progress: Progress) -> None:
        @np.errstate(over="ignore", invalid="ignore")  # invalid numbers are reported later
        def read(part: slice) -> int:
            first, last = np.searchsorted(rows, [part.start, part.stop])
            splats = target.splats.take(slice(first, last))
            selected = rows[first:last] - part.start
            for (_, _, decoders), row_type, start in zip(COLUMNS, types, starts[:-1], strict=True):
                blocks = rows_of(source.read_at, int(start), row_type, part.start, part.stop, count)
                values = np.concatenate([values for _, values in blocks])[selected].astype(np.float32)
                for name, decode in decoders.items():
                    getattr(splats, name)[:] = decode(values)
            return target.start + int(last)

        rows = leaves[target.start : target.stop]
        if len(rows):
            begin, stop = int(rows[0]), int(rows[-1]) + 1
            parts = (slice(begin + part.start, begin + part.stop) for part in blocks_of(stop - begin))
            for done in ordered_map(read, parts, threads):
                progress("reading", done, len(leaves), "splat")

    trailing = {"trailing_bytes": source.size - end}
    return Reader(len(leaves), DEGREE, "HIER", fill, header=trailing, block=BLOCK_ROWS, concurrent=True)


def _count(source: OpenFile, at: int) -> int:
    if at + COUNT.itemsize > source.size:
        raise TruncatedError("cut short, or no .hier: it has fewer splats than it announces")
    return int(np.frombuffer(source.read_at(at, COUNT.itemsize), COUNT)[0])


def _leaves(source: OpenFile, at: int, node: np.dtype[Any], nodes: int, count: int) -> NDArray[np.int64]:
    """Return the splats of full detail, ascending: leaves of all nodes, and merged splats of nodes without children.

    A hierarchy that was divided into chunks may have nodes without their children.
    """
    runs = [np.empty((0, 2), np.int64)]
    for _, block in rows_of(source.read_at, at, node, 0, nodes, nodes, "nodes"):
        start, leaves, merged, depth, children, first_child = (
            block[name].astype(np.int64) for name in ("start", "leaves", "merged", "depth", "children", "first_child")
        )
        wrong = (np.minimum.reduce([start, leaves, merged, children]) < 0) | (start + leaves + merged > count)
        wrong |= (children > 0) & ((first_child < 1) | (first_child + children > nodes))
        if wrong.any():
            raise FormatError("corrupt: a node names splats or children that the file does not have")
        lengths = leaves + np.where((children == 0) & (depth > 0), merged, 0)
        runs.append(np.stack([start, lengths], axis=1)[lengths > 0])
    start, lengths = np.concatenate(runs).T
    order = np.argsort(start, kind="stable")
    start, lengths = start[order], lengths[order]
    if (start[1:] < start[:-1] + lengths[:-1]).any():
        raise FormatError("corrupt: two of its nodes name the same splats")
    before = np.cumsum(lengths) - lengths
    return np.repeat(start - before, lengths) + np.arange(int(lengths.sum()))
