"""The columns of a simulation over time, as small multiples; the one place that talks to matplotlib."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..images.text import BACKGROUND, FAINT, INK, LINE
from ..support.errors import SparklodError
from ..tables.columns import Row
from ..tables.statistics import numbers

#: Pixels an inch, and in them the width of all charts together and the height of a row of two.
DPI, WIDTH, ROW = 100, 1600, 255

#: How much higher a chart is than its greatest number: room for what is written at frames to look at.
HEADROOM = 1.22

#: Stops of the ramps that the pictures of scenes have.
GREEN, BLUE, INDIGO, ORANGE, YELLOW, PINK = "#44bf70", "#2a788e", "#414487", "#ed7953", "#fde725", "#ff5c8a"

PANEL = "#141b24"

Series = NDArray[np.float64]
Axes = Any


def load_matplotlib() -> ModuleType:
    """Imports matplotlib, without what it shares with other users of it.

    Raises:
        SparklodError: it is not installed.
    """
    try:
        import matplotlib
        import matplotlib.backends.backend_agg
        import matplotlib.figure
        import matplotlib.ticker
    except ImportError as error:
        raise SparklodError(f"charts are drawn by matplotlib: pip install 'sparklod[render]' ({error})") from None
    return matplotlib


class Frames:
    """The columns of some rows as arrays.

    Attributes:
        x: (N,) where they are along the axis: seconds, or numbers of frames where there are no times.
    """

    def __init__(self, rows: Sequence[Row]) -> None:
        times = numbers(rows, "time_s")
        timed = len(times) == len(rows) and len(set(times)) > 1
        self.rows, self._timed = rows, timed
        self.x = np.array(times if timed else numbers(rows, "frame"), np.float64)
        if len(rows) == 1:  # as wide as a frame, for a line to be seen
            self.rows, self.x = [rows[0], rows[0]], self.x + np.array([-0.5, 0.5])

    def tick(self, value: float, place: int) -> str:
        """What stands at a place of the axis."""
        if self._timed:
            return f"{value:g} s"
        return f"frame {value:,.0f}" if value == round(value) else ""

    def has(self, *names: str) -> bool:
        """Whether there is a number in each of these columns."""
        return all(numbers(self.rows, name) for name in names)

    def column(self, name: str) -> Series:
        """(N,) numbers; NaN where a cell is empty."""
        return np.array([np.nan if row[name] is None else row[name] for row in self.rows], np.float64)

    def ratio(self, name: str, of: str) -> Series:
        """(N,) one column over another; NaN where a cell is empty, or the other is 0."""
        above, below = self.column(name), self.column(of)
        return np.divide(above, below, out=np.full(len(above), np.nan), where=below != 0)


@dataclass(frozen=True)
class Panel:
    """One of the small multiples.

    Attributes:
        title: what it shows.
        columns: all of which it needs.
        draw: draws into axes, and returns (N,) the heights that frames are marked at.
        marks: the reasons to look at a frame that are marked here.
    """

    title: str
    columns: tuple[str, ...]
    draw: Callable[[Axes, Frames, ModuleType], Series]
    marks: tuple[str, ...] = ()


def _drawn(axes: Axes, frames: Frames, matplotlib: ModuleType) -> Series:
    _stack(axes, frames, (("full detail", "leaves", GREEN), ("stand for others", "interior", BLUE)))
    budget = frames.column("budget")
    axes.plot(frames.x, budget, color=YELLOW, linewidth=1.4, label="budget")
    axes.set_ylim(0, max(axes.get_ylim()[1], 1.05 * float(np.nanmax(budget))))
    _counted(axes, matplotlib)
    axes.set_ylabel("splats")
    return frames.column("selected")


def _where(axes: Axes, frames: Frames, matplotlib: ModuleType) -> Series:
    parts = (("in the picture", "in_frustum", GREEN), ("beside it", "outside", BLUE), ("behind", "behind", INDIGO))
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
    """Makes the axis go from 0 to above the greatest of numbers, some of which may be missing."""
    axes.set_ylim(0, HEADROOM * float(np.nanmax(values)) or 1)


def _counted(axes: Axes, matplotlib: ModuleType, unit: str = "") -> None:
    """Marks an axis of heights in whole numbers, with k and M for thousands and millions."""
    axes.yaxis.set_major_locator(matplotlib.ticker.MaxNLocator(6, steps=[1, 2, 5, 10], integer=True, min_n_ticks=1))
    axes.yaxis.set_major_formatter(matplotlib.ticker.EngFormatter(unit, sep=" " if unit else ""))


def _beside(axes: Axes) -> Axes:
    """A second axis of heights, on the right."""
    other = axes.twinx()
    other.grid(False)
    return other


def _coarse(axes: Axes, frames: Frames, matplotlib: ModuleType) -> Series:
    values = frames.ratio("pixel_scale_min", "pixel_scale_limit")
    values[~(values > 0)] = np.nan
    axes.plot(frames.x, values, color=ORANGE, linewidth=1.4)
    axes.axhline(1, color=FAINT, linewidth=1, linestyle=(0, (4, 3)), label="the limit")
    axes.set_yscale("log", base=2)
    axes.yaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    # From at least half to twice the limit, so that what is as good as the limit looks so.
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
    axes.set_ylabel("share of the splats")
    return values


def _fetched(axes: Axes, frames: Frames, matplotlib: ModuleType) -> Series:
    values = frames.column("bytes_new")
    some = values > 0
    axes.vlines(frames.x[some], 0, values[some], color=ORANGE, linewidth=1.8, label="for a frame")
    _counted(axes, matplotlib, "B")
    _from_zero(axes, values)
    axes.set_ylabel("for a frame")
    total = _beside(axes)
    fetched = np.nancumsum(values)
    total.plot(frames.x, fetched, color=GREEN, linewidth=1.6)
    axes.plot([], [], color=GREEN, linewidth=1.6, label="in all")
    _counted(total, matplotlib, "B")
    _from_zero(total, fetched)
    total.set_ylabel("in all")
    return values


def _cache(axes: Axes, frames: Frames, matplotlib: ModuleType) -> Series:
    values = frames.column("missing")
    axes.fill_between(frames.x, 0, values, color=ORANGE, alpha=0.35, linewidth=0)
    axes.plot(frames.x, values, color=ORANGE, linewidth=1.2, label="missing")
    _from_zero(axes, values)
    _counted(axes, matplotlib)
    axes.set_ylabel("splats, missing")
    chunks = _beside(axes)
    resident = frames.column("chunks_resident")
    chunks.plot(frames.x, resident, color=GREEN, linewidth=1.6)
    axes.plot([], [], color=GREEN, linewidth=1.6, label="in the cache")
    _from_zero(chunks, resident)
    chunks.yaxis.set_major_locator(matplotlib.ticker.MaxNLocator(5, integer=True))
    chunks.set_ylabel("chunks, in the cache")
    return values


def _levels(axes: Axes, frames: Frames, matplotlib: ModuleType) -> Series:
    mean, most = frames.column("level_mean"), frames.column("level_max")
    axes.fill_between(frames.x, frames.column("level_min"), most, color=BLUE, alpha=0.5, linewidth=0, label="all")
    axes.plot(frames.x, mean, color=GREEN, linewidth=1.6, label="mean")
    axes.yaxis.set_major_locator(matplotlib.ticker.MaxNLocator(6, integer=True))
    _from_zero(axes, most)
    axes.set_ylabel("links from the root")
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
    Panel("What is drawn", ("leaves", "interior", "budget"), _drawn),
    Panel("Where it is", ("in_frustum", "outside", "behind"), _where),
    Panel("Levels of the cut", ("level_min", "level_mean", "level_max"), _levels),
    Panel("Pixel scale that all is divided down to", ("pixel_scale_min", "pixel_scale_limit"), _coarse, ("coarsest",)),
    Panel("Churn: what pops", ("churn",), _churn, ("churn",)),
    Panel("Fetched", ("bytes_new",), _fetched, ("bytes",)),
    Panel("Cache", ("missing", "chunks_resident"), _cache, ("missing",)),
    Panel("Time until all is there", ("complete_in_s",), _line("complete_in_s", "seconds", ORANGE), ("incomplete",)),
    Panel("Overdraw", ("overdraw_estimate",), _line("overdraw_estimate", "splats a pixel", ORANGE), ("overdraw",)),
    Panel("Time to find the cut", ("traverse_ms",), _line("traverse_ms", "milliseconds", GREEN)),
)


def draw(rows: Sequence[Row], marked: Mapping[str, int]) -> NDArray[np.uint8]:
    """(H, WIDTH, 3) the charts of a path; a column without a number has none.

    Args:
        rows: one for each frame, at least one.
        marked: numbers of frames worth a look, by the reason (`Panel.marks`).

    Raises:
        SparklodError: matplotlib is not installed.
    """
    matplotlib = load_matplotlib()
    with styled(matplotlib):
        return _draw(matplotlib, rows, marked)


@contextlib.contextmanager
def styled(matplotlib: ModuleType) -> Iterator[None]:
    """Draws inside in the style of charts that go with the pictures of scenes, whatever a matplotlibrc says."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(style())
        yield


