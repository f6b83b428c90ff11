"""Charts of a traversal: its columns over time, as small multiples. The only module that imports matplotlib."""

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

#: Resolution in pixels an inch; width of the figure and height of a row of two charts, in pixels.
DPI, WIDTH, ROW = 100, 1600, 255

#: Upper end of an axis over the largest value: leaves room for the labels of marked frames.
HEADROOM = 1.22

#: Colours of the series: stops of the colour scales of `render.color_scales`, and pink for marks.
GREEN, BLUE, INDIGO, ORANGE, YELLOW, PINK = "#44bf70", "#2a788e", "#414487", "#ed7953", "#fde725", "#ff5c8a"

PANEL = "#141b24"

Series = NDArray[np.float64]
Axes = Any


def load_matplotlib() -> ModuleType:
    """Imports matplotlib without pyplot, whose global state belongs to the calling program.

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
    """Columns of rows as arrays, along an axis of time or of frame numbers.

    Attributes:
        x: (N,) seconds; frame numbers where the rows have no times.
    """

    def __init__(self, rows: Sequence[Row]) -> None:
        times = numbers(rows, "time_s")
        timed = len(times) == len(rows) and len(set(times)) > 1
        self.rows, self._timed = rows, timed
        self.x = np.array(times if timed else numbers(rows, "frame"), np.float64)
        if len(rows) == 1:  # two points, one frame apart, so that a line can be seen
            self.rows, self.x = [rows[0], rows[0]], self.x + np.array([-0.5, 0.5])

    def tick(self, value: float, place: int) -> str:
        """The label of a tick of the axis."""
        if self._timed:
            return f"{value:g} s"
        return f"frame {value:,.0f}" if value == round(value) else ""

    def has(self, *names: str) -> bool:
        """Whether each of these columns has a number in some row."""
        return all(numbers(self.rows, name) for name in names)

    def column(self, name: str) -> Series:
        """(N,) values of a column; NaN for empty cells."""
        return np.array([np.nan if row[name] is None else row[name] for row in self.rows], np.float64)

    def ratio(self, name: str, of: str) -> Series:
        """(N,) one column over another; NaN where a cell is empty, or the other is 0."""
        above, below = self.column(name), self.column(of)
        return np.divide(above, below, out=np.full(len(above), np.nan), where=below != 0)


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
    axes.set_ylabel("share of both frames' splats")
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
    axes.set_ylabel("edges from the root")
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
    """Applies `style` inside the context, whatever a matplotlibrc says."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(style())
        yield


def style() -> dict[str, Any]:
    """matplotlib's parameters for charts in the colours of the rendered figures."""
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
        margin = 0.004 * (frames.x[-1] - frames.x[0])  # so that markers at either end are not cut
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
