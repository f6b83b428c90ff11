"""`DetailSettings`, how a scene is divided into regions and detail levels."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import ClassVar

from ..support.setting_fields import CheckedSettings, Quantity, Range, setting, whole
from ..support.units import parse_count

#: The most levels after full detail. Viewers choose between a handful; chosen.
MOST_LEVELS = 15


def parse_levels(text: str) -> tuple[float, ...] | None:
    """Return the levels of a text such as "50%,25%,12%", as shares of full detail; None for "auto".

    Raises:
        ValueError: the text is neither.
    """
    if text.strip() == "auto":
        return None
    from .budget import SHARE  # whose fractions take milliseconds to load

    shares = [SHARE.fullmatch(part.strip()) for part in text.split(",")]
    levels = tuple(float(share[1]) / 100 for share in shares if share is not None)
    if len(levels) < len(shares) or not _are_levels(levels):
        raise ValueError(
            f"{text!r} is neither auto nor shares of full detail such as 50%,25%,12%: at most {MOST_LEVELS}, each"
            " smaller than the one before, above 0% and below 100%"
        )
    return levels


def _are_levels(levels: tuple[float, ...]) -> bool:
    descends = all(a > b for a, b in itertools.pairwise((1.0, *levels, 0.0)))
    return 0 < len(levels) <= MOST_LEVELS and descends


@dataclass(frozen=True)
class DetailSettings(CheckedSettings):
    """How regions and detail levels are made; the defaults are those of the tools of the makers of Streamed SOG.

    A region has no more splats of all levels together than a chunk file.
    """

    HEADING: ClassVar[str] = "Streamed SOG"

    levels: tuple[float, ...] | None = setting(
        None,
        "Splats of each detail level after full detail, as shares of it in descending order, such as 50%,25%,12%,6%;"
        " auto suits the scene.  [default: auto]",
        Quantity("SHARES|auto", parse_levels),
    )
    chunk_splats: int = setting(
        524_288, "Splats, about, after which a chunk file is closed.", Quantity("N", parse_count, whole(1))
    )
    extent: float = setting(
        16.0,
        "Longest side of a region, in world units of the output; regions that are longer are divided.",
        Range(above=0),
        name="region_extent",
    )
    min_splats: int = setting(
        8_192,
        "Splats below which a region is not divided, however long it is.",
        Quantity("N", parse_count, whole(1)),
        name="region_min_splats",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.levels is not None and not _are_levels(self.levels):
            raise ValueError(
                f"levels are {self.levels}; give 1 to {MOST_LEVELS} shares below 1 and above 0, descending"
            )
