"""`DetailRule`, how a viewer of Streamed SOG chooses a detail level for each region."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ..support.setting_fields import CheckedSettings, Range, setting, whole

#: What a viewer makes of a budget: it spends all of it, or only keeps within it what distances ask for.
BUDGET_MODES = ("target", "limit")

#: PlayCanvas's budget of splats, and the chunk files that it loads at a time, unless it is told otherwise.
BUDGET, FETCHERS = 1_000_000, 2

#: The shortest base distance, world units.
LEAST_BASE_DISTANCE = 0.1


@dataclass(frozen=True)
class DetailRule(CheckedSettings):
    """How a viewer chooses detail levels: names, defaults and bounds are those of PlayCanvas 2.23.

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
