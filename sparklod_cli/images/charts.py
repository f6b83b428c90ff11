"""Charts of a traversal (`traverse --plot`) and of a comparison. Only this module imports matplotlib."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from ..system.errors import SparklodError, optional_import
from ..system.units import count_of, percent_of
from ..tables.columns import Row, numbers, totals
from .pixels import BACKGROUND, FAINT, INK, LINE, write_title
from .scene_plots import PathScene, picture_of_path

#: Colours of the series: stops of the colour scales of `render.color_scales`, and pink for marks.
GREEN, BLUE, INDIGO, ORANGE, YELLOW, PINK = "#44bf70", "#2a788e", "#414487", "#ed7953", "#fde725", "#ff5c8a"

#: (N,) numbers, one for each row.
Series = NDArray[np.float64]

Axes = Any


class FrameColumns:
    """Columns of a table as arrays, along an axis of time or of frame numbers.

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
        return all(numbers(self.rows, name) for name in names)

    def column(self, name: str) -> Series:
        """Return the cells of a column, NaN where a cell is empty."""
        return np.array([np.nan if row[name] is None else row[name] for row in self.rows], np.float64)


#: Resolution in pixels per inch, and width of a figure in pixels.
DPI, WIDTH = 100, 1600

#: Background of a chart.
PANEL = "#141b24"


def load_matplotlib() -> ModuleType:
    """Import matplotlib without pyplot, whose global state belongs to the calling program."""
    with optional_import("--plot needs matplotlib", "render", package="matplotlib"):
        import matplotlib
        import matplotlib.backends.backend_agg
        import matplotlib.figure
        import matplotlib.ticker
    return matplotlib


#: Matplotlib's parameters for charts in the colours of the rendered figures.
STYLE = {
    "axes.edgecolor": LINE, "axes.facecolor": PANEL, "axes.labelcolor": FAINT, "axes.titlecolor": INK,
    "axes.labelsize": 10, "axes.titlesize": 12, "axes.titlelocation": "left", "axes.titlepad": 8,
    "axes.spines.top": False, "axes.spines.right": False, "axes.axisbelow": True,
    "axes.grid": True, "grid.color": LINE, "grid.alpha": 0.22, "grid.linewidth": 0.8,
    "xtick.color": FAINT, "ytick.color": FAINT, "xtick.labelsize": 9.5, "ytick.labelsize": 9.5,
    "legend.fontsize": 9.5, "legend.frameon": False, "legend.labelcolor": FAINT,
    "figure.facecolor": BACKGROUND,
}  # fmt: skip


def draw(lines: int, height: int, fill: Callable[[ModuleType, NDArray[Any]], None]) -> NDArray[np.uint8]:
    """Draw a figure of two columns of charts in `STYLE`, ignoring any matplotlibrc; return (H, WIDTH, 3) pixels.

    Args:
        lines: rows of charts, each `height` pixels high.
        fill: draws the charts, given matplotlib and their (2 * lines,) axes.
    """
    matplotlib = load_matplotlib()
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)
        figure = matplotlib.figure.Figure((WIDTH / DPI, height * lines / DPI), DPI, layout="constrained")
        canvas = matplotlib.backends.backend_agg.FigureCanvasAgg(figure)
        figure.get_layout_engine().set(rect=(0.012, 0.008, 0.976, 0.992), wspace=0.05, hspace=0.05)
        fill(matplotlib, figure.subplots(lines, 2, squeeze=False).ravel())
        canvas.draw()
        pixels: NDArray[np.uint8] = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    return pixels


def _figure(title: str, lines: Sequence[tuple[str, str]], height: int, *images: NDArray[np.uint8]) -> bytes:
    """Return the PNG of images of `WIDTH`, from top to bottom, below a title and lines of text with their colours."""
    head = Image.new("RGB", (WIDTH, height), BACKGROUND)
    write_title(ImageDraw.Draw(head), 1.0, title, lines)
    out = io.BytesIO()
    Image.fromarray(np.concatenate([np.asarray(head), *images])).save(out, "PNG", optimize=True)
    return out.getvalue()


#: Heights of a row of charts and of the title above them, in pixels.
COMPARISON_ROW, COMPARISON_HEAD = 420, 122

#: Colours of the budgets, in their order; with more budgets than colours they repeat.
COLORS = (INDIGO, BLUE, GREEN, YELLOW, ORANGE, PINK)

#: A budget as it was given ("5%"), and its rows, one for each frame.
BudgetRows = tuple[str, Sequence[Row]]


