"""Settings of the regions and detail levels of a scene, and of a viewer's choice of levels in Streamed SOG."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import ClassVar

from ..system.setting_fields import CheckedSettings, Quantity, Range, setting, whole
from ..system.units import parse_count

#: What a viewer makes of a budget: it spends all of it, or only keeps within it what distances ask for.
BUDGET_MODES = ("target", "limit")

#: PlayCanvas's budget of splats, and the chunk files that it loads at a time, unless it is told otherwise.
BUDGET, FETCHERS = 1_000_000, 2

#: Requests to a host that browsers have under way at a time, by HTTP/1.1; a chunk file takes seven or eight.
CONNECTIONS = 6

#: The shortest base distance, world units.
LEAST_BASE_DISTANCE = 0.1

#: The most levels after full detail. Viewers choose between a handful; chosen.
MOST_LEVELS = 15


@dataclass(frozen=True)
class DetailRule(CheckedSettings):
    """Rule by which a viewer chooses detail levels: names, defaults and bounds are those of PlayCanvas 2.23.

    They are its `splatBudgetMode`, `lodBaseDistance` (seen by a camera with a field of view of 45 degrees),
    `lodMultiplier`, `lodBehindPenalty`, `lodDistanceShrink`, `lodRangeMin`, `lodRangeMax` and `lodUnderfillLimit`.

    Attributes:
        shrink: 0..1, by how much of what it has more than the median the bound of a region is smaller when its distance
            is measured.
        finest, coarsest: the levels that may be chosen.

    Raises:
        ValueError: a number is out of its range.
    """

    HEADING: ClassVar[str] = "Streamed SOG"

    mode: str = setting(
        BUDGET_MODES[0],
        "Spend the whole budget, or take the levels that distances ask for, and coarser ones only where those exceed"
        " it.",
        BUDGET_MODES,
        name="budget_mode",
    )
    base_distance: float = setting(
        5.0,
        "Distance at which level 1 replaces full detail, in world units; with --budget-mode limit.",
        Range(LEAST_BASE_DISTANCE),
        name="lod_base_distance",
        needs="budget_mode=limit",  # a budget that is always spent depends on ratios of distances alone
    )
    multiplier: float = setting(
        3.0, "Ratio of the distances at which successive levels begin.", Range(1.2), name="lod_multiplier"
    )
    behind_penalty: float = setting(
        1.5, "Factor of the distance of regions straight behind the camera.", Range(1), name="lod_behind_penalty"
    )
    shrink: float = 0.75
    finest: int = 0
    coarsest: int = 99
    underfill: int = setting(
        0,
        "With --bandwidth: while the file of a level loads, draw one that is up to this many levels coarser.",
        whole(0, 100),
        name="lod_underfill",
        needs="bandwidth",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        Range(0, 1).check("shrink", self.shrink)
        if not 0 <= self.finest <= self.coarsest:
            raise ValueError(f"levels {self.finest} to {self.coarsest} are no range; give 0 <= finest <= coarsest")


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
    """Settings of regions and detail levels; the defaults are those of the tools of the makers of Streamed SOG.

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
