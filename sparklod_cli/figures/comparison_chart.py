"""Charts of a comparison of cuts with full detail."""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..images.pixels import FAINT
from ..system.units import percent_of
from ..tables.columns import Row
from ..tables.statistics import numbers
from .charts import BLUE, GREEN, INDIGO, ORANGE, PINK, YELLOW, Axes, FrameColumns, draw, head, stacked

#: Heights of a row of charts and of the title above them, in pixels.
ROW, HEAD = 420, 122

#: Colours of the budgets, in their order; with more budgets than colours they repeat.
COLORS = (INDIGO, BLUE, GREEN, YELLOW, ORANGE, PINK)

#: The rows of a budget, one for each frame, and the budget as it was given ("5%").
Series = tuple[str, Sequence[Row]]


def plot(series: Sequence[Series], title: str) -> bytes:
    """Return the PNG of charts: PSNR, SSIM and PSNR of edges by budget, PSNR, worst tile and popping along the path.

    A chart of which no frame has a value, such as popping of single views, stays away.

    Args:
        series: one for each budget, all of the same frames.

    Raises:
        SparklodError: matplotlib is not installed.
    """
    groups, frames = [rows for _, rows in series], len(series[0][1])

    def fill(matplotlib: ModuleType, grid: NDArray[Any]) -> None:
        _by_budget(matplotlib, grid[0], groups, "psnr", "PSNR by budget", "dB")
        _by_budget(matplotlib, grid[1], groups, "ssim", "SSIM by budget", "")
        _by_budget(matplotlib, grid[2], groups, "edge_psnr", "PSNR of edges by budget", "dB")
        _by_frame(grid[3], series, "psnr", "PSNR along the path", "dB")
        _by_frame(grid[4], series, "worst_tile_psnr", "PSNR of the worst tile", "dB")
        _by_frame(grid[5], series, "popping", "Popping along the path", "steps of 8 bits")

    about = f"against full detail, {frames:,} frame{'s' * (frames > 1)}, on black and on white"
    return stacked(head(title, [(about, FAINT)], HEAD), draw(3, ROW, fill))


def _by_budget(
    matplotlib: ModuleType, axes: Axes, groups: Sequence[Sequence[Row]], name: str, title: str, unit: str
) -> None:
    """Mean over the frames, in all and on either background, and the range from the lowest to the highest frame."""
    if not all(numbers(rows, name) for rows in groups):
        axes.set_visible(False)
        return
    groups = sorted(groups, key=lambda rows: numbers(rows, "share")[0])
    share = np.array([numbers(rows, "share")[0] for rows in groups])
    cells = np.array([numbers(rows, name) for rows in groups])
    axes.fill_between(
        share, cells.min(axis=1), cells.max(axis=1), color=GREEN, alpha=0.25, linewidth=0, label="range of frames"
    )
    for background, color in (("black", BLUE), ("white", YELLOW)):
        mean = [np.mean(numbers(rows, f"{name}_{background}")) for rows in groups]
        axes.plot(share, mean, color=color, linewidth=1, linestyle=(0, (4, 3)), label=f"on {background}")
    axes.plot(share, cells.mean(axis=1), "o-", color=GREEN, linewidth=1.8, markersize=5, label="mean")
    axes.set_xscale("log")
    axes.set_xticks(share)
    axes.xaxis.set_major_formatter(lambda value, place: percent_of(value))
    axes.xaxis.set_minor_locator(matplotlib.ticker.NullLocator())
    axes.set_title(title)
    axes.set_ylabel(unit)
    axes.legend(loc="lower right", ncols=4, borderpad=0, handlelength=1.4)


def _by_frame(axes: Axes, series: Sequence[Series], name: str, title: str, unit: str) -> None:
    """One line for each budget."""
    if not any(numbers(rows, name) for _, rows in series):
        axes.set_visible(False)
        return
    for at, (budget, rows) in enumerate(series):
        frames = FrameColumns(rows)
        axes.plot(frames.x, frames.column(name), color=COLORS[at % len(COLORS)], linewidth=1.4, label=budget)
        axes.xaxis.set_major_formatter(frames.tick)
        axes.set_xlim(frames.x[0], frames.x[-1])
    axes.set_title(title)
    axes.set_ylabel(unit)
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(series), borderpad=0, handlelength=1.4)