def plot_comparison(series: Sequence[BudgetRows], title: str) -> bytes:
    """Draw the quality of pictures by budget and along the path, and return the PNG.

    All budgets have the same frames. A chart without a value, such as popping of single views, is omitted.
    """
    groups, frames = [rows for _, rows in series], len(series[0][1])

    def fill(matplotlib: ModuleType, grid: NDArray[Any]) -> None:
        _by_budget(matplotlib, grid[0], groups, "psnr", "PSNR by budget", "dB")
        _by_budget(matplotlib, grid[1], groups, "ssim", "SSIM by budget", "")
        _by_budget(matplotlib, grid[2], groups, "edge_psnr", "PSNR of edges by budget", "dB")
        _by_frame(grid[3], series, "psnr", "PSNR along the path", "dB")
        _by_frame(grid[4], series, "worst_tile_psnr", "PSNR of the worst tile", "dB")
        _by_frame(grid[5], series, "popping", "Popping along the path", "steps of 8 bits")

    about = f"against full detail, {count_of(frames, 'frame')}, on black and on white"
    return _figure(title, [(about, FAINT)], COMPARISON_HEAD, draw(3, COMPARISON_ROW, fill))


def _by_budget(
    matplotlib: ModuleType, axes: Axes, groups: Sequence[Sequence[Row]], name: str, title: str, unit: str
) -> None:
    """Draw the mean over all frames, in total and per background, and the range of the frames."""
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
    _label(axes, title, unit, ncols=4)


def _label(axes: Axes, title: str, unit: str, **legend: Any) -> None:
    axes.set_title(title)
    axes.set_ylabel(unit)
    axes.legend(loc="lower right", borderpad=0, handlelength=1.4, **legend)


def _by_frame(axes: Axes, series: Sequence[BudgetRows], name: str, title: str, unit: str) -> None:
    if not any(numbers(rows, name) for _, rows in series):
        axes.set_visible(False)
        return
    for at, (budget, rows) in enumerate(series):
        frames = FrameColumns(rows)
        axes.plot(frames.x, frames.column(name), color=COLORS[at % len(COLORS)], linewidth=1.4, label=budget)
        axes.xaxis.set_major_formatter(frames.tick)
        axes.set_xlim(frames.x[0], frames.x[-1])
    _label(axes, title, unit, bbox_to_anchor=(1.0, 1.0), ncols=len(series))


#: Height of a row of two charts, pixels.
ROW = 255

#: Upper end of an axis over the largest value: leaves room for the labels of marked frames.
HEADROOM = 1.22


@dataclass(frozen=True)
class Panel:
    """A chart of the figure.

    Attributes:
        columns: required columns; without a number in each of them the chart is omitted.
        draw: draws into matplotlib's axes and returns (N,) heights at which frames are marked.
        marks: criteria by which frames are marked in this chart.
    """

    title: str
    columns: tuple[str, ...]
    draw: Callable[[Axes, FrameColumns, ModuleType], Series]
    marks: tuple[str, ...] = ()


def _selected(axes: Axes, frames: FrameColumns, matplotlib: ModuleType) -> Series:
    _stack(axes, frames, matplotlib, (("leaves", "leaves", GREEN), ("merged", "interior", BLUE)))
    budget = frames.column("budget")
    axes.plot(frames.x, budget, color=YELLOW, linewidth=1.4, label="budget")
    axes.set_ylim(0, max(axes.get_ylim()[1], 1.05 * float(np.nanmax(budget))))
    return frames.column("selected")


def _frustum(axes: Axes, frames: FrameColumns, matplotlib: ModuleType) -> Series:
    parts = (("inside", "in_frustum", GREEN), ("outside", "outside", BLUE), ("behind", "behind", INDIGO))
    _stack(axes, frames, matplotlib, parts)
    return frames.column("in_frustum")


def _stack(axes: Axes, frames: FrameColumns, matplotlib: ModuleType, parts: Sequence[tuple[str, str, str]]) -> None:
    floor = np.zeros(len(frames.x))
    for label, name, color in parts:
        top = floor + np.nan_to_num(frames.column(name))
        axes.fill_between(frames.x, floor, top, color=color, linewidth=0, label=label)
        floor = top
    axes.set_ylim(0, max(float(floor.max()) * 1.03, 1))
    _use_whole_ticks(axes, matplotlib)
    axes.set_ylabel("splats")


def _start_at_zero(axes: Axes, values: Series) -> None:
    axes.set_ylim(0, HEADROOM * float(np.nanmax(values)) or 1)