def style() -> dict[str, Any]:
    """Parameters of matplotlib for charts that go with the pictures of scenes."""
    return {
        "axes.edgecolor": LINE, "axes.facecolor": PANEL, "axes.labelcolor": FAINT, "axes.titlecolor": INK,
        "axes.labelsize": 10, "axes.titlesize": 12, "axes.titlelocation": "left", "axes.titlepad": 8,
        "axes.spines.top": False, "axes.spines.right": False, "axes.axisbelow": True,
        "axes.grid": True, "grid.color": LINE, "grid.alpha": 0.22, "grid.linewidth": 0.8,
        "xtick.color": FAINT, "ytick.color": FAINT, "xtick.labelsize": 9.5, "ytick.labelsize": 9.5,
        "legend.fontsize": 9.5, "legend.frameon": False, "legend.labelcolor": FAINT,
        "figure.facecolor": BACKGROUND,
    }  # fmt: skip


def _draw(matplotlib: ModuleType, rows: Sequence[Row], marked: Mapping[str, int]) -> NDArray[np.uint8]:
    frames = Frames(rows)
    panels = [panel for panel in PANELS if frames.has(*panel.columns)]
    lines = max(1, -(-len(panels) // 2))
    figure = matplotlib.figure.Figure((WIDTH / DPI, ROW * lines / DPI), DPI, layout="constrained")
    canvas = matplotlib.backends.backend_agg.FigureCanvasAgg(figure)
    figure.get_layout_engine().set(rect=(0.012, 0.008, 0.976, 0.992), wspace=0.05, hspace=0.05)
    grid = figure.subplots(lines, 2, squeeze=False).ravel()
    for axes in grid[len(panels) :]:
        axes.remove()
    places = {row["frame"]: at for at, row in enumerate(rows)}
    for panel, axes in zip(panels, grid, strict=False):
        axes.set_title(panel.title)
        heights = panel.draw(axes, frames, matplotlib)
        margin = 0.004 * (frames.x[-1] - frames.x[0])  # so that what is at an end is seen whole
        axes.set_xlim(frames.x[0] - margin, frames.x[-1] + margin)
        axes.xaxis.set_major_formatter(frames.tick)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=4, borderpad=0, handlelength=1.4)
        for reason, number in marked.items():
            at = places[number]
            axes.axvline(frames.x[at], color=PINK, alpha=0.28, linewidth=0.9)
            if reason in panel.marks:
                _mark(axes, number, frames.x[at], heights[at], at > 0.85 * len(rows))
    canvas.draw()
    pixels: NDArray[np.uint8] = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    return pixels


def _mark(axes: Axes, number: int, x: float, y: float, left: bool) -> None:
    axes.plot([x], [y], "o", color=PINK, markersize=6, zorder=5, clip_on=False)
    axes.annotate(
        f"frame {number:,}",
        (x, y),
        (-8 if left else 8, 3),
        textcoords="offset points",
        color=INK,
        fontsize=9.5,
        ha="right" if left else "left",
        va="bottom",
        annotation_clip=False,
    )
