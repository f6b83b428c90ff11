"""`DetailSettings`, how a scene is divided into regions and detail levels."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from ..support import defaults
from .budget import SHARE

#: The most levels after full detail. Viewers choose between a handful; chosen.
MOST_LEVELS = 15


@dataclass(frozen=True)
class DetailSettings:
    """How regions and detail levels are made.

    Attributes:
        levels: splats of each level after full detail, as a share of it, descending, above 0 and below 1; None for
            levels that suit the scene.
        chunk_splats: a chunk file is closed at about this many splats, and a region has no more of all levels together.
        extent: longest side, in world units, beyond which a region is divided.
        min_splats: a region of fewer splats is not divided for its extent.
    """

    levels: tuple[float, ...] | None = None
    chunk_splats: int = defaults.DETAIL_CHUNK_SPLATS
    extent: float = defaults.DETAIL_EXTENT
    min_splats: int = defaults.DETAIL_MIN_SPLATS

    def __post_init__(self) -> None:
        levels = self.levels
        if levels is not None and not (
            0 < len(levels) <= MOST_LEVELS and all(a > b for a, b in itertools.pairwise((1.0, *levels, 0.0)))
        ):
            raise ValueError(f"levels are {levels}; give 1 to {MOST_LEVELS} shares below 1 and above 0, descending")
        for name in ("chunk_splats", "extent", "min_splats"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; give more than 0")


def parse_levels(text: str) -> tuple[float, ...] | None:
    """The levels of a text such as "50%,25%,12%", as shares of full detail; None for "auto".

    Raises:
        ValueError: the text is neither.
    """
    if text.strip() == "auto":
        return None
    found = [SHARE.fullmatch(part.strip()) for part in text.split(",")]
    shares = tuple(float(share[1]) / 100 for share in found if share is not None)
    try:
        return DetailSettings(shares if len(shares) == len(found) else ()).levels
    except ValueError:
        raise ValueError(
            f"{text!r} is neither auto nor shares of full detail such as 50%,25%,12%: at most {MOST_LEVELS}, each"
            " smaller than the one before, above 0% and below 100%"
        ) from None