def _use_whole_ticks(axes: Axes, matplotlib: ModuleType, unit: str = "") -> None:
    """Give the vertical axis ticks at whole numbers, with k and M for thousands and millions."""
    axes.yaxis.set_major_locator(matplotlib.ticker.MaxNLocator(6, steps=[1, 2, 5, 10], integer=True, min_n_ticks=1))
    axes.yaxis.set_major_formatter(matplotlib.ticker.EngFormatter(unit, sep=" " if unit else ""))


def _second_line(axes: Axes, frames: FrameColumns, values: Series, label: str) -> Axes:
    """Draw a green line against a second vertical axis, which is returned, and add it to the legend of the first."""
    second = axes.twinx()
    second.grid(False)
    second.plot(frames.x, values, color=GREEN, linewidth=1.6)
    axes.plot([], [], color=GREEN, linewidth=1.6, label=label)
    _start_at_zero(second, values)
    second.set_ylabel(label)
    return second


def _pixel_scale(axes: Axes, frames: FrameColumns, matplotlib: ModuleType) -> Series:
    with np.errstate(divide="ignore", invalid="ignore"):
        values = frames.column("pixel_scale_min") / frames.column("pixel_scale_limit")
    values[~((values > 0) & np.isfinite(values))] = np.nan
    axes.plot(frames.x, values, color=ORANGE, linewidth=1.4)
    axes.axhline(1, color=FAINT, linewidth=1, linestyle=(0, (4, 3)), label="limit")
    axes.set_yscale("log", base=2)
    axes.yaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    # At least from half to twice the limit, so that values close to the limit look close to it.
    finite = [*values[np.isfinite(values)], 1.0]
    axes.set_ylim(min(0.5, 0.8 * min(finite)), max(2.0, 1.6 * max(finite)))
    axes.set_ylabel("times the limit")
    return values


def _churn(axes: Axes, frames: FrameColumns, matplotlib: ModuleType) -> Series:
    values = frames.column("churn")
    axes.fill_between(frames.x, 0, values, color=ORANGE, alpha=0.25, linewidth=0)
    axes.plot(frames.x, values, color=ORANGE, linewidth=1.2)
    axes.yaxis.set_major_formatter(lambda value, place: percent_of(value))
    _start_at_zero(axes, values)
    axes.set_ylabel("share of splats")
    return values


def _fetched(axes: Axes, frames: FrameColumns, matplotlib: ModuleType) -> Series:
    values = frames.column("bytes_new")
    some = values > 0
    axes.vlines(frames.x[some], 0, values[some], color=ORANGE, linewidth=1.8, label="per frame")
    _use_whole_ticks(axes, matplotlib, "B")
    _start_at_zero(axes, values)
    axes.set_ylabel("per frame")
    _use_whole_ticks(_second_line(axes, frames, np.nancumsum(values), "total"), matplotlib, "B")
    return values


def _cache(axes: Axes, frames: FrameColumns, matplotlib: ModuleType) -> Series:
    values = frames.column("missing")
    axes.fill_between(frames.x, 0, values, color=ORANGE, alpha=0.35, linewidth=0)
    axes.plot(frames.x, values, color=ORANGE, linewidth=1.2, label="nodes missing")
    _start_at_zero(axes, values)
    _use_whole_ticks(axes, matplotlib)
    axes.set_ylabel("nodes missing")
    chunks = _second_line(axes, frames, frames.column("chunks_resident"), "chunks resident")
    chunks.yaxis.set_major_locator(matplotlib.ticker.MaxNLocator(5, integer=True))
    return values


def _depths(axes: Axes, frames: FrameColumns, matplotlib: ModuleType) -> Series:
    mean, most = frames.column("level_mean"), frames.column("level_max")
    axes.fill_between(frames.x, frames.column("level_min"), most, color=BLUE, alpha=0.5, linewidth=0, label="range")
    axes.plot(frames.x, mean, color=GREEN, linewidth=1.6, label="mean")
    axes.yaxis.set_major_locator(matplotlib.ticker.MaxNLocator(6, integer=True))
    _start_at_zero(axes, most)
    if frames.has("pixel_scale_limit"):
        axes.set_ylabel("edges from the root")
    else:  # only trees have such a limit
        axes.set_title("Detail levels of the cut")
        axes.set_ylabel("level")
    return mean


def _line(name: str, unit: str, color: str) -> Callable[[Axes, FrameColumns, ModuleType], Series]:
    def draw(axes: Axes, frames: FrameColumns, matplotlib: ModuleType) -> Series:
        values = frames.column(name)
        axes.plot(frames.x, values, color=color, linewidth=1.3)
        _start_at_zero(axes, values)
        axes.set_ylabel(unit)
        return values

    return draw


