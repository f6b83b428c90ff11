"""How a scene is divided into regions and detail levels, and how a viewer of Streamed SOG chooses a level for each."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from ..support import defaults
from .budget import SHARE

#: What a viewer makes of a budget: it spends all of it, or only keeps within it what distances ask for.
BUDGET_MODES = ("target", "limit")

#: PlayCanvas's budget of splats, and the chunk files that it loads at a time, unless it is told otherwise.
BUDGET, FETCHERS = 1_000_000, 2

#: Its defaults for distances: world units, and factors; and the least that it takes.
BASE_DISTANCE, LEAST_BASE_DISTANCE = 5.0, 0.1
MULTIPLIER, LEAST_MULTIPLIER = 3.0, 1.2
BEHIND_PENALTY, SHRINK = 1.5, 0.75

#: The most levels after full detail. Viewers choose between a handful; chosen.
MOST_LEVELS = 15


@dataclass(frozen=True)
class DetailRule:
    """How a viewer chooses detail levels: names and defaults are those of PlayCanvas 2.23.

    Attributes:
        mode: "target" spends the budget whatever the distances are; "limit" takes the levels that distances ask for,
            and coarser ones where those exceed the budget. `splatBudgetMode`.
        base_distance: world units from which level 1 is asked for, seen by a camera with a field of view of 45 degrees.
            `lodBaseDistance`.
        multiplier: of that distance from each level to the next. `lodMultiplier`.
        behind_penalty: factor of the distance of what is straight behind the camera; 1 for none. `lodBehindPenalty`.
        shrink: 0..1, by how much of what it has more than the median the bound of a region is smaller when its distance
            is measured. `lodDistanceShrink`.
        finest, coarsest: the levels that may be chosen. `lodRangeMin`, `lodRangeMax`.
        underfill: levels by which a region may be coarser than chosen while the file of its level loads.
            `lodUnderfillLimit`.

    Raises:
        ValueError: a number is out of its range.
    """

    mode: str = BUDGET_MODES[0]
    base_distance: float = BASE_DISTANCE
    multiplier: float = MULTIPLIER
    behind_penalty: float = BEHIND_PENALTY
    shrink: float = SHRINK
    finest: int = 0
    coarsest: int = 99
    underfill: int = 0

    def __post_init__(self) -> None:
        if self.mode not in BUDGET_MODES:
            raise ValueError(f"there is no budget mode {self.mode!r}; give one of {', '.join(BUDGET_MODES)}")
        for name, least in (
            ("base_distance", LEAST_BASE_DISTANCE),
            ("multiplier", LEAST_MULTIPLIER),
            ("behind_penalty", 1.0),
        ):
            if not least <= getattr(self, name) < float("inf"):
                raise ValueError(f"{name} is {getattr(self, name)}; give {least:g} or more")
        if not 0 <= self.shrink <= 1:
            raise ValueError(f"shrink is {self.shrink}; give 0 to 1")
        if not 0 <= self.finest <= self.coarsest:
            raise ValueError(f"levels {self.finest} to {self.coarsest} are no range; give 0 <= finest <= coarsest")
        if self.underfill < 0:
            raise ValueError(f"underfill is {self.underfill}; give 0 or more")


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
    """Return the levels of a text such as "50%,25%,12%", as shares of full detail; None for "auto".

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
