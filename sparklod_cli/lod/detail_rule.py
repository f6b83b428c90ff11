"""`DetailRule`, how a viewer of Streamed SOG chooses a detail level for each region."""

from __future__ import annotations

from dataclasses import dataclass

#: What a viewer makes of a budget: it spends all of it, or only keeps within it what distances ask for.
BUDGET_MODES = ("target", "limit")

#: PlayCanvas's budget of splats, and the chunk files that it loads at a time, unless it is told otherwise.
BUDGET, FETCHERS = 1_000_000, 2

#: Its defaults for distances: world units, and factors; and the least that it takes.
BASE_DISTANCE, LEAST_BASE_DISTANCE = 5.0, 0.1
MULTIPLIER, LEAST_MULTIPLIER = 3.0, 1.2
BEHIND_PENALTY, SHRINK = 1.5, 0.75


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
