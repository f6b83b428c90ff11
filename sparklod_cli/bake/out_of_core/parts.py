"""Parts of the input: which splats of it are kept, and as what."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ...io import read_rgba
from ...model.selection import Tally
from ...model.splats import Splats
from ...model.streams import SceneStream
from ...support.parallel import blocks_of
from ..settings import BakeSettings

#: Splats of a part, unless blocks are smaller, and the most parts: their splats of all blocks are pieces of files, of
#: which there should not be too many. Chosen.
PART_SPLATS, MAX_PARTS = 1 << 19, 256


@dataclass(frozen=True, eq=False)
class Kept:
    """What is kept of some splats.

    Attributes:
        splats: those, transformed.
        tally: what became of all.
        beyond: how many of those that are kept left the range of float32.
    """

    splats: Splats
    tally: Tally
    beyond: int


def parts_of(count: int, block_splats: int) -> tuple[int, ...]:
    """Where each part begins, and at last the count; an empty input has no part."""
    length = max(min(block_splats, PART_SPLATS), -(-count // MAX_PARTS))
    return (0, *(part.stop for part in blocks_of(count, length)))


def kept_of(stream: SceneStream, start: int, stop: int, settings: BakeSettings) -> Iterator[Kept]:
    """What is kept of a range of the input, block by block."""
    at = start
    for splats in stream.read(start, stop):
        if settings.rgba is not None:
            values = read_rgba(settings.rgba, stream.count, slice(at, at + len(splats)))
            splats = dataclasses.replace(splats, rgb=np.ascontiguousarray(values[:, :3]), opacity=values[:, 3].copy())
        at += len(splats)
        splats = splats.with_max_sh(settings.max_sh)
        keep, tally = settings.selection.examine(splats)
        kept = splats if keep.all() else splats.take(keep)
        turned = settings.transform.apply(kept)
        beyond = 0 if turned is kept else int(np.count_nonzero(~turned.is_valid()))
        yield Kept(turned, tally, beyond)
