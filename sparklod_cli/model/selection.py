"""`Selection`, which splats of a scene to keep: it drops what cannot be drawn, crops, and counts what it drops."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..support.errors import InvalidSplatsError
from .splats import INVALID, Splats, describe_invalid

Vector = tuple[float, float, float]

#: Reasons for dropping a splat, in the order in which they are applied, and their words in a report.
REASONS = INVALID | {
    "zero_opacity": "zero opacity",
    "zero_scale": "zero scale",
    "low_opacity": "below --min-opacity",
    "cropped": "cropped",
}


@dataclass(frozen=True)
class Selection:
    """The splats to keep.

    Attributes:
        drop_invalid: drop invalid splats (`splats.INVALID`) instead of raising an error.
        min_opacity: keep splats of at least this opacity, 0..1.
        min_box, max_box: keep splats whose centre lies in this box, borders (as float32) included; world units.
        within: keep splats whose centre lies in this ball: centre and radius, world units.
    """

    drop_invalid: bool = False
    min_opacity: float = 0.0
    min_box: Vector | None = None
    max_box: Vector | None = None
    within: tuple[Vector, float] | None = None

    def apply(self, splats: Splats) -> tuple[Splats, dict[str, int]]:
        """The splats that are kept, in their order, and the number dropped for each of `REASONS` that occurred.

        Raises:
            InvalidSplatsError: there are no splats, some are invalid without `drop_invalid`, or none is left.
        """
        if len(splats) == 0:
            raise InvalidSplatsError("it has no splats")
        invalid = splats.invalid()
        if invalid and not self.drop_invalid:
            raise InvalidSplatsError(f"{describe_invalid(invalid)}, add --on-invalid drop to leave them out")
        keeps = {kind: ~mask for kind, mask in invalid.items()} | {
            "zero_opacity": splats.opacity > 0,
            "zero_scale": splats.scale.max(axis=1, initial=0) > 0,
            "low_opacity": splats.opacity >= self.min_opacity,
            "cropped": self._inside(splats.center),
        }
        keep = np.ones(len(splats), np.bool_)
        dropped = {}
        for reason in (reason for reason in REASONS if reason in keeps):
            before = int(np.count_nonzero(keep))
            keep &= keeps[reason]
            dropped[reason] = before - int(np.count_nonzero(keep))
        dropped = {reason: count for reason, count in dropped.items() if count}
        if not keep.any():
            raise InvalidSplatsError(f"no splat is left of {len(splats):,} ({describe(dropped)})")
        return (splats if keep.all() else splats.take(keep)), dropped

    def _inside(self, center: NDArray[np.float32]) -> NDArray[np.bool_]:
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
    """ "12 not finite, 3 cropped", for display."""
    return ", ".join(f"{count:,} {REASONS[reason]}" for reason, count in dropped.items())
