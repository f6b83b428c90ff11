"""Whether the leaves of a tree are the splats of the file that it was baked from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..codecs.spz_layout import LOD, Layout
from ..scene import Scene
from ..selection import Selection
from ..splats import Splats
from .findings import Finding

#: Codes may differ by so much: writers round, cut off or go through float16.
STEPS = 1

#: Degrees of rotation that two codes of one rotation may be apart, by the bytes of the code.
DEGREES = {3: 14.0, 4: 0.8}


def check(scene: Scene, original: Scene) -> list[Finding]:
    """Findings where the leaves of `scene`, an SPZ tree, are not exactly the splats of `original` that can be drawn.

    Both are compared as codes of the tree's file: its centres must be the same to a step, and so must be all else.
    """
    if scene.tree is None:
        return [Finding("expect.leaves", "there is no tree whose leaves could be compared")]
    leaves = scene.splats.take(scene.tree.is_leaf)
    splats, _ = Selection(drop_invalid=True).apply(original.splats.with_max_sh(leaves.sh_degree))
    if len(leaves) != len(splats):
        return [Finding("expect.leaves", f"{len(leaves):,} leaves, the original has {len(splats):,} splats to draw")]
    if leaves.sh_degree != splats.sh_degree:
        return [Finding("expect.leaves", f"SH degree {leaves.sh_degree}, the original has {splats.sh_degree}")]
    return _compare(scene, leaves, splats)


def _codes(layout: Layout, splats: Splats) -> dict[str, NDArray[np.int64]]:
    """(N, numbers) of each column, as whole numbers."""
    codes = {}
    for stream in layout.streams():
        if hasattr(splats, stream.column) and stream.column != "quat_xyzw":
            values = np.ascontiguousarray(stream.encode(getattr(splats, stream.column)))
            rows = values.view(np.uint8).reshape(len(splats), stream.size).astype(np.int64)
            if stream.column == "center":  # three bytes a coordinate
                rows = rows.reshape(-1, 3, 3) @ np.array([1, 1 << 8, 1 << 16])
                rows = np.where(rows >= 1 << 23, rows - (1 << 24), rows)
            codes[stream.column] = rows
    return codes


def _order(codes: dict[str, NDArray[np.int64]]) -> NDArray[np.intp]:
    keys = [codes[name][:, index] for name in ("opacity", "rgb", "scale") for index in range(codes[name].shape[1])]
    return np.lexsort([*keys, *codes["center"].T])


def _compare(scene: Scene, leaves: Splats, splats: Splats) -> list[Finding]:
    header = scene.header
    layout = Layout(max(2, int(header["version"])), len(leaves), leaves.sh_degree, int(header["fractional_bits"]), LOD)
    ours, theirs = _codes(layout, leaves), _codes(layout, splats)
    first, second = _order(ours), _order(theirs)
    differs = np.zeros(len(leaves), np.bool_)
    for name, codes in ours.items():
        # SH codes keep their upper bits only: a step is a bucket of 8 or 16.
        most = STEPS * (16 if name == "sh" else 1)
        differs |= (np.abs(codes[first] - theirs[name][second]) > most).any(axis=1)
    size = next(stream.size for stream in layout.streams() if stream.column == "quat_xyzw")
    cosine = np.abs(np.einsum("ij,ij->i", leaves.quat_xyzw[first], splats.quat_xyzw[second]).astype(np.float64))
    differs |= np.degrees(2 * np.arccos(np.minimum(cosine, 1))) > DEGREES[size]
    count = int(np.count_nonzero(differs))
    if not count:
        return []
    assert scene.tree is not None
    index = int(np.flatnonzero(scene.tree.is_leaf)[first[int(np.argmax(differs))]])
    return [
        Finding(
            "expect.leaves", f"{count:,} leaves are not splats of the original; the first is {index:,}", index, count
        )
    ]
