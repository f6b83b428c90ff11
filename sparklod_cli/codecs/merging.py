"""Several scenes as one."""

from __future__ import annotations

import bisect
import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..model.axes import common, differing, rotated
from ..model.sh import COEFFICIENTS
from ..model.splats import Splats
from ..model.transforms import Transform
from ..system.errors import naming
from ..system.progress import Progress
from ..system.units import count_of
from .reader import Reader, Target
from .scene_files import copy_rows


@dataclass(frozen=True, eq=False)
class Placed:
    """A scene and where it stands.

    Attributes:
        reader: of its splats.
        name: in messages.
        transform: turns, scales and moves them.
    """

    reader: Reader
    name: str
    transform: Transform = field(default_factory=Transform)


def merged(parts: Sequence[Placed]) -> Reader:
    """Merge scenes into one: their splats in this order, of the highest SH degree; lower ones are padded with zeros.

    It is antialiased if most of the splats are; notes tell where they differ. An axis points up that does in all of
    them. What is wrong with one of them is raised with its name.

    Args:
        parts: at least one.
    """
    firsts = tuple(itertools.accumulate((part.reader.count for part in parts), initial=0))
    degree = max(part.reader.sh_degree for part in parts)
    antialiased, notes = _antialiased(parts)
    notes += tuple(f"{part.name}: {note}" for part in parts for note in part.reader.notes)
    axes = [rotated(part.reader.up, part.transform.rotation) for part in parts]
    notes += tuple(f"{text}, so none is noted unless --up names it" for text in differing(axes))
    return Reader(
        firsts[-1],
        degree,
        " and ".join(sorted({part.reader.format for part in parts})),
        _FillMerged(tuple(parts), firsts, degree),
        antialiased,
        tuple(dict.fromkeys(notes)),
        up=common(axes),
        up_by=(common(part.reader.up_by for part in parts) or "") if axes == [part.reader.up for part in parts] else "",
    )


def _antialiased(parts: Sequence[Placed]) -> tuple[bool, tuple[str, ...]]:
    """Return whether most splats are antialiased, and notes where they differ."""
    count = sum(part.reader.count for part in parts)
    found = sum(part.reader.count for part in parts if part.reader.antialiased)
    most = 2 * found > count
    if found in (0, count):
        return most, ()
    kind = "antialiased" if most else "not antialiased"
    text = f"{found:,} of {count_of(count, 'splat')} are antialiased, and the others are not; all are written as {kind}"
    return most, (text,)


@dataclass(frozen=True, eq=False)
class _FillMerged:
    """`Reader.fill` of several scenes; can be pickled if their readers can. Takes the memory of a block."""

    parts: tuple[Placed, ...]
    firsts: tuple[int, ...]
    sh_degree: int

    def __call__(self, target: Target, threads: int, progress: Progress) -> None:
        start, number = target.start, bisect.bisect_right(self.firsts, target.start) - 1
        while start < target.stop:
            part, first, stop = self.parts[number], self.firsts[number], min(self.firsts[number + 1], target.stop)
            with naming(part.name):
                for splats in part.reader.blocks(start - first, stop - first):
                    rows = target.rows(slice(start, start := start + len(splats)))
                    copy_rows(part.transform.apply(_padded(splats, self.sh_degree)), rows)
                    progress("reading", start - target.start, len(target.splats), "splat")
            number += 1


def _padded(splats: Splats, sh_degree: int) -> Splats:
    """Return splats of at least this SH degree; coefficients that they lack are 0."""
    if splats.sh_degree >= sh_degree:
        return splats
    sh = np.zeros((len(splats), COEFFICIENTS[sh_degree], 3), np.float32)
    sh[:, : splats.sh.shape[1]] = splats.sh
    return dataclasses.replace(splats, sh=sh)
