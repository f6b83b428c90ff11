"""`Selection`: drops splats that cannot be drawn or lie outside of a crop, and counts them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..system.errors import InvalidSplatsError
from ..system.threads import blocks_of, ordered_map
from .splats import INVALID, Splats, describe_counts

Vector = tuple[float, float, float]

#: Reasons for dropping a splat, in the order of their application, and their words in a report.
REASONS = INVALID | {
    "zero_opacity": "zero opacity",
    "zero_scale": "zero scale",
    "low_opacity": "below --min-opacity",
    "cropped": "cropped",
}

#: Splats that a thread examines at a time: few enough for the processor's cache.
EXAMINED = 1 << 15


@dataclass(frozen=True)
class SelectionTally:
    """Counts of the selected and dropped splats of a scene, or of a part of it.

    Attributes:
        count: N splats.
        dropped: number of dropped splats by the `REASONS` that occur.
        first_invalid: place of the first invalid splat; None without any.
    """

    count: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    first_invalid: int | None = None

    @property
    def selected(self) -> int:
        """Number of selected splats."""
        return self.count - sum(self.dropped.values())

    def then(self, after: SelectionTally) -> SelectionTally:
        """Return the tally of these splats followed by others."""
        first = self.first_invalid
        if first is None and after.first_invalid is not None:
            first = self.count + after.first_invalid
        sums = {reason: self.dropped.get(reason, 0) + after.dropped.get(reason, 0) for reason in REASONS}
        return SelectionTally(self.count + after.count, {reason: sum_ for reason, sum_ in sums.items() if sum_}, first)


@dataclass(frozen=True)
class Selection:
    """Criteria of the splats to keep.

    Attributes:
        drop_invalid: drop invalid splats (`splats.INVALID`) instead of raising an error.
        min_opacity: least opacity, 0..1.
        min_box, max_box: lowest and highest centre, borders (as float32) included; world units.
        within: ball around all centres: centre and radius, world units.
        drop_invisible: drop splats without opacity or size, which trees cannot have.
    """

    drop_invalid: bool = False
    min_opacity: float = 0.0
    min_box: Vector | None = None
    max_box: Vector | None = None
    within: tuple[Vector, float] | None = None
    drop_invisible: bool = True

    def apply(self, splats: Splats, *, threads: int = 1) -> tuple[Splats, dict[str, int]]:
        """Return the selected splats, in their order, and `SelectionTally.dropped`.

        Raises:
            InvalidSplatsError: there are no splats, some are invalid without `drop_invalid`, or none is left.
        """
        keep, tally = self.examine(splats, threads=threads)
        self.check(tally)
        return (splats if keep.all() else splats.take(keep)), tally.dropped

    def examine(self, splats: Splats, *, threads: int = 1) -> tuple[NDArray[np.bool_], SelectionTally]:
        """Return the (N,) mask of the selected splats of a scene, or of a part of it, and the tally.

        Invalid splats are never selected.
        """
        keep, tally = np.ones(len(splats), np.bool_), SelectionTally()
        parts = blocks_of(len(splats), EXAMINED)
        examined = ordered_map(lambda part: self._examine(splats.take(part)), parts, threads)
        for part, (selected, more) in zip(parts, examined, strict=True):
            keep[part], tally = selected, tally.then(more)
        return keep, tally

    def _examine(self, splats: Splats) -> tuple[NDArray[np.bool_], SelectionTally]:
        invalid = splats.invalid()
        passes = {kind: ~mask for kind, mask in invalid.items()}
        if self.drop_invisible:
            passes["zero_opacity"] = splats.opacity > 0
            passes["zero_scale"] = np.maximum.reduce(splats.scale.T, initial=0) > 0
        passes["low_opacity"] = splats.opacity >= self.min_opacity
        passes["cropped"] = self._inside(splats.center)
        keep, dropped = np.ones(len(splats), np.bool_), {}
        for reason, mask in passes.items():
            if count := int(np.count_nonzero(keep & ~mask)):
                dropped[reason] = count
                keep &= mask
        first = min((int(np.argmax(mask)) for mask in invalid.values()), default=None)
        return keep, SelectionTally(len(splats), dropped, first)

    def check(self, tally: SelectionTally) -> None:
        """Check the tally of a whole scene; raises `InvalidSplatsError` as `apply`."""
        if tally.count == 0:
            raise InvalidSplatsError("it has no splats")
        if tally.first_invalid is not None and not self.drop_invalid:
            counts = {kind: count for kind, count in tally.dropped.items() if kind in INVALID}
            text, invalid = describe_counts(counts, tally.count, tally.first_invalid), sum(counts.values())
            if 2 * invalid >= tally.count:
                raise InvalidSplatsError(f"{text}: without them little of the scene is left, so export it again")
            if not tally.selected:
                others = {reason: count for reason, count in tally.dropped.items() if reason not in INVALID}
                raise InvalidSplatsError(f"{text}, and no other splat is left ({describe(others)})")
            raise InvalidSplatsError(f"{text}, add --on-invalid drop to leave them out")
        if not tally.selected:
            raise InvalidSplatsError(f"no splat is left of {tally.count:,} ({describe(tally.dropped)})")

    def _inside(self, center: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return a (N,) mask of the centres inside the box and the ball."""
        inside = np.ones(len(center), np.bool_)
        if self.min_box is not None:
            inside &= (center >= np.asarray(self.min_box, np.float32)).all(axis=1)
        if self.max_box is not None:
            inside &= (center <= np.asarray(self.max_box, np.float32)).all(axis=1)
        if self.within is not None:
            middle, radius = self.within
            offset = center.astype(np.float64) - middle
            inside &= np.einsum("ij,ij->i", offset, offset) <= radius * radius
        return inside


def describe(dropped: dict[str, int]) -> str:
    """Describe numbers of dropped splats, such as "12 not finite, 3 cropped"."""
    return ", ".join(f"{count:,} {REASONS[reason]}" for reason, count in dropped.items())
