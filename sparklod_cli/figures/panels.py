"""The charts of a traversal, one for each group of columns: the rows of `PANELS`. Draws into axes of matplotlib."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from ..images.text import FAINT
from .series import BLUE, GREEN, INDIGO, ORANGE, YELLOW, Frames, Series

#: Upper end of an axis over the largest value: leaves room for the labels of marked frames.
HEADROOM = 1.22


Axes = Any


@dataclass(frozen=True)
class Panel:
    """One chart of the figure.

    Attributes:
        title: of the chart.
        columns: that the chart needs; without a number in each of them it is left out.
        draw: draws into matplotlib's axes and returns (N,) heights at which frames are marked.
        marks: reasons for marking a frame, of those that this chart shows.
    """

    title: str
    columns: tuple[str, ...]
    draw: Callable[[Axes, Frames, ModuleType], Series]
    marks: tuple[str, ...] = ()


def _drawn(axes: Axes, frames: Frames, matplotlib: ModuleType) -> Series:
    _stack(axes, frames, (("leaves", "leaves", GREEN), ("merged", "interior", BLUE)))
    budget = frames.column("budget")
    axes.plot(frames.x, budget, color=YELLOW, linewidth=1.4, label="budget")
    axes.set_ylim(0, max(axes.get_ylim()[1], 1.05 * float(np.nanmax(budget))))
    _counted(axes, matplotlib)
    axes.set_ylabel("splats")
    return frames.column("selected")


def _where(axes: Axes, frames: Frames, matplotlib: ModuleType) -> Series:
    parts = (("inside", "in_frustum", GREEN), ("outside", "outside", BLUE), ("behind", "behind", INDIGO))
    _stack(axes, frames, parts)
    _counted(axes, matplotlib)
    axes.set_ylabel("splats")
    return frames.column("in_frustum")


def _stack(axes: Axes, frames: Frames, parts: Sequence[tuple[str, str, str]]) -> None:
    floor = np.zeros(len(frames.x))
    for label, name, color in parts:
        top = floor + np.nan_to_num(frames.column(name))
        axes.fill_between(frames.x, floor, top, color=color, linewidth=0, label=label)
        floor = top
    axes.set_ylim(0, max(float(floor.max()) * 1.03, 1))


def _from_zero(axes: Axes, values: Series) -> None:
    """Lets the vertical axis run from 0 to `HEADROOM` times the largest value; NaN is ignored."""
    axes.set_ylim(0, HEADROOM * float(np.nanmax(values)) or 1)


def _counted(axes: Axes, matplotlib: ModuleType, unit: str = "") -> None:
    """Gives the vertical axis ticks at whole numbers, with k and M for thousands and millions."""
    axes.yaxis.set_major_locator(matplotlib.ticker.MaxNLocator(6, steps=[1, 2, 5, 10], integer=True, min_n_ticks=1))
    axes.yaxis.set_major_formatter(matplotlib.ticker.EngFormatter(unit, sep=" " if unit else ""))


def _beside(axes: Axes) -> Axes:
    """A second vertical axis, on the right."""
    other = axes.twinx()
    other.grid(False)
    return other


def _coarse(axes: Axes, frames: Frames, matplotlib: ModuleType) -> Series:
    values = frames.ratio("pixel_scale_min", "pixel_scale_limit")
    values[~(values > 0)] = np.nan
    axes.plot(frames.x, values, color=ORANGE, linewidth=1.4)
    axes.axhline(1, color=FAINT, linewidth=1, linestyle=(0, (4, 3)), label="limit")
    axes.set_yscale("log", base=2)
    axes.yaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    # At least from half to twice the limit, so that values close to the limit look close to it.
    finite = [*values[np.isfinite(values)], 1.0]
    axes.set_ylim(min(0.5, 0.8 * min(finite)), max(2.0, 1.6 * max(finite)))
    axes.set_ylabel("times the limit")
    return values


def _churn(axes: Axes, frames: Frames, matplotlib: ModuleType) -> Series:
    values = frames.column("churn")
    axes.fill_between(frames.x, 0, values, color=ORANGE, alpha=0.25, linewidth=0)
    axes.plot(frames.x, values, color=ORANGE, linewidth=1.2)
    axes.yaxis.set_major_formatter(lambda value, place: f"{100 * value:.3g} %")
    _from_zero(axes, values)
    axes.set_ylabel("share of splats")
    return values


def _fetched(axes: Axes, frames: Frames, matplotlib: ModuleType) -> Series:
    values = frames.column("bytes_new")
    some = values > 0
    axes.vlines(frames.x[some], 0, values[some], color=ORANGE, linewidth=1.8, label="per frame")
    _counted(axes, matplotlib, "B")
    _from_zero(axes, values)
    axes.set_ylabel("per frame")
    total = _beside(axes)
    fetched = np.nancumsum(values)
    total.plot(frames.x, fetched, color=GREEN, linewidth=1.6)
    axes.plot([], [], color=GREEN, linewidth=1.6, label="total")
    _counted(total, matplotlib, "B")
    _from_zero(total, fetched)
    total.set_ylabel("total")
    return values


def _cache(axes: Axes, frames: Frames, matplotlib: ModuleType) -> Series:
    values = frames.column("missing")
    axes.fill_between(frames.x, 0, values, color=ORANGE, alpha=0.35, linewidth=0)
    axes.plot(frames.x, values, color=ORANGE, linewidth=1.2, label="nodes missing")
    _from_zero(axes, values)
    _counted(axes, matplotlib)
    axes.set_ylabel("nodes missing")
    chunks = _beside(axes)
    resident = frames.column("chunks_resident")
    chunks.plot(frames.x, resident, color=GREEN, linewidth=1.6)
    axes.plot([], [], color=GREEN, linewidth=1.6, label="chunks resident")
    _from_zero(chunks, resident)
    chunks.yaxis.set_major_locator(matplotlib.ticker.MaxNLocator(5, integer=True))
    chunks.set_ylabel("chunks resident")
    return values


def _depths(axes: Axes, frames: Frames, matplotlib: ModuleType) -> Series:
    mean, most = frames.column("level_mean"), frames.column("level_max")
    axes.fill_between(frames.x, frames.column("level_min"), most, color=BLUE, alpha=0.5, linewidth=0, label="range")
    axes.plot(frames.x, mean, color=GREEN, linewidth=1.6, label="mean")
    axes.yaxis.set_major_locator(matplotlib.ticker.MaxNLocator(6, integer=True))
    _from_zero(axes, most)
    if frames.has("pixel_scale_limit"):
        axes.set_ylabel("edges from the root")
    else:  # only trees have such a limit
        axes.set_title("Detail levels of the cut")
        axes.set_ylabel("level")
    return mean


def _line(name: str, unit: str, color: str) -> Callable[[Axes, Frames, ModuleType], Series]:
    def draw(axes: Axes, frames: Frames, matplotlib: ModuleType) -> Series:
        values = frames.column(name)
        axes.plot(frames.x, values, color=color, linewidth=1.3)
        _from_zero(axes, values)
        axes.set_ylabel(unit)
        return values

    return draw


PANELS = (
    Panel("Splats drawn", ("leaves", "interior", "budget"), _drawn),
    Panel("Inside or outside the frustum", ("in_frustum", "outside", "behind"), _where),
    Panel("Depth of the cut", ("level_min", "level_mean", "level_max"), _depths),
    Panel("Pixel scale", ("pixel_scale_min", "pixel_scale_limit"), _coarse, ("coarsest",)),
    Panel("Churn", ("churn",), _churn, ("churn",)),
    Panel("Bytes fetched", ("bytes_new",), _fetched, ("bytes",)),
    Panel("Chunk cache", ("missing", "chunks_resident"), _cache, ("missing",)),
    Panel(
        "Time until the cut is resident", ("complete_in_s",), _line("complete_in_s", "seconds", ORANGE), ("incomplete",)
    ),
    Panel("Overdraw", ("overdraw_estimate",), _line("overdraw_estimate", "splats a pixel", ORANGE), ("overdraw",)),
    Panel("Time to find the cut", ("traverse_ms",), _line("traverse_ms", "milliseconds", GREEN)),
)
