"""Several scenes as one: each where it was placed, one after the other."""

from __future__ import annotations

import bisect
import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..support.errors import SparklodError
from ..support.units import count_of
from .sh import COEFFICIENTS
from .splats import Splats
from .streams import SceneStream
from .transforms import Transform
from .up_axis import common, rotated


@dataclass(frozen=True, eq=False)
class Placed:
    """A scene and where it stands.

    Attributes:
        stream: its splats.
        name: in messages.
        transform: turns, scales and moves them.
    """

    stream: SceneStream
    name: str
    transform: Transform = dataclasses.field(default_factory=Transform)


def merged(parts: Sequence[Placed]) -> SceneStream:
    """One scene of several: their splats in this order, of the highest SH degree; lower ones are padded with zeros.

    It is antialiased if most of the splats are; notes tell where they differ. An axis points up that does in all of
    them. What is wrong with one of them is raised with its name.

    Args:
        parts: at least one.
    """
    firsts = tuple(itertools.accumulate((part.stream.count for part in parts), initial=0))
    degree = max(part.stream.sh_degree for part in parts)
    antialiased, notes = _antialiased(parts)
    notes += tuple(f"{part.name}: {note}" for part in parts for note in part.stream.notes)
    return SceneStream(
        firsts[-1],
        degree,
        _Read(tuple(parts), firsts, degree),
        antialiased,
        " and ".join(sorted({part.stream.format for part in parts})),
        tuple(dict.fromkeys(notes)),
        up=common(rotated(part.stream.up, part.transform.rotation) for part in parts),
    )


def _antialiased(parts: Sequence[Placed]) -> tuple[bool, tuple[str, ...]]:
    """Whether most splats are antialiased, and what is to be said of it."""
    count = sum(part.stream.count for part in parts)
    found = sum(part.stream.count for part in parts if part.stream.antialiased)
    most = 2 * found > count
    if found in (0, count):
        return most, ()
    kind = "antialiased" if most else "not antialiased"
    text = f"{found:,} of {count_of(count, 'splat')} are antialiased, and the others are not; all are written as {kind}"
    return most, (text,)


@dataclass(frozen=True, eq=False)
class _Read:
    """`SceneStream.read` of several scenes; can be pickled if their streams can."""

    parts: tuple[Placed, ...]
    firsts: tuple[int, ...]
    sh_degree: int

    def __call__(self, start: int, stop: int) -> Iterator[Splats]:
        number = bisect.bisect_right(self.firsts, start) - 1
        while start < stop:
            part, first, last = self.parts[number], self.firsts[number], min(self.firsts[number + 1], stop)
            try:
                for splats in part.stream.read(start - first, last - first):
                    yield part.transform.apply(_padded(splats, self.sh_degree))
            except SparklodError as error:
                raise type(error)(f"{part.name}: {error}") from None
            start, number = last, number + 1


def _padded(splats: Splats, sh_degree: int) -> Splats:
    """Splats of at least this SH degree; coefficients that they lack are 0."""
    if splats.sh_degree >= sh_degree:
        return splats
    sh = np.zeros((len(splats), COEFFICIENTS[sh_degree], 3), np.float32)
    sh[:, : splats.sh.shape[1]] = splats.sh
    return dataclasses.replace(splats, sh=sh)
