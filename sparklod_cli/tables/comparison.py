"""The table of a comparison: its columns, and what its rows come to for each budget."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from ..cameras.sources import MOST_TURN
from .assertions import numbers, statistic
from .columns import FRAME, Column, Row

COLUMNS = (
    *FRAME,
    Column("budget", int, "", "splats", "the most that may be drawn, all instances together"),
    Column("share", float, ".6g", "share", "budget over the splats of full detail"),
    Column("selected", int, "", "splats", "what is drawn; with `--continuous` more than the budget, as some fade"),
    Column("psnr_black", float, ".3f", "dB", "PSNR against full detail, both on black; 100 if they are the same"),
    Column("psnr_white", float, ".3f", "dB", "the same on white"),
    Column("psnr", float, ".3f", "dB", "mean of the two"),
    Column("ssim_black", float, ".5f", "", "SSIM against full detail, both on black; 1 if they are the same"),
    Column("ssim_white", float, ".5f", "", "the same on white"),
    Column("ssim", float, ".5f", "", "mean of the two"),
    Column("edge_psnr_black", float, ".3f", "dB", "PSNR at the edges of full detail, on black; empty if it has none"),
    Column("edge_psnr_white", float, ".3f", "dB", "the same on white"),
    Column("edge_psnr", float, ".3f", "dB", "mean of the two"),
    Column("worst_tile_psnr", float, ".3f", "dB", "PSNR of the tile of 64 x 64 pixels that is farthest off, on either"),
    Column("worst_tile_x", int, "", "px", "its left side"),
    Column("worst_tile_y", int, "", "px", "its upper side"),
    Column("popping_black", float, ".4f", "8 bits", "change since the last frame beyond that of full detail, on black"),
    Column("popping_white", float, ".4f", "8 bits", "the same on white"),
    Column("popping", float, ".4f", "8 bits", "mean of the two; empty where a frame follows none"),
)

#: Why all cells of a column may be empty.
EMPTY = {
    **dict.fromkeys(
        ("popping_black", "popping_white", "popping"),
        f"no frame follows another; a path has times, and turns by at most {MOST_TURN:g} degrees a frame",
    ),
    **dict.fromkeys(("edge_psnr_black", "edge_psnr_white", "edge_psnr"), "full detail has no edges in any frame"),
}


@dataclass(frozen=True)
class BudgetSummary:
    """Summary of the frames of a budget.

    Attributes:
        text: the budget, as it was given.
        budget, share: see `COLUMNS`.
        frames: how many.
        selected: mean.
        psnr, psnr_min, psnr_max, psnr_black, psnr_white: dB; means but for the least and the most.
        ssim, ssim_min: mean and least.
        edge_psnr, edge_psnr_min: dB, mean and least of the frames that have edges; None if none has.
        worst_tile_psnr: the least, dB.
        worst_frame, worst_tile_x, worst_tile_y: where that is.
        popping, popping_max: mean and most, in steps of 8 bits; None if no frame follows another.
        popping_frame: the frame that has the most; None as well.
    """

    text: str
    budget: int
    share: float
    frames: int
    selected: float
    psnr: float
    psnr_min: float
    psnr_max: float
    psnr_black: float
    psnr_white: float
    ssim: float
    ssim_min: float
    edge_psnr: float | None
    edge_psnr_min: float | None
    worst_tile_psnr: float
    worst_frame: int
    worst_tile_x: int
    worst_tile_y: int
    popping: float | None
    popping_max: float | None
    popping_frame: int | None

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def rows_by_budget(rows: Iterable[Row], budgets: int) -> list[list[Row]]:
    """Return the rows of each of some budgets, in the order of the frames."""
    every = list(rows)
    return [every[at::budgets] for at in range(budgets)]


def summarize(rows: Iterable[Row], budgets: Sequence[str]) -> list[BudgetSummary]:
    """Return the summary of the rows of a comparison for each budget, named as it was given."""
    return [_summary(budget, mine) for budget, mine in zip(budgets, rows_by_budget(rows, len(budgets)), strict=True)]


def _summary(text: str, rows: Sequence[Row]) -> BudgetSummary:
    def of(name: str, which: str = "mean") -> Any:
        cells = numbers(rows, name)
        return float(f"{statistic(which, cells):.9g}") if cells else None

    first = rows[0]
    worst = min(rows, key=lambda row: numbers([row], "worst_tile_psnr")[0])
    popped = [row for row in rows if row["popping"] is not None]
    most = max(popped, key=lambda row: numbers([row], "popping")[0], default=None)
    places = {"worst_frame": "frame", "worst_tile_x": "worst_tile_x", "worst_tile_y": "worst_tile_y"}
    means = ("selected", "psnr", "psnr_black", "psnr_white", "ssim", "edge_psnr", "popping")
    return BudgetSummary(
        text=text,
        budget=int(numbers([first], "budget")[0]),
        share=float(numbers([first], "share")[0]),
        frames=len(rows),
        worst_tile_psnr=of("worst_tile_psnr", "min"),
        popping_frame=None if most is None else int(numbers([most], "frame")[0]),
        **{name: of(name) for name in means},
        **{f"{name}_min": of(name, "min") for name in ("psnr", "ssim", "edge_psnr")},
        **{f"{name}_max": of(name, "max") for name in ("psnr", "popping")},
        **{name: int(numbers([worst], column)[0]) for name, column in places.items()},
    )
