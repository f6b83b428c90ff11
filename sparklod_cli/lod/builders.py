"""The table of tree builders; a new one needs a module and a row here."""

from __future__ import annotations

from dataclasses import dataclass

from ..model.sh import COEFFICIENTS

#: Ratio of the voxel sizes of successive levels in the quick builder.
MIN_BASE, MAX_BASE, DEFAULT_BASE = 1.1, 2.0, 1.5

#: Maximum ratio of nodes to leaves in the quality builder; 2 keeps every node of its binary tree.
MIN_GROWTH, MAX_GROWTH, DEFAULT_GROWTH = 1.05, 2.0, 1.4

#: Growth of the tree that the detail levels of a Streamed SOG are cut from: as it is not written, it keeps all nodes.
DETAIL_GROWTH = MAX_GROWTH


#: Bytes that a splat takes at the peak of a bake: without spherical harmonics, and for each of their coefficients.
#: Peaks of processes (VmHWM), as `benchmarks/bench_memory.py` measures them, with some room to spare.
SplatBytes = tuple[int, int]


def bytes_of(each: SplatBytes, splats: int, sh_degree: int) -> int:
    """Return the bytes of `splats` splats of an SH degree."""
    fixed, coefficient = each
    return splats * (fixed + coefficient * COEFFICIENTS[sh_degree])


@dataclass(frozen=True)
class Builder:
    """A tree builder.

    Its module has `build(splats, SETTING, *, progress) -> (nodes, tree)` and is a `stage_records.StagedBuilder`.

    Attributes:
        setting: name of its only parameter, a number.
        summary: phrase for help texts.
        in_bands: its trees are put in the order of `band_order` for files that are read whole. That saves 3 to 4 % of
            a file of quality, and 1 to 2 % of one of quick, which is not worth the time.
        in_memory: of a splat of the input, in memory.
        in_block: of a splat of a block, out of core.
        in_scratch: of a splat of the input in the scratch folder, out of core. Those of blocks are removed when their
            nodes are made.
    """

    setting: str
    summary: str
    in_bands: bool
    in_memory: SplatBytes
    in_block: SplatBytes
    in_scratch: SplatBytes


#: Builders by the name of the method, which is that of the module; the first is the default.
BUILDERS = {
    "quick": Builder(
        "base",
        "pairs in cells of a voxel grid, in seconds",
        in_bands=False,
        in_memory=(220, 27),
        in_block=(300, 50),
        in_scratch=(190, 32),
    ),
    "quality": Builder(
        "growth",
        "the pairs that cost least, in all",
        in_bands=True,
        in_memory=(250, 30),
        in_block=(350, 50),
        in_scratch=(200, 34),
    ),
}
METHODS = tuple(BUILDERS)