PANELS = (
    Panel("Splats drawn", ("leaves", "interior", "budget"), _selected),
    Panel("Inside or outside the frustum", ("in_frustum", "outside", "behind"), _frustum),
    Panel("Depth of the cut", ("level_min", "level_mean", "level_max"), _depths),
    Panel("Pixel scale", ("pixel_scale_min", "pixel_scale_limit"), _pixel_scale, ("coarsest",)),
    Panel("Churn", ("churn",), _churn, ("churn",)),
    Panel("Bytes fetched", ("bytes_new",), _fetched, ("bytes",)),
    Panel("Chunk cache", ("missing", "chunks_resident"), _cache, ("missing",)),
    Panel(
        "Time until the cut is resident", ("complete_in_s",), _line("complete_in_s", "seconds", ORANGE), ("incomplete",)
    ),
    Panel("Overdraw", ("overdraw_estimate",), _line("overdraw_estimate", "splats a pixel", ORANGE), ("overdraw",)),
    Panel("Time to find the cut", ("traverse_ms",), _line("traverse_ms", "milliseconds", GREEN)),
)


#: Labels of the criteria by which frames are marked (`simulation.results.MOMENTS`).
LABELS = {
    "churn": "most churn",
    "bytes": "most bytes fetched",
    "coarsest": "coarsest",
    "missing": "most missing",
    "incomplete": "longest until resident",
    "overdraw": "most overdraw",
}


def plot(
    rows: Iterable[Row], marked: Mapping[str, int], title: str, scene: PathScene | None = None
) -> tuple[bytes, str | None]:
    """Draw charts of a traversal, with its path below them, and return the PNG.

    Args:
        rows: table of the traversal; rows of single instances are ignored.
        marked: numbers of notable frames by criterion, a key of `LABELS`.

    Returns:
        The PNG, and the reason why the picture of the path is missing, None if it is not.
    """
    frames = totals(rows)
    if not frames:
        raise SparklodError("there is nothing to draw: the path has no frames")
    lines = [(_about(frames), FAINT)]
    if marked:
        lines.append((", ".join(f"{LABELS[reason]}: frame {number:,}" for reason, number in marked.items()), PINK))
    title = "".join(mark if mark.isprintable() else "\N{REPLACEMENT CHARACTER}" for mark in title)
    title = title if len(title) <= 100 else f"{title[:99]}…"
    images, note = [draw_charts(frames, marked)], None
    if scene is not None:
        try:
            images.append(np.asarray(Image.open(io.BytesIO(picture_of_path(scene))).convert("RGB")))
        except SparklodError as error:
            note = f"drawn without the picture of the path: {error}"
    return _figure(title, lines, 96 + 26 * len(lines), *images), note


def _about(frames: Sequence[Row]) -> str:
    said = [count_of(len(frames), "frame")]
    times = numbers(frames, "time_s")
    if len(set(times)) > 1:
        said.append(f"{times[-1] - times[0]:.3f} s")
    sizes = list(dict.fromkeys((row["width"], row["height"]) for row in frames if row["width"] and row["height"]))
    if sizes:
        said.append(f"{sizes[0][0]} x {sizes[0][1]} pixels" + (" and other sizes" if len(sizes) > 1 else ""))
    budgets = sorted(set(numbers(frames, "budget")))
    if budgets:
        ends = " to ".join(f"{each:,}" for each in dict.fromkeys([budgets[0], budgets[-1]]))
        said.append(f"a budget of {ends} splats")
    return ", ".join(said)


def draw_charts(rows: Sequence[Row], marked: Mapping[str, int]) -> NDArray[np.uint8]:
    """Draw the charts of a path, of at least one frame, except those of empty columns; return (H, WIDTH, 3) pixels.

    `marked` are numbers of notable frames by criterion (`Panel.marks`).
    """
    frames = FrameColumns(rows)
    panels = [panel for panel in PANELS if frames.has(*panel.columns)]

    def fill(matplotlib: ModuleType, grid: NDArray[Any]) -> None:
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
                    point, text = (frames.x[at], heights[at]), f"frame {number:,}"
                    axes.plot(*point, "o", color=PINK, markersize=6, zorder=5, clip_on=False)
                    side, away = ("right", -8) if at > 0.85 * len(rows) else ("left", 8)
                    look = {"color": INK, "fontsize": 9.5, "ha": side, "va": "bottom", "annotation_clip": False}
                    axes.annotate(text, point, (away, 3), textcoords="offset points", **look)

    return draw(max(1, -(-len(panels) // 2)), ROW, fill)
