"""Helpers for charts of tables: time series, colours, matplotlib figures. No other module imports matplotlib."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from ..images.pixels import BACKGROUND, FAINT, INK, LINE, write_title
from ..system.optional import optional_import
from ..system.units import percent_of
from ..tables.assertions import numbers
from ..tables.columns import Row

#: Colours of the series: stops of the colour scales of `render.color_scales`, and pink for marks.
GREEN, BLUE, INDIGO, ORANGE, YELLOW, PINK = "#44bf70", "#2a788e", "#414487", "#ed7953", "#fde725", "#ff5c8a"

#: (N,) numbers, one for each row.
Series = NDArray[np.float64]


class FrameColumns:
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


#: Resolution in pixels an inch, and width of a figure in pixels.
DPI, WIDTH = 100, 1600

#: Ground of a chart.
PANEL = "#141b24"

Axes = Any


def load_matplotlib() -> ModuleType:
    """Import matplotlib without pyplot, whose global state belongs to the calling program.

    Raises:
        SparklodError: it is not installed.
    """
    with optional_import("--plot needs matplotlib", "render", package="matplotlib"):
        import matplotlib
        import matplotlib.backends.backend_agg
        import matplotlib.figure
        import matplotlib.ticker
    return matplotlib


def style() -> dict[str, Any]:
    """Matplotlib's parameters for charts in the colours of the rendered figures."""
    return {
        "axes.edgecolor": LINE, "axes.facecolor": PANEL, "axes.labelcolor": FAINT, "axes.titlecolor": INK,
        "axes.labelsize": 10, "axes.titlesize": 12, "axes.titlelocation": "left", "axes.titlepad": 8,
        "axes.spines.top": False, "axes.spines.right": False, "axes.axisbelow": True,
        "axes.grid": True, "grid.color": LINE, "grid.alpha": 0.22, "grid.linewidth": 0.8,
        "xtick.color": FAINT, "ytick.color": FAINT, "xtick.labelsize": 9.5, "ytick.labelsize": 9.5,
        "legend.fontsize": 9.5, "legend.frameon": False, "legend.labelcolor": FAINT,
        "figure.facecolor": BACKGROUND,
    }  # fmt: skip


def draw(lines: int, height: int, fill: Callable[[ModuleType, NDArray[Any]], None]) -> NDArray[np.uint8]:
    """(H, WIDTH, 3) a figure in the style of this package, whatever a matplotlibrc says.

    Args:
        fill: draws into the axes of the charts, (2 lines,), given matplotlib and these.

    Raises:
        SparklodError: matplotlib is not installed.
    """
    matplotlib = load_matplotlib()
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(style())
        figure = matplotlib.figure.Figure((WIDTH / DPI, height * lines / DPI), DPI, layout="constrained")
        canvas = matplotlib.backends.backend_agg.FigureCanvasAgg(figure)
        figure.get_layout_engine().set(rect=(0.012, 0.008, 0.976, 0.992), wspace=0.05, hspace=0.05)
        fill(matplotlib, figure.subplots(lines, 2, squeeze=False).ravel())
        canvas.draw()
        pixels: NDArray[np.uint8] = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    return pixels


def head(title: str, lines: Sequence[tuple[str, str]], height: int) -> Image.Image:
    """Title of a figure and lines below it, each a text and a colour."""
    image = Image.new("RGB", (WIDTH, height), BACKGROUND)
    write_title(ImageDraw.Draw(image), 1.0, title, lines)
    return image


def stacked(*images: Image.Image | NDArray[np.uint8]) -> bytes:
    """Return the PNG of images of the same width, stacked from top to bottom."""
    out = io.BytesIO()
    Image.fromarray(np.concatenate([np.asarray(image) for image in images])).save(out, "PNG", optimize=True)
    return out.getvalue()


#: Heights of a row of charts and of the title above them, in pixels.
COMPARISON_ROW, COMPARISON_HEAD = 420, 122

#: Colours of the budgets, in their order; with more budgets than colours they repeat.
COLORS = (INDIGO, BLUE, GREEN, YELLOW, ORANGE, PINK)

#: The rows of a budget, one for each frame, and the budget as it was given ("5%").
BudgetRows = tuple[str, Sequence[Row]]


def plot_comparison(series: Sequence[BudgetRows], title: str) -> bytes:
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
    return stacked(head(title, [(about, FAINT)], COMPARISON_HEAD), draw(3, COMPARISON_ROW, fill))


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


def _by_frame(axes: Axes, series: Sequence[BudgetRows], name: str, title: str, unit: str) -> None:
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
